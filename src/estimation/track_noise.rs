//! Residuals of the same tracks over several pairs in; how much of their noise they keep out.
//!
//! A pair's pixels serve two motions: as the present view of one and as the previous view of the
//! next. If both uses share their noise (*reuse* κ: 1 where a keypoint is detected once, 0 where it
//! is measured afresh for every motion), the errors of the motions are correlated, and largely
//! cancel. If part of the noise stays with a track from pair to pair (*persistence* λ), motions are
//! better than their pixels, for what is common to both views cancels too. Neither is assumed here:
//! residuals tell.
//!
//! In units of σ, with `p` the noise of the previous view and `n` that of the present one, the model
//! is `Cov(pₖ, nₖ) = λ` within a motion k, and over two motions `Cov(nₖ, pₖ₊₁) = κ`,
//! `Cov(pₖ, pₖ₊₁) = Cov(nₖ, nₖ₊₁) = Cov(pₖ, nₖ₊₁) = λ`, all times the variance factor. A residual is
//! the noise projected off the point's three directions; products of residuals are linear in the
//! unknowns, which follow by least squares over tracks and pairs.

use super::bundle::TrackedPoint;
use super::influence::Influence;
use super::sight;
use super::two_frame::TwoFrameMotion;
use crate::geometry::product::{product, product_transposed};
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector4};

type Matrix8 = SMatrix<f64, 8, 8>;
type Vector8 = SVector<f64, 8>;

/// What is known of the tracks' noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackNoise {
    /// Variance of the pixels over what their σ say.
    pub variance_factor: f64,
    /// Share of the variance that a track keeps from pair to pair: λ.
    pub persistence: f64,
    /// Share of the variance that both uses of one pair's pixels have in common: κ.
    pub reuse: f64,
}

impl TrackNoise {
    /// Noise that is new in every pair, and the same in both uses of a pair: that of a detector.
    #[must_use]
    pub fn of_detector(variance_factor: f64) -> Self {
        Self {
            variance_factor,
            persistence: 0.0,
            reuse: 1.0,
        }
    }

    /// What one track's noise contributes to the covariance of a motion; `influence` is
    /// [whitened](Influence::whitened).
    #[must_use]
    pub fn covariance(&self, influence: &Influence) -> Matrix6<f64> {
        let (p, q) = (&influence.by_prev, &influence.by_now);
        let own = product_transposed(p, p) + product_transposed(q, q);
        let shared = product_transposed(p, q) * self.persistence;
        se3::symmetric(&((own + shared + shared.transpose()) * self.variance_factor))
    }
}

/// A track's residual in one motion, in σ, and the projection that made it of the noise.
#[derive(Clone, Copy, Debug)]
pub struct TrackResidual {
    residual: Vector8,
    projector: Matrix8,
}

impl TrackResidual {
    /// The residual of a track at a motion; its point need not be at its optimum.
    ///
    /// `None` where a camera cannot see the point.
    #[must_use]
    pub fn new(
        rig: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        point: &TrackedPoint,
    ) -> Option<Self> {
        let y = &point.inverse_depth;
        let prev = sight::linearise(rig, &Isometry3::identity(), y)?;
        let now = sight::linearise(rig, &prev_from_now.inverse(), y)?;
        let mut jacobian = SMatrix::<f64, 8, 3>::zeros();
        let mut gap = Vector8::zeros();
        let scaled = |v: Vector4<f64>, sigma: &Vector4<f64>| v.component_div(sigma);
        for j in 0..3 {
            let column = scaled(prev.by_point.column(j).into(), &point.prev.sigma_px);
            jacobian.fixed_view_mut::<4, 1>(0, j).copy_from(&column);
            let column = scaled(now.by_point.column(j).into(), &point.now.sigma_px);
            jacobian.fixed_view_mut::<4, 1>(4, j).copy_from(&column);
        }
        gap.fixed_rows_mut::<4>(0)
            .copy_from(&scaled(point.prev.px - prev.px, &point.prev.sigma_px));
        gap.fixed_rows_mut::<4>(4)
            .copy_from(&scaled(point.now.px - now.px, &point.now.sigma_px));
        let transposed = jacobian.transpose();
        let normal: Matrix3<f64> = product(&transposed, &jacobian);
        let hat = product(
            &jacobian,
            &product(&normal.cholesky()?.inverse(), &transposed),
        );
        let projector = Matrix8::identity() - hat;
        Some(Self {
            residual: product(&projector, &gap),
            projector,
        })
    }

