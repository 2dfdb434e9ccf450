//! Latency of text queries on a loaded scene.
use super::measure::{Budget, Quartiles};
use super::report::{Clock, Section};
use crate::gpu::Device;
use crate::infer::RegionEncoder;
use crate::query::QueryOptions;
use crate::run::ask::QueryScene;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};

/// Measures one query in all views of a scene, which are rendered and decoded once before.
pub fn measure(
    device: &Device,
    (splats, field, cameras): (&Splats, LanguageField, &[Camera]),
    mut encoder: Box<dyn RegionEncoder>,
    text: &str,
    budget: &Budget,
) -> Result<Section> {
    let Some(first) = cameras.first() else {
        return Err(Error::input("the scene has no cameras to ask"));
    };
    let place = format!("“{text}” in {} views, {} × {}", cameras.len(), first.width, first.height);
    let mut section = Section::new("query", place);
    let encoding = budget.wall(|| encoder.embed_texts(&[text]).map(drop))?;
    let mut scene = QueryScene::open(device, (splats, cameras), field, encoder)?;
    let rendering = budget.wall(|| scene.set_views(cameras).map(drop))?;
    section.time("render and decode all views", Clock::Wall, rendering);
    section.time("encode the text", Clock::Wall, encoding);
    let query = budget.wall(|| {
        scene.forget_texts();
        scene.ask(text, &QueryOptions::default()).map(drop)
    })?;
    section.time("query", Clock::Wall, query);
    let again = budget.wall(|| scene.ask(text, &QueryOptions::default()).map(drop))?;
    section.time("query of a text asked before", Clock::Wall, again);
    let names: Vec<String> = scene.time_passes()?.into_keys().collect();
    if names.is_empty() {
        return Ok(section);
    }
    let passes = budget.repeat(|| scene.time_passes())?;
    for name in &names {
        let times: Vec<f64> = passes.iter().filter_map(|run| run.get(name)).copied().collect();
        section.time(name, Clock::Device, Quartiles::of(&times));
    }
    Ok(section)
}
