//! `splatvk run`
use super::args::{DeviceArgs, SavingArgs, whole};
use super::kept::report_kept_stages;
use super::print::{ending, print, print_json};
use super::progress;
use crate::infer::installed::{Inventory, inventory};
use crate::run::base;
use crate::run::method::SPARSELGS;
use crate::run::sources::{FeatureSources, MaskSources, MatchSources, SourceChoice, SourceKind, choose};
use crate::run::{
    GeometryConfig, Inputs, LanguageConfig, ReconstructionConfig, RunPlan, RunRecord, TrainingConfig,
};
use crate::{Error, Result, files};
use clap::Args;
use std::path::{Path, PathBuf};

/// `splatvk run`
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Photos, folders of photos (JPEG, PNG, HEIC, AVIF, WebP, TIFF, EXR, HDR), or a video
    #[arg(required = true, value_name = "INPUT")]
    pub inputs: Vec<PathBuf>,
    /// Scene directory to write [default: out/NAME, after the input]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Ask the finished scene; may be repeated
    #[arg(long = "query", value_name = "TEXT")]
    pub queries: Vec<String>,
    /// How many photos to use: sharp ones that overlap, from different places [default: all, at
    /// most 4]
    #[arg(long, value_name = "N", value_parser = whole::<usize>(2..))]
    pub views: Option<usize>,
    /// Add the photos to this scene, made by run, instead of making one of their own; without
    /// --out, the larger scene stands beside it under the next number, and the old one stays
    #[arg(long, value_name = "SCENE", conflicts_with_all = ["views", "init", "depth_prior", "method", "feature_dim", "per_level", "compat"])]
    pub add: Option<PathBuf>,
    /// Working size and training
    #[command(flatten)]
    pub training: TrainingConfig,
    /// Where the scene is written
    #[command(flatten)]
    pub saving: SavingArgs,
    /// Sources of cameras and depth
    #[command(flatten)]
    pub geometry: GeometryConfig,
    /// Masks, features and codes
    #[command(flatten)]
    pub language: LanguageConfig,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

pub fn run(args: &RunArgs) -> Result<()> {
    let plan = plan(args, &inventory(&args.device.registry()?))?;
    let progress = progress::reporter();
    let outcome = crate::run::run(&plan, progress.as_ref())?;
    // Before the lines to copy, which are to be the last.
    report_kept_stages(progress.as_ref());
    if args.device.json {
        let record = serde_json::to_value(crate::run::run_record(&outcome));
        print_json(&record.map_err(|e| Error::work(format!("run record: {e}")))?)?;
    } else {
        print(&(crate::run::closing_table(&outcome) + &ending(&outcome.plan.output.out)))?;
    }
    Ok(())
}

/// Builds the plan of the arguments: names sources and refuses contradictions. No work happens
/// here.
fn plan(args: &RunArgs, installed: &Inventory) -> Result<RunPlan> {
    let asked = ReconstructionConfig {
        geometry: args.geometry.clone(),
        training: args.training.clone(),
        language: Some(args.language.clone()),
    };
    let mut queries = args.queries.clone();
    let config = match &args.add {
        None => asked.resolved(installed)?,
        Some(scene) => {
            let made = base::record_of(scene)?;
            // The scene's queries, then the new ones.
            queries = joined(&made.config.plan.inputs.queries, &args.queries);
            as_made(asked, &made, installed)?
        }
    };
    let out = match (&args.out, &args.add) {
        (Some(out), _) => out.clone(),
        (None, Some(scene)) => files::next_free(scene),
        (None, None) => default_out(&args.inputs),
    };
    Ok(RunPlan {
        inputs: Inputs {
            photos: args.inputs.clone(),
            add: args.add.clone(),
            views: args.views,
            photo_masks: args.saving.photo_masks.clone(),
            queries,
            ..Inputs::default()
        },
        config,
        machine: args.device.machine(),
        output: args.saving.destination(out),
    })
}

/// The texts of a scene, then the new ones.
fn joined(of_scene: &[String], asked: &[String]) -> Vec<String> {
    let new = asked.iter().filter(|text| !of_scene.contains(text));
    of_scene.iter().chain(new).cloned().collect()
}