    /// Its square, σ².
    #[must_use]
    pub fn squares(&self) -> f64 {
        self.residual.norm_squared()
    }
}

/// What the meter believes of persistence and reuse before it has seen anything is worth so many
/// tracks; what it believes of the variance, one: a single pair tells that well.
const PRIOR_TRACKS: f64 = 300.0;
/// Of what was seen, so much counts one pair later: a memory of fifty pairs.
const MEMORY: f64 = 0.98;
/// Squared residuals beyond this many times the variance factor are blunders (five degrees of
/// freedom). Tracks come here judged; a narrow gate on top would cut off the tails that are noise.
const GATE: f64 = 100.0;

/// Measures the noise of one motion's tracks after the other.
#[derive(Clone, Debug)]
pub struct TrackNoiseWatch {
    meter: TrackNoiseMeter,
    /// Of the motion before, by the tracks' numbers.
    residuals: Vec<(u64, TrackResidual)>,
    motion_freedom: f64,
}

impl TrackNoiseWatch {
    /// A watch that expects a detector's noise; motions have so many degrees of freedom.
    #[must_use]
    pub fn new(motion_freedom: usize) -> Self {
        Self {
            meter: TrackNoiseMeter::new(&TrackNoise::of_detector(1.0)),
            residuals: Vec::new(),
            motion_freedom: motion_freedom as f64,
        }
    }

    /// Forgets which tracks there were, not what was learnt of their noise.
    pub fn forget_tracks(&mut self) {
        self.residuals.clear();
    }

    /// Takes note of a motion's residuals; what its tracks' noise is. `ids` and `points` are those
    /// that the motion was estimated from, ids rising.
    pub fn observe(
        &mut self,
        rig: &StereoRig,
        motion: &TwoFrameMotion,
        ids: &[u64],
        points: &[TrackedPoint],
    ) -> TrackNoise {
        self.meter.age();
        let residuals: Vec<(u64, TrackResidual)> = motion
            .tracks
            .iter()
            .filter_map(|&i| {
                let residual = TrackResidual::new(rig, &motion.reprojected, &points[i as usize])?;
                Some((ids[i as usize], residual))
            })
            .collect();
        let mut before = self.residuals.iter().peekable();
        for (id, residual) in &residuals {
            while before.next_if(|(other, _)| other < id).is_some() {}
            let before = before.next_if(|(other, _)| other == id);
            self.meter
                .observe(before.map(|(_, before)| before), residual);
        }
        // The motion, too, was fitted to the residuals.
        let count = 5.0 * residuals.len().max(2) as f64;
        let fitted = count / (count - self.motion_freedom);
        self.residuals = residuals;
        let mut noise = self.meter.noise();
        noise.variance_factor *= fitted;
        noise
    }
}

/// Measures the noise of tracks.
#[derive(Clone, Debug)]
pub struct TrackNoiseMeter {
    /// Normal equations of s², s² λ, s² κ.
    normal: Matrix3<f64>,
    right: Vector3<f64>,
}

impl TrackNoiseMeter {
    /// A meter that believes `expected` until residuals tell otherwise.
    #[must_use]
    pub fn new(expected: &TrackNoise) -> Self {
        let mut meter = Self {
            normal: Matrix3::zeros(),
            right: Vector3::zeros(),
        };
        // s² as from one track's five squares; s² λ and s² κ relative to it, whatever it is.
        meter.add(5.0 * expected.variance_factor, &Vector3::new(5.0, 0.0, 0.0));
        let weight = (5.0 * PRIOR_TRACKS).sqrt();
        meter.add(
            0.0,
            &(Vector3::new(-expected.persistence, 1.0, 0.0) * weight),
        );
        meter.add(0.0, &(Vector3::new(-expected.reuse, 0.0, 1.0) * weight));
        meter
    }

