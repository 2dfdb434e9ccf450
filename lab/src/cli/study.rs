//! Data sets and plans of `splatlab ablate` and `splatlab figures`.
use super::args::{LayoutArg, StudyArgs};
use crate::ablate::{DataSet, Plan, Regime, Regions, Sources};
use crate::{Error, Result};
use splatvk::fit::RgbOptions;
use splatvk::infer::Registry;
use splatvk::infer::installed::{Inventory, inventory};
use splatvk::run::paper::PaperSources;
use splatvk::run::sources::{
    FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind, choose,
};
use splatvk::run::{Compat, GeometryConfig, LanguageConfig, ReconstructionConfig, TrainingConfig};
use std::path::PathBuf;

/// Opens data sets. Their names are the last components of their paths, as many as make all names
/// distinct.
pub(super) fn data_sets(folders: &[PathBuf], layout: LayoutArg) -> Result<Vec<DataSet>> {
    let absolute = |f: &PathBuf| f.canonicalize().unwrap_or_else(|_| f.clone());
    let parts: Vec<Vec<String>> = folders
        .iter()
        .map(|f| absolute(f).components().map(|c| c.as_os_str().to_string_lossy().into_owned()).collect())
        .collect();
    let longest = parts.iter().map(Vec::len).max().unwrap_or(1);
    let Some(n) = (1..=longest).find(|n| are_distinct(&parts, *n)) else {
        return Err(Error::input("--data: the same folder twice; give each once"));
    };
    let open = |(folder, parts): (&PathBuf, &Vec<String>)| {
        DataSet::open(last_components(parts, n), folder, layout.given())
    };
    folders.iter().zip(&parts).map(open).collect()
}

/// Whether the last `n` components of every path make a name of its own.
fn are_distinct(parts: &[Vec<String>], n: usize) -> bool {
    let mut names: Vec<String> = parts.iter().map(|p| last_components(p, n)).collect();
    names.sort();
    names.windows(2).all(|w| w[0] != w[1])
}

fn last_components(parts: &[String], n: usize) -> String {
    parts[parts.len().saturating_sub(n)..].join("/")
}

/// Plan without tables and with seed 0.
pub(super) fn plan(args: &StudyArgs, registry: &Registry) -> Result<Plan> {
    for (flag, value) in
        [("--iterations", args.iterations), ("--language-iterations", args.language_iterations)]
    {
        if value == Some(0) {
            return Err(Error::input(format!("{flag} 0: give at least 1, or leave it out")));
        }
    }
    let (regime, sources) = regime(args, sources(args, registry)?, registry)?;
    Ok(Plan {
        regime,
        tables: Vec::new(),
        regions: args.regions.as_deref().map(|s| regions(s, &sources)).transpose()?,
        sources,
        views: args.views,
        true_cameras: args.true_cameras,
        max_points: args.max_points,
        seeds: vec![0],
        iterations: args.iterations.unwrap_or_else(|| RgbOptions::preset(regime.preset).iterations),
        language_iterations: args.language_iterations.unwrap_or_else(|| regime.language_iterations()),
    })
}

/// Schedules and rules of every row, and with --paper the paper's networks.
fn regime(args: &StudyArgs, sources: Sources, registry: &Registry) -> Result<(Regime, Sources)> {
    if !args.paper {
        let compat = args.compat.as_deref().map_or(Ok(None), Compat::named)?;
        return Ok((Regime { preset: args.preset, compat, published: false }, sources));
    }
    let named = |source: &Option<String>, own: SourceChoice| match source {
        Some(_) => own,
        None => SourceChoice::named("auto"),
    };
    let config = ReconstructionConfig {
        geometry: GeometryConfig { init: named(&args.init, sources.init), ..GeometryConfig::default() },
        training: TrainingConfig::default(),
        language: Some(LanguageConfig {
            paper: true,
            paper_sources: args.paper_sources,
            matcher: named(&args.matcher, sources.matcher),
            masks: named(&args.masks, sources.masks),
            features: named(&args.features, sources.features),
            ..LanguageConfig::default()
        }),
    };
    let config = config.resolved(&inventory(registry))?;
    let language = config.language.unwrap_or_default();
    let regime = Regime {
        preset: config.training.preset.unwrap_or(Regime::OWN.preset),
        compat: language.compat,
        published: args.paper_sources == PaperSources::Own,
    };
    let LanguageConfig { matcher, masks, features, .. } = language;
    Ok((regime, Sources { init: config.geometry.init, matcher, masks, features }))
}

/// Sources of every row. Options that are not given default to the built-in sources, so that tables
/// of different machines are comparable.
fn sources(args: &StudyArgs, registry: &Registry) -> Result<Sources> {
    let (networks, own) = (inventory(registry), Sources::default());
    Ok(Sources {
        init: choose_or::<GeometrySources>(&args.init, own.init, &networks)?,
        matcher: choose_or::<MatchSources>(&args.matcher, own.matcher, &networks)?,
        masks: choose_or::<MaskSources>(&args.masks, own.masks, &networks)?,
        features: choose_or::<FeatureSources>(&args.features, own.features, &networks)?,
    })
}

fn choose_or<K: SourceKind>(
    text: &Option<String>,
    default: SourceChoice,
    networks: &Inventory,
) -> Result<SourceChoice> {
    text.as_deref().map_or(Ok(default), |text| choose::<K>(text, networks))
}

fn regions(text: &str, own: &Sources) -> Result<Regions> {
    match text.split_once(':') {
        Some(("dir", dir)) if !dir.is_empty() => Ok(Regions::given(existing("--regions", dir)?)),
        None if text == "built-in" => Ok(own.regions()),
        None if text == "flawed" => Ok(Regions::Flawed),
        None if text == "exact" => Ok(Regions::Exact),
        _ => Err(Error::input(format!(
            "--regions {text}: unknown; use one of: built-in, flawed, exact, dir:DIR"
        ))),
    }
}

fn existing(flag: &str, path: &str) -> Result<PathBuf> {
    let path = PathBuf::from(path);
    if path.exists() {
        return Ok(path);
    }
    Err(Error::input(format!("{flag}: {} does not exist; check the path", path.display())))
}
