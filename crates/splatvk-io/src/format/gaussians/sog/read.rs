//! Reader of `.sog` and of `meta.json` with its images.
use super::{CODES, FIRST_TAG, META, Meta, ROW, VERSION};
use crate::format::logit;
use crate::scene::{Splats, sh_coefficients};
use crate::{Error, Result, files};
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Rgba, RgbaImage};
use std::io::{Cursor, Read};
use std::path::Path;

/// Pixels of an image beyond twice those that are needed.
const SPARE: usize = 1 << 16;
/// Size of the description: 64 MiB are permitted in a folder, codebooks take some kilobytes.
const MOST_META: u64 = 1 << 20;

/// Reads a file; all of it is read.
pub fn read_noted(path: &Path, _notes: &mut Vec<String>) -> Result<Splats> {
    let bytes = files::read(path)?;
    let parsed = files::guarded(|| parse(path, &bytes));
    let parsed = parsed.unwrap_or_else(|panic| Err(format!("damaged ({panic}); copy the file again")));
    parsed.map_err(|e| Error::input(format!("{}: {e}", path.display())))
}

fn parse(path: &Path, bytes: &[u8]) -> Result<Splats, String> {
    let mut source = Source::open(path, bytes)?;
    let meta = description(&source.meta()?)?;
    Images::load(&meta, &mut source)?.splats(&meta)
}

/// `meta.json` of a supported version.
fn description(text: &[u8]) -> Result<Meta, String> {
    let json: serde_json::Value =
        files::parse_json(text).map_err(|e| format!("{META}: {e}; write it again"))?;
    match json.get("version").map(|v| v.as_u64()) {
        Some(Some(version)) if version == u64::from(VERSION) => {}
        Some(Some(version)) => return Err(format!("version {version} of SOG is not known ({VERSION} is)")),
        _ if json.get("means").is_some() => {
            return Err("the first version of SOG is not read; splat-transform writes it as .ply".into());
        }
        _ => return Err(format!("its {META} describes no Gaussians; give a .sog, or the {META} of one")),
    }
    serde_json::from_value(json).map_err(|e| format!("{META}: {e}; write it again"))
}

/// Files of an archive or of a folder.
enum Source<'a> {
    Archive(Box<zip::ZipArchive<Cursor<&'a [u8]>>>, u64),
    Folder(&'a Path, &'a [u8]),
}

impl<'a> Source<'a> {
    fn open(path: &'a Path, bytes: &'a [u8]) -> Result<Source<'a>, String> {
        if path.file_name().is_some_and(|name| name == META) {
            return Ok(Source::Folder(path.parent().unwrap_or(Path::new("")), bytes));
        }
        let archive = zip::ZipArchive::new(Cursor::new(bytes))
            .map_err(|e| format!("not a readable archive ({e}); copy the file again"))?;
        Ok(Source::Archive(Box::new(archive), files::most_content(bytes.len())))
    }

    fn meta(&mut self) -> Result<Vec<u8>, String> {
        match self {
            Source::Archive(archive, left) => member(archive, META, (*left).min(MOST_META)),
            Source::Folder(_, bytes) => Ok(bytes.to_vec()),
        }
    }

    /// An image by the name that the description has for it.
    fn file(&mut self, name: &str) -> Result<Vec<u8>, String> {
        match self {
            Source::Archive(archive, left) => {
                let bytes = member(archive, name, *left)?;
                *left -= bytes.len() as u64;
                Ok(bytes)
            }
            Source::Folder(folder, _) => {
                let outside = || format!("its image {name} is outside of its folder; put it beside {META}");
                files::read(&files::within(folder, name).ok_or_else(outside)?)
                    .map_err(|e| format!("its image {e}"))
            }
        }
    }
}

/// A member of at most `left` bytes.
fn member(archive: &mut zip::ZipArchive<Cursor<&[u8]>>, name: &str, left: u64) -> Result<Vec<u8>, String> {
    let damaged = |e: &dyn std::fmt::Display| format!("its {name} cannot be read ({e}); copy the file again");
    let member = archive.by_name(name).map_err(|e| damaged(&e))?;
    let mut bytes = Vec::new();
    // One byte more detects longer ones, and makes the archive verify the checksum.
    member.take(left.saturating_add(1)).read_to_end(&mut bytes).map_err(|e| damaged(&e))?;
    match bytes.len() as u64 > left {
        true => Err(format!("its {name} is far larger than the file can hold")),
        false => Ok(bytes),
    }
}

