//! `splatvk export`
use super::args::{ExportArgs, ExportFormat};
use super::listing;
use crate::format::{colmap, create_folder, ply, scene_dir, splat, transforms};
use crate::scene::Camera;
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
        ExportFormat::Splat => whole(&args.out, |path| splat::write_splats(path, &scene.splats))?,
        ExportFormat::Transforms => {
            let cameras = cameras(&scene, args)?;
            whole(&args.out, |path| transforms::write(path, cameras, None))?;
        }
        ExportFormat::Colmap => {
            let cameras = cameras(&scene, args)?;
            let points = colmap::read_points(&args.scene.join("cameras/colmap")).ok();
            colmap::write(&args.out, cameras, points.as_ref())?;
        }
    }
    listing(std::slice::from_ref(&args.out), args.json)
}

fn cameras<'a>(scene: &'a scene_dir::Scene, args: &ExportArgs) -> Result<&'a [Camera]> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a bare .ply has no cameras; give a scene directory",
            args.scene.display()
        )));
    }
    Ok(&scene.cameras)
}

/// Writes beside the target and renames: a file that was there stays until the new one is whole.
fn whole(out: &Path, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let mut name = out.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".partial-{}", std::process::id()));
    let partial = out.with_file_name(name);
    let outcome = write(&partial).and_then(|()| std::fs::rename(&partial, out).map_err(Error::io(out)));
    if outcome.is_err() {
        // The error is what matters; the partial file may not even exist.
        let _ = std::fs::remove_file(&partial);
    }
    outcome
}
