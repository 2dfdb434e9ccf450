//! Scenes: loading, reading, queries, saving.
use super::boundary::{self, CallError, LastError, bad_argument, guard, guard_number};
use super::context::SvkContext;
use super::types::*;
use crate::Error;
use crate::gpu::external::Delivery;
use crate::query::QueryResult;
use crate::query::instances::Instance;
use crate::query::presence::Presence;
use crate::run::Answers;
use crate::run::live::LiveScene;
use crate::scene::{Camera, Pose};
use crate::sync::lock;
use glam::{DMat3, DVec3};
use std::ffi::c_char;
use std::sync::Mutex;

/// A trained or loaded scene.
pub struct SvkScene {
    pub(super) live: Mutex<LiveScene>,
    /// Copies to buffers and images of the host that may be unfinished.
    pub(super) deliveries: Mutex<Vec<Delivery>>,
    pub(super) error: LastError,
}

impl SvkScene {
    pub(super) fn boxed(live: LiveScene) -> *mut SvkScene {
        let scene =
            SvkScene { live: Mutex::new(live), deliveries: Mutex::default(), error: LastError::default() };
        Box::into_raw(Box::new(scene))
    }
}

/// Runs the body of a function with a scene.
pub(super) unsafe fn with(
    scene: *const SvkScene,
    body: impl FnOnce(&SvkScene) -> Result<(), CallError>,
) -> SvkStatus {
    // SAFETY: per the header.
    match unsafe { scene.as_ref() } {
        Some(scene) => guard(&scene.error, || body(scene)),
        None => SvkStatus::Argument,
    }
}

/// Reads and checks a camera of the host.
pub(super) unsafe fn camera_in(pointer: *const SvkCamera) -> Result<Camera, CallError> {
    // SAFETY: per the header.
    let c = unsafe { boundary::read(pointer) }?;
    let [x, y, z] = c.world_to_camera;
    let rows = DMat3::from_cols(
        DVec3::new(x[0], x[1], x[2]),
        DVec3::new(y[0], y[1], y[2]),
        DVec3::new(z[0], z[1], z[2]),
    );
    let pose = Pose { rotation: rows.transpose(), translation: DVec3::new(x[3], y[3], z[3]) };
    let camera = Camera {
        name: "camera".into(),
        width: c.width,
        height: c.height,
        fx: c.fx,
        fy: c.fy,
        cx: c.cx,
        cy: c.cy,
        pose,
    };
    camera.checked().map_err(|e| CallError::Error(Error::input(e)))
}

/// Loads a scene directory, or a file of Gaussians, with the language file beside it if there is
/// one. On failure `*scene` is NULL and the context keeps the error text. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_load(
    context: *mut SvkContext,
    path: *const c_char,
    scene: *mut *mut SvkScene,
) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(context) = (unsafe { boundary::handle(context, "context") }) else { return SvkStatus::Argument };
    guard(&context.error, || {
        // SAFETY: per the header.
        let (slot, path) = unsafe { (boundary::slot(scene)?, boundary::path(path, "path")?) };
        let Some(path) = path else { return bad_argument("the path is null") };
        *slot = SvkScene::boxed(LiveScene::load(&context.device, &path, &context.registry)?);
        Ok(())
    })
}

/// Destroys a scene, after its unfinished writes to buffers and images of the host. NULL is
/// allowed. No other call with this scene may be running.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_destroy(scene: *mut SvkScene) {
    if !scene.is_null() {
        // SAFETY: made by Box::into_raw, and not used any more.
        guard_number(|| drop(unsafe { Box::from_raw(scene) }));
    }
}

/// Copies the error text of the last failed call with this scene, in any thread, into `text` as
/// svk_context_device_name does; returns the number of bytes that the whole text needs.
/// Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_error(scene: *const SvkScene, text: *mut c_char, bytes: usize) -> usize {
    // SAFETY: per the header.
    guard_number(|| unsafe { scene.as_ref().map_or(0, |s| s.error.copy(text, bytes)) })
}

/// Fills `info` with the contents of the scene. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_info(scene: *const SvkScene, info: *mut SvkSceneInfo) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let live = lock(&scene.live);
            let levels = live.language().map_or(&[][..], |l| &l.levels);
            let level = |k: usize| levels.get(k).map_or(0, |l| l.codebook.len() as u32);
            let value = SvkSceneInfo {
                size: 0,
                splats: live.splats().len() as u64,
                sh_degree: live.splats().sh_degree,
                cameras: live.cameras().len() as u32,
                codes: [0, 1, 2].map(level),
                feature_dim: [0, 1, 2].map(|k| live.features(k).map_or(0, |f| f.count as u32)),
                metres_per_unit: live.world().scale.as_ref().map_or(0.0, |s| s.metres_per_unit),
            };
            boundary::write(info, &value)
        })
    }
}

