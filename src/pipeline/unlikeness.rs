//! How well patches fit in; by how much their places are less sure than they say out.
//!
//! A patch says how sure its place is by what is left of it once it is aligned, and patches are taken to err each for
//! itself. Where the images have changed at once, blurred by a jolt or lit in another way, they err together: all of
//! them are off a little in the same direction, and no number of them averages it out. That they fit worse than
//! usual tells when.

/// What a pair's patches leave unexplained may grow so much, over what is usual, before it means anything: as the
/// motion or the view changes, it does by itself.
const PAR: f64 = 2.0;
/// Share of a new pair in what is usual.
const GAIN: f64 = 0.1;
/// What remains between any two images, of their noise: less is not told apart.
const LEAST: f64 = 1e-4;

/// How much of the patches is left unexplained, and how much is usual.
#[derive(Clone, Debug, Default)]
pub(super) struct Unlikeness {
    usual: Option<f64>,
    /// Of the last pair, over what is usual.
    ratio: f64,
    correlations: Vec<f32>,
}

impl Unlikeness {
    /// Takes note of how well the patches of one pair fit.
    pub(super) fn take(&mut self, correlations: impl Iterator<Item = f32>) {
        self.correlations.clear();
        self.correlations.extend(correlations);
        self.ratio = 1.0;
        if self.correlations.is_empty() {
            return;
        }
        let middle = self.correlations.len() / 2;
        let (_, median, _) = self
            .correlations
            .select_nth_unstable_by(middle, f32::total_cmp);
        let unlike = (1.0 - f64::from(*median)).max(LEAST);
        let usual = self.usual.unwrap_or(unlike);
        self.ratio = unlike / usual;
        // A jump is not what is usual, unless it lasts.
        self.usual = Some(usual + GAIN * (unlike.min(PAR * usual) - usual));
    }

    /// By how much the standard deviations of the last pair's patches are to be widened: 1 or more. What they leave
    /// unexplained is a variance.
    pub(super) fn widening(&self) -> f64 {
        (self.ratio / PAR).max(1.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(pairs: &[f32]) -> f64 {
        let mut unlikeness = Unlikeness::default();
        for unlike in pairs {
            unlikeness.take([0.5, 1.0 - unlike, 1.0].into_iter());
        }
        unlikeness.widening()
    }

    #[test]
    fn what_is_as_usual_or_better_is_as_sure_as_it_says() {
        assert_eq!(after(&[]), 1.0);
        assert_eq!(after(&[0.05]), 1.0);
        assert_eq!(after(&[0.01, 0.015, 0.01, 0.018]), 1.0);
        assert_eq!(after(&[0.05, 0.001]), 1.0);
        assert_eq!(after(&[0.0, 0.0]), 1.0);
    }

    #[test]
    fn a_jump_widens_and_one_that_lasts_becomes_usual() {
        let jump = after(&[0.01, 0.01, 0.08]);
        assert!((jump - 2.0).abs() < 1e-3, "{jump}");
        let mut lasting = vec![0.01, 0.01];
        lasting.resize(40, 0.08);
        assert_eq!(after(&lasting), 1.0);
    }

    #[test]
    fn a_pair_without_patches_changes_nothing() {
        let mut unlikeness = Unlikeness::default();
        unlikeness.take([0.99].into_iter());
        unlikeness.take(std::iter::empty());
        assert_eq!(unlikeness.widening(), 1.0);
        unlikeness.take([0.92].into_iter());
        assert!((unlikeness.widening() - 2.0).abs() < 1e-3);
    }
}
