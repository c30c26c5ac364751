//! Configuration: what was typed in, a checked one out.
//!
//! One table a stage; each stage's own `Settings` hold its defaults, ranges and reasons. Unknown
//! keys are refused, and a value out of range is named with file, line and key.

use crate::settings::SettingError;
use crate::toml_file::{TomlError, TomlText};
use crate::{capture, estimation, features, matching, output, pipeline, rig_watch, service};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// All settings.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The rig file; relative to the configuration's own folder. Default: the recording's own.
    pub rig: Option<PathBuf>,
    /// The two cameras.
    pub camera: capture::settings::Cameras,
    /// How their frames become pairs.
    pub capture: capture::settings::Settings,
    /// How recordings are read.
    pub dataset: capture::dataset::Settings,
    /// How features are found.
    pub features: features::Settings,
    /// How features are matched.
    pub matching: matching::Settings,
    /// How motion is estimated.
    pub estimation: estimation::Settings,
    /// How the rig is watched.
    pub rig_watch: rig_watch::Settings,
    /// How the work is spread over threads.
    pub pipeline: pipeline::Settings,
    /// Where the results are published.
    pub publish: output::publication::Settings,
    /// What is kept for the next run.
    pub last_pose: output::last_pose::Settings,
    /// How the daemon behaves as a service.
    pub service: service::Settings,
    /// Where figures can be fetched.
    pub metrics: service::metrics::Settings,
}

impl Config {
    /// Reads a configuration file; what it does not mention keeps its default.
    ///
    /// # Errors
    /// The file cannot be read, is not TOML, has an unknown key, or a value of the wrong type or out
    /// of range.
    pub fn load(path: &Path) -> Result<Self, TomlError> {
        let mut config = Self::from_text(&TomlText::read(path)?)?;
        if let Some(folder) = path.parent() {
            let files = [&mut config.rig, &mut config.last_pose.file];
            for file in files.into_iter().flatten() {
                *file = folder.join(&*file);
            }
        }
        Ok(config)
    }

    /// Reads a configuration from a text.
    ///
    /// # Errors
    /// As [`load`](Self::load).
    pub fn parse(text: &str) -> Result<Self, TomlError> {
        Self::from_text(&TomlText::new("configuration", text))
    }

    fn from_text(text: &TomlText) -> Result<Self, TomlError> {
        let config: Self = text.parse()?;
        for (table, checked) in [
            ("camera.left", check_camera(config.camera.left.as_ref())),
            ("camera.right", check_camera(config.camera.right.as_ref())),
            ("capture", config.capture.check()),
            ("dataset", config.dataset.check()),
            ("features.surf", config.features.surf.check()),
            #[cfg(feature = "opencv")]
            ("features.opencv", config.features.opencv.check()),
            ("features", config.features.check()),
            ("matching", config.matching.check()),
            ("matching", config.check_partners()),
            ("estimation", config.estimation.check()),
            ("rig_watch", config.rig_watch.check()),
            ("pipeline", config.pipeline.check()),
            ("publish", config.publish.check()),
            ("last_pose", config.last_pose.check()),
            ("service", config.service.check()),
            ("metrics", config.metrics.check()),
        ] {
            checked.map_err(|SettingError { key, cause }| {
                text.wrong(&format!("{table}.{key}"), cause)
            })?;
        }
        Ok(config)
    }

    /// Surroundings tell places by whole pixels: the window finds each again to a fraction of one, and what goes from
    /// pair to pair does not.
    fn check_partners(&self) -> Result<(), SettingError> {
        let is_window = self.estimation.method == estimation::Method::Window;
        if self.matching.partners == matching::Partners::Features || is_window {
            return Ok(());
        }
        Err(SettingError {
            key: "partners",
            cause: "\"surroundings\" needs estimation.method = \"window\"".to_owned(),
        })
    }
}

fn check_camera(camera: Option<&capture::settings::CameraSettings>) -> Result<(), SettingError> {
    camera.map_or(Ok(()), capture::settings::CameraSettings::check)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error_of(text: &str) -> String {
        Config::parse(text)
            .expect_err("must be refused")
            .to_string()
    }

    #[test]
    fn surroundings_need_the_window() {
        let surroundings = "[matching]\npartners = \"surroundings\"\n";
        assert!(Config::parse(surroundings).is_ok());
        let bundle = format!("{surroundings}[estimation]\nmethod = \"bundle\"\n");
        assert_eq!(
            error_of(&bundle),
            "configuration:2: matching.partners: \"surroundings\" needs estimation.method = \"window\""
        );
    }

    #[test]
    fn an_empty_configuration_is_the_default() {
        assert_eq!(Config::parse("").expect("valid"), Config::default());
    }

    #[test]
    fn mistakes_are_named_with_line_and_key() {
        let unknown = error_of("[estimation]\nmethd = \"svd\"\n");
        assert!(
            unknown.starts_with("configuration:2: estimation.methd: unknown field `methd`"),
            "{unknown}"
        );
        assert_eq!(
            error_of("[matching]\n\nmax_ratio = 7.0\n"),
            "configuration:3: matching.max_ratio: must be from 0.1 to 1, but is 7"
        );
        assert_eq!(
            error_of("[features]\n[features.surf]\nhessian = -1.0\n"),
            "configuration:3: features.surf.hessian: must be from 0 to 1000000, but is -1"
        );
        let nan = error_of("[estimation]\ngate_sigma2 = nan\n");
        assert!(
            nan.contains("estimation.gate_sigma2: must be from 1 to 100"),
            "{nan}"
        );
        let method = error_of("estimation = { method = \"magic\" }");
        assert!(
            method.contains("estimation.method: unknown variant `magic`"),
            "{method}"
        );
    }
}
