//! Networks of the user in a run: found before any work, listed in run.json.
use super::config::ReconstructionConfig;
use super::ignored;
use super::plan::RunPlan;
use super::sources::{DepthSources, FeatureSources, GeometrySources, MaskSources, MatchSources, installed};
use crate::Result;
use crate::infer::Registry;
use crate::infer::installed::{HashedFile, Installed};
use crate::progress::Progress;
use crate::report::ModelUsed;

/// Models that a plan uses: the built-in pack, and the files of networks.
///
/// # Errors
/// A missing network, or a file that cannot be read.
pub fn models_used(plan: &RunPlan) -> Result<Vec<ModelUsed>> {
    let registry = plan.machine.registry()?;
    let networks = Networks::find(&plan.config, &registry)?.used()?;
    let built_in = registry.status().into_iter().filter(|m| m.installed);
    let built_in = built_in.map(|m| ModelUsed { name: m.name, sha256: m.sha256, licence: m.licence });
    Ok(built_in.chain(networks).collect())
}

/// The networks of a configuration.
pub(super) struct Networks(Vec<Installed>);

impl Networks {
    /// Finds all networks; an error names the missing one.
    pub(super) fn find(config: &ReconstructionConfig, registry: &Registry) -> Result<Networks> {
        let geometry = &config.geometry;
        let mut found = vec![
            installed::<GeometrySources>(&geometry.init, registry)?,
            installed::<DepthSources>(&geometry.depth_prior, registry)?,
        ];
        if let Some(language) = &config.language {
            found.push(installed::<MatchSources>(&language.matcher, registry)?);
            found.push(installed::<MaskSources>(&language.masks, registry)?);
            found.push(installed::<FeatureSources>(&language.features, registry)?);
        }
        let mut found: Vec<Installed> = found.into_iter().flatten().collect();
        for network in ignored::networks(config, registry)? {
            if found.iter().all(|f| f.name != network.name) {
                found.push(network);
            }
        }
        Ok(Networks(found))
    }

    /// Whether built-in methods do all of the work.
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Entries of run.json.
    pub(super) fn used(&self) -> Result<Vec<ModelUsed>> {
        let mut used = Vec::new();
        for model in &self.0 {
            let licence = model.catalogue_entry().map_or("unknown", |k| k.licence.as_str());
            for HashedFile { path: file, sha256 } in model.files()? {
                let file = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
                let name =
                    format!("{} {file}{}", model.name, if model.untrained() { " (untrained)" } else { "" });
                used.push(ModelUsed { name, sha256, licence: licence.to_owned() });
            }
        }
        Ok(used)
    }

    pub(super) fn warn_untrained(&self, progress: &dyn Progress) {
        let names: Vec<&str> = self.0.iter().filter(|m| m.untrained()).map(|m| m.name.as_str()).collect();
        if !names.is_empty() {
            progress.warn(&format!(
                "{}: untrained weights; their outputs carry no meaning, only time and memory are real",
                names.join(", ")
            ));
        }
    }
}
