/* splatvk: a few photos without camera poses to a Gaussian-splat scene that answers text queries.
 *
 * Generated from src/capi by cbindgen; do not edit.
 *
 * Rules for all functions
 * - Handles (SvkContext, SvkScene) are opaque. A handle comes from one function and ends with its _destroy. Scenes keep what
 *   they need of their context, which may end before them.
 * - Functions return a SvkStatus. After anything but SVK_STATUS_OK the handle keeps a text of one line that says what was
 *   wrong, where, and what to do. When even the handle is NULL, there is only SVK_STATUS_ARGUMENT.
 * - Structures begin with their size. Fill them with zeros, set `size` to sizeof the structure, then set what you need: zero
 *   is the default of every field. Structures that are filled for you need their `size` set, too.
 * - Texts are UTF-8 and end with a zero byte. Pointers that you give are used during the call only.
 * - Every function may be called from any thread; where it says so, calls with one handle wait for each other. A handle
 *   must not be destroyed while another call with it runs.
 * - A child process after fork() has none of the threads and no device: there, call nothing but exec functions and _exit.
 * - Texts that you ask have at most 300 characters and 40 words; other texts and paths have at most 65,536 bytes.
 * - Nothing is thrown or unwound into your code, and nothing may be thrown out of your callbacks.
 * - Vulkan handles are given as void * (VkInstance, VkPhysicalDevice, VkDevice, VkQueue) and uint64_t (VkBuffer, VkImage,
 *   VkSemaphore), so that this header needs no other one.
 *
 * Version: compare svk_abi_version() with SVK_ABI_VERSION; the upper 16 bits must agree and the lower ones of the library must
 * not be smaller. */


#pragma once

#include <stddef.h>
#include <stdint.h>

/*
 Version of this interface: major × 65536 + minor. A program runs with any library of the same major version and the
 same or a higher minor one.
 */
#define SVK_ABI_VERSION 65536

/*
 What a function returns. Anything but `SVK_STATUS_OK` leaves a text behind: svk_context_error,
 svk_scene_error.
 */
enum SvkStatus
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     Done.
     */
    SVK_STATUS_OK = 0,
    /*
     What was given cannot be used; the text says what and why.
     */
    SVK_STATUS_INPUT = 1,
    /*
     A file could not be read.
     */
    SVK_STATUS_IO = 2,
    /*
     A library or program is not installed.
     */
    SVK_STATUS_MISSING = 3,
    /*
     The Vulkan device or driver refused something, other than the codes from 9 on.
     */
    SVK_STATUS_GPU = 4,
    /*
     Something failed while working on valid input.
     */
    SVK_STATUS_WORK = 5,
    /*
     The progress callback asked to stop; nothing was made or written.
     */
    SVK_STATUS_CANCELLED = 6,
    /*
     A pointer is null or a structure's size is wrong: a mistake in the calling program.
     */
    SVK_STATUS_ARGUMENT = 7,
    /*
     A mistake in splatvk. The handle may be destroyed, and nothing else should be done with it.
     */
    SVK_STATUS_INTERNAL = 8,
    /*
     The Vulkan device was lost. Contexts and scenes on it can only be destroyed; a context on a
     new device may work.
     */
    SVK_STATUS_DEVICE_LOST = 9,
    /*
     The Vulkan device has no memory left: fewer splats, smaller photos or another device may
     help.
     */
    SVK_STATUS_OUT_OF_DEVICE_MEMORY = 10,
    /*
     No Vulkan loader, driver or device that can be used.
     */
    SVK_STATUS_NO_DEVICE = 11,
    /*
     A model, or a file of it, is missing or not what it is used for.
     */
    SVK_STATUS_MISSING_MODEL = 12,
    /*
     A file cannot be written: the disk is full, or the folder does not allow it. Nothing
     half-written stays.
     */
    SVK_STATUS_UNWRITABLE = 13,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkStatus SvkStatus;
#else
typedef int32_t SvkStatus;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Time against quality.
 */