/// Configuration of photos that join a scene: unset options are those of the scene.
fn as_made(
    asked: ReconstructionConfig,
    made: &RunRecord,
    installed: &Inventory,
) -> Result<ReconstructionConfig> {
    let method = asked.language.as_ref().map(|l| l.method(asked.training.preset));
    let of_scene = made.config.plan.config.language.clone().unwrap_or_default();
    let language = asked.language.unwrap_or_default();
    ReconstructionConfig {
        geometry: GeometryConfig::default(),
        training: TrainingConfig {
            preset: asked.training.preset.or(made.config.preset),
            ignore: joined(&made.config.plan.config.training.ignore, &asked.training.ignore),
            ..asked.training
        },
        language: Some(LanguageConfig {
            matcher: source_as_made::<MatchSources>(language.matcher, of_scene.matcher, installed)?,
            masks: source_as_made::<MaskSources>(language.masks, of_scene.masks, installed)?,
            features: source_as_made::<FeatureSources>(language.features, of_scene.features, installed)?,
            feature_dim: of_scene.feature_dim,
            per_level: of_scene.per_level,
            compat: of_scene.compat,
            // Explicit training options win.
            method: method.filter(|m| *m == &SPARSELGS).or(of_scene.method),
            ..language
        }),
    }
    .resolved(installed)
}

/// The requested source; for `auto` the one that the scene was made with.
fn source_as_made<K: SourceKind>(
    asked: SourceChoice,
    made: SourceChoice,
    installed: &Inventory,
) -> Result<SourceChoice> {
    if asked != SourceChoice::named("auto") {
        return Ok(asked);
    }
    // The scene may have been moved here from another machine.
    choose::<K>(&made.to_string(), installed).map_err(|e| {
        let option = K::OPTION;
        Error::input(format!("{e} (the scene was made with --{option} {made}; give --{option} again)"))
    })
}

/// `out/<name>` in the current folder; a folder called `images` takes its parent's name.
fn default_out(inputs: &[PathBuf]) -> PathBuf {
    let first = inputs.first().map(PathBuf::as_path).unwrap_or(Path::new("scene"));
    let folder = if first.is_file() { first.parent().unwrap_or(first) } else { first };
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_path_buf());
    let named = if has_generic_name(&folder) { folder.parent().unwrap_or(&folder) } else { &folder };
    Path::new("out").join(named.file_name().unwrap_or("scene".as_ref()))
}

