/* splatvk: makes a Gaussian-splat scene that answers text queries from a few photos without camera
 * poses.
 *
 * Generated from src/capi by cbindgen; do not edit.
 *
 * Rules for all functions
 * - Handles (SvkContext, SvkScene, SvkEditor) are opaque. Each is created by one function and
 *   destroyed by its _destroy function. A context may be destroyed before its scenes and editors.
 * - Functions return an SvkStatus. After any other status than SVK_STATUS_OK the handle keeps an
 *   error text of one line: the error, its place, and the remedy. For a handle that is NULL there
 *   is no text, only SVK_STATUS_ARGUMENT.
 * - Structures begin with their size. Fill them with zeros, set `size` to the sizeof of the
 *   structure, then set other fields; zero is the default of every field. Set `size` of output
 *   structures, too.
 * - Texts are UTF-8 and end with a zero byte. Functions use the caller's pointers during the call
 *   only, except lock_queue, unlock_queue and user of SvkVulkanDevice.
 * - Every function may be called from any thread. Where its comment says so, calls with one handle
 *   are serialised. A handle must not be destroyed while another call with it runs.
 * - After fork() the child process has none of the threads and no device; it must call only exec
 *   functions and _exit.
 * - Query texts have at most 300 characters and 40 words, other texts and paths at most 65,536
 *   bytes.
 * - No function throws or unwinds into the caller, and callbacks must not throw.
 * - Vulkan handles are void * (VkInstance, VkPhysicalDevice, VkDevice, VkQueue) or uint64_t
 *   (VkBuffer, VkImage, VkSemaphore), so that this header includes no other one.
 *
 * Version: the upper 16 bits of svk_abi_version() and SVK_ABI_VERSION must be equal, and the lower
 * 16 bits of svk_abi_version() must not be smaller. */


#pragma once

#include <stddef.h>
#include <stdint.h>

/*
 Version of this interface: major × 65536 + minor. A program works with any library of the same
 major version and the same or a higher minor version.
 */
#define SVK_ABI_VERSION 65537

/*
 Result of a function. After any other status than SVK_STATUS_OK, svk_context_error,
 svk_scene_error or svk_editor_error returns a text.
 */
enum SvkStatus
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     Success.
     */
    SVK_STATUS_OK = 0,
    /*
     The input cannot be used; the text names it and the reason.
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
     An error of the Vulkan device or driver without a code of its own (9 to 11).
     */
    SVK_STATUS_GPU = 4,
    /*
     Work on valid input failed.
     */
    SVK_STATUS_WORK = 5,
    /*
     The progress callback stopped the work; nothing was made or written.
     */
    SVK_STATUS_CANCELLED = 6,
    /*
     An argument is invalid, such as a null pointer or a wrong structure size: an error of the
     calling program.
     */
    SVK_STATUS_ARGUMENT = 7,
    /*
     An error in splatvk. The handle can only be destroyed.
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
     There is no usable Vulkan loader, driver or device.
     */
    SVK_STATUS_NO_DEVICE = 11,
    /*
     A model, or a file of it, is missing or unsuitable.
     */
    SVK_STATUS_MISSING_MODEL = 12,
    /*
     A file cannot be written: the disk is full, or the folder is not writable. No partial file
     remains.
     */
    SVK_STATUS_UNWRITABLE = 13,
    /*
     An edit was not made, because its selection may be wrong: nothing is changed.
     svk_editor_doubts returns the reasons, and SvkEdit.force edits anyway.
     */
    SVK_STATUS_DOUBTFUL = 14,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkStatus SvkStatus;
#else
typedef int32_t SvkStatus;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Trade-off between time and quality.
 */
enum SvkPreset
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     SVK_PRESET_DRAFT on a CPU device, SVK_PRESET_DEFAULT on a GPU.
     */
    SVK_PRESET_AUTO = 0,
    /*
     Takes minutes on a 2-core CPU.
     */
    SVK_PRESET_DRAFT = 1,
    /*
     Best quality for the time on a GPU.
     */
    SVK_PRESET_DEFAULT = 2,
    /*
     Schedule and constants of the paper.
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
 Degree of the spherical harmonics of colours; above 0 colours depend on the viewing direction.
 */
enum SvkShDegree
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     The highest degree that improves photos left out of the fit.
     */
    SVK_SH_DEGREE_AUTO = 0,
    /*
     The same colour from all directions.
     */
    SVK_SH_DEGREE_ZERO = 1,
    /*
     4 coefficients per colour channel.
     */
    SVK_SH_DEGREE_ONE = 2,
    /*
     9 coefficients per colour channel.
     */
    SVK_SH_DEGREE_TWO = 3,
    /*
     16 coefficients per colour channel.
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
 Presence in the scene of the thing that a text means.
 */
enum SvkPresence
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     The text model has too few other texts to compare with.
     */
    SVK_PRESENCE_UNKNOWN = 0,
    /*
     The thing is in the scene.
     */
    SVK_PRESENCE_FOUND = 1,
    /*
     The features do not decide, or a part of the text is not understood (see svk_scene_notes).
     */
    SVK_PRESENCE_UNSURE = 2,
    /*
     The thing is not in the scene.
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
 Kind of a call of the progress callback.
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
     `done` of the `total` steps of the stage are finished.
     */
    SVK_PROGRESS_KIND_STEP = 1,
    /*
     The stage ends.
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
 Rendered channel.
 */
