//! Images in; whether a camera shows what it has shown before.
//!
//! No two images of a sensor are the same to the byte: where they are, the camera or its driver hands on an old
//! one under a new stamp. Such a pair would give a pose that is exact, sure of itself, and of another time.

use super::method::DescribedPair;
use crate::capture::Side;

/// Images that are remembered at most.
const MOST: usize = 64;

/// The last images of both cameras, by their fingerprints.
#[derive(Debug)]
pub(super) struct Repeats {
    remembered: usize,
    last: [[Option<u64>; MOST]; 2],
    next: usize,
}

/// A camera hands on what it has handed on before.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{} one that was there before, to the byte: a camera or its driver is frozen", .0.words())]
pub struct Repeated(Whose);

/// Whose image it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Whose {
    One(Side),
    Both,
}

impl Whose {
    fn words(self) -> &'static str {
        match self {
            Self::One(Side::Left) => "the left image is",
            Self::One(Side::Right) => "the right image is",
            Self::Both => "each image is",
        }
    }
}

impl Repeats {
    /// `remembered` images back, of each camera.
    pub(super) fn new(remembered: u32) -> Self {
        Self {
            remembered: (remembered as usize).min(MOST),
            last: [[None; MOST]; 2],
            next: 0,
        }
    }

    /// Refuses a pair of which one image was there before; remembers both.
    pub(super) fn check(&mut self, pair: &DescribedPair) -> Result<(), Repeated> {
        let now = [pair.left.fingerprint, pair.right.fingerprint];
        if self.remembered == 0 {
            return Ok(());
        }
        let is_old = |side: usize| {
            now[side].is_some() && self.last[side][..self.remembered].contains(&now[side])
        };
        let repeated = match [is_old(0), is_old(1)] {
            [false, false] => Ok(()),
            [true, false] => Err(Repeated(Whose::One(Side::Left))),
            [false, true] => Err(Repeated(Whose::One(Side::Right))),
            [true, true] => Err(Repeated(Whose::Both)),
        };
        for (last, now) in self.last.iter_mut().zip(now) {
            last[self.next] = now;
        }
        self.next = (self.next + 1) % self.remembered;
        repeated
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn pair(left: u64, right: u64) -> DescribedPair {
        let mut pair = DescribedPair::default();
        pair.left.fingerprint = (left > 0).then_some(left);
        pair.right.fingerprint = (right > 0).then_some(right);
        pair
    }

    proptest! {
        #[test]
        fn an_image_is_refused_exactly_if_it_is_among_those_remembered(
            remembered in 0_u32..6,
            images in prop::collection::vec((0_u64..8, 0_u64..8), 1..60),
        ) {
            let mut repeats = Repeats::new(remembered);
            for (i, &(left, right)) in images.iter().enumerate() {
                let before = &images[i.saturating_sub(remembered as usize)..i];
                let is_old = before.iter().any(|&(l, r)| (left > 0 && l == left) || (right > 0 && r == right));
                prop_assert_eq!(repeats.check(&pair(left, right)).is_err(), is_old);
            }
        }
    }

    #[test]
    fn the_refusal_names_the_camera() {
        let say = |now: [u64; 2]| {
            let mut repeats = Repeats::new(1);
            assert_eq!(repeats.check(&pair(1, 2)), Ok(()));
            repeats
                .check(&pair(now[0], now[1]))
                .map_err(|e| e.to_string())
        };
        assert_eq!(say([3, 4]), Ok(()));
        for (now, words) in [
            ([1, 4], "the left image is"),
            ([3, 2], "the right image is"),
            ([1, 2], "each image is"),
        ] {
            assert!(say(now).is_err_and(|e| e.starts_with(words)));
        }
    }
}
