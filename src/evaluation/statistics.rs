//! Numbers in, the statistics that trajectory papers print out.

/// What is usually said of a list of errors, in their own unit.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Statistics {
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// Median; of an even number the mean of the middle two.
    pub median: f64,
    /// Standard deviation about the mean, dividing by the number of values.
    pub std: f64,
    /// Smallest.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Sum of squares, in the unit squared.
    pub sse: f64,
    /// How many.
    pub count: usize,
}

impl Statistics {
    /// The statistics of some values; `None` of none.
    #[must_use]
    pub fn of(values: &[f64]) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let count = values.len();
        let n = count as f64;
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let sse: f64 = values.iter().map(|x| x * x).sum();
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
        Some(Self {
            rmse: (sse / n).sqrt(),
            mean,
            median: 0.5 * (sorted[(count - 1) / 2] + sorted[count / 2]),
            std: variance.sqrt(),
            min: sorted[0],
            max: sorted[count - 1],
            sse,
            count,
        })
    }
}
