//! Feature workers that can be asked, while they run, to look for fewer features.

use crate::features::{ExtractError, Extractor, Features};
use crate::image::GrayImage;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

/// The share of the features that is looked for, 0 to 1: one for all workers of a run.
#[derive(Clone, Debug)]
pub struct Share(Arc<AtomicU32>);

impl Default for Share {
    /// All of them.
    fn default() -> Self {
        Self(Arc::new(AtomicU32::new(1.0_f32.to_bits())))
    }
}

impl Share {
    /// Takes effect with the next image of each worker.
    pub fn set(&self, share: f32) {
        self.0
            .store(share.clamp(0.0, 1.0).to_bits(), Ordering::Relaxed);
    }

    /// The share now.
    #[must_use]
    pub fn get(&self) -> f32 {
        f32::from_bits(self.0.load(Ordering::Relaxed))
    }

    /// An extractor that keeps to it.
    #[must_use]
    pub fn bound(&self, inner: Box<dyn Extractor>) -> Box<dyn Extractor> {
        Box::new(Bound {
            inner,
            share: self.clone(),
        })
    }
}

struct Bound {
    inner: Box<dyn Extractor>,
    share: Share,
}

impl Extractor for Bound {
    fn extract(&mut self, image: &GrayImage, features: &mut Features) -> Result<(), ExtractError> {
        self.inner.set_share(self.share.get());
        self.inner.extract(image, features)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::{Settings, extractor};
    use crate::simulation::{SceneName, Simulation, TrajectoryName, small_rig};

    fn room() -> GrayImage {
        let (scene, way) = (SceneName::Room, TrajectoryName::LoopRoom);
        let simulation = Simulation::new(
            scene,
            way,
            small_rig(),
            crate::simulation::Settings::default(),
        );
        simulation.expect("fits").pair(0).0.left
    }

    #[test]
    fn the_strongest_share_of_the_budget_is_found_and_all_of_it_again_afterwards() {
        let mut settings = Settings::default();
        settings.surf.budget = 100;
        let share = Share::default();
        let mut extractor = share.bound(extractor(&settings).expect("valid"));
        let image = room();
        let mut count = |part: f32| {
            share.set(part);
            let mut features = Features::default();
            extractor.extract(&image, &mut features).expect("done");
            features.len()
        };
        let all = count(1.0);
        assert!(all > 90, "{all}");
        let some = count(0.5);
        assert!((40..=50).contains(&some), "{some}");
        assert_eq!(count(1.0), all);
    }
}
