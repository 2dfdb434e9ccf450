//! Enumerations and structures of the C interface.
use std::ffi::{c_char, c_void};

/// Result of a function. After any other status than SVK_STATUS_OK, svk_context_error,
/// svk_scene_error or svk_editor_error returns a text.
#[repr(i32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkStatus {
    /// Success.
    Ok = 0,
    /// The input cannot be used; the text names it and the reason.
    Input = 1,
    /// A file could not be read.
    Io = 2,
    /// A library or program is not installed.
    Missing = 3,
    /// An error of the Vulkan device or driver without a code of its own (9 to 11).
    Gpu = 4,
    /// Work on valid input failed.
    Work = 5,
    /// The progress callback stopped the work; nothing was made or written.
    Cancelled = 6,
    /// An argument is invalid, such as a null pointer or a wrong structure size: an error of the
    /// calling program.
    Argument = 7,
    /// An error in splatvk. The handle can only be destroyed.
    Internal = 8,
    /// The Vulkan device was lost. Contexts and scenes on it can only be destroyed; a context on a
    /// new device may work.
    DeviceLost = 9,
    /// The Vulkan device has no memory left: fewer splats, smaller photos or another device may
    /// help.
    OutOfDeviceMemory = 10,
    /// There is no usable Vulkan loader, driver or device.
    NoDevice = 11,
    /// A model, or a file of it, is missing or unsuitable.
    MissingModel = 12,
    /// A file cannot be written: the disk is full, or the folder is not writable. No partial file
    /// remains.
    Unwritable = 13,
    /// An edit was not made, because its selection may be wrong: nothing is changed.
    /// svk_editor_doubts returns the reasons, and SvkEdit.force edits anyway.
    Doubtful = 14,
}

/// Trade-off between time and quality.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkPreset {
    /// SVK_PRESET_DRAFT on a CPU device, SVK_PRESET_DEFAULT on a GPU.
    Auto = 0,
    /// Takes minutes on a 2-core CPU.
    Draft = 1,
    /// Best quality for the time on a GPU.
    Default = 2,
    /// Schedule and constants of the paper.
    Paper = 3,
}

/// Degree of the spherical harmonics of colours; above 0 colours depend on the viewing direction.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkShDegree {
    /// The highest degree that improves photos left out of the fit.
    Auto = 0,
    /// The same colour from all directions.
    Zero = 1,
    /// 4 coefficients per colour channel.
    One = 2,
    /// 9 coefficients per colour channel.
    Two = 3,
    /// 16 coefficients per colour channel.
    Three = 4,
}

/// Kind of a call of the progress callback.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkProgressKind {
    /// A stage begins.
    Begin = 0,
    /// `done` of the `total` steps of the stage are finished.
    Step = 1,
    /// The stage ends.
    End = 2,
    /// `note` is a warning for the user.
    Warning = 3,
}

/// Rendered channel.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkChannel {
    /// 4 values: red, green and blue on black, as display-referred sRGB values (not clamped in
    /// floats), and alpha.
    Colour = 0,
    /// 1 value: accumulated opacity, 0 to 1.
    Alpha = 1,
    /// 1 value: expected camera z in scene units; 0 where alpha is below a half.
    Depth = 2,
    /// Blended features of one level: SvkSceneInfo.feature_dim values.
    Features = 3,
    /// 1 value: smoothed relevancy of the pixel to `text`, 0 to 1; 0 where the view is empty.
    Relevancy = 4,
}

/// Memory layout of values. Rows go from top to bottom, without gaps.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkEncoding {
    /// 32-bit floats [height][width][values]. As an image: VK_FORMAT_R32_SFLOAT for 1 value,
    /// VK_FORMAT_R32G32B32A32_SFLOAT for 4; other counts are for memory and buffers only.
    F32 = 0,
    /// 32-bit floats [ceil(values / 4)][height][width][4], padded with zeros. As an image:
    /// VK_FORMAT_R32G32B32A32_SFLOAT with one array layer per 4 values.
    F32X4 = 1,
    /// 16-bit floats, otherwise as SVK_ENCODING_F32X4. As an image: VK_FORMAT_R16G16B16A16_SFLOAT.
    /// Not for relevancy.
    F16X4 = 2,
    /// 8 bits, values clamped to [0, 1], otherwise as SVK_ENCODING_F32X4. As an image:
    /// VK_FORMAT_R8G8B8A8_UNORM. Not for relevancy.
    Unorm8X4 = 3,
}

