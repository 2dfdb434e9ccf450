//! Numbers and structures that cross the boundary.
use std::ffi::{c_char, c_void};

/// What a function returns. Anything but `SVK_STATUS_OK` leaves a text behind: svk_context_error,
/// svk_scene_error.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkStatus {
    /// Done.
    Ok = 0,
    /// What was given cannot be used; the text says what and why.
    Input = 1,
    /// A file could not be read.
    Io = 2,
    /// A library or program is not installed.
    Missing = 3,
    /// The Vulkan device or driver refused something, other than the codes from 9 on.
    Gpu = 4,
    /// Something failed while working on valid input.
    Work = 5,
    /// The progress callback asked to stop; nothing was made or written.
    Cancelled = 6,
    /// A pointer is null or a structure's size is wrong: a mistake in the calling program.
    Argument = 7,
    /// A mistake in splatvk. The handle may be destroyed, and nothing else should be done with it.
    Internal = 8,
    /// The Vulkan device was lost. Contexts and scenes on it can only be destroyed; a context on a
    /// new device may work.
    DeviceLost = 9,
    /// The Vulkan device has no memory left: fewer splats, smaller photos or another device may
    /// help.
    OutOfDeviceMemory = 10,
    /// No Vulkan loader, driver or device that can be used.
    NoDevice = 11,
    /// A model, or a file of it, is missing or not what it is used for.
    MissingModel = 12,
    /// A file cannot be written: the disk is full, or the folder does not allow it. Nothing
    /// half-written stays.
    Unwritable = 13,
}

/// Time against quality.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkPreset {
    /// Draft on a CPU device, default on a GPU.
    Auto = 0,
    /// Minutes on a 2-core CPU.
    Draft = 1,
    /// Best quality for the time on a GPU.
    Default = 2,
    /// The paper's schedule and constants.
    Paper = 3,
}

/// Spherical-harmonics degree of colours: above 0 they depend on the direction.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkShDegree {
    /// What photos support that are left out for a test.
    Auto = 0,
    /// The same from everywhere.
    Zero = 1,
    /// 4 numbers per colour channel.
    One = 2,
    /// 9.
    Two = 3,
    /// 16.
    Three = 4,
}

/// What a call of the progress callback is about.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkProgressKind {
    /// A stage begins.
    Begin = 0,
    /// `done` of its `total` steps are finished.
    Step = 1,
    /// It is over.
    End = 2,
    /// `note` is a warning for the user.
    Warning = 3,
}

/// What to render.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkChannel {
    /// 4 values: red, green, blue on black (display-referred sRGB values, not clamped in floats),
    /// and alpha.
    Colour = 0,
    /// 1 value: accumulated opacity, 0 to 1.
    Alpha = 1,
    /// 1 value: expected camera z in scene units, 0 where alpha is below a half.
    Depth = 2,
    /// The blended features of one level: as many values as SvkSceneInfo.feature_dim says for it.
    Features = 3,
    /// 1 value: how well the pixel answers `text`, 0 to 1, smoothed; 0 where the scene says
    /// nothing.
    Relevancy = 4,
}

/// How values are stored. Rows go from top to bottom, without gaps.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkEncoding {
    /// 32-bit floats [height][width][values]. As an image: VK_FORMAT_R32_SFLOAT for 1 value,
    /// VK_FORMAT_R32G32B32A32_SFLOAT for 4; other counts are for memory and buffers only.
    F32 = 0,
    /// 32-bit floats [ceil(values / 4)][height][width][4], filled up with zeros. As an image:
    /// VK_FORMAT_R32G32B32A32_SFLOAT with one array layer for every 4 values.
    F32X4 = 1,
    /// The same in 16-bit floats: VK_FORMAT_R16G16B16A16_SFLOAT. Not for relevancy.
    F16X4 = 2,
    /// The same in 8 bits, values clamped to [0, 1]: VK_FORMAT_R8G8B8A8_UNORM. Not for relevancy.
    Unorm8X4 = 3,
}

/// Arrays of a scene, for svk_scene_read. N is the number of Gaussians.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkArray {
    /// [N][3] centres, scene units; axes as the cameras' (x right, y down, z forward in a camera
    /// without rotation).
    Means = 0,
    /// [N][3] natural logarithms of the standard deviations along the local axes.
    LogScales = 1,
    /// [N][4] rotations w, x, y, z; not necessarily normalised.
    Quats = 2,
    /// [N] opacities before the sigmoid.
    OpacityLogits = 3,
    /// [N][(degree + 1)²][3] spherical-harmonics coefficients; colour = 0.5 + 0.2820948 · the
    /// first.
    Sh = 4,
    /// [N] pixels of all photos that show the Gaussian; below 0.05 no photo does and it is guessed.
    /// Empty (0 floats) where that is not known: files of Gaussians, scenes of older versions.
    Seen = 5,
}