/// The images of a file in their compressed form, of checked sizes.
struct Images {
    means: [Encoded; 2],
    scales: Encoded,
    quats: Encoded,
    sh0: Encoded,
    /// Palette, and row of it per Gaussian.
    rest: Option<[Encoded; 2]>,
}

struct Encoded {
    name: String,
    bytes: Vec<u8>,
}

impl Encoded {
    fn decoder(&self) -> Result<impl ImageDecoder + '_, String> {
        let bad = |e: &dyn std::fmt::Display| format!("its {}: {e}; copy the file again", self.name);
        let reader = ImageReader::new(Cursor::new(self.bytes.as_slice()))
            .with_guessed_format()
            .map_err(|e| bad(&e))?;
        match reader.format() {
            Some(ImageFormat::WebP | ImageFormat::Png) => reader.into_decoder().map_err(|e| bad(&e)),
            _ => Err(format!("its {} is no WebP or PNG image; write it again", self.name)),
        }
    }

    /// Refuses an image with fewer pixels than are needed, or many more, before it is decoded.
    fn check(&self, needed: usize) -> Result<(), String> {
        let (width, height) = self.decoder()?.dimensions();
        let pixels = width as usize * height as usize;
        match pixels >= needed && pixels / 2 <= needed.saturating_add(SPARE) {
            true => Ok(()),
            false => {
                Err(format!("its {} has {width} × {height} pixels for {needed}; copy it again", self.name))
            }
        }
    }

    fn pixels(&self) -> Result<RgbaImage, String> {
        let image = DynamicImage::from_decoder(self.decoder()?);
        Ok(image.map_err(|e| format!("its {}: {e}; copy the file again", self.name))?.into_rgba8())
    }
}

impl Images {
    fn load(meta: &Meta, source: &mut Source) -> Result<Images, String> {
        let mut size = 0;
        let mut load = |name: &String| {
            let bytes = source.file(name)?;
            size += bytes.len();
            Ok::<_, String>(Encoded { name: name.clone(), bytes })
        };
        let [low, high] = &meta.means.files;
        let images = Images {
            means: [load(low)?, load(high)?],
            scales: load(&meta.scales.files[0])?,
            quats: load(&meta.quats.files[0])?,
            sh0: load(&meta.sh0.files[0])?,
            rest: match &meta.rest {
                Some(rest) => Some([load(&rest.files[0])?, load(&rest.files[1])?]),
                None => None,
            },
        };
        images.check(meta, size)?;
        Ok(images)
    }

    /// Bounds the memory by the size of the images: all counts come from the file.
    fn check(&self, meta: &Meta, size: usize) -> Result<(), String> {
        let bands = meta.rest.as_ref().map_or(0, |rest| rest.bands);
        if bands > 3 {
            return Err(format!("SH degree {bands} is not known (0 to 3 are); export it with a lower one"));
        }
        // Position, scale, rotation and opacity have eleven numbers.
        let numbers = 11 + 3 * u64::from(sh_coefficients(bands) as u32);
        if (meta.count as u64).saturating_mul(4 * numbers) > files::most_content(size).saturating_mul(4) {
            return Err(format!("{} Gaussians are far more than its {size} bytes can hold", meta.count));
        }
        let [low, high] = &self.means;
        [low, high, &self.scales, &self.quats, &self.sh0]
            .into_iter()
            .try_for_each(|i| i.check(meta.count))?;
        let (Some(rest), Some([entries, labels])) = (&meta.rest, &self.rest) else { return Ok(()) };
        labels.check(meta.count)?;
        if rest.count > 1 << 16 {
            return Err(format!("a palette of {} entries is too large (65,536 are known)", rest.count));
        }
        let columns = ROW * (sh_coefficients(bands) - 1);
        entries.check(columns * rest.count.div_ceil(ROW))?;
        match entries.decoder()?.dimensions().0 as usize == columns {
            true => Ok(()),
            false => Err(format!("its {} is not {columns} pixels wide; write it again", entries.name)),
        }
    }

