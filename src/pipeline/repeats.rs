//! Images in; whether a camera shows what it has shown before.
//!
//! No two images of a sensor are the same to the byte, not in a band of their rows: where they are, the camera or
//! its driver hands on an old one, or half of one, under a new stamp. Such a pair would give a pose that is exact,
//! sure of itself, and of another time.

use super::method::DescribedPair;
use crate::image::BANDS;

/// Images that are remembered at most.
const MOST: usize = 64;
/// As many bands of one old image make an image old. A few may be alike by chance: of a sky without a shade but for
/// the one wire before it.
const OLD_BANDS: usize = BANDS / 4;

/// Fingerprints of an image's bands.
type Prints = [Option<u64>; BANDS];

/// The last images of both cameras, by their fingerprints.
#[derive(Debug)]
pub(super) struct Repeats {
    remembered: usize,
    last: [[Prints; MOST]; 2],
    next: usize,
}

/// A camera hands on what it has handed on before.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{} there before, to the byte: a camera or its driver hands on what is old", self.words())]
pub struct Repeated([Old; 2]);

/// How much of an image is old.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Old {
    Nothing,
    Part,
    Whole,
}

impl Repeated {
    fn words(&self) -> &'static str {
        match self.0 {
            [Old::Whole, Old::Nothing] => "the left image was",
            [Old::Part, Old::Nothing] => "a part of the left image was",
            [Old::Nothing, Old::Whole] => "the right image was",
            [Old::Nothing, Old::Part] => "a part of the right image was",
            [Old::Whole, Old::Whole] => "each image was",
            _ => "a part of each image was",
        }
    }
}

impl Repeats {
    /// `remembered` images back, of each camera.
    pub(super) fn new(remembered: u32) -> Self {
        Self {
            remembered: (remembered as usize).min(MOST),
            last: [[[None; BANDS]; MOST]; 2],
            next: 0,
        }
    }

    /// Refuses a pair of which an image, or a good part of one, was there before; remembers both.
    pub(super) fn check(&mut self, pair: &DescribedPair) -> Result<(), Repeated> {
        if self.remembered == 0 {
            return Ok(());
        }
        let now = [&pair.left.fingerprints, &pair.right.fingerprints];
        let old = [0, 1].map(|side| {
            let last = self.last[side][..self.remembered].iter();
            how_old(now[side], last)
        });
        for (last, now) in self.last.iter_mut().zip(now) {
            last[self.next] = *now;
        }
        self.next = (self.next + 1) % self.remembered;
        if old == [Old::Nothing; 2] {
            return Ok(());
        }
        Err(Repeated(old))
    }
}

/// How much of an image is that of one of the `last`.
fn how_old<'a>(now: &Prints, last: impl Iterator<Item = &'a Prints>) -> Old {
    let told = now.iter().flatten().count();
    let old = last.map(|last| in_common(now, last)).max().unwrap_or(0);
    if old < told.clamp(1, OLD_BANDS) {
        Old::Nothing
    } else if old < told {
        Old::Part
    } else {
        Old::Whole
    }
}

/// How many bands of two images are the same.
fn in_common(one: &Prints, other: &Prints) -> usize {
    let same = |(a, b): &(&Option<u64>, &Option<u64>)| a.is_some() && a == b;
    one.iter().zip(other).filter(same).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// An image whose bands are all of one kind, 0 for those that say nothing.
    fn image(kind: u64) -> Prints {
        [(kind > 0).then_some(kind); BANDS]
    }

    fn pair(left: Prints, right: Prints) -> DescribedPair {
        let mut pair = DescribedPair::default();
        pair.left.fingerprints = left;
        pair.right.fingerprints = right;
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
                prop_assert_eq!(repeats.check(&pair(image(left), image(right))).is_err(), is_old);
            }
        }

        #[test]
        fn a_quarter_that_is_old_is_refused_and_so_is_all_that_says_anything(
            old in prop::collection::vec(any::<bool>(), BANDS),
            dark in prop::collection::vec(any::<bool>(), BANDS),
        ) {
            let mut repeats = Repeats::new(2);
            prop_assert!(repeats.check(&pair(image(1), image(2))).is_ok());
            prop_assert!(repeats.check(&pair(image(3), image(4))).is_ok());
            let kind = |band: usize| (!dark[band]).then_some(if old[band] { 1 } else { 5 });
            let now: Prints = std::array::from_fn(kind);
            let told = now.iter().flatten().count();
            let repeated = now.iter().flatten().filter(|kind| **kind == 1).count();
            let is_old = repeated >= BANDS / 4 || (repeated == told && told > 0);
            prop_assert_eq!(repeats.check(&pair(now, image(6))).is_err(), is_old);
        }
    }

    #[test]
    fn the_refusal_names_the_camera() {
        let say = |left: Prints, right: Prints| {
            let mut repeats = Repeats::new(1);
            assert_eq!(repeats.check(&pair(image(1), image(2))), Ok(()));
            repeats.check(&pair(left, right)).map_err(|e| e.to_string())
        };
        let half = |kind: u64| {
            let mut half = image(kind);
            half[BANDS / 2..].fill(Some(9));
            half
        };
        assert_eq!(say(image(3), image(4)), Ok(()));
        for (left, right, words) in [
            (image(1), image(4), "the left image was there"),
            (image(3), image(2), "the right image was there"),
            (image(1), image(2), "each image was there"),
            (half(1), image(4), "a part of the left image was there"),
            (image(3), half(2), "a part of the right image was there"),
            (half(1), image(2), "a part of each image was there"),
        ] {
            let said = say(left, right);
            assert!(
                said.as_ref().is_err_and(|e| e.starts_with(words)),
                "{said:?}"
            );
        }
    }
}
