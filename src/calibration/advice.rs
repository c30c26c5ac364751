//! Where boards were shown, in; what is missing, in words, out.

use super::Calibration;
use nalgebra::{Isometry3, Vector2};

/// Regions along either side of an image.
const REGIONS: usize = 3;
/// What they are called, row by row.
const NAMES: [&str; REGIONS * REGIONS] = [
    "upper left corner",
    "upper edge",
    "upper right corner",
    "left edge",
    "middle",
    "right edge",
    "lower left corner",
    "lower edge",
    "lower right corner",
];
/// Points that a region needs.
const LEAST_POINTS: usize = 12;
/// Tilt, degrees, that counts as one.
const TILT_DEG: f64 = 12.0;
/// Farthest distance over nearest that tells focal lengths and distances apart.
const DISTANCE_RATIO: f64 = 1.35;
/// Views with which a calibration is usually good.
const GOOD_VIEWS: usize = 15;
/// Points noisier than this, px, are so for a reason.
const NOISY_PX: f64 = 0.5;
/// A focal length's σ as a share of it that is worth more views.
const FOCAL_SHARE: f64 = 1e-3;

/// Where boards were seen and how they stood.
#[derive(Clone, Debug, Default)]
pub struct Coverage {
    /// Points in each region, row by row, left and right.
    points: [[usize; REGIONS * REGIONS]; 2],
    /// Turned about the upright axis and about the level one, degrees, a pair a view.
    tilts_deg: Vec<[f64; 2]>,
    /// Distance of the board's first point, m, one a view.
    depths_m: Vec<f64>,
}

impl Coverage {
    /// Adds a point that a camera (0 left, 1 right) saw.
    pub fn add_point(&mut self, side: usize, px: &Vector2<f64>, size_px: (u32, u32)) {
        let region = |at: f64, size: u32| {
            let share = (at + 0.5) / f64::from(size.max(1)) * REGIONS as f64;
            (share.max(0.0) as usize).min(REGIONS - 1)
        };
        self.points[side][region(px.y, size_px.1) * REGIONS + region(px.x, size_px.0)] += 1;
    }

    /// Adds a placement of the board.
    pub fn add_placement(&mut self, left_from_board: &Isometry3<f64>) {
        self.tilts_deg.push(tilts_deg(left_from_board));
        self.depths_m.push(left_from_board.translation.z);
    }

    /// How many views there are.
    #[must_use]
    pub fn views(&self) -> usize {
        self.tilts_deg.len()
    }

    /// What is missing, each a phrase for a sentence such as "show the board …".
    #[must_use]
    pub fn missing(&self) -> Vec<String> {
        let mut missing = Vec::new();
        for (side, name) in ["left", "right"].iter().enumerate() {
            let empty: Vec<&str> = (0..NAMES.len())
                .filter(|&i| self.points[side][i] < LEAST_POINTS)
                .map(|i| NAMES[i])
                .collect();
            if !empty.is_empty() {
                missing.push(format!("in the {name} image's {}", listed(&empty)));
            }
        }
        for (axis, ways) in [
            ["its left side nearer", "its right side nearer"],
            ["its upper side nearer", "its lower side nearer"],
        ]
        .iter()
        .enumerate()
        {
            let has = |sign: f64| {
                self.tilts_deg
                    .iter()
                    .any(|tilts| sign * tilts[axis] > TILT_DEG)
            };
            let wanted: Vec<&str> = [1.0, -1.0]
                .iter()
                .zip(ways)
                .filter(|(sign, _)| !has(**sign))
                .map(|(_, way)| *way)
                .collect();
            if !wanted.is_empty() {
                missing.push(format!("tilted, {}", listed(&wanted)));
            }
        }
        let (near, far) = self
            .depths_m
            .iter()
            .fold((f64::INFINITY, 0.0_f64), |(near, far), &z| {
                (near.min(z), far.max(z))
            });
        if far < DISTANCE_RATIO * near {
            missing.push("nearer and farther: at least a third apart".to_owned());
        }
        missing
    }
}

/// How far the board is turned about the upright and about the level axis, degrees: above 0 where its left, or its
/// upper, side is nearer.
fn tilts_deg(left_from_board: &Isometry3<f64>) -> [f64; 2] {
    let mut normal = left_from_board.rotation * nalgebra::Vector3::z();
    // Whichever way its axes run, the board is seen from the front.
    if normal.z < 0.0 {
        normal = -normal;
    }
    // A plane's depth grows to the right where its normal points left.
    [
        (-normal.x).atan2(normal.z).to_degrees(),
        (-normal.y).atan2(normal.z).to_degrees(),
    ]
}