    fn splats(&self, meta: &Meta) -> Result<Splats, String> {
        let degree = meta.rest.as_ref().map_or(0, |rest| rest.bands);
        let mut s = Splats::with_capacity(meta.count, degree);
        s.antialiased = meta.antialias;
        let [low, high] = [self.means[0].pixels()?, self.means[1].pixels()?];
        let mean = |(low, high): (&Rgba<u8>, &Rgba<u8>)| {
            [0, 1, 2].map(|k| {
                let at = f64::from(u16::from_le_bytes([low.0[k], high.0[k]])) / 65535.0;
                let v = meta.means.mins[k] + at * (meta.means.maxs[k] - meta.means.mins[k]);
                v.abs().exp_m1().copysign(v) as f32
            })
        };
        s.means.extend(low.pixels().zip(high.pixels()).take(meta.count).map(mean));
        drop((low, high));
        let codes = codes(&meta.scales.codebook)?;
        let scale = |p: &Rgba<u8>| [0, 1, 2].map(|k| codes[usize::from(p.0[k])]);
        s.log_scales.extend(self.scales.pixels()?.pixels().take(meta.count).map(scale));
        s.quats.extend(self.quats.pixels()?.pixels().take(meta.count).map(|p| rotation(p.0)));
        let colours = self.sh0.pixels()?;
        let opacity = |p: &Rgba<u8>| logit(f32::from(p.0[3]) / 255.0);
        s.opacity_logits.extend(colours.pixels().take(meta.count).map(opacity));
        self.colours(meta, &colours, &mut s.sh)?;
        Ok(s)
    }

    /// Base colours, each followed by its row of the palette.
    fn colours(&self, meta: &Meta, colours: &RgbaImage, sh: &mut Vec<f32>) -> Result<(), String> {
        let base = codes(&meta.sh0.codebook)?;
        let base = |p: &Rgba<u8>| [0, 1, 2].map(|k| base[usize::from(p.0[k])]);
        let colours = colours.pixels().take(meta.count);
        let (Some(rest), Some([entries, labels])) = (&meta.rest, &self.rest) else {
            sh.extend(colours.flat_map(base));
            return Ok(());
        };
        let codes = codes(&rest.codebook)?;
        let (entries, labels) = (entries.pixels()?, labels.pixels()?);
        let coefficients = sh_coefficients(rest.bands) - 1;
        for (colour, label) in colours.zip(labels.pixels()) {
            sh.extend(base(colour));
            let label = usize::from(u16::from_le_bytes([label.0[0], label.0[1]]));
            if label >= rest.count {
                return Err(format!("entry {label} of a palette of {}; copy the file again", rest.count));
            }
            // The palette's rows follow each other, four bytes per coefficient.
            let row = &entries.as_raw()[4 * label * coefficients..][..4 * coefficients];
            sh.extend(row.chunks_exact(4).flat_map(|p| [0, 1, 2].map(|k| codes[usize::from(p[k])])));
        }
        Ok(())
    }
}

/// The three smaller components of (w, x, y, z) over ±1/√2; the largest follows from unit length.
/// A tag of no component gives no rotation, and the Gaussian is left out.
fn rotation(p: [u8; 4]) -> [f32; 4] {
    let Some(largest) = p[3].checked_sub(FIRST_TAG).map(usize::from) else { return [0.0; 4] };
    let mut q = [0.0f32; 4];
    let mut squares = 0.0;
    for (slot, k) in (0..4).filter(|k| *k != largest).enumerate() {
        q[k] = (f32::from(p[slot]) / 255.0 - 0.5) * std::f32::consts::SQRT_2;
        squares += q[k] * q[k];
    }
    q[largest] = (1.0 - squares).max(0.0).sqrt();
    q
}

/// Codes of a codebook. Early files lack the first one, which continues the steps of the others.
fn codes(codebook: &[Option<f32>]) -> Result<[f32; CODES], String> {
    let numbers: [Option<f32>; CODES] = codebook
        .try_into()
        .map_err(|_| format!("a codebook of {} numbers where {CODES} are needed", codebook.len()))?;
    let missing = || "a codebook lacks numbers; write the file again".to_owned();
    let mut out = [0.0; CODES];
    for (k, number) in numbers.iter().enumerate().rev() {
        out[k] = match number {
            Some(v) => *v,
            None if k == 0 => out[1] + (out[1] - out[CODES - 1]) / 255.0,
            None => return Err(missing()),
        };
    }
    Ok(out)
}
