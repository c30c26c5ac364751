//! OpenCV's FLANN: two sets of features in, the two nearest neighbours of each feature out.
//!
//! The search in randomised KD-trees is approximate (Muja and Lowe 2009): it stops after looking at
//! [`Settings::checks`] leaves, and may then miss the true nearest neighbour. Its random numbers come from a
//! fixed seed, so that the same features always give the same answer.

use crate::features::Features;
use crate::settings::SettingError;
use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, Mat, MatTraitConstManual};
use opencv::flann::{Index, IndexTrait, KDTreeIndexParams, SearchParams};

/// Seed of the trees, for each search anew.
const SEED: i32 = 1;

/// The knobs of FLANN.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Randomised trees that are searched side by side. Count, 1 to 64, default 4: OpenCV's choice.
    pub trees: u32,
    /// Leaves that a search looks at: more is slower and more exact. Count, 1 to 100000, default 128:
    /// between street images that finds 98 to 99 of 100 matches of an exhaustive search (ratio 0.8).
    pub checks: u32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            trees: 4,
            checks: 128,
        }
    }
}

impl Settings {
    /// Refuses values out of their range.
    ///
    /// # Errors
    /// The first knob whose value lies outside.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("flann.trees", self.trees, 1..=64)?;
        SettingError::unless_in("flann.checks", self.checks, 1..=100_000)
    }
}

/// A feature of the set that was searched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Which one it is.
    pub index: usize,
    /// Euclidean distance of the two descriptors, 0 to 2.
    pub distance: f32,
}

impl Neighbour {
    fn new(index: i32, squared_distance: f32) -> opencv::Result<Self> {
        Ok(Self {
            index: usize::try_from(index)?,
            distance: squared_distance.sqrt(),
        })
    }
}

/// A feature and the one that it matches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Which one of the features that were looked for.
    pub query: usize,
    /// Its nearest neighbour.
    pub nearest: Neighbour,
}

/// Why there was no search.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FlannError {
    /// Features of two different detectors cannot be compared.
    #[error(
        "descriptors of {query} and of {train} numbers cannot be compared; are they of different detectors?"
    )]
    Lengths {
        /// Floats of a descriptor that was looked for.
        query: usize,
        /// Floats of a descriptor that was searched.
        train: usize,
    },
    /// OpenCV failed.
    #[error("the search of nearest neighbours with FLANN failed: {cause}")]
    Library {
        /// What OpenCV said.
        cause: String,
    },
}

impl From<opencv::Error> for FlannError {
    fn from(cause: opencv::Error) -> Self {
        Self::Library {
            cause: cause.message.trim().replace('\n', " "),
        }
    }
}

/// The search by FLANN.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FlannMatcher {
    settings: Settings,
}

impl FlannMatcher {
    /// A search with these settings.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self { settings }
    }

    /// For each feature of `query` its nearest and its second nearest neighbour in `train`; nothing
    /// where `train` holds fewer than two.
    ///
    /// # Errors
    /// The descriptors are of different lengths, or OpenCV fails.
    pub fn knn2(
        &self,
        query: &Features,
        train: &Features,
    ) -> Result<Vec<[Neighbour; 2]>, FlannError> {
        if query.is_empty() || train.len() < 2 {
            return Ok(Vec::new());
        }
        if query.descriptor_len != train.descriptor_len {
            return Err(FlannError::Lengths {
                query: query.descriptor_len,
                train: train.descriptor_len,
            });
        }
        Ok(self.search(query, train)?)
    }

    /// The features of `query` whose nearest neighbour in `train` is nearer than `max_ratio` times the
    /// second nearest (Lowe 2004, section 7.1), in order.
    ///
    /// # Errors
    /// As [`Self::knn2`].
    pub fn matches(
        &self,
        query: &Features,
        train: &Features,
        max_ratio: f32,
    ) -> Result<Vec<Match>, FlannError> {
        let pairs = self.knn2(query, train)?;
        Ok(pairs
            .into_iter()
            .enumerate()
            .filter(|(_, [first, second])| first.distance < max_ratio * second.distance)
            .map(|(query, [nearest, _])| Match { query, nearest })
            .collect())
    }

    /// The pairs, by index into `a` and into `b`, of which one is among the two nearest neighbours
    /// of the other: each once, in order.
    ///
    /// # Errors
    /// As [`Self::knn2`].
    pub fn neighbours(&self, a: &Features, b: &Features) -> Result<Vec<(u32, u32)>, FlannError> {
        let numbered = |neighbours: Vec<[Neighbour; 2]>| {
            (0..)
                .zip(neighbours)
                .flat_map(|(query, two)| two.map(|n| (query, n.index as u32)))
        };
        let mut pairs: Vec<(u32, u32)> = numbered(self.knn2(a, b)?).collect();
        pairs.extend(numbered(self.knn2(b, a)?).map(|(j, i)| (i, j)));
        pairs.sort_unstable();
        pairs.dedup();
        Ok(pairs)
    }

    fn search(&self, query: &Features, train: &Features) -> opencv::Result<Vec<[Neighbour; 2]>> {
        let (query, train) = (as_mat(query)?, as_mat(train)?);
        // The generator is this thread's own.
        core::set_rng_seed(SEED)?;
        let trees = KDTreeIndexParams::new(i32::try_from(self.settings.trees)?)?;
        let mut index = Index::new_def(&train, &trees)?;
        let (mut indices, mut squares) = (Mat::default(), Mat::default());
        let search = SearchParams::new_1(i32::try_from(self.settings.checks)?, 0.0, true)?;
        index.knn_search(&query, &mut indices, &mut squares, 2, &search)?;
        let indices = indices.data_typed::<i32>()?.chunks_exact(2);
        let squares = squares.data_typed::<f32>()?.chunks_exact(2);
        indices
            .zip(squares)
            .map(|(index, square)| {
                Ok([
                    Neighbour::new(index[0], square[0])?,
                    Neighbour::new(index[1], square[1])?,
                ])
            })
            .collect()
    }
}