/// Fills `camera` with camera `index` of the scene, and copies the name of its photo into `name`,
/// which has `name_bytes` bytes and may be NULL. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_camera(
    scene: *const SvkScene,
    index: u32,
    camera: *mut SvkCamera,
    name: *mut c_char,
    name_bytes: usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let live = lock(&scene.live);
            let Some(c) = live.cameras().get(index as usize) else {
                return bad_argument(format!("there is no camera {index}, only {}", live.cameras().len()));
            };
            let (r, t) = (c.pose.rotation, c.pose.translation);
            let row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
            let value = SvkCamera {
                size: 0,
                width: c.width,
                height: c.height,
                fx: c.fx,
                fy: c.fy,
                cx: c.cx,
                cy: c.cy,
                world_to_camera: [row(0), row(1), row(2)],
            };
            boundary::copy_text(&c.name, name, name_bytes);
            boundary::write(camera, &value)
        })
    }
}

/// Copies an array of the scene into `values`. `array` is an SvkArray; `count` must be exactly the
/// number of its floats. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_read(
    scene: *const SvkScene,
    array: u32,
    values: *mut f32,
    count: usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let live = lock(&scene.live);
            let s = live.splats();
            let all: &[f32] = match array {
                0 => s.means.as_flattened(),
                1 => s.log_scales.as_flattened(),
                2 => s.quats.as_flattened(),
                3 => &s.opacity_logits,
                4 => &s.sh,
                5 => &live.seen().pixels,
                other => return bad_argument(format!("there is no array {other}")),
            };
            if values.is_null() || all.len() != count {
                return bad_argument(format!(
                    "array {array} has {} floats; give room for exactly these",
                    all.len()
                ));
            }
            std::ptr::copy_nonoverlapping(all.as_ptr(), values, count);
            Ok(())
        })
    }
}

/// Looks for a text in the view of a camera and fills `answer`. `mask` may be NULL; otherwise it
/// receives width × height bytes, 255 where the view shows the thing and 0 elsewhere, and
/// `mask_bytes` must be exactly that number. "Not found" is an answer, not a failure. Thread-safe;
/// calls with one scene are serialised.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_query(
    scene: *mut SvkScene,
    text: *const c_char,
    camera: *const SvkCamera,
    answer: *mut SvkAnswer,
    mask: *mut u8,
    mask_bytes: usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let text = text_in(text)?;
            let camera = camera_in(camera)?;
            let pixels = camera.width as usize * camera.height as usize;
            if !mask.is_null() && mask_bytes != pixels {
                return bad_argument(format!("the mask has {mask_bytes} bytes, the view {pixels} pixels"));
            }
            let all = lock(&scene.live).ask(&text, &camera)?;
            let (presence, p_value) = (presence(all.presence), f64::from(all.p_value.unwrap_or(0.0)));
            let (instances, reliability) = (all.instances.len() as u32, all.reliability.unwrap_or(-1.0));
            let found = one_view(all)?;
            let value = SvkAnswer {
                size: 0,
                found: u32::from(found.found),
                level: found.level as u32,
                score: f64::from(found.score),
                x: found.location.0 as f64 + 0.5,
                y: found.location.1 as f64 + 0.5,
                mask_pixels: found.mask_pixels() as u64,
                presence: presence as u32,
                instances,
                p_value,
                reliability,
            };
            boundary::write(answer, &value)?;
            if !mask.is_null() {
                let out = std::slice::from_raw_parts_mut(mask, pixels);
                out.iter_mut().zip(&found.mask().data).for_each(|(o, m)| *o = if *m { 255 } else { 0 });
            }
            Ok(())
        })
    }
}

