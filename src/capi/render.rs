//! Rendering into memory, buffers and images of the host.
use super::boundary::{self, CallError, bad_argument, guard};
use super::scene::{SvkScene, camera_in, one_view};
use super::types::*;
use crate::gpu::Buffer;
use crate::gpu::external::{Sync, Target};
use crate::gpu::vk::{self, Handle};
use crate::pass::pack::{self, Encoding, FrameChannel};
use crate::run::live::LiveScene;
use crate::run::view::{FeatureChannels, SCENE_MODEL};
use crate::scene::Camera;
use crate::sync::lock;
use std::collections::BTreeSet;

/// Renders the scene from a camera into all `outputs`. Without a signal semaphore, or with `sync`
/// NULL, the call returns when all outputs are written. With one it may return before buffers and
/// images are written; memory of the host is always written before it returns. Calls with one scene
/// are serialised, and so are their writes. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_render(
    scene: *mut SvkScene,
    camera: *const SvkCamera,
    outputs: *const SvkOutput,
    output_count: usize,
    sync: *const SvkSync,
) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(scene) = (unsafe { boundary::handle(scene, "scene") }) else { return SvkStatus::Argument };
    guard(&scene.error, || {
        // SAFETY: per the header.
        unsafe {
            let camera = camera_in(camera)?;
            let outputs = boundary::read_array(outputs, output_count)?;
            let sync = boundary::read_or_default(sync)?;
            render(scene, &camera, &outputs, &sync)
        }
    })
}

/// Waits until all buffers and images of earlier calls of svk_scene_render are written.
/// Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_scene_wait(scene: *mut SvkScene) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(scene) = (unsafe { boundary::handle(scene, "scene") }) else { return SvkStatus::Argument };
    guard(&scene.error, || {
        let under_way = std::mem::take(&mut *lock(&scene.deliveries));
        under_way.iter().try_for_each(|d| d.wait()).map_err(CallError::from)
    })
}

/// A checked output.
struct RenderRequest {
    content: RenderContent,
    encoding: Encoding,
    destination: RenderDestination,
}

enum RenderContent {
    /// Index of one of the scene's models, and a channel of its frame.
    Frame(usize, FrameChannel),
    /// Text of the query.
    Relevancy(String),
}

enum RenderDestination {
    Host(*mut u8),
    Device(Target),
}

unsafe fn render(
    scene: &SvkScene,
    camera: &Camera,
    outputs: &[SvkOutput],
    sync: &SvkSync,
) -> Result<(), CallError> {
    let mut live = lock(&scene.live);
    // SAFETY: per the header.
    let check = |(i, o): (usize, &SvkOutput)| unsafe { checked_request(&live, camera, o, i) };
    let requests = outputs.iter().enumerate().map(check).collect::<Result<Vec<_>, _>>()?;
    let packed = pack_all(&mut live, camera, &requests)?;
    let mut copies = Vec::new();
    for (buffer, request) in packed.into_iter().zip(&requests) {
        match request.destination {
            RenderDestination::Host(memory) => {
                let bytes = buffer.cast::<u8>().read()?;
                // SAFETY: `checked_request` has checked the length of the host's memory.
                unsafe { std::ptr::copy_nonoverlapping(bytes.as_ptr(), memory, bytes.len()) };
            }
            RenderDestination::Device(target) => copies.push((buffer, target)),
        }
    }
    let sync = Sync {
        wait: timeline_point(sync.wait_semaphore, sync.wait_value),
        signal: timeline_point(sync.signal_semaphore, sync.signal_value),
    };
    if copies.is_empty() && sync.wait.is_none() && sync.signal.is_none() {
        return Ok(());
    }
    // SAFETY: the host vouches for its targets and semaphores.
    let delivery = unsafe { live.device().deliver(copies, sync) }?;
    let mut under_way = lock(&scene.deliveries);
    under_way.retain(|d| !d.finished());
    under_way.push(delivery);
    Ok(())
}

/// Semaphore with its value; `None` for a null handle.
fn timeline_point(semaphore: u64, value: u64) -> Option<(vk::Semaphore, u64)> {
    (semaphore != 0).then(|| (vk::Semaphore::from_raw(semaphore), value))
}

