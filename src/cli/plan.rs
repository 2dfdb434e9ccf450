//! What the arguments mean: defaults resolved, names understood, contradictions refused. No work happens here.
use super::args::{DeviceArgs, MethodArg, PresetArg, RunArgs};
use crate::infer::installed::{Duty, Inventory, known};
use crate::language::Reducer;
use crate::language::sam::SamOptions;
use crate::photo::SMALLEST_SIDE;
use crate::run::{FeatureSource, InitSource, MaskSource, MatchSource, Method, RunPlan};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// `splatvk run`; `auto` is the best of `installed`, or what is built in.
pub fn run(args: &RunArgs, installed: &Inventory) -> Result<RunPlan> {
    let method = method(args.method);
    let recipe = method.recipe();
    let feature_dim = args.feature_dim.unwrap_or(recipe.feature_dim);
    if ![3, 8, 16].contains(&feature_dim) {
        return Err(Error::input(format!("--feature-dim {feature_dim}: choose 3, 8 or 16")));
    }
    if matches!(recipe.reducer, Reducer::Autoencoder { .. }) && feature_dim != 3 {
        return Err(Error::input(format!(
            "--feature-dim {feature_dim}: the autoencoder of --method langsplat has 3 dimensions; leave it out"
        )));
    }
    for (flag, value) in
        [("--iterations", args.iterations), ("--language-iterations", args.language_iterations)]
    {
        if value == Some(0) {
            return Err(Error::input(format!("{flag} 0: give at least 1, or leave it out")));
        }
    }
    if args.mask_points == 0 || args.mask_points > 128 {
        return Err(Error::input(format!("--mask-points {}: give 1 to 128", args.mask_points)));
    }
    if let Some(blank) = args.queries.iter().find(|q| q.trim().is_empty()) {
        return Err(Error::input(format!("--query \"{blank}\": give a few words")));
    }
    Ok(RunPlan {
        inputs: args.inputs.clone(),
        views: args.views,
        out: args.out.clone().unwrap_or_else(|| default_out(&args.inputs)),
        force: args.force,
        resume: args.resume,
        checkpoint_seconds: args.checkpoint_seconds,
        preset: args.preset.map(preset),
        init: init(&args.init, installed)?,
        matcher: matcher(&args.matcher, installed)?,
        masks: masks(&args.masks, installed)?,
        sam: SamOptions { points: args.mask_points, crops: !args.no_mask_crops, ..SamOptions::default() },
        features: features(&args.features, installed)?,
        queries: args.queries.clone(),
        seed: args.seed,
        iterations: args.iterations,
        language_iterations: args.language_iterations,
        method,
        feature_dim,
        per_level: args.per_level,
        max_size: max_size(args.max_size)?,
        device: args.device.device.clone(),
        deterministic: args.deterministic,
        models: models(&args.device),
    })
}

/// `--max-size`, if it leaves enough to work with.
pub fn max_size(given: Option<usize>) -> Result<Option<usize>> {
    match given {
        Some(n) if n < SMALLEST_SIDE => Err(Error::input(format!(
            "--max-size {n}: give at least {SMALLEST_SIDE} pixels, or leave it out"
        ))),
        _ => Ok(given),
    }
}

/// The folder of `--models`.
pub fn models(args: &DeviceArgs) -> Option<PathBuf> {
    args.models.clone()
}

fn method(method: MethodArg) -> Method {
    match method {
        MethodArg::Sparselgs => Method::SparseLgs,
        MethodArg::Langsplat => Method::LangSplat,
        MethodArg::Legaussians => Method::LeGaussians,
        MethodArg::Lsm => Method::Lsm,
    }
}

/// The library's preset.
pub fn preset(preset: PresetArg) -> crate::fit::Preset {
    match preset {
        PresetArg::Draft => crate::fit::Preset::Draft,
        PresetArg::Default => crate::fit::Preset::Default,
        PresetArg::Paper => crate::fit::Preset::Paper,
    }
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

fn init(text: &str, installed: &Inventory) -> Result<InitSource> {
    match text.split_once(':') {
        Some(("cameras", file)) if !file.is_empty() => Ok(InitSource::Cameras(existing("--init", file)?)),
        None if text == "auto" => {
            Ok(best(installed, Duty::Geometry).map_or(InitSource::Sfm, InitSource::Network))
        }
        None if text == "sfm" => Ok(InitSource::Sfm),
        None => network("--init", text, Duty::Geometry, "auto, sfm, cameras:FILE").map(InitSource::Network),
        _ => Err(unknown("--init", text, Duty::Geometry, "auto, sfm, cameras:FILE")),
    }
}

fn masks(text: &str, installed: &Inventory) -> Result<MaskSource> {
    match text.split_once(':') {
        Some(("dir", dir)) if !dir.is_empty() => Ok(MaskSource::Dir(existing("--masks", dir)?)),
        None if text == "auto" => {
            Ok(best(installed, Duty::Masks).map_or(MaskSource::Graph, MaskSource::Network))
        }
        None if text == "graph" => Ok(MaskSource::Graph),
        None => network("--masks", text, Duty::Masks, "auto, graph, dir:DIR").map(MaskSource::Network),
        _ => Err(unknown("--masks", text, Duty::Masks, "auto, graph, dir:DIR")),
    }
}

fn features(text: &str, installed: &Inventory) -> Result<FeatureSource> {
    match text.split_once(':') {
        Some(("dir", dir)) if !dir.is_empty() => Ok(FeatureSource::Dir(existing("--features", dir)?)),
        None if text == "auto" => {
            Ok(best(installed, Duty::Features).map_or(FeatureSource::Words, FeatureSource::Network))
        }
        None if text == "words" => Ok(FeatureSource::Words),
        None => {
            network("--features", text, Duty::Features, "auto, words, dir:DIR").map(FeatureSource::Network)
        }
        _ => Err(unknown("--features", text, Duty::Features, "auto, words, dir:DIR")),
    }
}

pub(super) fn existing(flag: &str, path: &str) -> Result<PathBuf> {
    let path = PathBuf::from(path);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::input(format!("{flag}: {} does not exist; check the path", path.display())))
}