enum SvkPreset
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     Draft on a CPU device, default on a GPU.
     */
    SVK_PRESET_AUTO = 0,
    /*
     Minutes on a 2-core CPU.
     */
    SVK_PRESET_DRAFT = 1,
    /*
     Best quality for the time on a GPU.
     */
    SVK_PRESET_DEFAULT = 2,
    /*
     The paper's schedule and constants.
     */
    SVK_PRESET_PAPER = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkPreset SvkPreset;
#else
typedef uint32_t SvkPreset;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Spherical-harmonics degree of colours: above 0 they depend on the direction.
 */
enum SvkShDegree
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     What photos support that are left out for a test.
     */
    SVK_SH_DEGREE_AUTO = 0,
    /*
     The same from everywhere.
     */
    SVK_SH_DEGREE_ZERO = 1,
    /*
     4 numbers per colour channel.
     */
    SVK_SH_DEGREE_ONE = 2,
    /*
     9.
     */
    SVK_SH_DEGREE_TWO = 3,
    /*
     16.
     */
    SVK_SH_DEGREE_THREE = 4,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkShDegree SvkShDegree;
#else
typedef uint32_t SvkShDegree;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Whether the scene has what a text means.
 */
enum SvkPresence
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     The text model knows too few texts to tell.
     */
    SVK_PRESENCE_UNKNOWN = 0,
    /*
     It has.
     */
    SVK_PRESENCE_FOUND = 1,
    /*
     What the scene's features say does not decide, or the text is not wholly understood (see
     svk_scene_notes).
     */
    SVK_PRESENCE_UNSURE = 2,
    /*
     It has not.
     */
    SVK_PRESENCE_ABSENT = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkPresence SvkPresence;
#else
typedef uint32_t SvkPresence;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 What a call of the progress callback is about.
 */
enum SvkProgressKind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     A stage begins.
     */
    SVK_PROGRESS_KIND_BEGIN = 0,
    /*
     `done` of its `total` steps are finished.
     */
    SVK_PROGRESS_KIND_STEP = 1,
    /*
     It is over.
     */
    SVK_PROGRESS_KIND_END = 2,
    /*
     `note` is a warning for the user.
     */
    SVK_PROGRESS_KIND_WARNING = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkProgressKind SvkProgressKind;
#else
typedef uint32_t SvkProgressKind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 What to render.
 */
enum SvkChannel
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     4 values: red, green, blue on black (display-referred sRGB values, not clamped in floats),
     and alpha.
     */
    SVK_CHANNEL_COLOUR = 0,
    /*
     1 value: accumulated opacity, 0 to 1.
     */
    SVK_CHANNEL_ALPHA = 1,
    /*
     1 value: expected camera z in scene units, 0 where alpha is below a half.
     */
    SVK_CHANNEL_DEPTH = 2,
    /*
     The blended features of one level: as many values as SvkSceneInfo.feature_dim says for it.
     */
    SVK_CHANNEL_FEATURES = 3,
    /*
     1 value: how well the pixel answers `text`, 0 to 1, smoothed; 0 where the scene says
     nothing.
     */
    SVK_CHANNEL_RELEVANCY = 4,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkChannel SvkChannel;
#else
typedef uint32_t SvkChannel;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 How values are stored. Rows go from top to bottom, without gaps.
 */
enum SvkEncoding
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     32-bit floats [height][width][values]. As an image: VK_FORMAT_R32_SFLOAT for 1 value,
     VK_FORMAT_R32G32B32A32_SFLOAT for 4; other counts are for memory and buffers only.
     */
    SVK_ENCODING_F32 = 0,
    /*
     32-bit floats [ceil(values / 4)][height][width][4], filled up with zeros. As an image:
     VK_FORMAT_R32G32B32A32_SFLOAT with one array layer for every 4 values.
     */
    SVK_ENCODING_F32X4 = 1,
    /*
     The same in 16-bit floats: VK_FORMAT_R16G16B16A16_SFLOAT. Not for relevancy.
     */
    SVK_ENCODING_F16X4 = 2,
    /*
     The same in 8 bits, values clamped to [0, 1]: VK_FORMAT_R8G8B8A8_UNORM. Not for relevancy.
     */
    SVK_ENCODING_UNORM8_X4 = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkEncoding SvkEncoding;
#else
typedef uint32_t SvkEncoding;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Arrays of a scene, for svk_scene_read. N is the number of Gaussians.
 */