/// Arrays of a scene, for svk_scene_read. N is the number of Gaussians.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkArray {
    /// [N][3] centres in scene units; the axes are x right, y down, z forward of a camera without
    /// rotation.
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
    /// [N] numbers of pixels, over all photos, that show the Gaussian. Below 0.05 no photo shows
    /// it, and it is extrapolated. Empty (0 floats) where this is unknown: files of Gaussians,
    /// scenes of older versions.
    Seen = 5,
}

/// Presence in the scene of the thing that a text means.
#[repr(u32)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SvkPresence {
    /// The text model has too few other texts to compare with.
    Unknown = 0,
    /// The thing is in the scene.
    Found = 1,
    /// The features do not decide, or a part of the text is not understood (see svk_scene_notes).
    Unsure = 2,
    /// The thing is not in the scene.
    Absent = 3,
}

/// Options of a context. Zero is the default of every field but `size`.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkContextOptions {
    /// sizeof(SvkContextOptions)
    pub size: usize,
    /// Vulkan device: "uuid:…", "pci:…", its number as a text, or a part of its name; NULL = the
    /// best device. Not for svk_context_adopt.
    pub device: *const c_char,
    /// Folder of the models; NULL = the installed ones.
    pub models: *const c_char,
    /// 1 = training gives the same bits in every run on one device, about a tenth slower.
    pub deterministic: u32,
    /// 1 = enable the Khronos validation layer. Not for svk_context_adopt.
    pub validation: u32,
    /// Provider that computes the networks, as of --provider; NULL = the environment variable
    /// SPLATVK_PROVIDER, or else "auto".
    pub provider: *const c_char,
}

/// A pointer to vkGetInstanceProcAddr, cast to this type.
pub type SvkVoidFunction = Option<unsafe extern "C" fn()>;

/// Locks or unlocks a queue of the host; `user` is SvkVulkanDevice.user.
pub type SvkQueueFunction = Option<unsafe extern "C" fn(user: *mut c_void)>;

/// A Vulkan device of the host, for svk_context_adopt. It must outlive the context and all its
/// scenes.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkVulkanDevice {
    /// sizeof(SvkVulkanDevice)
    pub size: usize,
    /// VkInstance, created with apiVersion 1.2 or newer.
    pub instance: *mut c_void,
    /// VkPhysicalDevice
    pub physical_device: *mut c_void,
    /// VkDevice, created with the feature synchronization2 (of Vulkan 1.3 or
    /// VK_KHR_synchronization2).
    pub device: *mut c_void,
    /// VkQueue that supports compute.
    pub queue: *mut c_void,
    /// Queue family of `queue`.
    pub queue_family: u32,
    /// Number of `extensions`.
    pub extension_count: u32,
    /// Names of the enabled device extensions.
    pub extensions: *const *const c_char,
    /// VkPhysicalDeviceFeatures2 chain of the device's creation. Some work is faster with each of
    /// these features: shaderInt64, storageBuffer16BitAccess, subgroupSizeControl,
    /// computeFullSubgroups, shaderBufferFloat32AtomicAdd. SvkSync needs timelineSemaphore. Read
    /// during the call only.
    pub features: *const c_void,
    /// vkGetInstanceProcAddr of the host; NULL = that of the system's loader.
    pub get_instance_proc_addr: SvkVoidFunction,
    /// Called before every use of the queue. NULL = the host does not use the queue during calls
    /// with this context or one of its scenes.
    pub lock_queue: SvkQueueFunction,
    /// Called after every use of the queue; set if and only if `lock_queue` is.
    pub unlock_queue: SvkQueueFunction,
    /// Argument of `lock_queue` and `unlock_queue`.
    pub user: *mut c_void,
}

/// A pinhole camera. Axes: x right, y down, z forward. The first pixel's centre is (0.5, 0.5).
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkCamera {
    /// sizeof(SvkCamera)
    pub size: usize,
    /// Width of the image, pixels.
    pub width: u32,
    /// Height of the image, pixels.
    pub height: u32,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point along x, pixels.
    pub cx: f64,
    /// Principal point along y, pixels.
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
    /// File name in messages, masks and cameras; NULL = that of `path`, or "photo_00", "photo_01",
    /// ...
    pub name: *const c_char,
    /// Image file (JPEG, PNG, HEIC, AVIF, WebP, TIFF), or a folder of image files.
    pub path: *const c_char,
    /// Content of an image file.
    pub encoded: *const u8,
    /// Length of `encoded`, bytes.
    pub encoded_bytes: usize,
    /// Upright 8-bit sRGB pixels of 3 or 4 bytes; the fourth byte is ignored.
    pub pixels: *const u8,
    /// Bytes per pixel of `pixels`: 3 or 4.
    pub pixel_bytes: u32,
    /// Width of `pixels`.
    pub width: u32,
    /// Height of `pixels`.
    pub height: u32,
    /// Distance of the rows of `pixels`, bytes; 0 = width * pixel_bytes.
    pub row_bytes: usize,
    /// Focal length of `pixels`, in pixels; 0 = unknown. Image files state their own.
    pub focal: f64,
    /// Camera of the photo; NULL = unknown. For all photos or for none.
    pub camera: *const SvkCamera,
    /// One byte for each of `pixels`, without gaps between rows: 0 = the pixel is not used (a
    /// person, a bonnet). NULL = all are used. Image files have masks in a folder "masks" beside
    /// them.
    pub mask: *const u8,
}

