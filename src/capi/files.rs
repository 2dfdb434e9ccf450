//! Scenes as files of other programs: exports, meshes, lists of things.
use super::boundary::{self, CallError, bad_argument};
use super::options::*;
use super::progress::Callback;
use super::scene::{SvkScene, with};
use super::types::SvkStatus;
use crate::format::scene_dir::Scene;
use crate::progress::Progress;
use crate::query::things::OBJECTS;
use crate::run::export::{Asked, ExportPlan};
use crate::run::mesh::{Collider, MeshPlan, TRIANGLES};
use crate::run::metric::Distance;
use crate::run::objects::{self, LEAST_SHARE, Listed, ObjectFiles, ObjectOptions};
use crate::run::{Machine, stored};
use crate::scene::UpAxis;
use crate::sync::lock;
use serde_json::Value;
use std::ffi::c_char;
use std::path::{Path, PathBuf};

/// Writes the scene as `splatvk export`: the format follows the ending of `path`; axes and unit
/// follow the direction up and the scale of the scene. `options` may be NULL. One line on what was
/// done is copied into `summary`, which has `summary_bytes` bytes and may be NULL. The output
/// appears complete or not at all. Formats of cameras and pages need a scene that is stored.
///
/// The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_export(
    scene: *mut SvkScene,
    path: *const c_char,
    options: *const SvkExportOptions,
    summary: *mut c_char,
    summary_bytes: usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |handle| {
            let file = path_in(path)?;
            let options = boundary::read_or_default(options)?;
            let plan = export_plan(&options)?;
            let progress = Callback::new(options.progress, options.user);
            let from = lock(&handle.live).path().to_path_buf();
            let out = plan.reserve(&from, &file, options.replace != 0)?;
            let (scene, _) = copied(handle);
            let done = out.write(scene, &progress)?;
            boundary::copy_text(&done.text, summary, summary_bytes);
            Ok(())
        })
    }
}

/// Writes the surfaces of the scene as triangles, as `splatvk mesh`, into a .glb, .ply or .obj.
/// `options` may be NULL. `info` receives the figures and may be NULL. The file appears complete or
/// not at all. Parts by object need a scene that is stored.
///
/// The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_mesh(
    scene: *mut SvkScene,
    path: *const c_char,
    options: *const SvkMeshOptions,
    info: *mut SvkMeshInfo,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |handle| {
            let file = path_in(path)?;
            let options = boundary::read_or_default(options)?;
            let given = boundary::path(options.cameras, "SvkMeshOptions.cameras")?;
            let progress = Callback::new(options.progress, options.user);
            let plan = mesh_plan(&options, given.as_deref(), &progress)?;
            let from = lock(&handle.live).path().to_path_buf();
            let inputs: Vec<&Path> = [Some(from.as_path()), given.as_deref()].into_iter().flatten().collect();
            let out = plan.reserve(&file, options.replace != 0, &inputs)?;
            let (scene, machine) = copied(handle);
            let figures = out.write(scene, &machine, &progress)?;
            if info.is_null() { Ok(()) } else { boundary::write(info, &mesh_info(&figures)) }
        })
    }
}

/// Writes the things of a stored scene with language into a folder, as `splatvk objects --out`:
/// objects.json, objects.csv, a file of Gaussians and a picture per thing, scene.glb with a named
/// node per thing, and scene.ply with the property `object`. `options` may be NULL. `*count`, which
/// may be NULL, receives the number of things, parts and subparts in objects.json. The files appear
/// complete or not at all.
///
/// The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_objects(
    scene: *mut SvkScene,
    folder: *const c_char,
    options: *const SvkObjectsOptions,
    count: *mut usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |handle| {
            let folder = path_in(folder)?;
            let options = boundary::read_or_default(options)?;
            let (files, things) = objects_plan(&options)?;
            let progress = Callback::new(options.progress, options.user);
            let from = lock(&handle.live).path().to_path_buf();
            let out = files.reserve(&folder, options.replace != 0, &[&from])?;
            let (mut scene, machine) = copied(handle);
            let (ready, list) = objects::of_scene(&mut scene, &machine, &things, &progress)?;
            let listed = Listed { scene: &mut scene, ready: &ready, list: &list };
            out.write(listed, &folder, &progress)?;
            if let Some(count) = count.as_mut() {
                *count = list.len();
            }
            Ok(())
        })
    }
}

unsafe fn path_in(path: *const c_char) -> Result<PathBuf, CallError> {
    // SAFETY: per the header.
    match unsafe { boundary::path(path, "path") }? {
        Some(path) => Ok(path),
        None => bad_argument("the path is null"),
    }
}

/// A copy of the scene, with its device and models.
fn copied(handle: &SvkScene) -> (Scene, Machine) {
    let live = lock(&handle.live);
    (live.copied(), live.machine())
}