    /// Lets go of a little of what was seen: to be called once a pair.
    pub fn age(&mut self) {
        self.normal *= MEMORY;
        self.right *= MEMORY;
    }

    /// Takes note of a track's residual, and of that of the same track in the motion before.
    pub fn observe(&mut self, before: Option<&TrackResidual>, now: &TrackResidual) {
        let limit = GATE * self.noise().variance_factor;
        if now.squares() > limit {
            return;
        }
        // Within one motion the noise's covariance is I + λX, X swapping its halves; R is the
        // projector. E[rᵀr] = tr(R) + λ tr(RX), 2 E[p·n] = tr(RX) + λ tr(RXRX).
        let r = &now.projector;
        let block = |i: usize, j: usize| r.fixed_view::<4, 4>(4 * i, 4 * j).into_owned();
        let swapped = 2.0 * block(0, 1).trace();
        let twice = 2.0
            * (block(0, 1).component_mul(&block(1, 0).transpose()).sum()
                + block(0, 0).component_mul(&block(1, 1)).sum());
        self.add(now.squares(), &Vector3::new(r.trace(), swapped, 0.0));
        let (p, n) = halves(&now.residual);
        self.add(2.0 * p.dot(&n), &Vector3::new(swapped, twice, 0.0));
        if let Some(before) = before.filter(|before| before.squares() <= limit) {
            self.observe_pair(before, now);
        }
    }

    /// Products of a track's residuals in two consecutive motions.
    fn observe_pair(&mut self, before: &TrackResidual, now: &TrackResidual) {
        let (bp, bn) = halves(&before.residual);
        let (np, nn) = halves(&now.residual);
        let (r, s) = (&before.projector, &now.projector);
        // tr(Tᵀ R M S) of the four 4×4 blocks T = (a, b) and M = (c, d): Σ R_ac S_db.
        let trace = |a: usize, b: usize, c: usize, d: usize| {
            let left = r.fixed_view::<4, 4>(4 * a, 4 * c);
            let right = s.fixed_view::<4, 4>(4 * d, 4 * b);
            left.component_mul(&right.transpose()).sum()
        };
        for (product, a, b) in [
            (bn.dot(&np), 1, 0),
            (bp.dot(&np), 0, 0),
            (bn.dot(&nn), 1, 1),
            (bp.dot(&nn), 0, 1),
        ] {
            let lasting = trace(a, b, 0, 0) + trace(a, b, 1, 1) + trace(a, b, 0, 1);
            let reused = trace(a, b, 1, 0);
            self.add(product, &Vector3::new(0.0, lasting, reused));
        }
    }

    fn add(&mut self, value: f64, by: &Vector3<f64>) {
        self.normal += by * by.transpose();
        self.right += by * value;
    }

    /// What is known so far.
    #[must_use]
    pub fn noise(&self) -> TrackNoise {
        let solved = self
            .normal
            .cholesky()
            .map_or_else(Vector3::zeros, |normal| normal.solve(&self.right));
        let variance_factor = solved.x.max(1e-6);
        TrackNoise {
            variance_factor,
            persistence: (solved.y / variance_factor).clamp(0.0, 0.95),
            reuse: (solved.z / variance_factor).clamp(0.0, 1.0),
        }
    }
}