enum SvkArray
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     [N][3] centres, scene units; axes as the cameras' (x right, y down, z forward in a camera
     without rotation).
     */
    SVK_ARRAY_MEANS = 0,
    /*
     [N][3] natural logarithms of the standard deviations along the local axes.
     */
    SVK_ARRAY_LOG_SCALES = 1,
    /*
     [N][4] rotations w, x, y, z; not necessarily normalised.
     */
    SVK_ARRAY_QUATS = 2,
    /*
     [N] opacities before the sigmoid.
     */
    SVK_ARRAY_OPACITY_LOGITS = 3,
    /*
     [N][(degree + 1)²][3] spherical-harmonics coefficients; colour = 0.5 + 0.2820948 · the
     first.
     */
    SVK_ARRAY_SH = 4,
    /*
     [N] pixels of all photos that show the Gaussian; below 0.05 no photo does and it is guessed.
     Empty (0 floats) where that is not known: files of Gaussians, scenes of older versions.
     */
    SVK_ARRAY_SEEN = 5,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkArray SvkArray;
#else
typedef uint32_t SvkArray;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 A Vulkan device and where the models are.
 */
typedef struct SvkContext SvkContext;

/*
 A trained or loaded scene.
 */
typedef struct SvkScene SvkScene;

/*
 How a context is made. All zero (but for `size`) is the default.
 */
typedef struct {
    /*
     sizeof(SvkContextOptions)
     */
    size_t size;
    /*
     Part of a Vulkan device's name, or its number as a text; NULL = the best one. Not for
     svk_context_adopt.
     */
    const char *device;
    /*
     Folder of the models; NULL = the installed ones.
     */
    const char *models;
    /*
     1 = training gives the same bits on every run on one device, about a tenth slower.
     */
    uint32_t deterministic;
    /*
     1 = with the Khronos validation layer. Not for svk_context_adopt.
     */
    uint32_t validation;
    /*
     What computes the networks, as --provider takes it; NULL = the environment variable
     SPLATVK_PROVIDER, or else "auto".
     */
    const char *provider;
} SvkContextOptions;

/*
 A pointer to vkGetInstanceProcAddr, cast to this type.
 */
typedef void (*SvkVoidFunction)(void);

/*
 Takes or releases the host's own lock of a queue; `user` is the structure's.
 */
typedef void (*SvkQueueFunction)(void *user);

/*
 A Vulkan device of the host, for svk_context_adopt. It must outlive the context and all scenes
 made from it.
 */
typedef struct {
    /*
     sizeof(SvkVulkanDevice)
     */
    size_t size;
    /*
     VkInstance made with apiVersion 1.2 or newer.
     */
    void *instance;
    /*
     VkPhysicalDevice
     */
    void *physical_device;
    /*
     VkDevice made with the feature synchronization2 (of Vulkan 1.3 or VK_KHR_synchronization2).
     */
    void *device;
    /*
     VkQueue with compute.
     */
    void *queue;
    /*
     Its family.
     */
    uint32_t queue_family;
    /*
     Number of `extensions`.
     */
    uint32_t extension_count;
    /*
     Names of the device extensions that were enabled.
     */
    const char *const *extensions;
    /*
     The VkPhysicalDeviceFeatures2 chain that the device was made with. Each feature of this list
     that is on makes some work faster: shaderInt64, storageBuffer16BitAccess,
     subgroupSizeControl, computeFullSubgroups, shaderBufferFloat32AtomicAdd. timelineSemaphore
     is needed for SvkSync. Read during the call only.
     */
    const void *features;
    /*
     vkGetInstanceProcAddr of the host; NULL = that of the system's loader.
     */
    SvkVoidFunction get_instance_proc_addr;
    /*
     Called around every use of the queue. NULL = the host leaves the queue alone while a call
     with this context or one of its scenes runs.
     */
    SvkQueueFunction lock_queue;
    /*
     The end of `lock_queue`.
     */
    SvkQueueFunction unlock_queue;
    /*
     Given to both.
     */
    void *user;
} SvkVulkanDevice;

/*
 A pinhole camera. Axes: x right, y down, z forward. The centre of the first pixel is at (0.5,
 0.5).
 */