enum SvkChannel
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     4 values: red, green and blue on black, as display-referred sRGB values (not clamped in
     floats), and alpha.
     */
    SVK_CHANNEL_COLOUR = 0,
    /*
     1 value: accumulated opacity, 0 to 1.
     */
    SVK_CHANNEL_ALPHA = 1,
    /*
     1 value: expected camera z in scene units; 0 where alpha is below a half.
     */
    SVK_CHANNEL_DEPTH = 2,
    /*
     Blended features of one level: SvkSceneInfo.feature_dim values.
     */
    SVK_CHANNEL_FEATURES = 3,
    /*
     1 value: smoothed relevancy of the pixel to `text`, 0 to 1; 0 where the view is empty.
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
 Memory layout of values. Rows go from top to bottom, without gaps.
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
     32-bit floats [ceil(values / 4)][height][width][4], padded with zeros. As an image:
     VK_FORMAT_R32G32B32A32_SFLOAT with one array layer per 4 values.
     */
    SVK_ENCODING_F32X4 = 1,
    /*
     16-bit floats, otherwise as SVK_ENCODING_F32X4. As an image: VK_FORMAT_R16G16B16A16_SFLOAT.
     Not for relevancy.
     */
    SVK_ENCODING_F16X4 = 2,
    /*
     8 bits, values clamped to [0, 1], otherwise as SVK_ENCODING_F32X4. As an image:
     VK_FORMAT_R8G8B8A8_UNORM. Not for relevancy.
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
     [N][3] centres in scene units; the axes are x right, y down, z forward of a camera without
     rotation.
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
     [N] numbers of pixels, over all photos, that show the Gaussian. Below 0.05 no photo shows
     it, and it is extrapolated. Empty (0 floats) where this is unknown: files of Gaussians,
     scenes of older versions.
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
 Shapes for physics beside every part of a mesh.
 */
enum SvkCollider
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     None.
     */
    SVK_COLLIDER_NONE = 0,
    /*
     The convex hull.
     */
    SVK_COLLIDER_HULL = 1,
    /*
     Convex pieces that follow the shape (V-HACD).
     */
    SVK_COLLIDER_DECOMPOSITION = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkCollider SvkCollider;
#else
typedef uint32_t SvkCollider;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Axis that points up in an exported file.
 */
enum SvkUpAxis
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     y in .spz, .glb and .gltf, else -y, where the scene states the direction up.
     */
    SVK_UP_AXIS_AUTO = 0,
    /*
     -y: right, down, forward, as in cameras.
     */
    SVK_UP_AXIS_MINUS_Y = 1,
    /*
     y: right, up, back.
     */
    SVK_UP_AXIS_Y = 2,
    /*
     z: right, forward, up.
     */
    SVK_UP_AXIS_Z = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkUpAxis SvkUpAxis;
#else
typedef uint32_t SvkUpAxis;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Level of the files of svk_scene_objects.
 */
enum SvkPieces
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     Things and surfaces, none of them within another.
     */
    SVK_PIECES_THINGS = 0,
    /*
     Masks of parts.
     */
    SVK_PIECES_PARTS = 1,
    /*
     Parts of parts.
     */
    SVK_PIECES_SUBPARTS = 2,
    /*
     Masks of wholes, which may join things with their table.
     */
    SVK_PIECES_WHOLES = 3,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkPieces SvkPieces;
#else
typedef uint32_t SvkPieces;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 Operation of an edit.
 */
enum SvkOperation
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : uint32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
    /*
     Removes the selected splats.
     */
    SVK_OPERATION_DELETE = 0,
    /*
     Removes all other splats.
     */
    SVK_OPERATION_ISOLATE = 1,
    /*
     Gives the selected splats a mean colour; each keeps its brightness against the mean.
     */
    SVK_OPERATION_RECOLOUR = 2,
    /*
     Moves the selected splats.
     */
    SVK_OPERATION_MOVE = 3,
    /*
     Removes splats in free space, in front of the surfaces that photos show.
     */
    SVK_OPERATION_FLOATERS = 4,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum SvkOperation SvkOperation;
#else
typedef uint32_t SvkOperation;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 A Vulkan device and a folder of models.
 */
typedef struct SvkContext SvkContext;

/*
 A scene directory that is being edited.
 */
typedef struct SvkEditor SvkEditor;

/*
 A trained or loaded scene.
 */
typedef struct SvkScene SvkScene;

/*
 Options of a context. Zero is the default of every field but `size`.
 */
typedef struct {
    /*
     sizeof(SvkContextOptions)
     */
    size_t size;
    /*
     Vulkan device: "uuid:…", "pci:…", its number as a text, or a part of its name; NULL = the
     best device. Not for svk_context_adopt.
     */
    const char *device;
    /*
     Folder of the models; NULL = the installed ones.
     */
    const char *models;
    /*
     1 = training gives the same bits in every run on one device, about a tenth slower.
     */
    uint32_t deterministic;
    /*
     1 = enable the Khronos validation layer. Not for svk_context_adopt.
     */
    uint32_t validation;
    /*
     Provider that computes the networks, as of --provider; NULL = the environment variable
     SPLATVK_PROVIDER, or else "auto".
     */
    const char *provider;
} SvkContextOptions;

/*
 A pointer to vkGetInstanceProcAddr, cast to this type.
 */
