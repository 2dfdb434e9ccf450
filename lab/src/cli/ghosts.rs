//! `splatlab ghosts`: views of a scene whose photos show a passer-by, against the same photos
//! without.
use super::args::GhostsArgs;
use crate::generate::{CLEAN, USED};
use crate::{Error, Result};
use serde_json::{Value, json};
use splatvk::cli::args::EditUse;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::scene;
use splatvk::format::scene_photos;
use splatvk::gpu;
use splatvk::photo::{self, Photo};
use splatvk::run::view::Viewer;
use splatvk::scene::{Image, LanguageField, RgbImage};
use std::path::Path;

/// Squared errors of some pixels.
#[derive(Clone, Copy, Default)]
struct Errors {
    squares: f64,
    pixels: usize,
}

impl Errors {
    fn add(&mut self, shown: [f32; 3], truth: [f32; 3]) {
        let square = |c: usize| f64::from(shown[c] - truth[c]).powi(2) / 3.0;
        self.squares += (0..3).map(square).sum::<f64>();
        self.pixels += 1;
    }

    fn join(&mut self, other: Errors) {
        self.squares += other.squares;
        self.pixels += other.pixels;
    }

    /// PSNR, dB; `None` without pixels.
    fn psnr(self) -> Option<f64> {
        (self.pixels > 0).then(|| -10.0 * (self.squares / self.pixels as f64).log10())
    }
}

/// Overlap of the pixels that a scene does not use with those of the passer-by.
#[derive(Clone, Copy, Default)]
struct Overlap {
    both: usize,
    unused: usize,
    walker: usize,
}

pub fn ghosts(args: &GhostsArgs) -> Result<()> {
    let scene = scene::load(&args.scene, EditUse::default())?;
    let photos = scene_photos::load(&args.scene)?;
    let device = gpu::open(args.device.device.as_deref())?;
    let mut viewer = Viewer::new(&device, &scene.splats, &LanguageField::default())?;
    let (mut inside, mut outside, mut overlap) = <(Errors, Errors, Overlap)>::default();
    let mut views = Vec::new();
    for (photo, camera) in photos.iter().zip(&scene.cameras) {
        let (clean, walker) = truth(&args.ground_truth, photo)?;
        let shown = viewer.view(camera)?.rendered.rgb;
        let (mut own, mut rest) = <(Errors, Errors)>::default();
        for p in 0..shown.data.len() {
            let errors = if walker.data[p] { &mut own } else { &mut rest };
            errors.add(shown.data[p].map(|v| v.clamp(0.0, 1.0)), clean.data[p]);
            overlap.unused += usize::from(!photo.uses(p));
            overlap.walker += usize::from(walker.data[p]);
            overlap.both += usize::from(!photo.uses(p) && walker.data[p]);
        }
        views.push(json!({
            "photo": photo.stem, "pixels": own.pixels, "psnr_walker": own.psnr(), "psnr_rest": rest.psnr(),
        }));
        inside.join(own);
        outside.join(rest);
    }
    let record = json!({
        "psnr_walker": inside.psnr(), "psnr_rest": outside.psnr(),
        "walker_unused": share(overlap.both, overlap.walker),
        "rest_unused": share(overlap.unused - overlap.both, inside.pixels + outside.pixels - overlap.walker),
        "photos": views,
    });
    if args.device.json { print_json(&record) } else { print(&text(&record)) }
}

fn share(part: usize, of: usize) -> Option<f64> {
    (of > 0).then(|| part as f64 / of as f64)
}

/// The picture without the passer-by, and the pixels that show it, as the scene has its photo: at
/// the working size, without cut bars, undistorted.
fn truth(folder: &Path, photo: &Photo) -> Result<(RgbImage, Image<bool>)> {
    let (width, height) = (photo.image.width, photo.image.height);
    let whole = [0, 1].map(|k| {
        let side = if k == 0 { photo.original_size.0 } else { photo.original_size.1 };
        (f64::from(side) * photo.to_working.scale[k]).round() as usize
    });
    let [left, top] = photo.to_working.offset.map(|v| (-v).round().max(0.0) as usize);
    let read = |name: &str, ending: &str| {
        let path = folder.join(name).join(format!("{}.{ending}", photo.stem));
        let image = photo::load_at(&path, whole[0].max(whole[1]))?.image;
        if [image.width, image.height] != whole || left + width > image.width || top + height > image.height {
            return Err(Error::input(format!(
                "{}: {} × {} pixels, the scene's photo has {} × {}",
                path.display(),
                image.width,
                image.height,
                whole[0],
                whole[1]
            )));
        }
        let data = (0..width * height).map(|p| image.at(left + p % width, top + p / width)).collect();
        let cut = RgbImage { width, height, data };
        Ok(photo.straightened.as_ref().map_or_else(|| cut.clone(), |lens| lens.image(&cut)))
    };
    let used = read(USED, "png")?;
    // Averages at the rim of the mask have a part of the passer-by.
    let data = used.data.iter().map(|v| v[0] < 0.999).collect();
    Ok((read(CLEAN, "jpg")?, Image { width, height, data }))
}

fn text(record: &Value) -> String {
    let figure = |key: &str, scale: f64, unit: &str| {
        record[key].as_f64().map_or("-".to_owned(), |v| format!("{:.1} {unit}", scale * v))
    };
    format!(
        "PSNR to the photos without the walker: {} where it was, {} elsewhere\nnot used: {} of its pixels, {} of the others\n",
        figure("psnr_walker", 1.0, "dB"),
        figure("psnr_rest", 1.0, "dB"),
        figure("walker_unused", 100.0, "%"),
        figure("rest_unused", 100.0, "%"),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_pools_pixels() {
        let mut near = Errors::default();
        assert!(near.psnr().is_none());
        near.add([0.5; 3], [0.6; 3]);
        assert!((near.psnr().unwrap() - 20.0).abs() < 1e-4);
        let mut far = Errors::default();
        far.add([1.0, 0.0, 0.0], [0.0; 3]);
        near.join(far);
        let mean: f64 = (0.01 + 1.0 / 3.0) / 2.0;
        assert!((near.psnr().unwrap() + 10.0 * mean.log10()).abs() < 1e-5);
    }
}