typedef struct {
    /*
     sizeof(SvkCamera)
     */
    size_t size;
    /*
     Pixels.
     */
    uint32_t width;
    /*
     Pixels.
     */
    uint32_t height;
    /*
     Focal length along x, pixels.
     */
    double fx;
    /*
     Focal length along y, pixels.
     */
    double fy;
    /*
     Principal point, pixels.
     */
    double cx;
    /*
     Principal point, pixels.
     */
    double cy;
    /*
     Rows of [R | t]: camera = R · world + t.
     */
    double world_to_camera[3][4];
} SvkCamera;

/*
 One photo: exactly one of `path`, `encoded` and `pixels` is set.
 */
typedef struct {
    /*
     sizeof(SvkPhoto)
     */
    size_t size;
    /*
     File name for messages, masks and cameras; NULL = that of `path`, or "photo_00", "photo_01",
     ...
     */
    const char *name;
    /*
     Image file (JPEG, PNG, HEIC, AVIF, WebP, TIFF); with SvkTrainOptions.views a folder of them,
     too.
     */
    const char *path;
    /*
     Such an image file in memory.
     */
    const uint8_t *encoded;
    /*
     Its length in bytes.
     */
    size_t encoded_bytes;
    /*
     Upright 8-bit sRGB pixels, 3 or 4 bytes each; a fourth byte is skipped.
     */
    const uint8_t *pixels;
    /*
     Bytes of a pixel: 3 or 4.
     */
    uint32_t pixel_bytes;
    /*
     Pixels.
     */
    uint32_t width;
    /*
     Pixels.
     */
    uint32_t height;
    /*
     From one row to the next, bytes; 0 = width * pixel_bytes.
     */
    size_t row_bytes;
    /*
     Focal length in these pixels, where it is known; 0 = unknown. For `pixels`; files tell it
     themselves.
     */
    double focal;
    /*
     The photo's camera, where it is known; for all photos or for none.
     */
    const SvkCamera *camera;
    /*
     For `pixels`: a byte for each, 0 where the pixel is not used (a person, a bonnet), rows
     packed; NULL = all are used. Files have masks in a folder "masks" beside theirs.
     */
    const uint8_t *mask;
} SvkPhoto;

/*
 What the progress callback is told. Texts are valid during the call only.
 */
typedef struct {
    /*
     sizeof(SvkProgress) of the library.
     */
    size_t size;
    /*
     SvkProgressKind
     */
    uint32_t kind;
    /*
     Name of the stage.
     */
    const char *stage;
    /*
     Steps finished.
     */
    uint64_t done;
    /*
     Steps in all; 0 = unknown.
     */
    uint64_t total;
    /*
     A short live figure ("PSNR 28.1"), or the warning.
     */
    const char *note;
} SvkProgress;

/*
 Called from any thread, never by two at a time, and never after svk_train has returned. Anything
 but 0 asks it to stop. No exception may leave it, and it may not call into the context that
 trains.
 */
typedef int32_t (*SvkProgressFunction)(void *user, const SvkProgress *progress);

/*
 How a scene is trained. All zero (but for `size`) is the default: built-in models, preset by
 device.
 */
