//! `splatvk run`
use super::args::{DeviceArgs, EXPERTS, MakingArgs, compats, whole};
use super::kept::tell_of_kept_stages;
use super::plan;
use super::print::{ending, print, print_json};
use super::progress;
use crate::infer::installed::{Inventory, inventory};
use crate::language::Reducer;
use crate::language::sam::SamOptions;
use crate::photo::MAX_VIEWS;
use crate::query::phrasing;
use crate::run::base::Settings;
use crate::run::compat::{self, Compat};
use crate::run::method::{METHODS, SPARSELGS};
use crate::run::sources::{
    self, DepthSources, FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind,
    choose,
};
use crate::run::{Method, RunPlan};
use crate::{Error, Result, files};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
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
    #[arg(long, value_name = "N", value_parser = views())]
    pub views: Option<usize>,
    /// Add the photos to this scene, made by run, instead of making one of their own; without
    /// --out, the larger scene stands beside it under the next number, and the old one stays
    #[arg(long, value_name = "SCENE", conflicts_with_all = ["views", "init", "depth_prior", "method", "feature_dim", "per_level", "compat"])]
    pub add: Option<PathBuf>,
    /// How the scene is made
    #[command(flatten)]
    pub making: MakingArgs,
    /// Source of cameras, depth and points
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<GeometrySources>(), help_heading = SOURCES)]
    pub init: String,
    /// Source of depth where photos cannot be matched
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<DepthSources>(), help_heading = SOURCES)]
    pub depth_prior: String,
    /// Source of dense matches
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<MatchSources>(), help_heading = SOURCES)]
    pub matcher: String,
    /// Source of masks
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<MaskSources>(), help_heading = SOURCES)]
    pub masks: String,
    /// Source of features
    #[arg(long, default_value = "auto", value_name = "SOURCE", help = sources::help::<FeatureSources>(), help_heading = SOURCES)]
    pub features: String,
    /// Points along each side of a photo at which a mask network is asked
    #[arg(long, default_value_t = 32, value_name = "N", value_parser = whole::<usize>(1..=128), help_heading = SOURCES)]
    pub mask_points: usize,
    /// Do not ask the mask network about four overlapping crops as well: five times faster, misses
    /// small things
    #[arg(long, help_heading = SOURCES)]
    pub no_mask_crops: bool,
    /// Optimisation steps of the language stage, instead of the preset's
    #[arg(long, value_name = "N", value_parser = whole::<usize>(1..), help_heading = EXPERTS)]
    pub language_iterations: Option<usize>,
    /// Length of the codes that splats carry: 3, 8 or 16 [default: 16; --compat and langsplat 3,
    /// legaussians 8]
    #[arg(long, value_name = "D", value_parser = whole::<usize>(3..=16), help_heading = EXPERTS)]
    pub feature_dim: Option<usize>,
    /// How language gets onto the splats: this program's ways, or a baseline on the same geometry
    /// to compare with [default: lift; sparselgs with --preset paper, --language-iterations,
    /// --per-level or --compat]
    #[arg(long, value_parser = methods(), value_name = "METHOD", help_heading = EXPERTS)]
    pub method: Option<String>,
    /// One model per level as in the paper, instead of one geometry for all three
    #[arg(long, help_heading = EXPERTS)]
    pub per_level: bool,
    /// Do what can be done in several ways as the paper, its authors' code or LangSplat: area score
    /// and conditions of the alignment, order of masks, one model per level, 3 numbers per code,
    /// level and mask of answers
    #[arg(long, value_parser = compats(), value_name = "WHOSE", help_heading = EXPERTS)]
    pub compat: Option<String>,
    /// Device and models
    #[command(flatten)]
    pub device: DeviceArgs,
}

/// Heading of the options that say where the parts of a scene come from.
const SOURCES: &str = "Sources and networks";

fn views() -> impl Fn(&str) -> std::result::Result<usize, String> + Clone + Send + Sync {
    whole(2..=MAX_VIEWS as u64)
}

fn methods() -> PossibleValuesParser {
    PossibleValuesParser::new(METHODS.map(|m| PossibleValue::new(m.name).help(m.about)))
}

pub fn run(args: &RunArgs) -> Result<()> {
    let installed = inventory(&args.device.registry()?);
    let plan = match &args.add {
        Some(scene) => joining(args, scene, &installed)?,
        None => plan(args, &installed)?,
    };
    let progress = progress::reporter();
    let outcome = crate::run::run(&plan, progress.as_ref())?;
    if args.device.json {
        let record = serde_json::to_value(crate::run::run_record(&outcome));
        print_json(&record.map_err(|e| Error::work(format!("run record: {e}")))?)?;
    } else {
        print(&(crate::run::closing_table(&outcome) + &ending(&outcome.plan.out)))?;
    }
    tell_of_kept_stages(progress.as_ref());
    Ok(())
}