/// "a", "a and b", "a, b and c".
fn listed(words: &[&str]) -> String {
    match words {
        [] => String::new(),
        [only] => (*only).to_owned(),
        [most @ .., last] => format!("{} and {last}", most.join(", ")),
    }
}

impl Calibration {
    /// Where its boards were seen and how they stood.
    #[must_use]
    pub fn coverage(&self) -> Coverage {
        let mut coverage = Coverage::default();
        let sizes = [&self.rig.left, &self.rig.right].map(|camera| (camera.width, camera.height));
        for residual in &self.residuals {
            coverage.add_point(residual.side, &residual.seen_px, sizes[residual.side]);
        }
        for view in &self.views {
            coverage.add_placement(&view.left_from_board);
        }
        coverage
    }

    /// What would make it better, a sentence each; empty where nothing stands out.
    #[must_use]
    pub fn advice(&self) -> Vec<String> {
        let mut advice: Vec<String> = self
            .coverage()
            .missing()
            .iter()
            .map(|what| format!("Show the board {what}."))
            .collect();
        if self.views.len() < GOOD_VIEWS {
            advice.push(format!(
                "Take more views: {} are few, {GOOD_VIEWS} and more average out what is wrong with each.",
                self.views.len()
            ));
        }
        if self.sigma_px > NOISY_PX {
            advice.push(format!(
                "The points are off by {:.2} px: look for blur, a moving board, too little light, a board that is not flat, or a lens that wants more coefficients.",
                self.sigma_px
            ));
        }
        if self.is_inflated {
            advice.push(format!(
                "Views contradict each other {:.1} times as much as their points' noise explains, and the covariance has grown by as much: is the board flat and stiff, were both images taken at one instant, does the lens want more coefficients?",
                self.between_views
            ));
        }
        let camera = [("left", &self.rig.left, 0), ("right", &self.rig.right, 12)];
        for (side, camera, slot) in camera {
            let share = self.sigma(slot) / camera.focal_px.x;
            if share > FOCAL_SHARE {
                advice.push(format!(
                    "The {side} focal length is known to {:.2} % only: more views that are tilted by 30° and more tell it best.",
                    100.0 * share
                ));
            }
        }
        if self.board.sigma_square_m == 0.0 {
            advice.push(
                "The squares' size is taken as exact. Measure over as many squares as there are, and state its uncertainty: the baseline, and with it every distance, is no better known.".to_owned(),
            );
        }
        advice
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn what_is_missing_is_named() {
        let size = (640, 480);
        let mut coverage = Coverage::default();
        for side in 0..2 {
            for y in 0..48 {
                for x in 0..64 {
                    let px = Vector2::new(f64::from(10 * x), f64::from(10 * y));
                    // The right image's upper right corner stays empty.
                    if side == 0 || px.x < 420.0 || px.y > 170.0 {
                        coverage.add_point(side, &px, size);
                    }
                }
            }
        }
        let at = |z: f64, tilt: Vector3<f64>| Isometry3::new(Vector3::new(0.0, 0.0, z), tilt);
        coverage.add_placement(&at(1.0, Vector3::zeros()));
        coverage.add_placement(&at(1.1, Vector3::x() * 0.4));
        coverage.add_placement(&at(1.1, Vector3::x() * -0.4));
        coverage.add_placement(&at(1.1, Vector3::y() * -0.4));
        assert_eq!(
            coverage.missing(),
            [
                "in the right image's upper right corner",
                "tilted, its right side nearer",
                "nearer and farther: at least a third apart"
            ]
        );
        coverage.add_placement(&at(1.5, Vector3::y() * 0.4));
        assert_eq!(
            coverage.missing(),
            ["in the right image's upper right corner"]
        );
    }

    #[test]
    fn a_board_whose_left_side_is_nearer_says_so() {
        let board = Isometry3::rotation(Vector3::y() * -0.4);
        // Its point to the right lies deeper.
        assert!((board * nalgebra::Point3::new(1.0, 0.0, 0.0)).z > 0.0);
        assert!(tilts_deg(&board)[0] > 20.0);
    }
}