/// Argument of the progress callback. Texts are valid during the call only.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkProgress {
    /// sizeof(SvkProgress) of the library.
    pub size: usize,
    /// SvkProgressKind
    pub kind: u32,
    /// Name of the stage.
    pub stage: *const c_char,
    /// Number of finished steps.
    pub done: u64,
    /// Number of all steps; 0 = unknown.
    pub total: u64,
    /// A short figure ("PSNR 28.1"), or the warning.
    pub note: *const c_char,
}

/// Progress callback. It is called from any thread, but never from two at a time, and not after the
/// function returns that it was given to. A result other than 0 stops the work. It must not throw
/// an exception or call functions with the context or the scene that works.
pub type SvkProgressFunction =
    Option<unsafe extern "C" fn(user: *mut c_void, progress: *const SvkProgress) -> i32>;

/// Options of training. Zero is the default of every field but `size`: built-in models, preset by
/// device.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkTrainOptions {
    /// sizeof(SvkTrainOptions)
    pub size: usize,
    /// SvkPreset
    pub preset: u32,
    /// Number of photos to choose of files and folders; 0 = all files, or at most 4 where a folder
    /// is given.
    pub views: u32,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Steps of the colour stage; 0 = the preset's.
    pub iterations: u64,
    /// Steps of the language stage; 0 = the preset's.
    pub language_iterations: u64,
    /// Length of the codes of splats: 3, 8 or 16; 0 = 16.
    pub feature_dim: u32,
    /// 1 = one set of splats per level, as in the paper.
    pub per_level: u32,
    /// Known cameras: transforms.json, a COLMAP model folder or cameras.json; NULL = estimated from
    /// the photos.
    pub cameras: *const c_char,
    /// Folder of precomputed masks (STEM_s.npy); NULL = built-in.
    pub masks: *const c_char,
    /// Folder of precomputed features (STEM_f.npy, text_embeddings.npz), the same as `masks`; NULL
    /// = built-in.
    pub features: *const c_char,
    /// Progress callback; may be NULL.
    pub progress: SvkProgressFunction,
    /// First argument of `progress`.
    pub user: *mut c_void,
    /// Longer side of the working images, pixels: larger photos are scaled down, smaller ones are
    /// not enlarged. 0 = 800 on a CPU device, 1600 on a GPU.
    pub max_size: u64,
    /// Source of cameras and points, as of `splatvk run --init`: "sfm", "cameras:FILE", the name of
    /// an installed network, or "auto" for the best of them. NULL = `cameras`, or else "sfm".
    pub init: *const c_char,
    /// Source of dense matches, as of --matcher. NULL = built-in.
    pub matcher: *const c_char,
    /// Source of masks, as of --masks. NULL = `masks`, or else built-in.
    pub mask_source: *const c_char,
    /// Source of region features, as of --features. NULL = `features`, or else built-in.
    pub feature_source: *const c_char,
    /// Method of the language stage, as of --method. NULL = "lift", or "sparselgs" with
    /// SVK_PRESET_PAPER, `language_iterations`, `per_level` or `compat`.
    pub method: *const c_char,
    /// SvkShDegree
    pub sh_degree: u64,
    /// Implementation whose choices are reproduced, as of --compat. NULL = none.
    pub compat: *const c_char,
    /// Source of depth where photos cannot be matched, as of --depth-prior: "dir:FOLDER", the name
    /// of an installed network, or "auto" for the best of them. NULL = none.
    pub depth_prior: *const c_char,
    /// Things that are ignored in all photos, as by --ignore, one a line. NULL = none.
    pub ignore: *const c_char,
    /// Folder of a mask per photo, as of --photo-masks: x.png or x.jpg.png for x.jpg, black is not
    /// used. All photos must be files. NULL = masks beside the photos, if there are any.
    pub photo_masks: *const c_char,
}