/// Whether the scene has what a text means.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkPresence {
    /// The text model knows too few texts to tell.
    Unknown = 0,
    /// It has.
    Found = 1,
    /// What the scene's features say does not decide, or the text is not wholly understood (see
    /// svk_scene_notes).
    Unsure = 2,
    /// It has not.
    Absent = 3,
}

/// How a context is made. All zero (but for `size`) is the default.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkContextOptions {
    /// sizeof(SvkContextOptions)
    pub size: usize,
    /// Part of a Vulkan device's name, or its number as a text; NULL = the best one. Not for
    /// svk_context_adopt.
    pub device: *const c_char,
    /// Folder of the models; NULL = the installed ones.
    pub models: *const c_char,
    /// 1 = training gives the same bits on every run on one device, about a tenth slower.
    pub deterministic: u32,
    /// 1 = with the Khronos validation layer. Not for svk_context_adopt.
    pub validation: u32,
    /// What computes the networks, as --provider takes it; NULL = the environment variable
    /// SPLATVK_PROVIDER, or else "auto".
    pub provider: *const c_char,
}

/// A pointer to vkGetInstanceProcAddr, cast to this type.
pub type SvkVoidFunction = Option<unsafe extern "C" fn()>;

/// Takes or releases the host's own lock of a queue; `user` is the structure's.
pub type SvkQueueFunction = Option<unsafe extern "C" fn(user: *mut c_void)>;

/// A Vulkan device of the host, for svk_context_adopt. It must outlive the context and all scenes
/// made from it.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkVulkanDevice {
    /// sizeof(SvkVulkanDevice)
    pub size: usize,
    /// VkInstance made with apiVersion 1.2 or newer.
    pub instance: *mut c_void,
    /// VkPhysicalDevice
    pub physical_device: *mut c_void,
    /// VkDevice made with the feature synchronization2 (of Vulkan 1.3 or VK_KHR_synchronization2).
    pub device: *mut c_void,
    /// VkQueue with compute.
    pub queue: *mut c_void,
    /// Its family.
    pub queue_family: u32,
    /// Number of `extensions`.
    pub extension_count: u32,
    /// Names of the device extensions that were enabled.
    pub extensions: *const *const c_char,
    /// The VkPhysicalDeviceFeatures2 chain that the device was made with. Each feature of this list
    /// that is on makes some work faster: shaderInt64, storageBuffer16BitAccess,
    /// subgroupSizeControl, computeFullSubgroups, shaderBufferFloat32AtomicAdd. timelineSemaphore
    /// is needed for SvkSync. Read during the call only.
    pub features: *const c_void,
    /// vkGetInstanceProcAddr of the host; NULL = that of the system's loader.
    pub get_instance_proc_addr: SvkVoidFunction,
    /// Called around every use of the queue. NULL = the host leaves the queue alone while a call
    /// with this context or one of its scenes runs.
    pub lock_queue: SvkQueueFunction,
    /// The end of `lock_queue`.
    pub unlock_queue: SvkQueueFunction,
    /// Given to both.
    pub user: *mut c_void,
}

/// A pinhole camera. Axes: x right, y down, z forward. The centre of the first pixel is at (0.5,
/// 0.5).
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkCamera {
    /// sizeof(SvkCamera)
    pub size: usize,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, pixels.
    pub cx: f64,
    /// Principal point, pixels.
    pub cy: f64,
    /// Rows of [R | t]: camera = R · world + t.
    pub world_to_camera: [[f64; 4]; 3],
}