/// Fills `instances` with the things in space that a text means, largest first, and with their
/// pixels in the view of a camera. It has room for `capacity` structures, each with its size set;
/// NULL and 0 only count. `*count` receives the number of things, which may be larger. Thread-safe;
/// calls with one scene are serialised.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_instances(
    scene: *mut SvkScene,
    text: *const c_char,
    camera: *const SvkCamera,
    instances: *mut SvkInstance,
    capacity: usize,
    count: *mut usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let (text, camera) = (text_in(text)?, camera_in(camera)?);
            let Some(count) = count.as_mut() else { return bad_argument("the pointer to the count is null") };
            let found = lock(&scene.live).ask(&text, &camera)?.instances;
            let values: Vec<SvkInstance> = found.iter().map(instance).collect();
            boundary::write_array(instances, capacity, &values)?;
            *count = values.len();
            Ok(())
        })
    }
}

/// Copies notes on the parts of a text that are not understood into `notes`, which has `bytes`
/// bytes; one line each, truncated where they do not fit and always ended with a zero byte.
/// Example: "answers for “mug”; “without handle” is not understood". Empty if the whole text is
/// understood. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_notes(
    scene: *mut SvkScene,
    text: *const c_char,
    notes: *mut c_char,
    bytes: usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let reading = lock(&scene.live).reading(&text_in(text)?)?;
            boundary::copy_text(&reading.notes().join("\n"), notes, bytes);
            Ok(())
        })
    }
}

unsafe fn text_in(text: *const c_char) -> Result<String, CallError> {
    // SAFETY: per the header.
    match unsafe { boundary::text(text, "text") }? {
        Some(text) => Ok(text),
        None => bad_argument("the text is null"),
    }
}

/// Returns the single view of an answer for one camera.
pub(super) fn one_view(answers: Answers) -> Result<QueryResult, CallError> {
    answers.views.into_iter().next().ok_or_else(|| Error::work("an answer without a view").into())
}

fn presence(presence: Option<Presence>) -> SvkPresence {
    match presence {
        None => SvkPresence::Unknown,
        Some(Presence::Found) => SvkPresence::Found,
        Some(Presence::Unsure) => SvkPresence::Unsure,
        Some(Presence::Absent) => SvkPresence::Absent,
    }
}

/// Converts an instance with its pixel in the only view.
fn instance(i: &Instance) -> SvkInstance {
    let pixel = i.pixels.first().copied().flatten();
    let [x, y] = pixel.unwrap_or_default();
    SvkInstance {
        size: 0,
        splats: i.splats.len() as u64,
        share: i.share,
        reliability: i.reliability.unwrap_or(-1.0),
        centre: i.centre.to_array(),
        box_min: i.bounds[0].to_array(),
        box_max: i.bounds[1].to_array(),
        axes: i.oriented.axes.map(|a| a.to_array()),
        box_size: i.oriented.size.to_array(),
        seen: u64::from(pixel.is_some()),
        x,
        y,
    }
}

/// Writes the scene to `path`.
///
/// A path that ends in .ply, .compressed.ply, .splat, .spz, .sog, .glb or .gltf becomes a file of
/// Gaussians in the axes and the unit of the scene (.spz and glTF with y and z reversed, since they
/// have y up), with the language beside it in NAME.language.npz. A path without an ending, with a
/// final slash, or of a folder becomes a scene directory. Any other ending is SVK_STATUS_INPUT.
///
/// The output appears complete or not at all. With `replace` = 1 it may replace a scene or a file,
/// but never a symbolic link, the file or directory that the scene was loaded from, a scene
/// directory with files of other programs, or the output of a running process or thread.
/// Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_save(
    scene: *mut SvkScene,
    path: *const c_char,
    replace: u32,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(scene, |scene| {
            let Some(path) = boundary::path(path, "path")? else { return bad_argument("the path is null") };
            Ok(lock(&scene.live).save(&path, replace != 0)?)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn camera_in_reads_matrix_rows() {
        let given = SvkCamera {
            size: size_of::<SvkCamera>(),
            width: 80,
            height: 60,
            fx: 13.0,
            fy: 26.0,
            cx: 40.0,
            cy: 30.0,
            // The camera's x, y and z axes are the world's y, z and x axes.
            world_to_camera: [[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, -2.0], [1.0, 0.0, 0.0, 3.0]],
        };
        // SAFETY: a whole structure.
        let camera = unsafe { camera_in(&given) }.ok().unwrap();
        // In the camera's frame the point is (20 + 1, 30 − 2, 10 + 3).
        let (pixel, depth) = camera.project(DVec3::new(10.0, 20.0, 30.0));
        assert!(
            (depth - 13.0).abs() < 1e-12 && (pixel - glam::DVec2::new(61.0, 86.0)).length() < 1e-9,
            "{pixel}"
        );
    }
}