/// The descriptors as OpenCV's matrix, one a row, in place.
fn as_mat(features: &Features) -> opencv::Result<BoxedRef<'_, Mat>> {
    Mat::new_rows_cols_with_data(
        i32::try_from(features.len())?,
        i32::try_from(features.descriptor_len)?,
        &features.descriptors,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const LEN: usize = 64;

    fn random_features(count: usize, seed: u64) -> Features {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut descriptors = Vec::new();
        for _ in 0..count {
            let values: Vec<f32> = (0..LEN).map(|_| random.random_range(-1.0..1.0)).collect();
            let norm = values.iter().map(|x| x * x).sum::<f32>().sqrt();
            descriptors.extend(values.iter().map(|x| x / norm));
        }
        Features {
            keypoints: vec![crate::features::Keypoint::default(); count],
            descriptor_len: LEN,
            descriptors,
        }
    }

    fn exhaustive(query: &[f32], train: &Features) -> [Neighbour; 2] {
        let mut all: Vec<Neighbour> = (0..train.len())
            .map(|index| Neighbour {
                index,
                distance: query
                    .iter()
                    .zip(train.descriptor(index))
                    .map(|(a, b)| (a - b).powi(2))
                    .sum::<f32>()
                    .sqrt(),
            })
            .collect();
        all.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        [all[0], all[1]]
    }

    /// With as many checks as there are features nothing can be missed.
    #[test]
    fn an_unhurried_search_is_exhaustive() {
        let (query, train) = (random_features(50, 1), random_features(300, 2));
        let matcher = FlannMatcher::new(Settings {
            checks: 10_000,
            ..Settings::default()
        });
        for (index, pair) in matcher.knn2(&query, &train).unwrap().iter().enumerate() {
            let wanted = exhaustive(query.descriptor(index), &train);
            for (found, wanted) in pair.iter().zip(&wanted) {
                assert_eq!(found.index, wanted.index);
                // Sums of 64 products in another order.
                assert!((found.distance - wanted.distance).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn a_copy_is_its_originals_nearest_neighbour() {
        let train = random_features(500, 3);
        let matches = FlannMatcher::default()
            .matches(&train, &train, 0.5)
            .unwrap();
        assert_eq!(matches.len(), train.len());
        for found in matches {
            assert_eq!(found.nearest.index, found.query);
            assert_eq!(found.nearest.distance, 0.0);
        }
    }

    #[test]
    fn the_search_is_the_same_every_time() {
        let (query, train) = (random_features(400, 4), random_features(400, 5));
        let hurried = FlannMatcher::new(Settings {
            trees: 2,
            checks: 4,
        });
        let first = hurried.knn2(&query, &train).unwrap();
        for _ in 0..3 {
            core::set_rng_seed(77).unwrap();
            assert_eq!(hurried.knn2(&query, &train).unwrap(), first);
        }
        let elsewhere = std::thread::spawn(move || hurried.knn2(&query, &train).unwrap());
        assert_eq!(elsewhere.join().unwrap(), first);
    }

    #[test]
    fn one_feature_has_no_second_neighbour() {
        let matcher = FlannMatcher::default();
        let (few, many) = (random_features(1, 6), random_features(10, 7));
        assert_eq!(matcher.knn2(&many, &few), Ok(Vec::new()));
        assert_eq!(matcher.knn2(&Features::default(), &many), Ok(Vec::new()));
        assert_eq!(matcher.knn2(&few, &many).unwrap().len(), 1);
    }

    #[test]
    fn descriptors_of_different_lengths_are_refused() {
        let query = Features {
            keypoints: vec![crate::features::Keypoint::default(); 2],
            descriptor_len: 32,
            descriptors: vec![0.0; 64],
        };
        let error = FlannMatcher::default().knn2(&query, &random_features(2, 8));
        assert_eq!(
            error,
            Err(FlannError::Lengths {
                query: 32,
                train: 64
            })
        );
    }
}
