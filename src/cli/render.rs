//! `splatvk render`
use super::args::{Channel, ImageFormat, RenderArgs};
use super::film;
use super::path::PathOutput;
use super::print::{listing, print, print_json};
use super::progress;
use super::scene;
use super::views;
use crate::format::npy::{self, NpyArray};
use crate::format::picture::{self, Planes};
use crate::format::views::Views;
use crate::gpu;
use crate::photo::VideoWriter;
use crate::report::colour;
use crate::run::outputs::WrittenFiles;
use crate::run::path::PathViews;
use crate::run::view::{DecodedFrame, UnseenShare, Viewer};
use crate::scene::{Camera, Image, LEVEL_NAMES, LanguageField, RgbImage, to_linear};
use crate::{Error, Result};
use serde_json::json;
use std::path::{Path, PathBuf};

pub fn render(args: &RenderArgs) -> Result<()> {
    if film::is_wanted(args) {
        return film::film(args);
    }
    let inputs: Vec<&Path> =
        std::iter::once(&args.scene).chain(&args.cameras).map(PathBuf::as_path).collect();
    let mut out = WrittenFiles::open(&args.out, args.force, &inputs)?;
    if args.video {
        VideoWriter::check("--video", "or leave the video out")?;
    }
    let scene = scene::load(&args.scene, args.edits)?;
    let given = match args.view.as_slice() {
        [] => args.cameras.as_deref().map(views::read).transpose()?,
        names => Some(named(&args.scene, names, args.height)?),
    };
    let wants_language = args.channels.iter().any(|c| matches!(c, Channel::Features | Channel::Codes));
    if wants_language && scene.language.is_none() {
        return Err(Error::input(format!(
            "{}: the scene has no language, so no features and codes; leave them out of --channels",
            args.scene.display()
        )));
    }
    let wants_unseen = args.channels.contains(&Channel::Unseen);
    if wants_unseen && scene.seen.pixels.is_empty() {
        return Err(Error::input(format!(
            "{}: what the photos show of the scene is not known, so no unseen; leave it out of --channels, or make the scene \
             again with this version",
            args.scene.display()
        )));
    }
    let no_language = LanguageField::default();
    let field = if wants_language { scene.language.as_ref().unwrap_or(&no_language) } else { &no_language };
    let device = gpu::open(args.device.device.as_deref())?;
    let mut viewer = Viewer::new(&device, &scene.splats, field)?
        .with_backdrop(&scene.backdrop)?
        .with_holes(&scene.holes)?;
    let mut unseen =
        wants_unseen.then(|| UnseenShare::new(&device, &scene.splats, &scene.seen)).transpose()?;
    let mut path = match args.path {
        Some(kind) => {
            let views = PathViews::new(&mut viewer, &scene.cameras, &scene.world)?;
            Some(PathOutput::new(kind.into(), views))
        }
        None => None,
    };
    let cameras = path.as_ref().map(|p| p.cameras().to_vec()).or(given).unwrap_or_default();
    let stems = views::stems(&cameras)?;
    if path.is_some() && stems.iter().any(|s| s == "sheet") {
        return Err(Error::input(
            "--path: a photo is called \"sheet\", as the sheet of all views; rename it",
        ));
    }
    let progress = progress::reporter();
    progress.begin("render", cameras.len() as u64);
    for (i, (camera, stem)) in cameras.iter().zip(&stems).enumerate() {
        progress.check()?;
        let view = if args.channels.contains(&Channel::Features) {
            viewer.view_with_features(camera)?
        } else {
            viewer.view(camera)?
        };
        if let Some(path) = &mut path {
            path.add(camera, &view);
        }
        let unseen = unseen.as_mut().map(|u| u.view(camera)).transpose()?;
        let view = View { decoded: &view, unseen: unseen.as_ref() };
        for format in &args.formats {
            match format {
                ImageFormat::Png => png(&mut out, stem, &args.channels, view, field)?,
                ImageFormat::Exr => exr(&mut out, stem, &args.channels, view)?,
                ImageFormat::Npy => arrays(&mut out, stem, &args.channels, view, field)?,
            }
        }
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    let Some(path) = path else { return listing(&out.keep()?, args.device.json) };
    path.write_sheet(&mut out)?;
    if args.video {
        path.write_video(&mut viewer, &mut out, progress.as_ref())?;
    }
    let files = out.keep()?;
    if args.device.json {
        return print_json(&json!({ "files": files, "views": path.json() }));
    }
    print(&path.table())?;
    listing(&files, false)
}

/// Cameras of named views of a scene.
fn named(scene: &Path, names: &[String], height: u32) -> Result<Vec<Camera>> {
    let views = Views::of_scene(scene)?;
    names.iter().map(|name| Ok(views.named(name)?.camera(height))).collect()
}

/// Output of one camera.
#[derive(Clone, Copy)]
struct View<'a> {
    decoded: &'a DecodedFrame,
    /// [H, W] share of unseen splats, if requested.
    unseen: Option<&'a Image<f32>>,
}

/// Levels of the field that have codes: (name, first feature channel, number of channels, index).
fn levels(field: &LanguageField) -> Vec<(&'static str, usize, usize, usize)> {
    let mut first = 0;
    let mut out = Vec::new();
    for (index, (name, level)) in LEVEL_NAMES.into_iter().zip(&field.levels).enumerate() {
        if !level.codebook.is_empty() {
            out.push((name, first, level.codebook.code_dim, index));
            first += level.codebook.code_dim;
        }
    }
    out
}