/// What the arguments mean: defaults resolved, names understood, contradictions refused; `auto` is
/// the best of `installed`, or what is built in. No work happens here.
fn plan(args: &RunArgs, installed: &Inventory) -> Result<RunPlan> {
    let compat = args.compat.as_deref().map_or(Ok(None), Compat::named)?;
    let preset = args.making.preset.map(plan::preset);
    let per_level = args.per_level || compat.is_some_and(|c| c.per_level);
    let method = match &args.method {
        Some(name) => Method::named(name)?,
        None => Method::by_default(preset, args.language_iterations, per_level),
    };
    let recipe = method.recipe;
    let feature_dim = args.feature_dim.unwrap_or_else(|| compat::feature_dim(compat, method));
    if ![3, 8, 16].contains(&feature_dim) {
        return Err(Error::input(format!("--feature-dim {feature_dim}: choose 3, 8 or 16")));
    }
    if matches!(recipe.reducer, Reducer::Autoencoder { .. }) && feature_dim != 3 {
        return Err(Error::input(format!(
            "--feature-dim {feature_dim}: the autoencoder of --method langsplat has 3 dimensions; leave it out"
        )));
    }
    for text in &args.queries {
        phrasing::check(text).map_err(|e| Error::input(format!("--query: {e}")))?;
    }
    let init = choose::<GeometrySources>(&args.init, installed)?;
    // A network that gives depth itself needs none suggested.
    let measured = GeometrySources::SOURCES.iter().any(|s| s.name == init.name);
    let depth_prior = match args.depth_prior.as_str() {
        "auto" if !measured => sources::default::<DepthSources>(),
        text => choose::<DepthSources>(text, installed)?,
    };
    Ok(RunPlan {
        inputs: args.inputs.clone(),
        add: None,
        views: args.views,
        out: args.out.clone().unwrap_or_else(|| default_out(&args.inputs)),
        force: args.making.force,
        photo_masks: args.making.photo_masks.clone(),
        resume: args.making.resume,
        checkpoint_seconds: args.making.checkpoint_seconds,
        preset,
        init,
        depth_prior,
        matcher: choose::<MatchSources>(&args.matcher, installed)?,
        masks: choose::<MaskSources>(&args.masks, installed)?,
        sam: SamOptions { points: args.mask_points, crops: !args.no_mask_crops, ..SamOptions::default() },
        features: choose::<FeatureSources>(&args.features, installed)?,
        queries: args.queries.clone(),
        seed: args.making.seed,
        iterations: args.making.iterations,
        language_iterations: args.language_iterations,
        sh_degree: args.making.sh_degree,
        method: Some(method),
        feature_dim,
        per_level,
        compat: None,
        max_size: args.making.max_size,
        device: args.device.device.clone(),
        deterministic: args.making.deterministic,
        cameras: Vec::new(),
        models: args.device.models.clone(),
        provider: args.device.provider.clone(),
    }
    .compatible(compat))
}

/// The plan for photos that join a scene: what the arguments leave open is as the scene was made.
fn joining(args: &RunArgs, scene: &Path, installed: &Inventory) -> Result<RunPlan> {
    let made = Settings::read(scene)?;
    let plan = plan(args, installed)?;
    let compat = made.compat().map_or(Ok(None), Compat::named)?;
    Ok(RunPlan {
        add: Some(scene.to_path_buf()),
        out: args.out.clone().unwrap_or_else(|| files::next_free(scene)),
        preset: plan.preset.or(made.preset()),
        init: sources::default::<GeometrySources>(),
        depth_prior: sources::default::<DepthSources>(),
        matcher: as_made::<MatchSources>(&made, &args.matcher, installed)?,
        masks: as_made::<MaskSources>(&made, &args.masks, installed)?,
        features: as_made::<FeatureSources>(&made, &args.features, installed)?,
        feature_dim: made.feature_dim().unwrap_or(plan.feature_dim),
        per_level: made.per_level(),
        // Steps that are asked for are done.
        method: Some(if plan.method() == &SPARSELGS { plan.method() } else { made.method()? }),
        queries: made.queries(&plan.queries),
        ..plan
    }
    .compatible(compat))
}

/// The source that is asked for; where that is left open, the one that the scene was made with.
fn as_made<K: SourceKind>(made: &Settings, asked: &str, installed: &Inventory) -> Result<SourceChoice> {
    let Some(recorded) = made.source(K::OPTION).filter(|_| asked == "auto") else {
        return choose::<K>(asked, installed);
    };
    // The scene knows no folders: it may have come from elsewhere.
    choose::<K>(recorded, installed).map_err(|e| {
        let option = K::OPTION;
        Error::input(format!("{e} (the scene was made with --{option} {recorded}; give --{option} again)"))
    })
}

