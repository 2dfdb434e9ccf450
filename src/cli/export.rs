//! `splatvk export`
use super::args::{ExportArgs, ExportFormat};
use super::listing;
use crate::format::{
    colmap, create_folder, gaussians, gltf, ply, ply_packed, scene_dir, splat, spz, transforms, whole,
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
        ExportFormat::Splat => packed(args, &scene, splat::write_splats)?,
        ExportFormat::CompressedPly => packed(args, &scene, ply_packed::write_splats)?,
        // These keep the scene's order.
        ExportFormat::Spz => packed(args, &scene, in_order(spz::write_splats))?,
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
