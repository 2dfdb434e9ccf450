//! `--paper`: the published method in one switch. It stands for `--preset paper --compat paper` and
//! the paper's networks, and refuses settings and networks of another kind.
use super::compat;
use super::config::{GeometryConfig, LanguageConfig, TrainingConfig};
use super::sources::{FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind};
use crate::fit::Preset;
use crate::infer::installed::{Installed, Inventory};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Networks that [`apply`] accepts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "cli", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum PaperSources {
    /// MASt3R, RoMa, SAM and CLIP; without one of them the run is refused
    #[default]
    Own,
    /// Any sources, as without --paper
    Any,
}

/// A network of the paper: its name and the catalogue entries that are it.
struct Network(&'static str, &'static [&'static str]);

const GEOMETRY: Network = Network("MASt3R", &["mast3r"]);
const MATCHER: Network = Network("RoMa", &["roma"]);
const MASKS: Network = Network("SAM", &["sam_vit_h", "sam_vit_l", "sam_vit_b"]);
const FEATURES: Network = Network("CLIP", &["clip_vit_b16", "clip_vit_b32"]);

/// Sets the choices of the paper.
///
/// # Errors
/// A setting that contradicts them, and missing networks.
pub fn apply(
    geometry: &mut GeometryConfig,
    training: &mut TrainingConfig,
    language: &mut LanguageConfig,
    installed: &Inventory,
) -> Result<()> {
    let contradicts =
        |option: &str| Err(Error::input(format!("--paper sets {option} itself: leave one of the two out")));
    if training.preset.is_some_and(|preset| preset != Preset::Paper) {
        return contradicts("--preset");
    }
    if language.compat.is_some_and(|given| *given != compat::PAPER) {
        return contradicts("--compat");
    }
    (training.preset, language.compat) = (Some(Preset::Paper), Some(&compat::PAPER));
    if language.paper_sources == PaperSources::Any {
        return Ok(());
    }
    let choices = [
        choose::<GeometrySources>(&mut geometry.init, &GEOMETRY, installed)?,
        choose::<MatchSources>(&mut language.matcher, &MATCHER, installed)?,
        choose::<MaskSources>(&mut language.masks, &MASKS, installed)?,
        choose::<FeatureSources>(&mut language.features, &FEATURES, installed)?,
    ];
    let missing: Vec<String> = choices.into_iter().flatten().collect();
    if missing.is_empty() {
        return Ok(());
    }
    Err(Error::missing_model(
        "paper",
        format!(
            "--paper: {} not installed; `splatvk models fetch paper --accept mast3r` installs the paper's networks, and \
             --paper-sources any takes the sources that are there",
            match missing.as_slice() {
                [one] => format!("{one} is"),
                several => format!("{} are", several.join(", ")),
            }
        ),
    ))
}

/// Chooses an installed network of the paper; returns its name where none is installed.
fn choose<K: SourceKind>(
    choice: &mut SourceChoice,
    Network(name, entries): &Network,
    installed: &Inventory,
) -> Result<Option<String>> {
    let is_it = |model: &&Installed| {
        let entry = model.catalogue_entry().is_some_and(|entry| entries.contains(&entry.id.as_str()));
        entry && model.tasks.contains(&K::TASK) && !model.untrained()
    };
    let text = choice.to_string();
    let is_chosen = |model: &&Installed| text == "auto" || text == model.name || text == model.family;
    // The first entry is the one that the paper or its code names.
    let rank = |model: &&Installed| {
        let entry = model.catalogue_entry().map(|entry| entry.id.as_str());
        entries.iter().position(|id| entry == Some(id))
    };
    match installed.models.iter().filter(is_it).filter(is_chosen).min_by_key(rank) {
        Some(model) => *choice = SourceChoice::named(&model.name),
        None if text == "auto" || entries.contains(&text.as_str()) => return Ok(Some((*name).to_owned())),
        None => {
            return Err(Error::input(format!(
                "--{} {text}: --paper uses {name}; leave it out, or give --paper-sources any",
                K::OPTION
            )));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::ReconstructionConfig;
    use crate::run::method::SPARSELGS;
    use std::collections::BTreeMap;

    fn installed(models: &[&str]) -> Inventory {
        let model = |name: &&str| Installed {
            name: (*name).to_owned(),
            family: name.split('_').next().unwrap_or_default().to_owned(),
            tasks: match *name {
                "mast3r" => vec![GeometrySources::TASK],
                "roma_outdoor" | "romav2" => vec![MatchSources::TASK],
                name if name.contains("sam") => vec![MaskSources::TASK],
                _ => vec![FeatureSources::TASK],
            },
            graphs: BTreeMap::new(),
            folder: "/models".into(),
            unused: Vec::new(),
        };
        Inventory { models: models.iter().map(model).collect(), broken: Vec::new() }
    }

    fn resolved(models: &[&str], change: impl Fn(&mut ReconstructionConfig)) -> Result<ReconstructionConfig> {
        let mut config = ReconstructionConfig::default();
        let auto = || SourceChoice::named("auto");
        config.geometry.init = auto();
        let mut language = LanguageConfig {
            paper: true,
            matcher: auto(),
            masks: auto(),
            features: auto(),
            ..Default::default()
        };
        std::mem::swap(config.language.as_mut().unwrap(), &mut language);
        change(&mut config);
        config.resolved(&installed(models))
    }

    const ALL: [&str; 7] =
        ["mast3r", "romav2", "roma_outdoor", "mobile_sam", "sam_vit_b", "clip_vit_b32", "clip_vit_b16_laion"];

    #[test]
    fn paper_sets_whole_regime() {
        let config = resolved(&ALL, |_| {}).unwrap();
        assert_eq!(config.training.preset, Some(Preset::Paper));
        let language = config.language.unwrap();
        assert_eq!(
            (config.geometry.init.name.as_str(), language.matcher.name.as_str()),
            ("mast3r", "roma_outdoor")
        );
        assert_eq!(
            (language.masks.name.as_str(), language.features.name.as_str()),
            ("sam_vit_b", "clip_vit_b16_laion")
        );
        assert_eq!(language.compat, Some(&compat::PAPER));
        assert_eq!(language.method, Some(&SPARSELGS));
        assert!(language.per_level && language.feature_dim == Some(3));
    }

    #[test]
    fn paper_refuses_substitutes() {
        let missing = resolved(&["mast3r", "romav2", "mobile_sam"], |_| {}).unwrap_err();
        let text = missing.to_string();
        assert!(
            text.contains("RoMa, SAM, CLIP are not installed") && text.contains("--paper-sources any"),
            "{text}"
        );
        let refused = |change: fn(&mut ReconstructionConfig)| resolved(&ALL, change).unwrap_err().to_string();
        let sfm = refused(|c| c.geometry.init = SourceChoice::named("sfm"));
        assert!(sfm.contains("--init sfm: --paper uses MASt3R"), "{sfm}");
        assert!(
            refused(|c| c.training.preset = Some(Preset::Draft)).contains("--paper sets --preset itself")
        );
        let compat = refused(|c| c.language.as_mut().unwrap().compat = Some(&compat::LANGSPLAT));
        assert!(compat.contains("--paper sets --compat itself"), "{compat}");
        let any =
            |c: &mut ReconstructionConfig| c.language.as_mut().unwrap().paper_sources = PaperSources::Any;
        let config = resolved(&[], any).unwrap();
        assert_eq!(config.geometry.init.name, "sfm");
        assert_eq!(config.language.unwrap().compat, Some(&compat::PAPER));
    }
}
