//! Text queries on a loaded scene.
use super::measure::Budget;
use super::report::{Clock, Section};
use crate::gpu::Device;
use crate::infer::RegionEncoder;
use crate::query::{QueryOptions, answer};
use crate::run::sources;
use crate::run::view::Viewer;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};

/// One question to every camera of a scene, whose views are rendered and decoded once, before.
pub fn measure(
    device: &Device,
    scene: (&Splats, &LanguageField, &[Camera]),
    encoder: &mut dyn RegionEncoder,
    text: &str,
    budget: &Budget,
) -> Result<Section> {
    let (splats, field, cameras) = scene;
    let Some(first) = cameras.first() else {
        return Err(Error::input("the scene has no cameras to ask"));
    };
    let place = format!("“{text}” in {} views, {} × {}", cameras.len(), first.width, first.height);
    let mut section = Section::new("query", place);
    let mut viewer = Viewer::new(device, splats, field)?;
    let mut views = Vec::new();
    let rendering = budget.wall(|| {
        views = cameras.iter().map(|c| viewer.view(c)).collect::<Result<Vec<_>>>()?;
        Ok(())
    })?;
    section.time("render and decode all views", Clock::Wall, rendering);
    let texts = [text.to_owned()];
    let encoding = budget.wall(|| sources::queries(&texts, encoder).map(drop))?;
    section.time("encode the text", Clock::Wall, encoding);
    let query = budget.wall(|| {
        let queries = sources::queries(&texts, encoder)?;
        for (view, query) in views.iter().flat_map(|v| queries.iter().map(move |q| (v, q))) {
            answer(&view.codes, field, query, &QueryOptions::default())?;
        }
        Ok(())
    })?;
    section.time("query", Clock::Wall, query);
    Ok(section)
}
