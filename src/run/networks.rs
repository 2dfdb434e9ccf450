//! The networks that users bring, as a run uses them: found before any work, named in run.json.
use super::{FeatureSource, InitSource, MaskSource, MatchSource, RunPlan};
use crate::Result;
use crate::infer::Registry;
use crate::infer::installed::{Duty, Installed};
use crate::progress::Progress;
use crate::report::ModelUsed;

/// The networks that a plan asks for.
pub(super) struct Networks {
    pub(super) geometry: Option<Installed>,
    pub(super) matcher: Option<Installed>,
    pub(super) masks: Option<Installed>,
    features: Option<Installed>,
}

impl Networks {
    /// Finds them all before any work; the error says what is missing.
    pub(super) fn of(plan: &RunPlan, registry: &Registry) -> Result<Networks> {
        let find = |duty, name: Option<&String>| name.map(|n| registry.installed(duty, n)).transpose();
        let geometry = match &plan.init {
            InitSource::Network(name) => Some(name),
            InitSource::Sfm | InitSource::Cameras(_) | InitSource::Given(_) => None,
        };
        let matcher = match &plan.matcher {
            MatchSource::Network(name) => Some(name),
            MatchSource::Xfeat => None,
        };
        let masks = match &plan.masks {
            MaskSource::Network(name) => Some(name),
            MaskSource::Graph | MaskSource::Dir(_) => None,
        };
        let features = match &plan.features {
            FeatureSource::Network(name) => Some(name),
            FeatureSource::Words | FeatureSource::Dir(_) => None,
        };
        Ok(Networks {
            geometry: find(Duty::Geometry, geometry)?,
            matcher: find(Duty::Matcher, matcher)?,
            masks: find(Duty::Masks, masks)?,
            features: find(Duty::Features, features)?,
        })
    }

    fn all(&self) -> impl Iterator<Item = &Installed> {
        [&self.geometry, &self.matcher, &self.masks, &self.features].into_iter().flatten()
    }

    /// What run.json says about them.
    pub(super) fn used(&self) -> Result<Vec<ModelUsed>> {
        let mut used = Vec::new();
        for model in self.all() {
            let licence = model.known().map_or("unknown", |k| k.licence.as_str());
            for (file, sha256) in model.files()? {
                let file = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let name =
                    format!("{} {file}{}", model.name, if model.untrained() { " (untrained)" } else { "" });
                used.push(ModelUsed { name, sha256, licence: licence.to_owned() });
            }
        }
        Ok(used)
    }

    pub(super) fn warn_untrained(&self, progress: &dyn Progress) {
        let names: Vec<&str> = self.all().filter(|m| m.untrained()).map(|m| m.name.as_str()).collect();
        if !names.is_empty() {
            progress.warn(&format!(
                "{}: untrained weights; what they say means nothing, only time and memory do",
                names.join(", ")
            ));
        }
    }
}