/// One photo: exactly one of `path`, `encoded` and `pixels` is set.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkPhoto {
    /// sizeof(SvkPhoto)
    pub size: usize,
    /// File name for messages, masks and cameras; NULL = that of `path`, or "photo_00", "photo_01",
    /// ...
    pub name: *const c_char,
    /// Image file (JPEG, PNG, HEIC, AVIF, WebP, TIFF); with SvkTrainOptions.views a folder of them,
    /// too.
    pub path: *const c_char,
    /// Such an image file in memory.
    pub encoded: *const u8,
    /// Its length in bytes.
    pub encoded_bytes: usize,
    /// Upright 8-bit sRGB pixels, 3 or 4 bytes each; a fourth byte is skipped.
    pub pixels: *const u8,
    /// Bytes of a pixel: 3 or 4.
    pub pixel_bytes: u32,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// From one row to the next, bytes; 0 = width * pixel_bytes.
    pub row_bytes: usize,
    /// Focal length in these pixels, where it is known; 0 = unknown. For `pixels`; files tell it
    /// themselves.
    pub focal: f64,
    /// The photo's camera, where it is known; for all photos or for none.
    pub camera: *const SvkCamera,
    /// For `pixels`: a byte for each, 0 where the pixel is not used (a person, a bonnet), rows
    /// packed; NULL = all are used. Files have masks in a folder "masks" beside theirs.
    pub mask: *const u8,
}

/// What the progress callback is told. Texts are valid during the call only.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkProgress {
    /// sizeof(SvkProgress) of the library.
    pub size: usize,
    /// SvkProgressKind
    pub kind: u32,
    /// Name of the stage.
    pub stage: *const c_char,
    /// Steps finished.
    pub done: u64,
    /// Steps in all; 0 = unknown.
    pub total: u64,
    /// A short live figure ("PSNR 28.1"), or the warning.
    pub note: *const c_char,
}

/// Called from any thread, never by two at a time, and never after svk_train has returned. Anything
/// but 0 asks it to stop. No exception may leave it, and it may not call into the context that
/// trains.
pub type SvkProgressFunction =
    Option<unsafe extern "C" fn(user: *mut c_void, progress: *const SvkProgress) -> i32>;

/// How a scene is trained. All zero (but for `size`) is the default: built-in models, preset by
/// device.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkTrainOptions {
    /// sizeof(SvkTrainOptions)
    pub size: usize,
    /// SvkPreset
    pub preset: u32,
    /// How many photos to use where a folder is given; 0 = all that are given.
    pub views: u32,
    /// Seed of everything random.
    pub seed: u64,
    /// Steps of the colour stage; 0 = the preset's.
    pub iterations: u64,
    /// Steps of the language stage; 0 = the preset's.
    pub language_iterations: u64,
    /// Length of the codes that splats carry: 3, 8 or 16; 0 = 16.
    pub feature_dim: u32,
    /// 1 = one model per level, as in the paper.
    pub per_level: u32,
    /// Known cameras: transforms.json, a COLMAP model folder or cameras.json; NULL = found from the
    /// photos.
    pub cameras: *const c_char,
    /// Folder of precomputed masks (STEM_s.npy); NULL = built-in.
    pub masks: *const c_char,
    /// Folder of precomputed features (STEM_f.npy, text_embeddings.npz), the same as `masks`; NULL
    /// = built-in.
    pub features: *const c_char,
    /// Called with the progress; a result other than 0 stops the run; may be NULL.
    pub progress: SvkProgressFunction,
    /// Given to `progress`.
    pub user: *mut c_void,
    /// Longer side of the working images, pixels: larger photos are scaled down, none is enlarged.
    /// 0 = 800 on a CPU device, 1600 on a GPU.
    pub max_size: u64,
    /// Cameras and points, as `splatvk run --init` takes it: "sfm", "cameras:FILE", the name of an
    /// installed network, or "auto" for the best of them. NULL = `cameras`, or else "sfm".
    pub init: *const c_char,
    /// Dense matches, as --matcher takes it. NULL = built-in.
    pub matcher: *const c_char,
    /// Masks, as --masks takes it. NULL = `masks`, or else built-in.
    pub mask_source: *const c_char,
    /// Region features, as --features takes it. NULL = `features`, or else built-in.
    pub feature_source: *const c_char,
    /// How language gets onto the splats, as --method takes it. NULL = "lift"; "sparselgs" with the
    /// preset of the paper, `language_iterations`, `per_level` or `compat`.
    pub method: *const c_char,
    /// SvkShDegree
    pub sh_degree: u64,
    /// What can be done in several ways, as others do it: as --compat takes it. NULL = as this
    /// library does it.
    pub compat: *const c_char,
    /// Depth suggested where photos cannot be matched, as --depth-prior takes it: "dir:FOLDER", the
    /// name of an installed network, or "auto" for the best of them. NULL = none.
    pub depth_prior: *const c_char,
}