typedef struct {
    /*
     sizeof(SvkTrainOptions)
     */
    size_t size;
    /*
     SvkPreset
     */
    uint32_t preset;
    /*
     How many photos to use where a folder is given; 0 = all that are given.
     */
    uint32_t views;
    /*
     Seed of everything random.
     */
    uint64_t seed;
    /*
     Steps of the colour stage; 0 = the preset's.
     */
    uint64_t iterations;
    /*
     Steps of the language stage; 0 = the preset's.
     */
    uint64_t language_iterations;
    /*
     Length of the codes that splats carry: 3, 8 or 16; 0 = 16.
     */
    uint32_t feature_dim;
    /*
     1 = one model per level, as in the paper.
     */
    uint32_t per_level;
    /*
     Known cameras: transforms.json, a COLMAP model folder or cameras.json; NULL = found from the
     photos.
     */
    const char *cameras;
    /*
     Folder of precomputed masks (STEM_s.npy); NULL = built-in.
     */
    const char *masks;
    /*
     Folder of precomputed features (STEM_f.npy, text_embeddings.npz), the same as `masks`; NULL
     = built-in.
     */
    const char *features;
    /*
     Called with the progress; a result other than 0 stops the run; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     Given to `progress`.
     */
    void *user;
    /*
     Longer side of the working images, pixels: larger photos are scaled down, none is enlarged.
     0 = 800 on a CPU device, 1600 on a GPU.
     */
    uint64_t max_size;
    /*
     Cameras and points, as `splatvk run --init` takes it: "sfm", "cameras:FILE", the name of an
     installed network, or "auto" for the best of them. NULL = `cameras`, or else "sfm".
     */
    const char *init;
    /*
     Dense matches, as --matcher takes it. NULL = built-in.
     */
    const char *matcher;
    /*
     Masks, as --masks takes it. NULL = `masks`, or else built-in.
     */
    const char *mask_source;
    /*
     Region features, as --features takes it. NULL = `features`, or else built-in.
     */
    const char *feature_source;
    /*
     How language gets onto the splats, as --method takes it. NULL = "lift"; "sparselgs" with the
     preset of the paper, `language_iterations`, `per_level` or `compat`.
     */
    const char *method;
    /*
     SvkShDegree
     */
    uint64_t sh_degree;
    /*
     What can be done in several ways, as others do it: as --compat takes it. NULL = as this
     library does it.
     */
    const char *compat;
    /*
     Depth suggested where photos cannot be matched, as --depth-prior takes it: "dir:FOLDER", the
     name of an installed network, or "auto" for the best of them. NULL = none.
     */
    const char *depth_prior;
} SvkTrainOptions;

/*
 What a scene holds.
 */
typedef struct {
    /*
     sizeof(SvkSceneInfo)
     */
    size_t size;
    /*
     Number of Gaussians.
     */
    uint64_t splats;
    /*
     Degree of their spherical harmonics, 0 to 3.
     */
    uint32_t sh_degree;
    /*
     Number of cameras; 0 for a bare file of Gaussians.
     */
    uint32_t cameras;
    /*
     Codes per level: subparts, parts, wholes. All 0 = no language.
     */
    uint32_t codes[3];
    /*
     Feature values per level.
     */
    uint32_t feature_dim[3];
    /*
     Metres in a scene unit; 0 = unknown.
     */
    double metres_per_unit;
} SvkSceneInfo;

/*
 The answer to a text in one view.
 */
typedef struct {
    /*
     sizeof(SvkAnswer)
     */
    size_t size;
    /*
     1 = the text was found in this view; 0 where it is absent.
     */
    uint32_t found;
    /*
     Level that answers: 0 = subparts, 1 = parts, 2 = wholes.
     */
    uint32_t level;
    /*
     Best relevancy in the view, 0 to 1; 0.5 is as close as to an everyday phrase.
     */
    double score;
    /*
     Centre of the most relevant pixel; the first pixel's is (0.5, 0.5).
     */
    double x;
    /*
     See `x`.
     */
    double y;
    /*
     Pixels in the mask; 0 where the text was not found.
     */
    uint64_t mask_pixels;
    /*
     SvkPresence: whether the scene has it, whatever this view shows.
     */
    uint32_t presence;
    /*
     Things in space that the text means: those of svk_scene_instances.
     */
    uint32_t instances;
    /*
     Share of other things that fit the scene at least as well: the p-value behind `presence`. 0
     = unknown.
     */
    double p_value;
    /*
     How far the photos agree on what answers, 0 to 1; below 0 = unknown.
     */
    double reliability;
} SvkAnswer;

/*
 One of the things that a text means. Lengths are in scene units.
 */
typedef struct {
    /*
     sizeof(SvkInstance)
     */
    size_t size;
    /*
     Number of its Gaussians.
     */
    uint64_t splats;
    /*
     Its share of all that answers the text, 0 to 1.
     */
    double share;
    /*
     How far the photos agree on what it is, 0 to 1; below 0 = unknown.
     */
    double reliability;
    /*
     Middle of the oriented box.
     */
    double centre[3];
    /*
     Lowest corner of the box along the scene's axes.
     */
    double box_min[3];
    /*
     Highest corner.
     */
    double box_max[3];
    /*
     Unit vectors along the edges of the oriented box.
     */
    double axes[3][3];
    /*
     Lengths of its edges, longest first.
     */
    double box_size[3];
    /*
     1 = the view shows it, at (`x`, `y`).
     */
    uint64_t seen;
    /*
     Pixel of its middle in the view; the first pixel's centre is (0.5, 0.5).
     */
    double x;
    /*
     See `x`.
     */
    double y;
} SvkInstance;