/// `out/<name>` beside where the command runs; a folder called `images` takes its parent's name.
fn default_out(inputs: &[PathBuf]) -> PathBuf {
    let first = inputs.first().map(PathBuf::as_path).unwrap_or(Path::new("scene"));
    let folder = if first.is_file() { first.parent().unwrap_or(first) } else { first };
    let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_path_buf());
    let generic = |p: &Path| p.file_name().is_some_and(|n| n == "images" || n == "photos" || n == "input");
    let named = if generic(&folder) { folder.parent().unwrap_or(&folder) } else { &folder };
    Path::new("out").join(named.file_name().unwrap_or("scene".as_ref()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::args::{Cli, Command};
    use crate::infer::installed::{Installed, Task};
    use crate::language::align::{AlignOptions, AreaScore};
    use clap::Parser;

    fn named(name: &str) -> SourceChoice {
        SourceChoice::named(name)
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
        assert_eq!(plan.out, Path::new("out/breakfast"));
        assert_eq!(plan.method().name, "lift");
        assert_eq!((plan.init, plan.masks), (named("sfm"), named("graph")));
        assert_eq!((plan.features, plan.feature_dim), (named("words"), 16));
        assert_eq!((plan.matcher, plan.sam), (named("xfeat"), SamOptions::default()));
    }

    #[test]
    fn presets_are_those_that_are_asked_for() {
        use crate::fit::Preset;
        for (name, preset) in
            [("draft", Preset::Draft), ("default", Preset::Default), ("paper", Preset::Paper)]
        {
            assert_eq!(plan(&["--preset", name]).unwrap().preset, Some(preset));
        }
    }

    #[test]
    fn photos_that_join_a_scene_get_masks_and_features_from_where_it_has_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let made = serde_json::json!({ "method": "lift", "masks": "dir:src", "features": "dir:tests" });
        let record = serde_json::json!({ "config": { "plan": made } });
        std::fs::write(folder.path().join("run.json"), record.to_string()).unwrap();
        let line = ["splatvk", "run", "new.jpg", "--features", "words"];
        let Command::Run(args) = Cli::try_parse_from(line).unwrap().command else { unreachable!() };
        let plan = super::joining(&args, folder.path(), &Inventory::default()).unwrap();
        assert_eq!(plan.masks, SourceChoice::with("dir", "src"));
        assert_eq!(
            (plan.features, plan.matcher),
            (named("words"), named("xfeat")),
            "asked for, not recorded"
        );
    }

    #[test]
    fn auto_takes_the_most_preferred_network_there_is() {
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
        assert_eq!(plan.masks, named("sam_vit_h"));
        assert_eq!(plan.features, named("mine"));
        assert_eq!(plan.init, named("mast3r_512"));
        assert_eq!(plan.matcher, named("xfeat"));
        // Depth of a geometry network needs no suggestion, that of stereo takes what there is.
        assert_eq!(plan.depth_prior, named("none"));
        let plan =
            plan_with(&["--masks", "graph", "--init", "sfm", "--features", "words"], &installed).unwrap();
        assert_eq!(plan.depth_prior, named("depth_anything_v2_small"));
        assert_eq!((plan.init, plan.masks, plan.features), (named("sfm"), named("graph"), named("words")));
    }

    #[test]
    fn each_method_has_its_own_code_length() {
        for (name, dim) in [("sparselgs", 16), ("langsplat", 3), ("legaussians", 8), ("lsm", 16)] {
            assert_eq!(plan(&["--method", name]).unwrap().feature_dim, dim, "{name}");
        }
    }

    #[test]
    fn what_others_do_is_resolved_in_the_plan() {
        let ours = plan(&[]).unwrap();
        assert_eq!(ours.recipe().align, AlignOptions::default());
        let paper = plan(&["--compat", "paper"]).unwrap();
        let area = paper.recipe().align.area;
        assert_eq!((paper.feature_dim, paper.per_level, area), (3, true, AreaScore::Paper));
        assert_eq!(serde_json::to_value(&paper).unwrap()["compat"], "paper");
        let authors = plan(&["--compat", "authors", "--feature-dim", "8"]).unwrap();
        assert_eq!((authors.feature_dim, authors.sam.paint_in_order), (8, true));
        assert!(!authors.recipe().build("x", 0).align.fusion, "dead at its own thresholds");
        let theirs = plan(&["--compat", "langsplat", "--method", "legaussians"]).unwrap();
        assert_eq!((theirs.feature_dim, theirs.recipe().build("x", 0).align.matching), (8, false));
    }

    #[test]
    fn families_and_names_of_networks_are_understood() {
        let plan =
            plan(&["--init", "dust3r", "--matcher", "roma", "--masks", "sam_vit_h", "--features", "clip"])
                .unwrap();
        assert_eq!(plan.init, named("dust3r"));
        assert_eq!(plan.matcher, named("roma"));
        assert_eq!(plan.masks, named("sam_vit_h"));
        assert_eq!(plan.features, named("clip"));
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_the_choices() {
        for (extra, says) in [
            (["--init", "colmap"], "auto, sfm, cameras:FILE, mast3r, dust3r"),
            (["--masks", "clip"], "auto, graph, dir:DIR, sam"),
            (["--masks", "dir:nowhere"], "does not exist"),
            (["--features", "sam"], "auto, words, dir:DIR, clip"),
            (["--matcher", "sift"], "auto, xfeat, mast3r, roma"),
            (["--feature-dim", "5"], "3, 8 or 16"),
            (["--query", " "], "a few words"),
            (["--method=langsplat", "--feature-dim=16"], "has 3 dimensions"),
        ] {
            let error = plan(&extra).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains(says), "{extra:?}: {error}");
        }
    }
}
