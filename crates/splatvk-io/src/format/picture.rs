//! Images and maps on disk: PNG, OpenEXR, npy.
use super::npy::{self, NpyArray};
use super::to_byte;
use crate::photo::Photo;
use crate::scene::{Coverage, Image, LEVEL_NAMES, Outside, RgbImage};
use crate::{Error, Result};
use exr::prelude as ex;
use std::collections::BTreeMap;
use std::path::Path;

fn picture_error(path: &Path) -> impl FnOnce(image::ImageError) -> Error {
    move |e| match e {
        image::ImageError::IoError(source) => Error::unwritable(path)(source),
        other => Error::work(format!("{}: {other}", path.display())),
    }
}

fn write_bytes(
    path: &Path,
    size: (usize, usize),
    bytes: &[u8],
    colour: image::ExtendedColorType,
) -> Result<()> {
    use image::ImageEncoder;
    // Through memory: of an I/O error the encoder keeps only the text.
    let mut out = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut out);
    encoder.write_image(bytes, size.0 as u32, size.1 as u32, colour).map_err(picture_error(path))?;
    std::fs::write(path, out).map_err(Error::unwritable(path))
}

/// Writes an 8-bit RGB PNG.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    let bytes: Vec<u8> = image.data.iter().flat_map(|c| c.map(to_byte)).collect();
    write_bytes(path, (image.width, image.height), &bytes, image::ExtendedColorType::Rgb8)
}

/// Writes the working image of a photo to `images` of a folder: with alpha where its background is
/// empty, and with a grey mask in `masks`, as in nerfstudio, where pixels are not used.
pub(super) fn write_photo(folder: &Path, name: &str, photo: &Photo) -> Result<()> {
    let path = folder.join("images").join(name);
    match &photo.coverage {
        Some(Coverage { share, outside: Outside::Empty }) => {
            let pixels = photo.image.data.iter().zip(&share.data);
            let bytes: Vec<u8> = pixels.flat_map(|([r, g, b], a)| [*r, *g, *b, *a].map(to_byte)).collect();
            write_bytes(&path, (share.width, share.height), &bytes, image::ExtendedColorType::Rgba8)
        }
        Some(Coverage { share, outside: Outside::Unknown }) => {
            let masks = folder.join("masks");
            std::fs::create_dir_all(&masks).map_err(Error::unwritable(&masks))?;
            write_grey_png(&masks.join(name), share)?;
            write_png(&path, &photo.image)
        }
        None => write_png(&path, &photo.image),
    }
}

/// Writes an 8-bit grey PNG of values in [0, 1].
pub fn write_grey_png(path: &Path, plane: &Image<f32>) -> Result<()> {
    let bytes: Vec<u8> = plane.data.iter().map(|v| to_byte(*v)).collect();
    write_bytes(path, (plane.width, plane.height), &bytes, image::ExtendedColorType::L8)
}

/// Writes an 8-bit grey PNG of given bytes.
pub fn write_grey_bytes(path: &Path, size: (usize, usize), bytes: &[u8]) -> Result<()> {
    write_bytes(path, size, bytes, image::ExtendedColorType::L8)
}

/// Writes an 8-bit grey PNG, 0 or 255.
pub fn write_mask_png(path: &Path, plane: &Image<bool>) -> Result<()> {
    let bytes: Vec<u8> = plane.data.iter().map(|v| if *v { 255 } else { 0 }).collect();
    write_bytes(path, (plane.width, plane.height), &bytes, image::ExtendedColorType::L8)
}

/// Encoding options of a JPEG.
#[derive(Clone, Debug)]
pub struct Jpeg {
    /// Quality, 1 to 100.
    pub quality: u8,
    /// A raw EXIF block.
    pub exif: Option<Vec<u8>>,
}

impl From<u8> for Jpeg {
    fn from(quality: u8) -> Jpeg {
        Jpeg { quality, exif: None }
    }
}

/// Bytes of a JPEG file; `jpeg` may be just its quality.
pub fn jpeg_bytes(image: &RgbImage, jpeg: impl Into<Jpeg>) -> Result<Vec<u8>> {
    use image::ImageEncoder;
    let Jpeg { quality, exif } = jpeg.into();
    let bytes: Vec<u8> = image.data.iter().flat_map(|c| c.map(to_byte)).collect();
    let failed = |e: &dyn std::fmt::Display| Error::work(format!("cannot encode a JPEG: {e}"));
    let mut out = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, quality);
    if let Some(exif) = exif {
        encoder.set_exif_metadata(exif).map_err(|e| failed(&e))?;
    }
    encoder
        .encode(&bytes, image.width as u32, image.height as u32, image::ExtendedColorType::Rgb8)
        .map_err(|e| failed(&e))?;
    Ok(out)
}

/// Channels of one rendered view for one EXR file; all of one size.
#[derive(Clone, Copy, Debug, Default)]
pub struct Planes<'a> {
    /// R, G, B.
    pub rgb: Option<&'a RgbImage>,
    /// A.
    pub alpha: Option<&'a Image<f32>>,
    /// Z, scene units.
    pub depth: Option<&'a Image<f32>>,
    /// unseen: share of every pixel that no photo shows.
    pub unseen: Option<&'a Image<f32>>,
    /// feat.00 …: (d, [H, W, d] values).
    pub features: Option<(usize, &'a [f32])>,
    /// code.s, code.m, code.l: one map per level, −1 = none.
    pub codes: &'a [Image<i32>],
}

