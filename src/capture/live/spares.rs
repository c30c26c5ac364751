//! Images that wait to be filled again, for each of two cameras.

use crate::capture::Side;
use crate::image::GrayImage;

/// Images a side that are kept: more than are ever under way would only be memory.
const MOST_SPARE: usize = 64;

#[derive(Debug)]
pub(super) struct Spares {
    sizes_px: [(u32, u32); 2],
    images: [Vec<GrayImage>; 2],
    /// Images a side that there are, here or under way.
    all: usize,
}

impl Spares {
    pub(super) fn new(sizes_px: [(u32, u32); 2]) -> Self {
        Self {
            sizes_px,
            images: Default::default(),
            all: 0,
        }
    }

    /// Adds images until there are `count` a side in all.
    pub(super) fn grow(&mut self, count: usize) {
        let count = count.min(MOST_SPARE);
        for (images, (width, height)) in self.images.iter_mut().zip(self.sizes_px) {
            let more = count.saturating_sub(self.all);
            images.extend((0..more).map(|_| GrayImage::filled(width, height, 0)));
        }
        self.all = self.all.max(count);
    }

    pub(super) fn take(&mut self, side: Side) -> Option<GrayImage> {
        self.images[side as usize].pop()
    }

    pub(super) fn give(&mut self, side: Side, image: GrayImage) {
        let images = &mut self.images[side as usize];
        if images.len() < MOST_SPARE {
            images.push(image);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_images_as_are_asked_for_are_there_once() {
        let mut spares = Spares::new([(4, 2), (3, 1)]);
        spares.grow(2);
        let held = spares.take(Side::Left).expect("there");
        // One that is under way counts.
        spares.grow(3);
        spares.grow(1);
        let mut sizes = |side| {
            let images = std::iter::from_fn(|| spares.take(side));
            images.map(|i| (i.width(), i.height())).collect::<Vec<_>>()
        };
        assert_eq!(sizes(Side::Left), [(4, 2); 2]);
        assert_eq!(sizes(Side::Right), [(3, 1); 3]);
        assert_eq!((held.width(), held.height()), (4, 2));
    }

    #[test]
    fn no_more_are_kept_than_are_ever_under_way() {
        let mut spares = Spares::new([(1, 1); 2]);
        for _ in 0..2 * MOST_SPARE {
            spares.give(Side::Left, GrayImage::filled(1, 1, 0));
        }
        let kept = std::iter::from_fn(|| spares.take(Side::Left)).count();
        assert_eq!(kept, MOST_SPARE);
    }
}