fn halves(r: &Vector8) -> (Vector4<f64>, Vector4<f64>) {
    (
        r.fixed_rows::<4>(0).into_owned(),
        r.fixed_rows::<4>(4).into_owned(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::synthetic::{normal4, random, rig, tracks};
    use nalgebra::Vector2;

    /// Tracks over three pairs; each motion's uses of the pixels have noise of their own, as `noise`
    /// says.
    fn measure(noise: &TrackNoise, seed: u64) -> TrackNoise {
        let rig = rig();
        let mut rng = random(seed);
        let step = crate::estimation::synthetic::step();
        let mut meter = TrackNoiseMeter::new(&TrackNoise::of_detector(1.0));
        let s = noise.variance_factor.sqrt();
        for _ in 0..60 {
            let first = tracks(&rig, &step, 100, [4.0, 40.0], 0.0, &mut rng);
            for p in &first {
                let y = p.inverse_depth;
                let two = (step * step).inverse();
                let Some(px) = crate::estimation::seen_at(&rig, &two, &y) else {
                    continue;
                };
                if !rig.right.contains(&Vector2::new(px[2], px[3]), 0.0) {
                    continue;
                }
                // λ of the variance lasts; of the rest, κ is such that both uses share it.
                let lasting = normal4(&mut rng) * noise.persistence.sqrt();
                let rest = 1.0 - noise.persistence;
                let same = (noise.reuse - noise.persistence).max(0.0) / rest;
                let common = normal4(&mut rng) * (rest * same).sqrt();
                let mut own = || normal4(&mut rng) * (rest * (1.0 - same)).sqrt();
                let sigma = p.prev.sigma_px;
                let noisy = |px: &Vector4<f64>, n: Vector4<f64>| px + (n * s).component_mul(&sigma);
                let (n1, p2) = (lasting + common + own(), lasting + common + own());
                let mut before = *p;
                before.prev.px = noisy(&p.prev.px, lasting + normal4(&mut rng) * rest.sqrt());
                before.now.px = noisy(&p.now.px, n1);
                let mut now = *p;
                let Some(seen) = rig.project(
                    &(step.inverse() * nalgebra::Point3::from(Vector3::new(y.x, y.y, 1.0) / y.z)),
                ) else {
                    continue;
                };
                now.prev.px = noisy(&seen, p2);
                now.now.px = noisy(&px, lasting + normal4(&mut rng) * rest.sqrt());
                now.now.sigma_px = sigma;
                now.prev.sigma_px = sigma;
                before.now.sigma_px = sigma;
                let Some(at) = crate::estimation::inverse_depth(&rig, &now.prev) else {
                    continue;
                };
                now.inverse_depth = at;
                let old = TrackResidual::new(&rig, &step, &before).expect("seen");
                let new = TrackResidual::new(&rig, &step, &now).expect("seen");
                meter.observe(None, &old);
                meter.observe(Some(&old), &new);
            }
        }
        meter.noise()
    }

    #[test]
    fn the_meter_finds_what_the_noise_is() {
        for (variance_factor, persistence, reuse) in [
            (1.0, 0.0, 1.0),
            (1.0, 0.0, 0.0),
            (2.0, 0.0, 1.0),
            (1.0, 0.5, 1.0),
            (0.5, 0.4, 0.4),
            (1.0, 0.2, 0.6),
        ] {
            let truth = TrackNoise {
                variance_factor,
                persistence,
                reuse,
            };
            let found = measure(&truth, 41);
            // 6000 tracks: σ of λ and κ is about 0.01, and the prior of 300 tracks pulls by 0.05.
            assert!(
                (found.variance_factor / variance_factor - 1.0).abs() < 0.05,
                "{truth:?} {found:?}"
            );
            assert!(
                (found.persistence - persistence).abs() < 0.08,
                "{truth:?} {found:?}"
            );
            assert!((found.reuse - reuse).abs() < 0.08, "{truth:?} {found:?}");
        }
    }

    #[test]
    fn projected_residuals_have_five_degrees_of_freedom() {
        let rig = rig();
        let step = crate::estimation::synthetic::step();
        let points = tracks(&rig, &step, 2000, [2.0, 40.0], 0.5, &mut random(42));
        let squares: f64 = points
            .iter()
            .map(|p| TrackResidual::new(&rig, &step, p).expect("seen").squares())
            .sum();
        // χ²(10 000)/10 000 within 3 σ.
        assert!((squares / 10_000.0 - 1.0).abs() < 0.043, "{squares}");
    }

    #[test]
    fn a_meter_that_saw_nothing_believes_what_it_was_told() {
        let told = TrackNoise {
            variance_factor: 1.7,
            persistence: 0.1,
            reuse: 0.9,
        };
        let found = TrackNoiseMeter::new(&told).noise();
        assert!((found.variance_factor - 1.7).abs() < 1e-12);
        assert!((found.persistence - 0.1).abs() < 1e-12 && (found.reuse - 0.9).abs() < 1e-12);
    }
}