/// Writes a scan-line, ZIP-compressed, 32-bit float OpenEXR file.
pub fn write_exr(path: &Path, size: (usize, usize), planes: Planes) -> Result<()> {
    use exr::prelude::WritableImage;
    let mut channels: Vec<(String, Vec<f32>)> = Vec::new();
    if let Some(rgb) = planes.rgb {
        for (k, name) in ["R", "G", "B"].into_iter().enumerate() {
            channels.push((name.into(), rgb.data.iter().map(|c| c[k]).collect()));
        }
    }
    channels.extend(planes.alpha.map(|p| ("A".to_string(), p.data.clone())));
    channels.extend(planes.depth.map(|p| ("Z".to_string(), p.data.clone())));
    channels.extend(planes.unseen.map(|p| ("unseen".to_string(), p.data.clone())));
    if let Some((d, values)) = planes.features {
        for k in 0..d {
            channels.push((format!("feat.{k:02}"), values.iter().skip(k).step_by(d).copied().collect()));
        }
    }
    for (name, codes) in LEVEL_NAMES.iter().zip(planes.codes) {
        // f32 holds every index up to 16 million.
        channels.push((format!("code.{name}"), codes.data.iter().map(|k| *k as f32).collect()));
    }
    let list =
        channels.into_iter().map(|(name, v)| ex::AnyChannel::new(name.as_str(), ex::FlatSamples::F32(v)));
    let encoding = ex::Encoding { compression: ex::Compression::ZIP16, ..ex::Encoding::FAST_LOSSLESS };
    let channels = ex::AnyChannels::sort(list.collect());
    let layer = ex::Layer::new(size, ex::LayerAttributes::default(), encoding, channels);
    let mut bytes = std::io::Cursor::new(Vec::new());
    ex::Image::from_layer(layer)
        .write()
        .to_buffered(&mut bytes)
        .map_err(|e| Error::work(format!("{}: cannot encode the EXR file: {e}", path.display())))?;
    std::fs::write(path, bytes.into_inner()).map_err(Error::unwritable(path))
}

/// Reads every channel of the first layer of an OpenEXR file, by name; half floats and integers
/// become floats.
pub fn read_exr(path: &Path) -> Result<BTreeMap<String, Image<f32>>> {
    use ex::ReadChannels;
    use ex::ReadLayers;
    let reader = ex::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let image = reader
        .all_attributes()
        .from_file(path)
        .map_err(|e| Error::input(format!("{}: not a readable EXR file: {e}", path.display())))?;
    let (width, height) = (image.layer_data.size.x(), image.layer_data.size.y());
    let plane = |c: ex::AnyChannel<ex::FlatSamples>| {
        (c.name.to_string(), Image { width, height, data: c.sample_data.values_as_f32().collect() })
    };
    Ok(image.layer_data.channel_data.list.into_iter().map(plane).collect())
}

/// Writes `[H, W]` or `[H, W, d]` values as `<f4` npy.
pub fn write_npy(path: &Path, size: (usize, usize), d: Option<usize>, values: &[f32]) -> Result<()> {
    let mut shape = vec![size.1, size.0];
    shape.extend(d);
    npy::write(path, &NpyArray::f32(&shape, values.to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exr_keeps_every_float() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let (w, h, d) = (5, 3, 2);
        let rgb =
            RgbImage { width: w, height: h, data: (0..15).map(|i| [i as f32 * 0.1, -1.5, 2.0e5]).collect() };
        let depth = Image { width: w, height: h, data: (0..15).map(|i| i as f32 * 1e-3).collect() };
        let features: Vec<f32> = (0..30).map(|i| i as f32).collect();
        let codes = Image { width: w, height: h, data: (-1..14).collect::<Vec<i32>>() };
        let planes = Planes {
            rgb: Some(&rgb),
            depth: Some(&depth),
            unseen: None,
            features: Some((d, &features)),
            codes: std::slice::from_ref(&codes),
            ..Planes::default()
        };
        write_exr(&path, (w, h), planes).unwrap();
        let image = read_exr(&path).unwrap();
        let names: Vec<&str> = image.keys().map(String::as_str).collect();
        assert_eq!(names, ["B", "G", "R", "Z", "code.s", "feat.00", "feat.01"]);
        assert_eq!(image["R"].data, rgb.data.iter().map(|c| c[0]).collect::<Vec<_>>());
        assert_eq!(image["Z"], depth);
        assert_eq!(image["code.s"].data, codes.data.iter().map(|k| *k as f32).collect::<Vec<_>>());
        assert_eq!(image["feat.01"].data, features.iter().skip(1).step_by(2).copied().collect::<Vec<_>>());
        std::fs::write(&path, b"no image").unwrap();
        assert_eq!(read_exr(&path).unwrap_err().exit_code(), 2);
    }
}