/*
 Where an image of the host is written: exactly one of `host`, `buffer` and `image` is set.
 */
typedef struct {
    /*
     sizeof(SvkOutput)
     */
    size_t size;
    /*
     SvkChannel
     */
    uint32_t channel;
    /*
     SvkEncoding
     */
    uint32_t encoding;
    /*
     For features: 0 = subparts, 1 = parts, 2 = wholes.
     */
    uint32_t level;
    /*
     Number of array layers of `image`.
     */
    uint32_t layers;
    /*
     For relevancy: what to look for, UTF-8.
     */
    const char *text;
    /*
     Memory of the host.
     */
    void *host;
    /*
     Size of `host`, or of the space in `buffer` from `offset` on. Must hold what the encoding
     needs.
     */
    size_t bytes;
    /*
     VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT, on the host's device.
     */
    uint64_t buffer;
    /*
     First byte of `buffer`; a multiple of 4.
     */
    uint64_t offset;
    /*
     VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, on the host's device: 2D, of the camera's
     size, one sample, in the format that the encoding names. Mip level 0 is written.
     */
    uint64_t image;
    /*
     VkImageLayout that the image has; VK_IMAGE_LAYOUT_UNDEFINED where its content may be lost.
     */
    uint32_t old_layout;
    /*
     VkImageLayout that it gets; not VK_IMAGE_LAYOUT_UNDEFINED.
     */
    uint32_t new_layout;
} SvkOutput;

/*
 Timeline semaphores of the host around writing to its buffers and images. Both belong to the
 context's queue family (or are shared concurrently) when the wait is over, and still do when the
 signal comes.
 */
typedef struct {
    /*
     sizeof(SvkSync)
     */
    size_t size;
    /*
     VkSemaphore of type timeline: targets may be written once it reaches `wait_value`; 0 = at
     once.
     */
    uint64_t wait_semaphore;
    /*
     See `wait_semaphore`.
     */
    uint64_t wait_value;
    /*
     VkSemaphore of type timeline: reaches `signal_value` when all targets are written. 0 = the
     call waits for that.
     */
    uint64_t signal_semaphore;
    /*
     See `signal_semaphore`.
     */
    uint64_t signal_value;
} SvkSync;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 The SVK_ABI_VERSION of the library. Thread-safe.
 */
uint32_t svk_abi_version(void);

/*
 The library's version, such as "0.1.0". Static memory. Thread-safe.
 */
const char *svk_version(void);

/*
 Makes a context on a Vulkan device of its own. `options` may be NULL. On failure `*context` is NULL and the text is
 kept for the calling thread: svk_context_error(NULL, ...). Thread-safe.
 */
SvkStatus svk_context_create(const SvkContextOptions *options, SvkContext **context);

/*
 Makes a context on the host's own Vulkan device. `options` may be NULL. Otherwise like svk_context_create.
 */
SvkStatus svk_context_adopt(const SvkVulkanDevice *device, const SvkContextOptions *options, SvkContext **context);

/*
 Ends a context; scenes made from it stay usable. NULL is allowed. No other call with this context may be running.
 */
void svk_context_destroy(SvkContext *context);

/*
 Copies the name of the Vulkan device into `text` (`bytes` long, always ended) and returns the bytes that it needs.
 Thread-safe.
 */
size_t svk_context_device_name(const SvkContext *context, char *text, size_t bytes);

/*
 Copies the text of the last failed call with this context (in any thread) into `text` (`bytes` long, always ended) and
 returns the bytes that it needs. NULL = the last failed creation of a context in this thread. Thread-safe.
 */
size_t svk_context_error(const SvkContext *context, char *text, size_t bytes);

/*
 Trains a scene from 2 to 16 photos. `options` may be NULL. On failure, and when the callback stops it, `*scene` is NULL
 and the text is the context's. Thread-safe; several trainings may run on one context, sharing its device.
 */