fn matcher(text: &str, installed: &Inventory) -> Result<MatchSource> {
    match text {
        "auto" => Ok(best(installed, Duty::Matcher).map_or(MatchSource::Xfeat, MatchSource::Network)),
        "xfeat" => Ok(MatchSource::Xfeat),
        _ => network("--matcher", text, Duty::Matcher, "auto, xfeat").map(MatchSource::Network),
    }
}

fn best(installed: &Inventory, duty: Duty) -> Option<String> {
    installed.best(duty).map(|model| model.name.clone())
}

/// The name of a family of networks, or of one, that does what the flag asks for; whether it is installed is seen later.
fn network(flag: &str, name: &str, duty: Duty, built_in: &str) -> Result<String> {
    let meant = known().iter().any(|k| k.does(duty) && (k.family == name || k.id == name));
    if meant { Ok(name.to_owned()) } else { Err(unknown(flag, name, duty, built_in)) }
}

fn unknown(flag: &str, value: &str, duty: Duty, built_in: &str) -> Error {
    let mut choices: Vec<&str> = built_in.split(", ").collect();
    for model in known().iter().filter(|k| k.does(duty)) {
        if !choices.contains(&model.family.as_str()) {
            choices.push(&model.family);
        }
    }
    Error::input(format!("{flag} {value}: unknown; use one of: {}", choices.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::args::{Cli, Command};
    use crate::infer::installed::Installed;
    use clap::Parser;

    fn plan(extra: &[&str]) -> Result<RunPlan> {
        plan_with(extra, &Inventory::default())
    }

    fn plan_with(extra: &[&str], installed: &Inventory) -> Result<RunPlan> {
        let line = ["splatvk", "run", "tests/data/breakfast/images"].iter().chain(extra);
        match Cli::try_parse_from(line).unwrap().command {
            Command::Run(args) => run(&args, installed),
            _ => unreachable!(),
        }
    }

    #[test]
    fn defaults_are_the_built_in_models() {
        let plan = plan(&[]).unwrap();
        assert_eq!(plan.out, Path::new("out/breakfast"));
        assert_eq!((plan.init, plan.masks), (InitSource::Sfm, MaskSource::Graph));
        assert_eq!((plan.features, plan.feature_dim), (FeatureSource::Words, 16));
        assert_eq!(plan.method, Method::SparseLgs);
        assert_eq!((plan.matcher, plan.sam), (MatchSource::Xfeat, SamOptions::default()));
    }

    #[test]
    fn auto_takes_the_most_preferred_network_there_is() {
        let model = |name: &str, duty| Installed {
            name: name.to_owned(),
            family: String::new(),
            duties: vec![duty],
            graphs: Default::default(),
            folder: PathBuf::new(),
            unused: Vec::new(),
        };
        let models = [
            ("sam_vit_b", Duty::Masks),
            ("sam_vit_h", Duty::Masks),
            ("mine", Duty::Features),
            ("da3", Duty::Geometry),
            ("mast3r_512", Duty::Geometry),
        ];
        let installed = Inventory { models: models.map(|(n, d)| model(n, d)).into(), broken: Vec::new() };
        let plan = plan_with(&[], &installed).unwrap();
        assert_eq!(plan.masks, MaskSource::Network("sam_vit_h".into()));
        assert_eq!(plan.features, FeatureSource::Network("mine".into()));
        assert_eq!(plan.init, InitSource::Network("mast3r_512".into()));
        assert_eq!(plan.matcher, MatchSource::Xfeat);
        let plan =
            plan_with(&["--masks", "graph", "--init", "sfm", "--features", "words"], &installed).unwrap();
        assert_eq!(
            (plan.init, plan.masks, plan.features),
            (InitSource::Sfm, MaskSource::Graph, FeatureSource::Words)
        );
    }

    #[test]
    fn each_method_has_its_own_code_length() {
        for (name, dim) in [("sparselgs", 16), ("langsplat", 3), ("legaussians", 8), ("lsm", 16)] {
            assert_eq!(plan(&["--method", name]).unwrap().feature_dim, dim, "{name}");
        }
    }

    #[test]
    fn families_and_names_of_networks_are_understood() {
        let plan =
            plan(&["--init", "dust3r", "--matcher", "roma", "--masks", "sam_vit_h", "--features", "clip"])
                .unwrap();
        assert_eq!(plan.init, InitSource::Network("dust3r".into()));
        assert_eq!(plan.matcher, MatchSource::Network("roma".into()));
        assert_eq!(plan.masks, MaskSource::Network("sam_vit_h".into()));
        assert_eq!(plan.features, FeatureSource::Network("clip".into()));
    }

    #[test]
    fn what_cannot_be_meant_is_refused_with_the_choices() {
        for (extra, says) in [
            (["--init", "colmap"], "auto, sfm, cameras:FILE, mast3r, dust3r"),
            (["--masks", "clip"], "auto, graph, dir:DIR, sam"),
            (["--mask-points", "0"], "1 to 128"),
            (["--max-size", "63"], "at least 64 pixels"),
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