typedef void (*SvkVoidFunction)(void);

/*
 Locks or unlocks a queue of the host; `user` is SvkVulkanDevice.user.
 */
typedef void (*SvkQueueFunction)(void *user);

/*
 A Vulkan device of the host, for svk_context_adopt. It must outlive the context and all its
 scenes.
 */
typedef struct {
    /*
     sizeof(SvkVulkanDevice)
     */
    size_t size;
    /*
     VkInstance, created with apiVersion 1.2 or newer.
     */
    void *instance;
    /*
     VkPhysicalDevice
     */
    void *physical_device;
    /*
     VkDevice, created with the feature synchronization2 (of Vulkan 1.3 or
     VK_KHR_synchronization2).
     */
    void *device;
    /*
     VkQueue that supports compute.
     */
    void *queue;
    /*
     Queue family of `queue`.
     */
    uint32_t queue_family;
    /*
     Number of `extensions`.
     */
    uint32_t extension_count;
    /*
     Names of the enabled device extensions.
     */
    const char *const *extensions;
    /*
     VkPhysicalDeviceFeatures2 chain of the device's creation. Some work is faster with each of
     these features: shaderInt64, storageBuffer16BitAccess, subgroupSizeControl,
     computeFullSubgroups, shaderBufferFloat32AtomicAdd. SvkSync needs timelineSemaphore. Read
     during the call only.
     */
    const void *features;
    /*
     vkGetInstanceProcAddr of the host; NULL = that of the system's loader.
     */
    SvkVoidFunction get_instance_proc_addr;
    /*
     Called before every use of the queue. NULL = the host does not use the queue during calls
     with this context or one of its scenes.
     */
    SvkQueueFunction lock_queue;
    /*
     Called after every use of the queue; set if and only if `lock_queue` is.
     */
    SvkQueueFunction unlock_queue;
    /*
     Argument of `lock_queue` and `unlock_queue`.
     */
    void *user;
} SvkVulkanDevice;

/*
 A pinhole camera. Axes: x right, y down, z forward. The first pixel's centre is (0.5, 0.5).
 */
typedef struct {
    /*
     sizeof(SvkCamera)
     */
    size_t size;
    /*
     Width of the image, pixels.
     */
    uint32_t width;
    /*
     Height of the image, pixels.
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
     Principal point along x, pixels.
     */
    double cx;
    /*
     Principal point along y, pixels.
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
     File name in messages, masks and cameras; NULL = that of `path`, or "photo_00", "photo_01",
     ...
     */
    const char *name;
    /*
     Image file (JPEG, PNG, HEIC, AVIF, WebP, TIFF), or a folder of image files.
     */
    const char *path;
    /*
     Content of an image file.
     */
    const uint8_t *encoded;
    /*
     Length of `encoded`, bytes.
     */
    size_t encoded_bytes;
    /*
     Upright 8-bit sRGB pixels of 3 or 4 bytes; the fourth byte is ignored.
     */
    const uint8_t *pixels;
    /*
     Bytes per pixel of `pixels`: 3 or 4.
     */
    uint32_t pixel_bytes;
    /*
     Width of `pixels`.
     */
    uint32_t width;
    /*
     Height of `pixels`.
     */
    uint32_t height;
    /*
     Distance of the rows of `pixels`, bytes; 0 = width * pixel_bytes.
     */
    size_t row_bytes;
    /*
     Focal length of `pixels`, in pixels; 0 = unknown. Image files state their own.
     */
    double focal;
    /*
     Camera of the photo; NULL = unknown. For all photos or for none.
     */
    const SvkCamera *camera;
    /*
     One byte for each of `pixels`, without gaps between rows: 0 = the pixel is not used (a
     person, a bonnet). NULL = all are used. Image files have masks in a folder "masks" beside
     them.
     */
    const uint8_t *mask;
} SvkPhoto;

/*
 Argument of the progress callback. Texts are valid during the call only.
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
     Number of finished steps.
     */
    uint64_t done;
    /*
     Number of all steps; 0 = unknown.
     */
    uint64_t total;
    /*
     A short figure ("PSNR 28.1"), or the warning.
     */
    const char *note;
} SvkProgress;

/*
 Progress callback. It is called from any thread, but never from two at a time, and not after the
 function returns that it was given to. A result other than 0 stops the work. It must not throw
 an exception or call functions with the context or the scene that works.
 */
typedef int32_t (*SvkProgressFunction)(void *user, const SvkProgress *progress);

