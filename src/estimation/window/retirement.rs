//! Landmarks that are not seen any more: what they say of the window's poses goes into the prior before their
//! anchor leaves, so that an adjustment goes through those that are under way alone.
//!
//! To first order nothing is lost: where the prior knows a pose, that is linearised for good anyway. What
//! no longer follows the poses is the landmark's own place, which nothing new would have moved.

use super::{Frame, Landmark, Window};

/// A landmark that none of the last so many keyframes saw will not be found again: those who look for it have
/// to give it up earlier.
pub const UNSEEN_KEYFRAMES: usize = 3;

impl Window {
    /// Hands what landmarks say that the last keyframes did not see on to the prior, where that knows all
    /// poses which they were seen from. All frames of the window are keyframes.
    pub(super) fn retire_landmarks(&mut self) {
        let Some(recent) = self.frames.len().checked_sub(UNSEEN_KEYFRAMES) else {
            return;
        };
        let is_known = |frame: &&Frame| frame.linearised.is_some();
        let known = self.frames.iter().skip(1).take_while(is_known).count();
        let first_kept = self.frames[recent.min(known + 1)].serial;
        let is_retired = |l: &Landmark| l.last_seen() < first_kept;
        if !self.landmarks.iter().any(is_retired) {
            return;
        }
        let (hessian, mut gradient, by_sources) = self.said_by(is_retired, None);
        self.count_from_linearised(&hessian, &mut gradient);
        let m = self.prior.vector.len();
        self.prior.information += hessian.view((0, 0), (m, m));
        self.prior.vector += gradient.rows(0, m);
        self.prior.by_sources += by_sources;
        self.memory.recycle(hessian);
        self.memory.recycle_vector(gradient);
        self.drop_retired(is_retired);
    }

    fn drop_retired(&mut self, is_retired: impl Fn(&Landmark) -> bool) {
        let (frames, spare) = (&mut self.frames, &mut self.spare_sights);
        self.landmarks.retain_mut(|landmark| {
            let is_retired = is_retired(landmark);
            if is_retired {
                let sights = std::mem::take(&mut landmark.observations);
                // One alone says nothing of poses.
                if sights.len() > 1 {
                    for sight in &sights {
                        let frame = frames.iter_mut().find(|f| f.serial == sight.serial);
                        if let Some(frame) = frame {
                            frame.retired_sights += 1;
                        }
                    }
                }
                spare.push(sights);
            }
            !is_retired
        });
    }
}
