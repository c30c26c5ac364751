//! Pairing: two lists of features and a window in, the partners that like each other best out.
//!
//! Left–right and over time differ in the window alone. Partners are compatible, near in
//! descriptor, clearly nearer than the second best candidate, and each other's choice.

use super::Settings;
use super::candidates::{Candidates, MatchError, Window};
use super::descriptor::{Best, Candidate, Seeker, compare, compatible, greatest_reach};
use crate::features::{Features, Keypoint};

/// Some of an image's features, numbered anew: number `i` is the image's feature `feature_of(i)`.
pub(super) struct Chosen<'a, F> {
    pub(super) features: &'a Features,
    pub(super) count: u32,
    pub(super) feature_of: F,
}

impl<F: Fn(u32) -> u32> Chosen<'_, F> {
    pub(super) fn keypoint(&self, i: u32) -> &Keypoint {
        &self.features.keypoints[(self.feature_of)(i) as usize]
    }

    fn descriptor(&self, i: u32) -> &[f32] {
        self.features.descriptor((self.feature_of)(i) as usize)
    }

    /// The chosen features alone, in their order.
    #[cfg(feature = "opencv")]
    pub(super) fn gathered(&self) -> Features {
        let mut chosen = Features {
            descriptor_len: self.features.descriptor_len,
            ..Features::default()
        };
        for i in 0..self.count {
            chosen.keypoints.push(*self.keypoint(i));
            chosen.descriptors.extend_from_slice(self.descriptor(i));
        }
        chosen
    }
}

/// Finds partners; keeps its working memory from search to search.
#[derive(Debug)]
pub(super) struct Pairing {
    settings: Settings,
    candidates: Candidates,
    nearby: Vec<Candidate>,
    b_of_a: Vec<Best>,
    a_of_b: Vec<Best>,
}

impl Pairing {
    pub(super) fn new(settings: Settings) -> Self {
        Self {
            candidates: Candidates::new(&settings),
            settings,
            nearby: Vec::new(),
            b_of_a: Vec::new(),
            a_of_b: Vec::new(),
        }
    }

    /// Compares all candidates of two lists.
    pub(super) fn search<A: Fn(u32) -> u32, B: Fn(u32) -> u32>(
        &mut self,
        a: &Chosen<'_, A>,
        b: &Chosen<'_, B>,
        window: &impl Window,
    ) -> Result<(), MatchError> {
        let Self {
            settings,
            candidates,
            nearby,
            b_of_a,
            a_of_b,
        } = self;
        b_of_a.clear();
        b_of_a.resize(a.count as usize, Best::NONE);
        a_of_b.clear();
        a_of_b.resize(b.count as usize, Best::NONE);
        let greatest_reach = greatest_reach(settings);
        let mut settle = |number: u32, nearby: &mut Vec<Candidate>| {
            let seeker = Seeker {
                number,
                descriptor: a.descriptor(number),
                greatest_reach,
            };
            let best = &mut b_of_a[number as usize];
            compare(seeker, nearby, b.features, best, a_of_b);
            nearby.clear();
        };
        nearby.clear();
        let mut seeking = 0;
        candidates.for_each(a, b, window, |i, j| {
            if i != seeking {
                if !nearby.is_empty() {
                    settle(seeking, nearby);
                }
                seeking = i;
            }
            if compatible(a.keypoint(i), b.keypoint(j), settings) {
                nearby.push(Candidate {
                    number: j,
                    feature: (b.feature_of)(j),
                });
            }
        })?;
        if !nearby.is_empty() {
            settle(seeking, nearby);
        }
        Ok(())
    }

    /// The partner of `i` in the last search, if each likes the other best.
    pub(super) fn partner(&self, i: u32) -> Option<u32> {
        let j = self.b_of_a[i as usize].accepted(&self.settings)?;
        (self.a_of_b[j as usize].accepted(&self.settings)? == i).then_some(j)
    }
}