unsafe fn export_plan(o: &SvkExportOptions) -> Result<ExportPlan, CallError> {
    // SAFETY: texts per the header.
    let text =
        |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkExportOptions.{field}")) };
    let up = match o.up {
        0 => None,
        1 => Some(UpAxis::MinusY),
        2 => Some(UpAxis::PlusY),
        3 => Some(UpAxis::PlusZ),
        other => return bad_argument(format!("SvkExportOptions.up is {other}; an SvkUpAxis")),
    };
    let ply_degree = match o.ply_degree {
        0 => ExportPlan::default().ply_degree,
        degree @ 1..=4 => degree - 1,
        other => return bad_argument(format!("SvkExportOptions.ply_degree is {other}; an SvkShDegree")),
    };
    if ![0, 2, 3, 4].contains(&o.spz_version) {
        return bad_argument(format!("SvkExportOptions.spz_version is {}; 2 to 4", o.spz_version));
    }
    Ok(ExportPlan {
        format: text(o.format, "format")?,
        ply_degree,
        spz_version: (o.spz_version > 0).then_some(o.spz_version),
        with_features: o.with_features != 0,
        title: text(o.title, "title")?,
        views: text(o.views, "views")?.map(PathBuf::from),
        guessed: o.guessed != 0,
        asked: Asked { up, metres: o.metres != 0, raw: o.raw != 0 },
    })
}

unsafe fn mesh_plan(
    o: &SvkMeshOptions,
    given: Option<&Path>,
    progress: &dyn Progress,
) -> Result<MeshPlan, CallError> {
    // SAFETY: texts per the header.
    let text = |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkMeshOptions.{field}")) };
    let length = |pointer, field: &str| -> Result<Option<Distance>, CallError> {
        let Some(text) = text(pointer, field)? else { return Ok(None) };
        match text.parse::<Distance>() {
            Ok(length) => Ok(Some(length)),
            Err(reason) => bad_argument(format!("SvkMeshOptions.{field}: {reason}")),
        }
    };
    let collider = match o.collider {
        0 => None,
        1 => Some(Collider::Hull),
        2 => Some(Collider::Decomposition),
        other => return bad_argument(format!("SvkMeshOptions.collider is {other}; an SvkCollider")),
    };
    let triangles = usize::try_from(o.triangles).unwrap_or(usize::MAX);
    Ok(MeshPlan {
        triangles: if triangles == 0 { TRIANGLES } else { triangles },
        error: length(o.error, "error")?,
        voxel: length(o.voxel, "voxel")?,
        fill_guessed: o.fill_guessed != 0,
        collider,
        by_object: o.by_object != 0,
        vocabulary: words(text(o.vocabulary, "vocabulary")?)?,
        cameras: given.map(|file| stored::cameras(file, progress)).transpose()?,
        raw: o.raw != 0,
        ..MeshPlan::default()
    })
}

fn words(text: Option<String>) -> Result<Option<Vec<String>>, CallError> {
    Ok(text.map(|text| objects::words(&text, "vocabulary")).transpose()?)
}

fn mesh_info(figures: &Value) -> SvkMeshInfo {
    let count = |key: &str| figures[key].as_u64().unwrap_or_default();
    let number = |key: &str| figures[key].as_f64().unwrap_or_default();
    SvkMeshInfo {
        size: 0,
        triangles: count("triangles"),
        vertices: count("vertices"),
        parts: count("parts"),
        border_edges: count("border_edges"),
        upright: u32::from(figures["up"] == "y"),
        metric: u32::from(figures["unit"] == "metre"),
        area: number("area"),
        voxel: number("voxel"),
        moved: number("moved"),
    }
}

unsafe fn objects_plan(o: &SvkObjectsOptions) -> Result<(ObjectFiles, ObjectOptions), CallError> {
    // SAFETY: texts per the header.
    let text =
        |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkObjectsOptions.{field}")) };
    let level = match o.pieces {
        0 => OBJECTS,
        1 => 1,
        2 => 0,
        3 => 2,
        other => return bad_argument(format!("SvkObjectsOptions.pieces is {other}; an SvkPieces")),
    };
    if !(0.0..=1.0).contains(&o.min_share) {
        return bad_argument(format!("SvkObjectsOptions.min_share is {}; 0 to 1", o.min_share));
    }
    let files = ObjectFiles {
        level,
        format: text(o.format, "format")?.unwrap_or_else(|| ObjectFiles::default().format),
        raw: o.raw != 0,
    };
    let things = ObjectOptions {
        vocabulary: words(text(o.vocabulary, "vocabulary")?)?,
        least_share: if o.min_share == 0.0 { LEAST_SHARE } else { o.min_share },
    };
    Ok((files, things))
}