/*
 Options of training. Zero is the default of every field but `size`: built-in models, preset by
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
     Number of photos to choose of files and folders; 0 = all files, or at most 4 where a folder
     is given.
     */
    uint32_t views;
    /*
     Seed of all random numbers.
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
     Length of the codes of splats: 3, 8 or 16; 0 = 16.
     */
    uint32_t feature_dim;
    /*
     1 = one set of splats per level, as in the paper.
     */
    uint32_t per_level;
    /*
     Known cameras: transforms.json, a COLMAP model folder or cameras.json; NULL = estimated from
     the photos.
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
     Progress callback; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     First argument of `progress`.
     */
    void *user;
    /*
     Longer side of the working images, pixels: larger photos are scaled down, smaller ones are
     not enlarged. 0 = 800 on a CPU device, 1600 on a GPU.
     */
    uint64_t max_size;
    /*
     Source of cameras and points, as of `splatvk run --init`: "sfm", "cameras:FILE", the name of
     an installed network, or "auto" for the best of them. NULL = `cameras`, or else "sfm".
     */
    const char *init;
    /*
     Source of dense matches, as of --matcher. NULL = built-in.
     */
    const char *matcher;
    /*
     Source of masks, as of --masks. NULL = `masks`, or else built-in.
     */
    const char *mask_source;
    /*
     Source of region features, as of --features. NULL = `features`, or else built-in.
     */
    const char *feature_source;
    /*
     Method of the language stage, as of --method. NULL = "lift", or "sparselgs" with
     SVK_PRESET_PAPER, `language_iterations`, `per_level` or `compat`.
     */
    const char *method;
    /*
     SvkShDegree
     */
    uint64_t sh_degree;
    /*
     Implementation whose choices are reproduced, as of --compat. NULL = none.
     */
    const char *compat;
    /*
     Source of depth where photos cannot be matched, as of --depth-prior: "dir:FOLDER", the name
     of an installed network, or "auto" for the best of them. NULL = none.
     */
    const char *depth_prior;
    /*
     Things that are ignored in all photos, as by --ignore, one a line. NULL = none.
     */
    const char *ignore;
    /*
     Folder of a mask per photo, as of --photo-masks: x.png or x.jpg.png for x.jpg, black is not
     used. All photos must be files. NULL = masks beside the photos, if there are any.
     */
    const char *photo_masks;
} SvkTrainOptions;

/*
 Contents of a scene.
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
     Degree of the spherical harmonics, 0 to 3.
     */
    uint32_t sh_degree;
    /*
     Number of cameras; 0 for a file of Gaussians.
     */
    uint32_t cameras;
    /*
     Number of codes per level: subparts, parts, wholes. All 0 = no language.
     */
    uint32_t codes[3];
    /*
     Length of the features per level.
     */
    uint32_t feature_dim[3];
    /*
     Metres per scene unit; 0 = unknown.
     */
    double metres_per_unit;
} SvkSceneInfo;

/*
 Answer to a text in one view.
 */
typedef struct {
    /*
     sizeof(SvkAnswer)
     */
    size_t size;
    /*
     1 = this view shows the thing that the text means.
     */
    uint32_t found;
    /*
     Level of the answer: 0 = subparts, 1 = parts, 2 = wholes.
     */
    uint32_t level;
    /*
     Best relevancy in the view, 0 to 1. At 0.5 a pixel is as similar to the text as to an
     everyday phrase.
     */
    double score;
    /*
     Centre of the most relevant pixel along x; the first pixel's centre is 0.5.
     */
    double x;
    /*
     Centre of the most relevant pixel along y; the first pixel's centre is 0.5.
     */
    double y;
    /*
     Number of pixels of the mask; 0 where nothing was found.
     */
    uint64_t mask_pixels;
    /*
     SvkPresence of the thing in the whole scene.
     */
    uint32_t presence;
    /*
     Number of things in space that the text means, as of svk_scene_instances.
     */
    uint32_t instances;
    /*
     P-value of `presence`: share of texts, this one included, that fit the scene at least as
     well. 0 = unknown.
     */
    double p_value;
    /*
     Agreement of the photos on the answer, 0 to 1; below 0 = unknown.
     */
    double reliability;
} SvkAnswer;

/*
 A thing in space that a text means. Lengths are in scene units.
 */
typedef struct {
    /*
     sizeof(SvkInstance)
     */
    size_t size;
    /*
     Number of Gaussians.
     */
    uint64_t splats;
    /*
     Share of the weight of all Gaussians that the text selects, 0 to 1.
     */
    double share;
    /*
     Agreement of the photos on the thing, 0 to 1; below 0 = unknown.
     */
    double reliability;
    /*
     Centre of the oriented bounding box.
     */
    double centre[3];
    /*
     Lowest corner of the bounding box along the scene's axes.
     */
    double box_min[3];
    /*
     Highest corner of the bounding box along the scene's axes.
     */
    double box_max[3];
    /*
     Unit vectors along the edges of the oriented bounding box, largest variance first.
     */
    double axes[3][3];
    /*
     Lengths of the edges of the oriented bounding box along `axes`.
     */
    double box_size[3];
    /*
     1 = the view shows the thing, at (`x`, `y`).
     */
    uint64_t seen;
    /*
     Pixel of `centre` in the view along x; the first pixel's centre is 0.5.
     */
    double x;
    /*
     Pixel of `centre` in the view along y; the first pixel's centre is 0.5.
     */
    double y;
} SvkInstance;

/*
 Destination of a rendered channel: exactly one of `host`, `buffer` and `image` is set.
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
     For relevancy: text of the query, UTF-8.
     */
    const char *text;
    /*
     Memory of the host.
     */
    void *host;
    /*
     Size of `host`, or of `buffer` from `offset` on, bytes; at least the size of the encoding.
     */
    size_t bytes;
    /*
     VkBuffer with VK_BUFFER_USAGE_TRANSFER_DST_BIT, on the host's device.
     */
    uint64_t buffer;
    /*
     Offset in `buffer`, bytes; a multiple of 4.
     */
    uint64_t offset;
    /*
     VkImage with VK_IMAGE_USAGE_TRANSFER_DST_BIT, on the host's device: 2D, of the camera's
     size, one sample, in the format of the encoding. Mip level 0 is written.
     */
    uint64_t image;
    /*
     VkImageLayout of the image before the write; VK_IMAGE_LAYOUT_UNDEFINED discards its content.
     */
    uint32_t old_layout;
    /*
     VkImageLayout of the image after the write; not VK_IMAGE_LAYOUT_UNDEFINED.
     */
    uint32_t new_layout;
} SvkOutput;