/// Renders all requests into one buffer each, of exactly its bytes.
fn pack_all(
    live: &mut LiveScene,
    camera: &Camera,
    requests: &[RenderRequest],
) -> Result<Vec<Buffer<u32>>, CallError> {
    let device = live.device().clone();
    // Queries come first: for a new camera they render a frame, and the frames below must be last.
    let mut packed: Vec<Option<Buffer<u32>>> = Vec::with_capacity(requests.len());
    for request in requests {
        packed.push(match &request.content {
            RenderContent::Frame(..) => None,
            RenderContent::Relevancy(text) => {
                let map = one_view(live.ask(text, camera)?)?.relevancy().data;
                Some(match request.encoding {
                    Encoding::F32x4 => {
                        let texels: Vec<[f32; 4]> = map.iter().map(|v| [*v, 0.0, 0.0, 0.0]).collect();
                        device.buffer_from("relevancy", &texels)?.cast()
                    }
                    _ => device.buffer_from("relevancy", &map)?.cast(),
                })
            }
        });
    }
    let pixels = camera.width as usize * camera.height as usize;
    let mut models = BTreeSet::new();
    for (slot, request) in packed.iter_mut().zip(requests) {
        if let RenderContent::Frame(model, source) = request.content {
            *slot = Some(pack::texels(&device, pixels, source, request.encoding)?);
            models.insert(model);
        }
    }
    for model in models {
        live.draw_bands(model, camera, |frame, band| {
            for (slot, request) in packed.iter().zip(requests) {
                match (slot, &request.content) {
                    (Some(texels), RenderContent::Frame(index, source)) if *index == model => {
                        pack::pack(&device, frame, band, *source, request.encoding, texels)?;
                    }
                    _ => {}
                }
            }
            Ok(())
        })?;
    }
    Ok(packed.into_iter().flatten().collect())
}

/// Checks output `i`.
unsafe fn checked_request(
    live: &LiveScene,
    camera: &Camera,
    o: &SvkOutput,
    i: usize,
) -> Result<RenderRequest, CallError> {
    let encoding = match o.encoding {
        0 => Encoding::F32,
        1 => Encoding::F32x4,
        2 => Encoding::F16x4,
        3 => Encoding::Unorm8x4,
        other => return bad_argument(format!("output {i}: there is no encoding {other}")),
    };
    let content = match o.channel {
        0 => RenderContent::Frame(SCENE_MODEL, FrameChannel::Colour),
        1 => RenderContent::Frame(SCENE_MODEL, FrameChannel::Alpha),
        2 => RenderContent::Frame(SCENE_MODEL, FrameChannel::Depth),
        3 => match live.features(o.level as usize) {
            None => {
                return bad_argument(format!("output {i}: the scene has no features at level {}", o.level));
            }
            Some(FeatureChannels { model, first, count }) => {
                RenderContent::Frame(model, FrameChannel::Features(first, count))
            }
        },
        // SAFETY: per the header.
        4 => match unsafe { boundary::text(o.text, "SvkOutput.text") }? {
            Some(text) if matches!(encoding, Encoding::F32 | Encoding::F32x4) => {
                RenderContent::Relevancy(text)
            }
            Some(_) => {
                return bad_argument(format!("output {i}: relevancy is written in 32-bit floats only"));
            }
            None => return bad_argument(format!("output {i}: relevancy needs a text")),
        },
        other => return bad_argument(format!("output {i}: there is no channel {other}")),
    };
    let channels = match &content {
        RenderContent::Frame(_, source) => source.channels(),
        RenderContent::Relevancy(_) => 1,
    };
    let bytes = encoding.bytes(channels, camera.width as usize * camera.height as usize);
    let destination = match (o.host.is_null(), o.buffer, o.image) {
        (false, 0, 0) => RenderDestination::Host(o.host.cast::<u8>()),
        (true, buffer, 0) if buffer != 0 => {
            if !o.offset.is_multiple_of(4) {
                return bad_argument(format!("output {i}: the offset {} is no multiple of 4", o.offset));
            }
            RenderDestination::Device(Target::Buffer { raw: vk::Buffer::from_raw(buffer), offset: o.offset })
        }
        (true, 0, image) if image != 0 => {
            RenderDestination::Device(image_target(o, i, camera, encoding, channels)?)
        }
        _ => return bad_argument(format!("output {i}: set exactly one of host, buffer and image")),
    };
    if o.image == 0 && o.bytes < bytes {
        return bad_argument(format!("output {i}: {bytes} bytes are needed, {} are there", o.bytes));
    }
    Ok(RenderRequest { content, encoding, destination })
}

/// Checks the image of output `i`.
fn image_target(
    o: &SvkOutput,
    i: usize,
    camera: &Camera,
    encoding: Encoding,
    channels: usize,
) -> Result<Target, CallError> {
    if encoding == Encoding::F32 && channels != 1 && channels != 4 {
        return bad_argument(format!(
            "output {i}: no image format has {channels} values; take SVK_ENCODING_F32X4"
        ));
    }
    let layers = encoding.layers(channels) as u32;
    if o.layers != layers {
        return bad_argument(format!(
            "output {i}: {layers} array layers are written, the image has {}",
            o.layers
        ));
    }
    if o.new_layout == vk::ImageLayout::UNDEFINED.as_raw() as u32 {
        return bad_argument(format!("output {i}: new_layout must not be VK_IMAGE_LAYOUT_UNDEFINED"));
    }
    Ok(Target::Image {
        raw: vk::Image::from_raw(o.image),
        size: [camera.width, camera.height],
        layers,
        before: vk::ImageLayout::from_raw(o.old_layout as i32),
        after: vk::ImageLayout::from_raw(o.new_layout as i32),
    })
}