/// Contents of a scene.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkSceneInfo {
    /// sizeof(SvkSceneInfo)
    pub size: usize,
    /// Number of Gaussians.
    pub splats: u64,
    /// Degree of the spherical harmonics, 0 to 3.
    pub sh_degree: u32,
    /// Number of cameras; 0 for a file of Gaussians.
    pub cameras: u32,
    /// Number of codes per level: subparts, parts, wholes. All 0 = no language.
    pub codes: [u32; 3],
    /// Length of the features per level.
    pub feature_dim: [u32; 3],
    /// Metres per scene unit; 0 = unknown.
    pub metres_per_unit: f64,
}

/// Destination of a rendered channel: exactly one of `host`, `buffer` and `image` is set.
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
    /// For relevancy: text of the query, UTF-8.
    pub text: *const c_char,
    /// Memory of the host.
    pub host: *mut c_void,
    /// Size of `host`, or of `buffer` from `offset` on, bytes; at least the size of the encoding.
    pub bytes: usize,
    /// VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT, on the host's device.
    pub buffer: u64,
    /// Offset in `buffer`, bytes; a multiple of 4.
    pub offset: u64,
    /// VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, on the host's device: 2D, of the camera's
    /// size, one sample, in the format of the encoding. Mip level 0 is written.
    pub image: u64,
    /// VkImageLayout of the image before the write; VK_IMAGE_LAYOUT_UNDEFINED discards its content.
    pub old_layout: u32,
    /// VkImageLayout of the image after the write; not VK_IMAGE_LAYOUT_UNDEFINED.
    pub new_layout: u32,
}

/// Timeline semaphores of the host for writes to its buffers and images. From the wait to the
/// signal these buffers and images must belong to the context's queue family or be shared
/// concurrently.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkSync {
    /// sizeof(SvkSync)
    pub size: usize,
    /// VkSemaphore of type timeline: writes begin once it reaches `wait_value`; 0 = at once.
    pub wait_semaphore: u64,
    /// Value of `wait_semaphore`.
    pub wait_value: u64,
    /// VkSemaphore of type timeline: it reaches `signal_value` when all writes are finished; 0 =
    /// the call waits for them.
    pub signal_semaphore: u64,
    /// Value of `signal_semaphore`.
    pub signal_value: u64,
}

/// Answer to a text in one view.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkAnswer {
    /// sizeof(SvkAnswer)
    pub size: usize,
    /// 1 = this view shows the thing that the text means.
    pub found: u32,
    /// Level of the answer: 0 = subparts, 1 = parts, 2 = wholes.
    pub level: u32,
    /// Best relevancy in the view, 0 to 1. At 0.5 a pixel is as similar to the text as to an
    /// everyday phrase.
    pub score: f64,
    /// Centre of the most relevant pixel along x; the first pixel's centre is 0.5.
    pub x: f64,
    /// Centre of the most relevant pixel along y; the first pixel's centre is 0.5.
    pub y: f64,
    /// Number of pixels of the mask; 0 where nothing was found.
    pub mask_pixels: u64,
    /// SvkPresence of the thing in the whole scene.
    pub presence: u32,
    /// Number of things in space that the text means, as of svk_scene_instances.
    pub instances: u32,
    /// P-value of `presence`: share of texts, this one included, that fit the scene at least as
    /// well. 0 = unknown.
    pub p_value: f64,
    /// Agreement of the photos on the answer, 0 to 1; below 0 = unknown.
    pub reliability: f64,
}

/// A thing in space that a text means. Lengths are in scene units.
#[repr(C)]
#[derive(Clone, Copy)]
pub struct SvkInstance {
    /// sizeof(SvkInstance)
    pub size: usize,
    /// Number of Gaussians.
    pub splats: u64,
    /// Share of the weight of all Gaussians that the text selects, 0 to 1.
    pub share: f64,
    /// Agreement of the photos on the thing, 0 to 1; below 0 = unknown.
    pub reliability: f64,
    /// Centre of the oriented bounding box.
    pub centre: [f64; 3],
    /// Lowest corner of the bounding box along the scene's axes.
    pub box_min: [f64; 3],
    /// Highest corner of the bounding box along the scene's axes.
    pub box_max: [f64; 3],
    /// Unit vectors along the edges of the oriented bounding box, largest variance first.
    pub axes: [[f64; 3]; 3],
    /// Lengths of the edges of the oriented bounding box along `axes`.
    pub box_size: [f64; 3],
    /// 1 = the view shows the thing, at (`x`, `y`).
    pub seen: u64,
    /// Pixel of `centre` in the view along x; the first pixel's centre is 0.5.
    pub x: f64,
    /// Pixel of `centre` in the view along y; the first pixel's centre is 0.5.
    pub y: f64,
}