/*
 Timeline semaphores of the host for writes to its buffers and images. From the wait to the
 signal these buffers and images must belong to the context's queue family or be shared
 concurrently.
 */
typedef struct {
    /*
     sizeof(SvkSync)
     */
    size_t size;
    /*
     VkSemaphore of type timeline: writes begin once it reaches `wait_value`; 0 = at once.
     */
    uint64_t wait_semaphore;
    /*
     Value of `wait_semaphore`.
     */
    uint64_t wait_value;
    /*
     VkSemaphore of type timeline: it reaches `signal_value` when all writes are finished; 0 =
     the call waits for them.
     */
    uint64_t signal_semaphore;
    /*
     Value of `signal_semaphore`.
     */
    uint64_t signal_value;
} SvkSync;

/*
 Options of svk_label. Zero is the default of every field but `size`: photos of a scene directory,
 or else 24 views that are rendered from the splats.
 */
typedef struct {
    /*
     sizeof(SvkLabelOptions)
     */
    size_t size;
    /*
     Folder of the photos of the training; needs `cameras`. NULL = none.
     */
    const char *images;
    /*
     Cameras in the coordinates of the splats: transforms.json, a COLMAP model folder or
     cameras.json; without `images` the splats are rendered from them. NULL = none.
     */
    const char *cameras;
    /*
     Folder of a mask per photo of `images`, as of --photo-masks; NULL = masks beside the photos,
     if there are any.
     */
    const char *photo_masks;
    /*
     Number of photos or cameras that are used; needs `cameras`. 0 = 16 photos, or 24 cameras.
     */
    uint32_t views;
    /*
     Number of views that are rendered from cameras in free space, at most 200; not with
     `cameras`. 0 = 24 where there are neither photos nor cameras.
     */
    uint32_t synthesize;
    /*
     Longer side of the working images, pixels. 0 = 800 on a CPU device, 1600 on a GPU.
     */
    uint64_t max_size;
    /*
     Source of masks, as of --masks. NULL = built-in.
     */
    const char *mask_source;
    /*
     Source of region features, as of --features. NULL = built-in.
     */
    const char *feature_source;
    /*
     Points along each side of a picture at which a mask network is asked, at most 128; 0 = 32.
     */
    uint32_t mask_points;
    /*
     1 = do not ask the mask network about four overlapping crops as well.
     */
    uint32_t no_mask_crops;
    /*
     Scene directory to write, whole or not at all; NULL = the scene stays in memory.
     */
    const char *out;
    /*
     1 = replace a scene directory at `out`.
     */
    uint64_t replace;
    /*
     Progress callback; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     First argument of `progress`.
     */
    void *user;
} SvkLabelOptions;

/*
 Options of svk_scene_export. Zero is the default of every field but `size`: upright and in
 metres, as far as the scene states them, without what no photo shows.
 */
typedef struct {
    /*
     sizeof(SvkExportOptions)
     */
    size_t size;
    /*
     Name of the format, as of --format; NULL = by the ending of the path.
     */
    const char *format;
    /*
     html: heading of the page; NULL = the name of the scene.
     */
    const char *title;
    /*
     html: file of named views; NULL = views.json of the scene.
     */
    const char *views;
    /*
     SvkUpAxis. An axis is SVK_STATUS_INPUT where the direction up is not known.
     */
    uint32_t up;
    /*
     1 = a scene whose metres are not known is SVK_STATUS_INPUT.
     */
    uint32_t metres;
    /*
     1 = keep the axes and the unit of the scene, except for those that `up` and `metres` name.
     */
    uint32_t raw;
    /*
     1 = keep what no photo shows: surfaces continued beyond the photos, colours behind the
     scene.
     */
    uint32_t guessed;
    /*
     ply: 1 = language features and codes as extra columns.
     */
    uint32_t with_features;
    /*
     ply: SvkShDegree of the file, padded with zeros; SVK_SH_DEGREE_AUTO = 3.
     */
    uint32_t ply_degree;
    /*
     spz: version of the file, 2 to 4; 0 = 3.
     */
    uint32_t spz_version;
    /*
     1 = replace an ordinary file, or files of the same names in a folder.
     */
    uint32_t replace;
    /*
     Progress callback; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     First argument of `progress`.
     */
    void *user;
} SvkExportOptions;

/*
 Options of svk_scene_mesh. Zero is the default of every field but `size`: upright, in metres and
 on the ground, as far as the scene states them. A length is "2mm", "0.5cm" or "0.01m" where the
 scale of the scene is known, or a number in its units.
 */