/// What a scene holds.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkSceneInfo {
    /// sizeof(SvkSceneInfo)
    pub size: usize,
    /// Number of Gaussians.
    pub splats: u64,
    /// Degree of their spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Number of cameras; 0 for a bare file of Gaussians.
    pub cameras: u32,
    /// Codes per level: subparts, parts, wholes. All 0 = no language.
    pub codes: [u32; 3],
    /// Feature values per level.
    pub feature_dim: [u32; 3],
    /// Metres in a scene unit; 0 = unknown.
    pub metres_per_unit: f64,
}

/// Where an image of the host is written: exactly one of `host`, `buffer` and `image` is set.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkOutput {
    /// sizeof(SvkOutput)
    pub size: usize,
    /// SvkChannel
    pub channel: u32,
    /// SvkEncoding
    pub encoding: u32,
    /// For features: 0 = subparts, 1 = parts, 2 = wholes.
    pub level: u32,
    /// Number of array layers of `image`.
    pub layers: u32,
    /// For relevancy: what to look for, UTF-8.
    pub text: *const c_char,
    /// Memory of the host.
    pub host: *mut c_void,
    /// Size of `host`, or of the space in `buffer` from `offset` on. Must hold what the encoding
    /// needs.
    pub bytes: usize,
    /// VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT, on the host's device.
    pub buffer: u64,
    /// First byte of `buffer`; a multiple of 4.
    pub offset: u64,
    /// VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, on the host's device: 2D, of the camera's
    /// size, one sample, in the format that the encoding names. Mip level 0 is written.
    pub image: u64,
    /// VkImageLayout that the image has; VK_IMAGE_LAYOUT_UNDEFINED where its content may be lost.
    pub old_layout: u32,
    /// VkImageLayout that it gets; not VK_IMAGE_LAYOUT_UNDEFINED.
    pub new_layout: u32,
}

/// Timeline semaphores of the host around writing to its buffers and images. Both belong to the
/// context's queue family (or are shared concurrently) when the wait is over, and still do when the
/// signal comes.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkSync {
    /// sizeof(SvkSync)
    pub size: usize,
    /// VkSemaphore of type timeline: targets may be written once it reaches `wait_value`; 0 = at
    /// once.
    pub wait_semaphore: u64,
    /// See `wait_semaphore`.
    pub wait_value: u64,
    /// VkSemaphore of type timeline: reaches `signal_value` when all targets are written. 0 = the
    /// call waits for that.
    pub signal_semaphore: u64,
    /// See `signal_semaphore`.
    pub signal_value: u64,
}

/// The answer to a text in one view.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkAnswer {
    /// sizeof(SvkAnswer)
    pub size: usize,
    /// 1 = the text was found in this view; 0 where it is absent.
    pub found: u32,
    /// Level that answers: 0 = subparts, 1 = parts, 2 = wholes.
    pub level: u32,
    /// Best relevancy in the view, 0 to 1; 0.5 is as close as to an everyday phrase.
    pub score: f64,
    /// Centre of the most relevant pixel; the first pixel's is (0.5, 0.5).
    pub x: f64,
    /// See `x`.
    pub y: f64,
    /// Pixels in the mask; 0 where the text was not found.
    pub mask_pixels: u64,
    /// SvkPresence: whether the scene has it, whatever this view shows.
    pub presence: u32,
    /// Things in space that the text means: those of svk_scene_instances.
    pub instances: u32,
    /// Share of other things that fit the scene at least as well: the p-value behind `presence`. 0
    /// = unknown.
    pub p_value: f64,
    /// How far the photos agree on what answers, 0 to 1; below 0 = unknown.
    pub reliability: f64,
}

/// One of the things that a text means. Lengths are in scene units.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkInstance {
    /// sizeof(SvkInstance)
    pub size: usize,
    /// Number of its Gaussians.
    pub splats: u64,
    /// Its share of all that answers the text, 0 to 1.
    pub share: f64,
    /// How far the photos agree on what it is, 0 to 1; below 0 = unknown.
    pub reliability: f64,
    /// Middle of the oriented box.
    pub centre: [f64; 3],
    /// Lowest corner of the box along the scene's axes.
    pub box_min: [f64; 3],
    /// Highest corner.
    pub box_max: [f64; 3],
    /// Unit vectors along the edges of the oriented box.
    pub axes: [[f64; 3]; 3],
    /// Lengths of its edges, longest first.
    pub box_size: [f64; 3],
    /// 1 = the view shows it, at (`x`, `y`).
    pub seen: u64,
    /// Pixel of its middle in the view; the first pixel's centre is (0.5, 0.5).
    pub x: f64,
    /// See `x`.
    pub y: f64,
}
