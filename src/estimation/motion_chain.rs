//! Motions between consecutive pairs in, with what each pixel did to them; the covariance of the
//! pose out, as far as the pixels' noise makes it (theory §4).
//!
//! Motions share noise in two ways. The pixels of a pair serve the motion that ends there and the
//! one that begins there: a correlation of one step, by [`TrackNoise::reuse`]. And what a track keeps
//! of its noise from pair to pair acts on all motions of its life: its effect on the pose is carried
//! along for each living track, by [`TrackNoise::persistence`], and settled when the track ends.

use super::influence::Influence;
use super::track_noise::TrackNoise;
use crate::geometry::product::{product, product_transposed};
use crate::geometry::se3;
use crate::uncertainty::compounding;
use nalgebra::{Isometry3, Matrix6, Matrix6x4};

/// A track of a motion: its number, and what its pixels in units of their σ did to the motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChainedTrack {
    /// The same in every motion that uses the track.
    pub id: u64,
    /// [Whitened](Influence::whitened).
    pub influence: Influence,
}

/// The pose's covariance along a chain of motions, all of right perturbations.
#[derive(Clone, Debug, Default)]
pub struct MotionChain {
    /// From noise that is new in each pair, and from tracks that have ended.
    settled: Matrix6<f64>,
    /// The derivative of the pose by what each living track keeps, per σ.
    living: Vec<(u64, Matrix6x4<f64>)>,
    last: Vec<ChainedTrack>,
    last_factor: f64,
}

impl MotionChain {
    /// A chain whose first motion starts from a pose of this covariance.
    #[must_use]
    pub fn beginning_at(cov: &Matrix6<f64>) -> Self {
        Self {
            settled: *cov,
            ..Self::default()
        }
    }

    /// Chains one more motion. Tracks have rising numbers.
    pub fn advance(
        &mut self,
        prev_from_now: &Isometry3<f64>,
        tracks: &[ChainedTrack],
        noise: &TrackNoise,
    ) {
        let ad = se3::adjoint(&prev_from_now.inverse());
        let (mut own, mut cross) = (Matrix6::zeros(), Matrix6::zeros());
        let mut ended = Matrix6::zeros();
        let mut living = Vec::with_capacity(tracks.len());
        let mut before = self.last.iter().peekable();
        let mut alive = self.living.iter().peekable();
        for track in tracks {
            let Influence {
                by_prev, by_now, ..
            } = &track.influence;
            own += product_transposed(by_prev, by_prev) + product_transposed(by_now, by_now);
            while before.next_if(|other| other.id < track.id).is_some() {}
            if let Some(other) = before.next_if(|other| other.id == track.id) {
                cross += product_transposed(&other.influence.by_now, by_prev);
            }
            while let Some((_, by)) = alive.next_if(|(id, _)| *id < track.id) {
                ended += product_transposed(by, by);
            }
            let earlier = alive.next_if(|(id, _)| *id == track.id);
            let carried = earlier.map_or_else(Matrix6x4::zeros, |(_, by)| product(&ad, by));
            living.push((track.id, carried + by_prev + by_now));
        }
        ended += alive
            .map(|(_, by)| product_transposed(by, by))
            .sum::<Matrix6<f64>>();

        let lasting = noise.persistence * noise.variance_factor;
        let fresh = noise.variance_factor - lasting;
        // Noise that both uses share, less what lasts anyway, between two pairs' factors.
        let factor = (self.last_factor * noise.variance_factor).sqrt();
        self.settled = compounding::chain_correlated(
            &(self.settled + ended * lasting),
            prev_from_now,
            &(own * fresh),
            &(cross * ((noise.reuse - noise.persistence).max(0.0) * factor)),
        );
        self.living = living;
        self.last.clear();
        self.last.extend_from_slice(tracks);
        self.last_factor = noise.variance_factor;
    }

    /// The pose's covariance now.
    #[must_use]
    pub fn covariance(&self, noise: &TrackNoise) -> Matrix6<f64> {
        let lasting = noise.persistence * noise.variance_factor;
        let living: Matrix6<f64> = self
            .living
            .iter()
            .map(|(_, by)| product_transposed(by, by))
            .sum();
        se3::symmetric(&(self.settled + living * lasting))
    }
}
