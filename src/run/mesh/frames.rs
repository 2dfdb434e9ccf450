//! Views of a scene as depth maps.
use super::things::{ThingLabels, Things};
use crate::Result;
use crate::format::scene_dir::Scene;
use crate::format::scene_photos;
use crate::gpu::Device;
use crate::pass::renderer::{RenderedFrame, Renderer};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::run::view::UnseenShare;
use crate::scene::{Camera, CameraOrbit, Image, RgbImage};
use glam::{DVec2, DVec3};
use splatvk_mesh::Frame;

/// Most pixels of all views: views are scaled down to it.
const MOST_PIXELS: f64 = 4e7;
/// Weight of colours of views between photos: they count where no photo shows a surface.
const BETWEEN: f32 = 0.01;

/// Renders the scene from its cameras and from views between neighbours.
pub(super) fn render(
    device: &Device,
    scene: &Scene,
    cameras: &[Camera],
    things: Option<&Things>,
    fill_guessed: bool,
    progress: &dyn Progress,
) -> Result<Vec<Frame>> {
    let mut renderer = Renderer::new(device, &scene.splats, &[], 0)?;
    let mut unseen = match fill_guessed || scene.seen.pixels.is_empty() {
        true => None,
        false => Some(UnseenShare::new(device, &scene.splats, &scene.seen)?),
    };
    let mut labels = things.map(|t| ThingLabels::new(device, &scene.splats, t)).transpose()?;
    let photos = photos(scene, cameras);
    let views = views(&mut renderer, scene, cameras)?;
    progress.begin("views", views.len() as u64);
    let mut frames = Vec::with_capacity(views.len());
    for (done, view) in views.iter().enumerate() {
        progress.check()?;
        let rendered = renderer.render(&view.camera)?;
        let unseen = unseen.as_mut().map(|u| u.view(&view.camera)).transpose()?;
        let labels = labels.as_mut().map(|l| l.view(&view.camera, &rendered.alpha)).transpose()?;
        let photo = view.photo.and_then(|i| photos.get(i));
        frames.push(Frame {
            weight: observed(&rendered, unseen.as_ref()),
            colour: colour(&rendered, photo),
            colour_weight: if view.photo.is_some() { 1.0 } else { BETWEEN },
            depth: rendered.depth,
            camera: view.camera.clone(),
            labels,
        });
        progress.step(done as u64 + 1, "");
    }
    progress.end();
    Ok(frames)
}

/// Share of every pixel that is a surface of a photo.
fn observed(rendered: &RenderedFrame, unseen: Option<&Image<f32>>) -> Image<f32> {
    let mut weight = rendered.alpha.clone();
    if let Some(unseen) = unseen {
        weight.data.iter_mut().zip(&unseen.data).for_each(|(w, u)| *w = (*w - u).max(0.0));
    }
    weight
}

/// Colours of a photo where it has some, otherwise the rendered ones over alpha.
fn colour(rendered: &RenderedFrame, photo: Option<&Photo>) -> RgbImage {
    let over = |c: &[f32; 3], a: &f32| c.map(|v| v / a.max(1e-3));
    let own: Vec<[f32; 3]> =
        rendered.rgb.data.iter().zip(&rendered.alpha.data).map(|(c, a)| over(c, a)).collect();
    let data = match photo.map(|p| (&p.image, p.coverage.as_ref())) {
        Some((image, _)) if image.data.len() != own.len() => own,
        Some((image, None)) => image.data.clone(),
        Some((image, Some(coverage))) => {
            let pixels = image.data.iter().zip(&own).zip(&coverage.share.data);
            pixels.map(|((photo, own), share)| if *share >= 1.0 { *photo } else { *own }).collect()
        }
        None => own,
    };
    RgbImage { data, ..rendered.rgb }
}

/// Photos of the scene in the order of its cameras; empty for other cameras and where they are not
/// kept.
fn photos(scene: &Scene, cameras: &[Camera]) -> Vec<Photo> {
    let own = !scene.cameras.is_empty() && scene.cameras == cameras;
    let photos = if own { scene_photos::load(&scene.path).unwrap_or_default() } else { Vec::new() };
    if photos.len() == cameras.len() { photos } else { Vec::new() }
}

struct View {
    camera: Camera,
    /// Index of the photo that it is.
    photo: Option<usize>,
}

/// The given cameras, then those between neighbours about the point that they look at.
fn views(renderer: &mut Renderer, scene: &Scene, cameras: &[Camera]) -> Result<Vec<View>> {
    let mut targets = Vec::new();
    for camera in cameras {
        let depth = renderer.render(camera)?.depth;
        targets.extend(depth.central_median().map(|z| {
            let middle = DVec2::new(f64::from(camera.width), f64::from(camera.height)) / 2.0;
            camera.unproject(middle, z)
        }));
    }
    let own = cameras.iter().enumerate().map(|(i, c)| View { camera: c.clone(), photo: Some(i) });
    let mut views: Vec<View> = own.collect();
    if !targets.is_empty() {
        let target = targets.iter().sum::<DVec3>() / targets.len() as f64;
        let up = scene.world.up.as_ref().map_or_else(|| CameraOrbit::mean_up(cameras), |up| up.direction);
        let orbit = CameraOrbit::new(cameras, target, up.normalize_or(-DVec3::Y));
        let between = orbit.between().into_iter().filter(|c| cameras.iter().all(|own| own.pose != c.pose));
        views.extend(between.map(|camera| View { camera, photo: None }));
    }
    let pixels: f64 = views.iter().map(|v| f64::from(v.camera.width) * f64::from(v.camera.height)).sum();
    if pixels > MOST_PIXELS {
        views.iter_mut().for_each(|v| v.camera = scaled(&v.camera, (MOST_PIXELS / pixels).sqrt()));
    }
    Ok(views)
}

fn scaled(camera: &Camera, by: f64) -> Camera {
    let side = |pixels: u32| ((f64::from(pixels) * by) as u32).max(1);
    camera.resized(side(camera.width), side(camera.height))
}