typedef struct {
    /*
     sizeof(SvkMeshOptions)
     */
    size_t size;
    /*
     Most triangles; 0 = 100,000.
     */
    uint64_t triangles;
    /*
     Instead of `triangles`: length by which 99.9 % of the surface may move. NULL = `triangles`.
     */
    const char *error;
    /*
     Side of a voxel; NULL = two pixels of the photos at their surfaces.
     */
    const char *voxel;
    /*
     Cameras to look from: transforms.json, a COLMAP model folder or cameras.json; a file of
     Gaussians needs them. NULL = those of the scene.
     */
    const char *cameras;
    /*
     Names of things to choose from, one a line; needs `by_object`. NULL = those of the text
     model.
     */
    const char *vocabulary;
    /*
     SvkCollider; not for .ply.
     */
    uint32_t collider;
    /*
     1 = a part with a name for every thing of the scene, which must have language.
     */
    uint32_t by_object;
    /*
     1 = also surfaces that no photo shows; otherwise they are holes.
     */
    uint32_t fill_guessed;
    /*
     1 = keep the axes, the unit and the origin of the scene.
     */
    uint32_t raw;
    /*
     1 = replace an ordinary file.
     */
    uint64_t replace;
    /*
     Progress callback; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     First argument of `progress`.
     */
    void *user;
} SvkMeshOptions;

/*
 Figures of a mesh. Lengths are in the unit of the file.
 */
typedef struct {
    /*
     sizeof(SvkMeshInfo)
     */
    size_t size;
    /*
     Number of triangles.
     */
    uint64_t triangles;
    /*
     Number of vertices.
     */
    uint64_t vertices;
    /*
     Number of parts.
     */
    uint64_t parts;
    /*
     Number of edges at holes and borders.
     */
    uint64_t border_edges;
    /*
     1 = y points up against gravity.
     */
    uint32_t upright;
    /*
     1 = the unit is a metre; 0 = that of the scene.
     */
    uint32_t metric;
    /*
     Area of the surface, square units.
     */
    double area;
    /*
     Side of a voxel.
     */
    double voxel;
    /*
     Length by which the simplification moved 99.9 % of the surface at most.
     */
    double moved;
} SvkMeshInfo;

/*
 Options of svk_scene_objects. Zero is the default of every field but `size`.
 */
typedef struct {
    /*
     sizeof(SvkObjectsOptions)
     */
    size_t size;
    /*
     Names to choose from, one a line; NULL = those of the text model.
     */
    const char *vocabulary;
    /*
     Smallest share of the opacity of the scene that is a thing, up to 1; 0 = 0.001.
     */
    double min_share;
    /*
     Format of the file of each thing, as of --format; NULL = "ply".
     */
    const char *format;
    /*
     SvkPieces: level of the files; objects.json lists all.
     */
    uint32_t pieces;
    /*
     1 = files keep the axes and the unit of the scene; otherwise they are upright and in metres,
     as far as the scene states them.
     */
    uint32_t raw;
    /*
     1 = replace ordinary files of the same names in the folder.
     */
    uint64_t replace;
    /*
     Progress callback; may be NULL.
     */
    SvkProgressFunction progress;
    /*
     First argument of `progress`.
     */
    void *user;
} SvkObjectsOptions;

/*
 An edit of a scene directory. Zero is the default of every field but `size`.
 */
typedef struct {
    /*
     sizeof(SvkEdit)
     */
    size_t size;
    /*
     SvkOperation
     */
    uint32_t operation;
    /*
     1 = also edit where the selection is doubtful.
     */
    uint32_t force;
    /*
     1 = only select: nothing is changed, whether it is doubtful or not.
     */
    uint32_t dry_run;
    /*
     SVK_OPERATION_FLOATERS: 1 = also splats on the surface of one photo that more photos look
     through.
     */
    uint32_t thorough;
    /*
     Selection as of `splatvk edit`: words, ids of things ("id:o3"), ranges ("opacity<0.1",
     "size>5cm", "reliability<0.3", "seen<1"), the thing at a pixel of a photo ("at:PHOTO:X,Y"),
     an outline there ("in:PHOTO:X,Y X,Y X,Y"), joined with " + ", " - " or " & ". NULL with
     SVK_OPERATION_FLOATERS.
     */
    const char *selection;
    /*
     Words select more (above 0) or less (below 0), -1 to 1.
     */
    double grow;
    /*
     SVK_OPERATION_RECOLOUR: sRGB colour, "#rrggbb" or "#rgb".
     */
    const char *colour;
    /*
     SVK_OPERATION_MOVE: displacement along the axes of the scene, scene units.
     */
    double displacement[3];
    /*
     SVK_OPERATION_MOVE: a text instead of `displacement`, "0,-5cm,0", "up 5cm" or "down 5cm".
     NULL = `displacement`.
     */
    const char *by;
} SvkEdit;

/*
 Outcome of an edit.
 */
typedef struct {
    /*
     sizeof(SvkEdited)
     */
    size_t size;
    /*
     Number of selected splats.
     */
    uint64_t splats;
    /*
     Their share of the opacity of the scene, 0 to 1.
     */
    double share;
    /*
     Number of reasons why the selection may be wrong; svk_editor_doubts returns them.
     */
    uint64_t doubts;
    /*
     Number of splats that a deletion took along: those behind the selected ones, which no photo
     shows.
     */
    uint64_t along;
} SvkEdited;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Returns the SVK_ABI_VERSION of the library. Thread-safe.
 */
uint32_t svk_abi_version(void);

/*
 Returns the version of the library, such as "0.1.0", in static memory. Thread-safe.
 */
const char *svk_version(void);