/// Features of one level, [H, W, d].
fn level_features(view: &DecodedFrame, first: usize, d: usize) -> Vec<f32> {
    let pixels = view.rendered.features.chunks_exact(view.rendered.feature_dim.max(1));
    pixels.flat_map(|f| f[first..first + d].iter().copied()).collect()
}

/// Writes previews: exact values are in the EXR and npy files.
fn png(
    out: &mut WrittenFiles,
    stem: &str,
    channels: &[Channel],
    View { decoded: view, unseen }: View,
    field: &LanguageField,
) -> Result<()> {
    let frame = &view.rendered;
    for channel in channels {
        match channel {
            Channel::Rgb => picture::write_png(&out.file(&format!("{stem}.png"))?, view.picture())?,
            Channel::Alpha => {
                picture::write_grey_png(&out.file(&format!("{stem}_alpha.png"))?, &frame.alpha)?
            }
            Channel::Depth => {
                picture::write_png(
                    &out.file(&format!("{stem}_depth.png"))?,
                    &colour::depth_image(&frame.depth),
                )?;
            }
            Channel::Features => {
                for (name, first, d, _) in levels(field) {
                    let image = false_colour(&level_features(view, first, d), d, &frame.alpha);
                    picture::write_png(&out.file(&format!("{stem}_features_{name}.png"))?, &image)?;
                }
            }
            Channel::Unseen => {
                if let Some(share) = unseen {
                    picture::write_grey_png(&out.file(&format!("{stem}_unseen.png"))?, share)?;
                }
            }
            Channel::Codes => {
                for (name, _, _, index) in levels(field) {
                    let image = colour::label_image(&view.codes[index]);
                    picture::write_png(&out.file(&format!("{stem}_codes_{name}.png"))?, &image)?;
                }
            }
        }
    }
    Ok(())
}

/// The first three components of the unit features as a colour.
fn false_colour(features: &[f32], d: usize, like: &Image<f32>) -> RgbImage {
    RgbImage {
        width: like.width,
        height: like.height,
        data: features.chunks_exact(d.max(1)).map(unit_colour).collect(),
    }
}

fn unit_colour(feature: &[f32]) -> [f32; 3] {
    let norm = feature.iter().map(|v| v * v).sum::<f32>().sqrt();
    [0, 1, 2].map(|k| if norm > 0.0 && k < feature.len() { 0.5 + 0.5 * feature[k] / norm } else { 0.0 })
}

fn exr(
    out: &mut WrittenFiles,
    stem: &str,
    channels: &[Channel],
    View { decoded: view, unseen }: View,
) -> Result<()> {
    let frame = &view.rendered;
    let has = |c: Channel| channels.contains(&c);
    // OpenEXR holds linear light.
    let linear = has(Channel::Rgb)
        .then(|| RgbImage { data: frame.rgb.data.iter().map(|c| c.map(to_linear)).collect(), ..frame.rgb });
    let planes = Planes {
        rgb: linear.as_ref(),
        alpha: has(Channel::Alpha).then_some(&frame.alpha),
        depth: has(Channel::Depth).then_some(&frame.depth),
        unseen,
        features: has(Channel::Features).then_some((frame.feature_dim, frame.features.as_slice())),
        codes: if has(Channel::Codes) { &view.codes } else { &[] },
    };
    picture::write_exr(&out.file(&format!("{stem}.exr"))?, (frame.rgb.width, frame.rgb.height), planes)
}

fn arrays(
    out: &mut WrittenFiles,
    stem: &str,
    channels: &[Channel],
    View { decoded: view, unseen }: View,
    field: &LanguageField,
) -> Result<()> {
    let frame = &view.rendered;
    let size = (frame.rgb.width, frame.rgb.height);
    for channel in channels {
        match channel {
            Channel::Rgb => {
                let values: Vec<f32> = frame.rgb.data.iter().flatten().copied().collect();
                picture::write_npy(&out.file(&format!("{stem}_rgb.npy"))?, size, Some(3), &values)?;
            }
            Channel::Alpha => {
                picture::write_npy(&out.file(&format!("{stem}_alpha.npy"))?, size, None, &frame.alpha.data)?
            }
            Channel::Depth => {
                picture::write_npy(&out.file(&format!("{stem}_depth.npy"))?, size, None, &frame.depth.data)?
            }
            Channel::Features => {
                for (name, first, d, _) in levels(field) {
                    let path = out.file(&format!("{stem}_features_{name}.npy"))?;
                    picture::write_npy(&path, size, Some(d), &level_features(view, first, d))?;
                }
            }
            Channel::Unseen => {
                if let Some(share) = unseen {
                    picture::write_npy(&out.file(&format!("{stem}_unseen.npy"))?, size, None, &share.data)?;
                }
            }
            Channel::Codes => {
                for (name, _, _, index) in levels(field) {
                    let codes = NpyArray::i32(&[size.1, size.0], view.codes[index].data.clone());
                    npy::write(out.file(&format!("{stem}_codes_{name}.npy"))?, &codes)?;
                }
            }
        }
    }
    Ok(())
}