SvkStatus svk_train(SvkContext *context,
                    const SvkPhoto *photos,
                    size_t photo_count,
                    const SvkTrainOptions *options,
                    SvkScene **scene);

/*
 Loads a scene directory, or a file of Gaussians (which has no language). On failure `*scene` is NULL and the text is the
 context's. Thread-safe.
 */
SvkStatus svk_scene_load(SvkContext *context,
                         const char *path,
                         SvkScene **scene);

/*
 Ends a scene, after waiting for what it still writes to buffers and images of the host. NULL is allowed. No other call
 with this scene may be running.
 */
void svk_scene_destroy(SvkScene *scene);

/*
 Copies the text of the last failed call with this scene (in any thread) into `text` (`bytes` long, always ended) and
 returns the bytes that it needs. Thread-safe.
 */
size_t svk_scene_error(const SvkScene *scene, char *text, size_t bytes);

/*
 What the scene holds. Thread-safe.
 */
SvkStatus svk_scene_info(const SvkScene *scene, SvkSceneInfo *info);

/*
 Camera `index` of the scene, and the name of its photo in `name` (`name_bytes` long; may be NULL). Thread-safe.
 */
SvkStatus svk_scene_camera(const SvkScene *scene, uint32_t index, SvkCamera *camera, char *name, size_t name_bytes);

/*
 Copies an array of the scene (SvkArray) into `values`, which must hold exactly `count` floats. Thread-safe.
 */
SvkStatus svk_scene_read(const SvkScene *scene, uint32_t array, float *values, size_t count);

/*
 Looks for a text in the view of a camera. `answer` is filled; `mask`, unless NULL, gets width × height bytes, 255 where
 the view shows what was asked for and 0 elsewhere, and `mask_bytes` is exactly that many. "Not found" is an answer, not
 a failure. Thread-safe; calls with one scene follow each other.
 */
SvkStatus svk_scene_query(SvkScene *scene,
                          const char *text,
                          const SvkCamera *camera,
                          SvkAnswer *answer,
                          uint8_t *mask,
                          size_t mask_bytes);

/*
 The things in space that a text means, largest first, with the pixels at which the view of a camera shows them. `instances`
 has room for `capacity` structures, each with its size set (0 and NULL to count only); `*count` gets the number of things,
 which may be more. Thread-safe; calls with one scene follow each other.
 */
SvkStatus svk_scene_instances(SvkScene *scene,
                              const char *text,
                              const SvkCamera *camera,
                              SvkInstance *instances,
                              size_t capacity,
                              size_t *count);

/*
 What is not understood of a text, one line each, into `notes` (`bytes` long, always ended): "answers for “mug”; “without
 handle” is not understood". Empty where all of it is understood. Thread-safe.
 */
SvkStatus svk_scene_notes(SvkScene *scene,
                          const char *text,
                          char *notes,
                          size_t bytes);

/*
 Writes the scene: a file of Gaussians where the name ends like one (.ply, .compressed.ply, .splat, .spz; language goes
 beside it, into NAME.language.npz), a scene directory where it has no ending, ends in a slash or is that of a folder; any other
 ending is SVK_STATUS_INPUT. It appears whole or not at all; `replace` = 1 allows to replace a scene or file that is there, but
 never a symbolic link, what the scene was loaded from, a scene directory with files in it that splatvk did not write, or a place
 to which another process or thread writes. Thread-safe.
 */
SvkStatus svk_scene_save(SvkScene *scene,
                         const char *path,
                         uint32_t replace);

/*
 Renders the scene from a camera into all `outputs` at once. `sync` may be NULL: then targets are written at once, and
 the call returns when they are. With a signal semaphore the call returns earlier; memory of the host is always written
 before it returns. Calls with one scene follow each other, and so do their writes. Thread-safe.
 */
SvkStatus svk_scene_render(SvkScene *scene,
                           const SvkCamera *camera,
                           const SvkOutput *outputs,
                           size_t output_count,
                           const SvkSync *sync);

/*
 Waits until everything that svk_scene_render was asked to write is written. Thread-safe.
 */
SvkStatus svk_scene_wait(SvkScene *scene);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus
