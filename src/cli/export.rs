//! `splatvk export`
use super::args::{ExportArgs, ExportFormat};
use super::print::listing;
use super::progress;
use crate::format::{
    SH_C0, colmap, create_folder, gaussians, gltf, ply, ply_packed, scene_dir, splat, spz, transforms, whole,
};
use crate::scene::{Camera, Splats};
use crate::{Error, Result};
use std::path::Path;

pub fn export(args: &ExportArgs) -> Result<()> {
    let scene = scene_dir::load(&args.scene)?;
    if let Some(parent) = args.out.parent().filter(|p| !p.as_os_str().is_empty()) {
        create_folder(parent).map_err(|e| Error::input(format!("{e}; choose another --out")))?;
    }
    match args.format {
        ExportFormat::Ply => {
            let language = if args.with_features { scene.language.as_ref() } else { None };
            if args.with_features && language.is_none() {
                return Err(Error::input(format!(
                    "{}: the scene has no language; leave --with-features out",
                    args.scene.display()
                )));
            }
            let options = ply::PlyOptions { degree: args.ply_degree, language };
            whole(&args.out, |path| ply::write_splats(path, &scene.splats, options))?;
        }
        ExportFormat::Splat => {
            warn_of_range(&scene.splats, splat::BRIGHTEST);
            packed(args, &scene, splat::write_splats)?
        }
        ExportFormat::CompressedPly => packed(args, &scene, ply_packed::write_splats)?,
        // These keep the scene's order.
        ExportFormat::Spz => {
            warn_of_range(&scene.splats, spz::BRIGHTEST);
            packed(args, &scene, in_order(spz::write_splats))?
        }
        ExportFormat::Glb => packed(args, &scene, in_order(gltf::write_glb))?,
        ExportFormat::Gltf => packed(args, &scene, in_order(gltf::write_gltf))?,
        ExportFormat::Transforms => {
            let cameras = cameras(&scene, args)?;
            whole(&args.out, |path| transforms::write(path, cameras, None))?;
        }
        ExportFormat::Colmap | ExportFormat::ColmapBin => {
            let cameras = cameras(&scene, args)?;
            let points = colmap::read_points(&args.scene.join("cameras/colmap")).ok();
            let write =
                if args.format == ExportFormat::Colmap { colmap::write } else { colmap::write_binary };
            write(&args.out, cameras, points.as_ref())?;
        }
    }
    listing(std::slice::from_ref(&args.out), args.json)
}

/// Base colours of ordinary photos stay below this: of 145,000 splats of the breakfast scene one in 50,000 is above 1.1,
/// none above 1.25.
const ORDINARY: f32 = 1.25;
/// Share of the solid splats that may be cut off unnoticed.
const UNNOTICED: f64 = 5e-4;

/// Warns where a format of bytes cuts off what solid splats have beyond its `brightest` base colour.
fn warn_of_range(splats: &Splats, brightest: f32) {
    let row = splats.sh.len() / splats.len().max(1);
    let limit = brightest.max(ORDINARY);
    let (mut solid, mut cut) = (0usize, 0usize);
    for (logit, sh) in splats.opacity_logits.iter().zip(splats.sh.chunks_exact(row.max(1))) {
        if *logit > 0.0 {
            solid += 1;
            cut += usize::from(sh.iter().take(3).any(|dc| 0.5 + SH_C0 * dc > limit));
        }
    }
    if cut as f64 > UNNOTICED * solid as f64 {
        progress::here().warn(&format!(
            "the format ends at {brightest:.2} of white and {cut} splats are brighter: they are cut off; ply, \
             compressed-ply, glb and gltf keep them"
        ));
    }
}

fn in_order(write: fn(&Path, &Splats) -> Result<()>) -> impl FnOnce(&Path, &Splats) -> Result<Vec<u32>> {
    move |path, splats| write(path, splats).map(|()| Vec::new())
}

/// A format that only keeps what viewers draw, with the language in a file beside it.
fn packed(
    args: &ExportArgs,
    scene: &scene_dir::Scene,
    write: impl FnOnce(&Path, &Splats) -> Result<Vec<u32>>,
) -> Result<()> {
    gaussians::write_as(&args.out, &scene.splats, scene.language.as_ref(), write)
}

fn cameras<'a>(scene: &'a scene_dir::Scene, args: &ExportArgs) -> Result<&'a [Camera]> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no cameras; give a scene directory",
            args.scene.display()
        )));
    }
    Ok(&scene.cameras)
}
