//! Where candidates come from: two lists of features and a window in, the pairs worth comparing out.
//!
//! The guided search takes every feature of the window that geometry leaves open. FLANN takes the
//! features whose descriptors are nearest, wherever they are, and the window then decides. What
//! follows is the same for both.

#[cfg(feature = "opencv")]
use super::flann::{FlannError, FlannMatcher};
use super::{Settings, pairing::Chosen};
use serde::{Deserialize, Serialize};

/// Which matcher proposes candidates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MatcherName {
    /// Geometry: everything near where a feature should be.
    #[default]
    Guided,
    /// OpenCV's FLANN: the two nearest descriptors.
    Flann,
}

/// Why features could not be matched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MatchError {
    /// FLANN failed.
    #[cfg(feature = "opencv")]
    #[error(transparent)]
    Flann(#[from] FlannError),
    /// FLANN was asked for, but is not there.
    #[cfg(not(feature = "opencv"))]
    #[error("FLANN needs the cargo feature `opencv`, with which this visod was not built")]
    NotBuiltIn,
}

/// What geometry says about where a feature may be found again.
pub(super) trait Window {
    /// Calls `visit` for each feature of the second list that lies in the window of feature `i` of
    /// the first.
    fn for_each_in(&self, i: u32, visit: impl FnMut(u32));

    /// Whether feature `j` of the second list lies in the window of feature `i` of the first.
    #[cfg(feature = "opencv")]
    fn holds(&self, i: u32, j: u32) -> bool;
}

/// A source of candidates.
#[derive(Debug)]
pub(super) enum Candidates {
    Guided,
    #[cfg(feature = "opencv")]
    Flann(FlannMatcher),
    #[cfg(not(feature = "opencv"))]
    Flann,
}

impl Candidates {
    pub(super) fn new(settings: &Settings) -> Self {
        match settings.matcher {
            MatcherName::Guided => Self::Guided,
            #[cfg(feature = "opencv")]
            MatcherName::Flann => Self::Flann(FlannMatcher::new(settings.flann.clone())),
            #[cfg(not(feature = "opencv"))]
            MatcherName::Flann => Self::Flann,
        }
    }

    /// Calls `visit` for each candidate pair, once, in a fixed order. All lie in the window.
    #[cfg_attr(
        not(feature = "opencv"),
        expect(
            unused_variables,
            reason = "the guided search has no use for the second list"
        )
    )]
    pub(super) fn for_each<A: Fn(u32) -> u32, B: Fn(u32) -> u32>(
        &self,
        a: &Chosen<'_, A>,
        b: &Chosen<'_, B>,
        window: &impl Window,
        mut visit: impl FnMut(u32, u32),
    ) -> Result<(), MatchError> {
        match self {
            Self::Guided => {
                for i in 0..a.count {
                    window.for_each_in(i, |j| visit(i, j));
                }
                Ok(())
            }
            #[cfg(feature = "opencv")]
            Self::Flann(flann) => {
                for (i, j) in flann.neighbours(&a.gathered(), &b.gathered())? {
                    if window.holds(i, j) {
                        visit(i, j);
                    }
                }
                Ok(())
            }
            #[cfg(not(feature = "opencv"))]
            Self::Flann => Err(MatchError::NotBuiltIn),
        }
    }
}