/*
 Creates a context on a new Vulkan device. `options` may be NULL. On failure `*context` is NULL,
 and svk_context_error(NULL, ...) returns the error text in the same thread. Thread-safe.
 */
SvkStatus svk_context_create(const SvkContextOptions *options, SvkContext **context);

/*
 Creates a context on a Vulkan device of the host. `options` may be NULL. Errors as of
 svk_context_create. Thread-safe.
 */
SvkStatus svk_context_adopt(const SvkVulkanDevice *device, const SvkContextOptions *options, SvkContext **context);

/*
 Destroys a context; its scenes stay usable. NULL is allowed. No other call with this context may
 be running.
 */
void svk_context_destroy(SvkContext *context);

/*
 Copies the name of the Vulkan device into `text`, which has `bytes` bytes; it is truncated where
 it does not fit and always ends with a zero byte. Returns the number of bytes that the whole
 name needs. Thread-safe.
 */
size_t svk_context_device_name(const SvkContext *context, char *text, size_t bytes);

/*
 Copies the error text of the last failed call with this context, in any thread, into `text` as
 svk_context_device_name does; returns the number of bytes that the whole text needs. With
 `context` NULL: of the last failed creation of a context in this thread. Thread-safe.
 */
size_t svk_context_error(const SvkContext *context, char *text, size_t bytes);

/*
 Trains a scene from two or more photos. `options` may be NULL. On failure, and when the callback
 stops it, `*scene` is NULL and the context keeps the error text. Thread-safe; several trainings
 may run on one context and share its device.
 */
SvkStatus svk_train(SvkContext *context,
                    const SvkPhoto *photos,
                    size_t photo_count,
                    const SvkTrainOptions *options,
                    SvkScene **scene);

/*
 Loads a scene directory, or a file of Gaussians, with the language file beside it if there is
 one. On failure `*scene` is NULL and the context keeps the error text. Thread-safe.
 */
SvkStatus svk_scene_load(SvkContext *context, const char *path, SvkScene **scene);

/*
 Destroys a scene, after its unfinished writes to buffers and images of the host. NULL is
 allowed. No other call with this scene may be running.
 */
void svk_scene_destroy(SvkScene *scene);

/*
 Copies the error text of the last failed call with this scene, in any thread, into `text` as
 svk_context_device_name does; returns the number of bytes that the whole text needs.
 Thread-safe.
 */
size_t svk_scene_error(const SvkScene *scene, char *text, size_t bytes);

/*
 Fills `info` with the contents of the scene. Thread-safe.
 */
SvkStatus svk_scene_info(const SvkScene *scene, SvkSceneInfo *info);

/*
 Fills `camera` with camera `index` of the scene, and copies the name of its photo into `name`,
 which has `name_bytes` bytes and may be NULL. Thread-safe.
 */
SvkStatus svk_scene_camera(const SvkScene *scene, uint32_t index, SvkCamera *camera, char *name, size_t name_bytes);

/*
 Copies an array of the scene into `values`. `array` is an SvkArray; `count` must be exactly the
 number of its floats. Thread-safe.
 */
SvkStatus svk_scene_read(const SvkScene *scene, uint32_t array, float *values, size_t count);

/*
 Looks for a text in the view of a camera and fills `answer`. `mask` may be NULL; otherwise it
 receives width × height bytes, 255 where the view shows the thing and 0 elsewhere, and
 `mask_bytes` must be exactly that number. "Not found" is an answer, not a failure. Thread-safe;
 calls with one scene are serialised.
 */
SvkStatus svk_scene_query(SvkScene *scene,
                          const char *text,
                          const SvkCamera *camera,
                          SvkAnswer *answer,
                          uint8_t *mask,
                          size_t mask_bytes);

/*
 Fills `instances` with the things in space that a text means, largest first, and with their
 pixels in the view of a camera. It has room for `capacity` structures, each with its size set;
 NULL and 0 only count. `*count` receives the number of things, which may be larger. Thread-safe;
 calls with one scene are serialised.
 */
SvkStatus svk_scene_instances(SvkScene *scene,
                              const char *text,
                              const SvkCamera *camera,
                              SvkInstance *instances,
                              size_t capacity,
                              size_t *count);

/*
 Copies notes on the parts of a text that are not understood into `notes`, which has `bytes`
 bytes; one line each, truncated where they do not fit and always ended with a zero byte.
 Example: "answers for “mug”; “without handle” is not understood". Empty if the whole text is
 understood. Thread-safe.
 */
SvkStatus svk_scene_notes(SvkScene *scene, const char *text, char *notes, size_t bytes);

/*
 Writes the scene to `path`.

 A path that ends in .ply, .compressed.ply, .splat, .spz, .sog, .glb or .gltf becomes a file of
 Gaussians in the axes and the unit of the scene (.spz and glTF with y and z reversed, since they
 have y up), with the language beside it in NAME.language.npz. A path without an ending, with a
 final slash, or of a folder becomes a scene directory. Any other ending is SVK_STATUS_INPUT.

 The output appears complete or not at all. With `replace` = 1 it may replace a scene or a file,
 but never a symbolic link, the file or directory that the scene was loaded from, a scene
 directory with files of other programs, or the output of a running process or thread.
 Thread-safe.
 */
SvkStatus svk_scene_save(SvkScene *scene, const char *path, uint32_t replace);

