//! How the frames of a window see points of its anchors, as they stand now: made when first asked for.

use super::super::sight::Viewpoint;
use super::{Frame, line_count, line_index};
use crate::geometry::StereoRig;

/// By [`line_index`], in memory that is kept.
#[derive(Clone, Debug, Default)]
pub(super) struct Viewpoints {
    made: Vec<Option<Viewpoint>>,
}

impl Viewpoints {
    /// Room for a window of so many frames.
    pub(super) fn with_room(frames: usize) -> Self {
        Self {
            made: Vec::with_capacity(line_count(frames)),
        }
    }

    /// Forgets all, for so many frames have moved.
    pub(super) fn begin(&mut self, frame_count: usize) {
        self.made.clear();
        self.made.resize(line_count(frame_count), None);
    }

    /// How one of `frames` sees points of another, which is not later.
    pub(super) fn of(
        &mut self,
        rig: &StereoRig,
        frames: &[Frame],
        anchor: usize,
        frame: usize,
    ) -> &Viewpoint {
        self.made[line_index(anchor, frame)].get_or_insert_with(|| {
            let datum_from_frame = &frames[frame].datum_from_frame;
            Viewpoint::new(
                rig,
                &(datum_from_frame.inverse() * frames[anchor].datum_from_frame),
            )
        })
    }
}