fn has_generic_name(folder: &Path) -> bool {
    folder.file_name().is_some_and(|n| n == "images" || n == "photos" || n == "input")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::args::{Cli, Command};
    use crate::infer::installed::{Installed, Task};
    use crate::language::align::{AlignOptions, AreaScore};
    use crate::language::sam::SamOptions;
    use crate::run::Method;
    use clap::Parser;

    fn named(name: &str) -> SourceChoice {
        SourceChoice::named(name)
    }

    fn language(plan: &RunPlan) -> LanguageConfig {
        plan.config.language.clone().unwrap()
    }

    fn plan(extra: &[&str]) -> Result<RunPlan> {
        plan_with(extra, &Inventory::default())
    }

    fn plan_with(extra: &[&str], installed: &Inventory) -> Result<RunPlan> {
        let line = ["splatvk", "run", "tests/data/breakfast/images"].iter().chain(extra);
        match Cli::try_parse_from(line).unwrap().command {
            Command::Run(args) => super::plan(&args, installed),
            _ => unreachable!(),
        }
    }

    #[test]
    fn defaults_are_the_built_in_models() {
        let plan = plan(&[]).unwrap();
        assert_eq!(plan.output.out, Path::new("out/breakfast"));
        let ours = LanguageConfig {
            method: Some(Method::named("lift").unwrap()),
            feature_dim: Some(16),
            ..LanguageConfig::default()
        };
        assert_eq!(ours.sam(), SamOptions::default());
        let config = ReconstructionConfig { language: Some(ours), ..ReconstructionConfig::default() };
        assert_eq!(plan.config, config);
    }

    #[test]
    fn preset_option_sets_preset() {
        use crate::fit::Preset;
        for (name, preset) in
            [("draft", Preset::Draft), ("default", Preset::Default), ("paper", Preset::Paper)]
        {
            assert_eq!(plan(&["--preset", name]).unwrap().config.training.preset, Some(preset));
        }
    }

    #[test]
    fn added_photos_take_sources_of_scene() {
        let folder = tempfile::tempdir().unwrap();
        let made = serde_json::json!({
            "method": "lift", "masks": "dir:src", "features": "dir:tests", "ignore": ["person"],
        });
        let record = serde_json::json!({ "config": { "plan": made } });
        std::fs::write(folder.path().join("run.json"), record.to_string()).unwrap();
        let scene = folder.path().to_str().unwrap();
        let plan = plan(&["--add", scene, "--features", "words", "--ignore", "car"]).unwrap();
        assert_eq!(plan.config.training.ignore, ["person", "car"]);
        let language = language(&plan);
        assert_eq!(language.masks, SourceChoice::with("dir", "src"));
        assert_eq!(
            (language.features, language.matcher),
            (named("words"), named("xfeat")),
            "asked for, not recorded"
        );
    }

    #[test]
    fn auto_takes_most_preferred_network() {
        let model = |name: &str, task| Installed {
            name: name.to_owned(),
            family: String::new(),
            tasks: vec![task],
            graphs: Default::default(),
            folder: PathBuf::new(),
            unused: Vec::new(),
        };
        let models = [
            ("sam_vit_b", Task::Masks),
            ("sam_vit_h", Task::Masks),
            ("mine", Task::Features),
            ("da3", Task::Geometry),
            ("mast3r_512", Task::Geometry),
            ("depth_anything_v2_small", Task::Depth),
        ];
        let installed = Inventory { models: models.map(|(n, d)| model(n, d)).into(), broken: Vec::new() };
        let plan = plan_with(&[], &installed).unwrap();
        let found = language(&plan);
        assert_eq!((found.masks, found.features), (named("sam_vit_h"), named("mine")));
        assert_eq!((plan.config.geometry.init, found.matcher), (named("mast3r_512"), named("xfeat")));
        // Depth of a geometry network needs no prior, that of stereo takes the installed one.
        assert_eq!(plan.config.geometry.depth_prior, named("none"));
        let plan =
            plan_with(&["--masks", "graph", "--init", "sfm", "--features", "words"], &installed).unwrap();
        let found = language(&plan);
        let GeometryConfig { init, depth_prior } = plan.config.geometry;
        assert_eq!((init, depth_prior), (named("sfm"), named("depth_anything_v2_small")));
        assert_eq!((found.masks, found.features), (named("graph"), named("words")));
    }

    #[test]
    fn method_sets_code_length() {
        for (name, dim) in [("sparselgs", 16), ("langsplat", 3), ("legaussians", 8), ("lsm", 16)] {
            let plan = plan(&["--method", name]).unwrap();
            assert_eq!(language(&plan).feature_dim, Some(dim), "{name}");
        }
    }

    #[test]
    fn compat_is_resolved_in_plan() {
        let resolved = |extra: &[&str]| language(&plan(extra).unwrap());
        assert_eq!(resolved(&[]).recipe(None).align, AlignOptions::default());
        let paper = resolved(&["--compat", "paper"]);
        assert_eq!((paper.feature_dim, paper.per_level), (Some(3), true));
        assert_eq!(paper.recipe(None).align.area, AreaScore::Paper);
        assert_eq!(serde_json::to_value(&paper).unwrap()["compat"], "paper");
        let authors = resolved(&["--compat", "authors", "--feature-dim", "8"]);
        assert_eq!((authors.feature_dim, authors.sam().paint_in_order), (Some(8), true));
        assert!(!authors.recipe(None).build("x", 0).align.fusion, "dead at its own thresholds");
        let theirs = resolved(&["--compat", "langsplat", "--method", "legaussians"]);
        assert_eq!(theirs.feature_dim, Some(8));
        assert!(!theirs.recipe(None).build("x", 0).align.matching);
    }

    #[test]
    fn sources_accept_network_families_and_names() {
        let plan =
            plan(&["--init", "dust3r", "--matcher", "roma", "--masks", "sam_vit_h", "--features", "clip"])
                .unwrap();
        let found = language(&plan);
        assert_eq!((plan.config.geometry.init, found.matcher), (named("dust3r"), named("roma")));
        assert_eq!((found.masks, found.features), (named("sam_vit_h"), named("clip")));
    }

    #[test]
    fn invalid_options_are_refused_with_choices() {
        for (extra, expected) in [
            (["--init", "colmap"], "auto, sfm, cameras:FILE, mast3r, dust3r"),
            (["--masks", "clip"], "auto, graph, dir:DIR, sam"),
            (["--masks", "dir:nowhere"], "does not exist"),
            (["--features", "sam"], "auto, words, dir:DIR, clip"),
            (["--matcher", "sift"], "auto, xfeat, mast3r, roma"),
            (["--feature-dim", "5"], "3, 8 or 16"),
            (["--query", " "], "a few words"),
            (["--ignore", " "], "--ignore: "),
            (["--method=langsplat", "--feature-dim=16"], "has 3 dimensions"),
        ] {
            let error = plan(&extra).and_then(|plan| plan.inputs.check()).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains(expected), "{extra:?}: {error}");
        }
    }
}