/*
 Renders the scene from a camera into all `outputs`. Without a signal semaphore, or with `sync`
 NULL, the call returns when all outputs are written. With one it may return before buffers and
 images are written; memory of the host is always written before it returns. Calls with one scene
 are serialised, and so are their writes. Thread-safe.
 */
SvkStatus svk_scene_render(SvkScene *scene,
                           const SvkCamera *camera,
                           const SvkOutput *outputs,
                           size_t output_count,
                           const SvkSync *sync);

/*
 Waits until all buffers and images of earlier calls of svk_scene_render are written.
 Thread-safe.
 */
SvkStatus svk_scene_wait(SvkScene *scene);

/*
 Gives the splats of a file of Gaussians of any trainer, or of a scene directory, language; no
 number of a splat changes. `options` may be NULL. On failure, and when the callback stops it,
 `*scene` is NULL, nothing is written, and the context keeps the error text. Thread-safe.
 */
SvkStatus svk_label(SvkContext *context, const char *path, const SvkLabelOptions *options, SvkScene **scene);

/*
 Writes the scene as `splatvk export`: the format follows the ending of `path`; axes and unit
 follow the direction up and the scale of the scene. `options` may be NULL. One line on what was
 done is copied into `summary`, which has `summary_bytes` bytes and may be NULL. The output
 appears complete or not at all. Formats of cameras and pages need a scene that is stored.

 The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
 */
SvkStatus svk_scene_export(SvkScene *scene,
                           const char *path,
                           const SvkExportOptions *options,
                           char *summary,
                           size_t summary_bytes);

/*
 Writes the surfaces of the scene as triangles, as `splatvk mesh`, into a .glb, .ply or .obj.
 `options` may be NULL. `info` receives the figures and may be NULL. The file appears complete or
 not at all. Parts by object need a scene that is stored.

 The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
 */
SvkStatus svk_scene_mesh(SvkScene *scene, const char *path, const SvkMeshOptions *options, SvkMeshInfo *info);

/*
 Writes the things of a stored scene with language into a folder, as `splatvk objects --out`:
 objects.json, objects.csv, a file of Gaussians and a picture per thing, scene.glb with a named
 node per thing, and scene.ply with the property `object`. `options` may be NULL. `*count`, which
 may be NULL, receives the number of things, parts and subparts in objects.json. The files appear
 complete or not at all.

 The call works on a copy of the scene: other calls go on meanwhile. Thread-safe.
 */
SvkStatus svk_scene_objects(SvkScene *scene, const char *folder, const SvkObjectsOptions *options, size_t *count);

/*
 Opens a scene directory for edits; on failure `*editor` is NULL and the context keeps the error
 text. Edits are kept in edits.json of the scene; its other files stay as they are, and scenes
 that are loaded later contain the edits. Thread-safe.
 */
SvkStatus svk_editor_open(SvkContext *context, const char *path, SvkEditor **editor);

/*
 Destroys an editor; the edits stay in the scene. NULL is allowed. No other call with this editor
 may be running.
 */
void svk_editor_destroy(SvkEditor *editor);

/*
 Copies the error text of the last failed call with this editor, in any thread, into `text` as
 svk_context_device_name does; returns the number of bytes that the whole text needs.
 Thread-safe.
 */
size_t svk_editor_error(const SvkEditor *editor, char *text, size_t bytes);

/*
 Selects splats of the edited scene, makes one edit of them and writes edits.json, whole or not
 at all; fills `edited`, which may be NULL.

 A selection that may be wrong, and that `force` does not allow, is SVK_STATUS_DOUBTFUL: nothing
 is changed, `edited` is filled, and svk_editor_doubts returns the reasons. A word that the scene
 does not contain, a selection of nothing and an edit that leaves no splat are SVK_STATUS_INPUT.
 Thread-safe; calls with one editor are serialised. A list that another program changed
 meanwhile is refused; a new editor has it.
 */
SvkStatus svk_editor_edit(SvkEditor *editor, const SvkEdit *edit, SvkEdited *edited);

/*
 Copies the reasons why the selection of the last svk_editor_edit may be wrong into `text`, which
 has `bytes` bytes: one line each, truncated where they do not fit and always ended with a zero
 byte; empty where it is sure. Returns the number of bytes that the whole text needs.
 Thread-safe.
 */
size_t svk_editor_doubts(const SvkEditor *editor, char *text, size_t bytes);

/*
 Undoes the last `most` edits. `*undone`, which may be NULL, receives how many there were: 0 is no
 failure. Thread-safe; calls with one editor are serialised.
 */
SvkStatus svk_editor_undo(SvkEditor *editor, size_t most, size_t *undone);

/*
 Applies the `most` edits that were undone last; a new edit ends what can be redone. `*redone`,
 which may be NULL, receives how many there were: 0 is no failure. Thread-safe; calls with one
 editor are serialised.
 */
SvkStatus svk_editor_redo(SvkEditor *editor, size_t most, size_t *redone);

/*
 Fills `edits` with the number of edits of the scene, and `undone` with the number of those that
 can be redone; both may be NULL. Thread-safe.
 */
SvkStatus svk_editor_count(const SvkEditor *editor, size_t *edits, size_t *undone);

/*
 Makes a scene of the present state; later edits do not change it. On failure `*scene` is NULL
 and the editor keeps the error text. Thread-safe.
 */
SvkStatus svk_editor_scene(SvkEditor *editor, SvkScene **scene);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus
