//! HEIC, HEIF and AVIF through libheif's C interface, loaded at run time: its HEVC decoders are
//! under the LGPL and patents, so splatvk runs without it and never links it. The signatures are
//! those of libheif 1.12 (2021), unchanged since.
use super::kind::{LARGEST_DECODED, TOO_LARGE, check_pixels};
use super::metadata::Metadata;
use super::support::Support;
use image::{DynamicImage, ImageBuffer};
use libloading::Library;
use std::ffi::{CStr, c_char, c_int, c_void};
use std::ptr;
use std::sync::OnceLock;

#[cfg(target_os = "macos")]
const LIBRARIES: &[&str] =
    &["libheif.1.dylib", "/opt/homebrew/lib/libheif.1.dylib", "/usr/local/lib/libheif.1.dylib"];
#[cfg(windows)]
const LIBRARIES: &[&str] = &["heif.dll", "libheif.dll"];
#[cfg(not(any(target_os = "macos", windows)))]
const LIBRARIES: &[&str] = &["libheif.so.1"];

/// Environment variable with the path of another library than the system's.
const VARIABLE: &str = "SPLATVK_LIBHEIF";

/// Advice where the library is missing.
const INSTALL: &str = "install it (tools/setup; apt-get install libheif1; brew install libheif)";

/// Advice where a decoder is missing; newer systems have separate packages for them.
const INSTALL_DECODER: &str = "install it (tools/setup; apt-get install libheif-plugin-libde265 for HEVC, \
    libheif-plugin-dav1d for AV1)";

/// `struct heif_error`.
#[repr(C)]
struct Status {
    code: c_int,
    subcode: c_int,
    message: *const c_char,
}

/// Beginning of `struct heif_color_profile_nclx`, the same in all versions.
#[repr(C)]
struct Nclx {
    version: u8,
    primaries: c_int,
    transfer: c_int,
    matrix: c_int,
    full_range: u8,
}

// Values of the header's enums.
const CODE_UNSUPPORTED_FILE: c_int = 3;
const CODE_UNSUPPORTED_FEATURE: c_int = 4;
const CODE_PLUGIN_LOADING: c_int = 11;
const FORMAT_HEVC: c_int = 1;
const FORMAT_AV1: c_int = 4;
const COLORSPACE_RGB: c_int = 1;
const CHROMA_RGB: c_int = 10;
const CHROMA_RGBA: c_int = 11;
const CHROMA_RGB_16: c_int = 14;
const CHROMA_RGBA_16: c_int = 15;
const CHANNEL_INTERLEAVED: c_int = 10;

/// Opaque `heif_context`, `heif_image_handle` and `heif_image`.
type Pointer = *mut c_void;

/// Defines the struct, its fields and their look-up from a table of the used functions.
macro_rules! functions {
    ($($name:ident: fn($($argument:ty),*) $(-> $result:ty)?;)*) => {
        #[allow(non_snake_case)] // the library's spelling
        struct Api {
            $($name: unsafe extern "C" fn($($argument),*) $(-> $result)?,)*
            /// Keeps the code of the functions in memory.
            _library: Library,
        }

        impl Api {
            /// # Safety
            /// The library must be libheif, whose symbols have the signatures above.
            unsafe fn of(library: Library) -> Result<Api, libloading::Error> {
                Ok(Api {
                    // SAFETY: guaranteed by the caller.
                    $($name: unsafe { *library.get(stringify!($name))? },)*
                    _library: library,
                })
            }
        }
    };
}

functions! {
    heif_get_version: fn() -> *const c_char;
    heif_have_decoder_for_format: fn(c_int) -> c_int;
    heif_context_alloc: fn() -> Pointer;
    heif_context_free: fn(Pointer);
    heif_context_read_from_memory_without_copy: fn(Pointer, *const c_void, usize, *const c_void) -> Status;
    heif_context_get_primary_image_handle: fn(Pointer, *mut Pointer) -> Status;
    heif_image_handle_release: fn(Pointer);
    heif_image_handle_get_width: fn(Pointer) -> c_int;
    heif_image_handle_get_height: fn(Pointer) -> c_int;
    heif_image_handle_has_alpha_channel: fn(Pointer) -> c_int;
    heif_image_handle_is_premultiplied_alpha: fn(Pointer) -> c_int;
    heif_image_handle_get_luma_bits_per_pixel: fn(Pointer) -> c_int;
    heif_image_handle_get_list_of_metadata_block_IDs: fn(Pointer, *const c_char, *mut u32, c_int) -> c_int;
    heif_image_handle_get_metadata_size: fn(Pointer, u32) -> usize;
    heif_image_handle_get_metadata_content_type: fn(Pointer, u32) -> *const c_char;
    heif_image_handle_get_nclx_color_profile: fn(Pointer, *mut *mut Nclx) -> Status;
    heif_nclx_color_profile_free: fn(*mut Nclx);
    heif_image_handle_get_metadata: fn(Pointer, u32, *mut c_void) -> Status;
    heif_image_handle_get_raw_color_profile_size: fn(Pointer) -> usize;
    heif_image_handle_get_raw_color_profile: fn(Pointer, *mut c_void) -> Status;
    heif_decode_image: fn(Pointer, *mut Pointer, c_int, c_int, *const c_void) -> Status;
    heif_image_release: fn(Pointer);
    heif_image_get_width: fn(Pointer, c_int) -> c_int;
    heif_image_get_height: fn(Pointer, c_int) -> c_int;
    heif_image_get_bits_per_pixel_range: fn(Pointer, c_int) -> c_int;
    heif_image_get_plane_readonly: fn(Pointer, c_int, *mut c_int) -> *const u8;
}

fn api() -> Result<&'static Api, &'static str> {
    static LOADED: OnceLock<Result<Api, String>> = OnceLock::new();
    LOADED.get_or_init(load).as_ref().map_err(String::as_str)
}

fn load() -> Result<Api, String> {
    let one_line = |e: libloading::Error| e.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
    let given = std::env::var(VARIABLE).ok().filter(|v| !v.is_empty());
    let names = given.as_deref().map_or(LIBRARIES.to_vec(), |name| vec![name]);
    // SAFETY: libheif's initialisers only fill tables of its own.
    let library = names.into_iter().find_map(|name| unsafe { Library::new(name) }.ok());
    let Some(library) = library else {
        return Err(match given {
            Some(name) => format!("libheif: {VARIABLE}={name} cannot be loaded; correct or unset it"),
            None => format!("libheif is not there; {INSTALL}"),
        });
    };
    // SAFETY: by its name this is libheif.
    let api = unsafe { Api::of(library) }.map_err(|e| {
        format!("libheif is too old or another library ({}); 1.12 or newer is needed", one_line(e))
    })?;
    Ok(api)
}

/// Support for HEIC and AVIF: "libheif 1.15.1 · HEVC, AV1", or the missing part with advice.
pub(super) fn status() -> Support {
    let api = match api() {
        Ok(api) => api,
        Err(what) => return Support::none("HEIC and AVIF photos cannot be read", what.to_owned()),
    };
    // SAFETY: a constant string of the library; the query takes any number.
    let (version, decoders) = unsafe {
        let version = CStr::from_ptr((api.heif_get_version)()).to_string_lossy();
        let have = |(_, format): &(&str, c_int)| (api.heif_have_decoder_for_format)(*format) != 0;
        (version, [("HEVC", FORMAT_HEVC), ("AV1", FORMAT_AV1)].into_iter().partition::<Vec<_>, _>(have))
    };
    let names = |list: &[(&str, c_int)]| list.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
    let (there, missing) = (names(&decoders.0), names(&decoders.1));
    let found = if there.is_empty() { "no decoders".to_owned() } else { there };
    let advice =
        (!missing.is_empty()).then(|| format!("libheif has no decoder for {missing}; {INSTALL_DECODER}"));
    Support { found: format!("libheif {version} · {found}"), advice }
}

/// Upright primary image of a file: libheif applies the rotation and mirroring of the container,
/// which take precedence over the orientation in EXIF (ISO/IEC 23008-12).
pub(super) struct Image {
    pub pixels: DynamicImage,
    pub metadata: Metadata,
}

/// Failure to read an image: a missing part to install, or a fault of the file. One line without
/// the file's name.
pub(super) enum Failure {
    Missing(String),
    Input(String),
}

/// Decodes the primary image. 8-bit files yield 8-bit, others 16-bit samples; premultiplied colours
/// lose their alpha, which equals compositing on black.
pub(super) fn decode(bytes: &[u8]) -> Result<Image, Failure> {
    let api = api().map_err(|what| Failure::Missing(format!("is a HEIC/AVIF photo and {what}")))?;
    // SAFETY: `bytes` outlives the context, and every pointer is freed once, after the values that
    // were made from it.
    unsafe {
        let (_context, handle) = primary(api, bytes)?;
        let shape = HeifLayout::of(api, handle.pointer)?;
        let mut image = ptr::null_mut();
        let decode = api.heif_decode_image;
        check(api, decode(handle.pointer, &mut image, COLORSPACE_RGB, shape.chroma(), ptr::null()))?;
        let image = Owned { pointer: image, free: api.heif_image_release };
        let metadata = Metadata {
            exif: exif(api, handle.pointer),
            icc: icc(api, handle.pointer),
            xmp: xmp(api, handle.pointer),
            code_points: code_points(api, handle.pointer),
            ..Metadata::default()
        };
        Ok(Image { pixels: shape.copy(api, image.pointer)?, metadata: metadata.bounded() })
    }
}

/// Number of pixels of the primary image, without decoding it; 0 where it cannot be read.
pub(super) fn pixels(bytes: &[u8]) -> u64 {
    let Ok(api) = api() else { return 0 };
    let side = |n: c_int| u64::try_from(n).unwrap_or(0);
    // SAFETY: as in `decode`.
    unsafe {
        primary(api, bytes).map_or(0, |(_context, handle)| {
            side((api.heif_image_handle_get_width)(handle.pointer))
                * side((api.heif_image_handle_get_height)(handle.pointer))
        })
    }
}

/// The context of a file and the handle of its primary image, which lives as long as the context;
/// drop the handle first.
///
/// # Safety
/// `bytes` must outlive the context.
unsafe fn primary(api: &Api, bytes: &[u8]) -> Result<(Owned, Owned), Failure> {
    let owned = |pointer, free| Owned { pointer, free };
    // SAFETY: pointers from the library, each freed once.
    unsafe {
        let context = owned((api.heif_context_alloc)(), api.heif_context_free);
        if context.pointer.is_null() {
            return Err(Failure::Input("no memory is left to decode the image".to_owned()));
        }
        let read = api.heif_context_read_from_memory_without_copy;
        check(api, read(context.pointer, bytes.as_ptr().cast(), bytes.len(), ptr::null()))?;
        let mut handle = ptr::null_mut();
        check(api, (api.heif_context_get_primary_image_handle)(context.pointer, &mut handle))?;
        Ok((context, owned(handle, api.heif_image_handle_release)))
    }
}

/// A pointer from the library with its destructor.
struct Owned {
    pointer: Pointer,
    free: unsafe extern "C" fn(Pointer),
}

impl Drop for Owned {
    fn drop(&mut self) {
        // SAFETY: created by the library, not freed before.
        unsafe { (self.free)(self.pointer) }
    }
}

fn check(api: &Api, status: Status) -> Result<(), Failure> {
    if status.code == 0 {
        return Ok(());
    }
    // SAFETY: the header guarantees a string with every error.
    let text = unsafe { CStr::from_ptr(status.message) }.to_string_lossy();
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    Err(match status.code {
        CODE_UNSUPPORTED_FILE | CODE_UNSUPPORTED_FEATURE | CODE_PLUGIN_LOADING => {
            // SAFETY: the query takes any number.
            let have = |format| unsafe { (api.heif_have_decoder_for_format)(format) } != 0;
            if have(FORMAT_HEVC) && have(FORMAT_AV1) {
                Failure::Input(format!(
                    "libheif does not read this kind of HEIC/AVIF ({text}); save it as JPEG"
                ))
            } else {
                Failure::Missing(format!(
                    "is a HEIC/AVIF photo and libheif lacks a decoder ({text}); {INSTALL_DECODER}"
                ))
            }
        }
        _ => Failure::Input(format!("the image is damaged ({text}); copy the photo again or save it anew")),
    })
}

/// Layout of the samples to request from libheif.
struct HeifLayout {
    deep: bool,
    alpha: bool,
}

impl HeifLayout {
    unsafe fn of(api: &Api, handle: Pointer) -> Result<HeifLayout, Failure> {
        // SAFETY: the caller's valid handle.
        let (w, h, bits, alpha) = unsafe {
            (
                (api.heif_image_handle_get_width)(handle),
                (api.heif_image_handle_get_height)(handle),
                (api.heif_image_handle_get_luma_bits_per_pixel)(handle),
                (api.heif_image_handle_has_alpha_channel)(handle) != 0
                    && (api.heif_image_handle_is_premultiplied_alpha)(handle) == 0,
            )
        };
        let shape = HeifLayout { deep: bits > 8, alpha };
        check_pixels(w.max(0) as u64, h.max(0) as u64).map_err(Failure::Input)?;
        let bytes = w.max(0) as u64 * h.max(0) as u64 * (3 + u64::from(alpha)) * (1 + u64::from(shape.deep));
        match bytes {
            0 => Err(Failure::Input("the image is damaged (no pixels); copy the photo again".to_owned())),
            b if b > LARGEST_DECODED => Err(Failure::Input(TOO_LARGE.to_owned())),
            _ => Ok(shape),
        }
    }

    fn chroma(&self) -> c_int {
        match (self.deep, self.alpha) {
            (false, false) => CHROMA_RGB,
            (false, true) => CHROMA_RGBA,
            (true, false) => CHROMA_RGB_16,
            (true, true) => CHROMA_RGBA_16,
        }
    }

    unsafe fn copy(&self, api: &Api, image: Pointer) -> Result<DynamicImage, Failure> {
        let mut stride: c_int = 0;
        // SAFETY: the caller's valid image.
        let (plane, w, h, bits) = unsafe {
            (
                (api.heif_image_get_plane_readonly)(image, CHANNEL_INTERLEAVED, &mut stride),
                (api.heif_image_get_width)(image, CHANNEL_INTERLEAVED),
                (api.heif_image_get_height)(image, CHANNEL_INTERLEAVED),
                (api.heif_image_get_bits_per_pixel_range)(image, CHANNEL_INTERLEAVED),
            )
        };
        let samples = w.max(0) as usize * if self.alpha { 4 } else { 3 };
        let row_bytes = samples * if self.deep { 2 } else { 1 };
        let (stride, rows) = (stride.max(0) as usize, h.max(0) as usize);
        if plane.is_null() || stride < row_bytes || samples * rows == 0 || !(8..=16).contains(&bits) {
            return Err(Failure::Input("libheif gave no pixels for this file; save it as JPEG".to_owned()));
        }
        // SAFETY: the library's rows of `stride` bytes, of which the first `row_bytes` hold
        // samples.
        let row = |y| unsafe { std::slice::from_raw_parts(plane.add(y * stride), row_bytes) };
        let (w, h) = (w as u32, h as u32);
        let made = if self.deep {
            // 10 or 12 bits in the low end of 16, little-endian.
            let top = (1u32 << bits) - 1;
            let widen = |v: &[u8; 2]| (u32::from(u16::from_le_bytes(*v)).min(top) * 65535 / top) as u16;
            let data: Vec<u16> =
                (0..rows).flat_map(|y| row(y).as_chunks::<2>().0.iter().map(widen)).collect();
            if self.alpha {
                ImageBuffer::from_raw(w, h, data).map(DynamicImage::ImageRgba16)
            } else {
                ImageBuffer::from_raw(w, h, data).map(DynamicImage::ImageRgb16)
            }
        } else {
            let mut data = Vec::with_capacity(row_bytes * rows);
            (0..rows).for_each(|y| data.extend_from_slice(row(y)));
            if self.alpha {
                ImageBuffer::from_raw(w, h, data).map(DynamicImage::ImageRgba8)
            } else {
                ImageBuffer::from_raw(w, h, data).map(DynamicImage::ImageRgb8)
            }
        };
        made.ok_or_else(|| Failure::Input("libheif gave too few pixels; save the photo as JPEG".to_owned()))
    }
}

/// Largest block of metadata, bytes. In JPEG it has 64 KiB at most; a larger one than this is
/// damage.
const LARGEST_BLOCK: usize = 16 << 20;

unsafe fn icc(api: &Api, handle: Pointer) -> Option<Vec<u8>> {
    // SAFETY: the caller's valid handle; the profile's own size is allocated.
    unsafe {
        let size = (api.heif_image_handle_get_raw_color_profile_size)(handle);
        if !(1..=LARGEST_BLOCK).contains(&size) {
            return None;
        }
        let mut profile = vec![0u8; size];
        let got = (api.heif_image_handle_get_raw_color_profile)(handle, profile.as_mut_ptr().cast());
        (got.code == 0).then_some(profile)
    }
}

/// Code points of ITU-T H.273 in the container or the stream.
unsafe fn code_points(api: &Api, handle: Pointer) -> Option<[u16; 4]> {
    let mut found = ptr::null_mut();
    // SAFETY: the caller's valid handle; the structure is read before it is freed.
    unsafe {
        let got = (api.heif_image_handle_get_nclx_color_profile)(handle, &mut found);
        if got.code != 0 || found.is_null() {
            return None;
        }
        let Nclx { primaries, transfer, matrix, full_range, .. } = *found;
        (api.heif_nclx_color_profile_free)(found);
        let number = |v: c_int| u16::try_from(v).unwrap_or(u16::MAX);
        Some([number(primaries), number(transfer), number(matrix), u16::from(full_range)])
    }
}

/// The XMP packet: a block with the MIME type of RDF.
unsafe fn xmp(api: &Api, handle: Pointer) -> Option<Vec<u8>> {
    let mut ids = [0u32; 8];
    // SAFETY: the caller's valid handle; at most as many ids as the array has elements; the type is
    // a string of the library or null.
    unsafe {
        let list = api.heif_image_handle_get_list_of_metadata_block_IDs;
        let count = list(handle, c"mime".as_ptr(), ids.as_mut_ptr(), ids.len() as c_int);
        let is_rdf = |id: &u32| {
            let name = (api.heif_image_handle_get_metadata_content_type)(handle, *id);
            !name.is_null() && CStr::from_ptr(name) == c"application/rdf+xml"
        };
        let id = *ids.iter().take(count.max(0) as usize).find(|id| is_rdf(id))?;
        block(api, handle, id)
    }
}

/// Content of a block of metadata.
unsafe fn block(api: &Api, handle: Pointer, id: u32) -> Option<Vec<u8>> {
    // SAFETY: the caller's valid handle and id; the block's own size is allocated.
    unsafe {
        let size = (api.heif_image_handle_get_metadata_size)(handle, id);
        if size > LARGEST_BLOCK {
            return None;
        }
        let mut block = vec![0u8; size];
        let got = (api.heif_image_handle_get_metadata)(handle, id, block.as_mut_ptr().cast());
        (got.code == 0).then_some(block)
    }
}

/// The first EXIF block, from its TIFF header on. Its first four bytes are the offset of that
/// header from their end.
unsafe fn exif(api: &Api, handle: Pointer) -> Option<Vec<u8>> {
    let mut id = 0u32;
    // SAFETY: the caller's valid handle; one id is requested.
    let block = unsafe {
        let list = api.heif_image_handle_get_list_of_metadata_block_IDs;
        if list(handle, c"Exif".as_ptr(), &mut id, 1) < 1 {
            return None;
        }
        block(api, handle, id)?
    };
    let (skip, rest) = block.split_first_chunk::<4>()?;
    rest.get(u32::from_be_bytes(*skip) as usize..).map(<[u8]>::to_vec)
}
