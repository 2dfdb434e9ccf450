//! Metadata of PNG files, extracted within bounds before decoding: the decoder inflates profiles
//! and texts without a bound.
use super::metadata::{LARGEST_ICC, LARGEST_XMP, Metadata};
use flate2::read::ZlibDecoder;
use std::io::Read;

/// Bytes of the signature.
const SIGNATURE: usize = 8;
/// Bytes of length, type and checksum of a chunk.
const FRAME: usize = 12;
const XMP: &[u8] = b"XML:com.adobe.xmp";

/// Removes all chunks that do not affect pixels, and returns their content. Animations become their
/// first picture.
pub(super) fn take_metadata(bytes: &mut Vec<u8>) -> Metadata {
    let mut found = Metadata::default();
    let (mut from, mut to) = (SIGNATURE, SIGNATURE);
    while let Some((length, kind)) = header(bytes, from) {
        let Some(end) = from.checked_add(length + FRAME).filter(|end| *end <= bytes.len()) else { break };
        let is_pixels = kind[0].is_ascii_uppercase() || &kind == b"tRNS";
        if is_pixels {
            bytes.copy_within(from..end, to);
            to += end - from;
        } else {
            note(&kind, &bytes[from + 8..end - 4], &mut found);
        }
        from = end;
    }
    // The decoder reports a truncated chunk.
    let rest = bytes.len().saturating_sub(from);
    if rest > 0 && from > to {
        bytes.copy_within(from.., to);
    }
    bytes.truncate(to.min(bytes.len()) + rest);
    found
}

fn header(bytes: &[u8], at: usize) -> Option<(usize, [u8; 4])> {
    let (length, kind) = (bytes.get(at..at + 4)?, bytes.get(at + 4..at + 8)?);
    Some((u32::from_be_bytes(length.try_into().ok()?) as usize, kind.try_into().ok()?))
}

/// Stores the content of a chunk; of two of a type the first counts.
fn note(kind: &[u8; 4], data: &[u8], found: &mut Metadata) {
    let number = |at: usize| Some(u32::from_be_bytes(data.get(at..at + 4)?.try_into().ok()?));
    match kind {
        b"eXIf" if found.exif.is_none() => found.exif = Some(data.to_vec()),
        b"iCCP" if found.icc.is_none() => match icc(data) {
            Some(profile) => found.icc = Some(profile),
            None => found
                .notes
                .push("its ICC profile is damaged or larger than 4 MiB, and is not used".to_owned()),
        },
        b"iTXt" if found.xmp.is_none() => found.xmp = xmp(data),
        b"cICP" if found.code_points.is_none() => {
            found.code_points_first = true;
            found.code_points =
                data.try_into().ok().map(|[p, t, m, range]: [u8; 4]| [p, t, m, range].map(u16::from));
        }
        b"sRGB" => found.is_srgb = true,
        b"gAMA" => found.gamma = number(0).filter(|g| *g > 0).map(|g| f64::from(g) / 100_000.0),
        b"cHRM" => {
            let values: Option<Vec<f64>> =
                (0..8).map(|k| number(4 * k).map(|v| f64::from(v) / 100_000.0)).collect();
            found.chromaticities = values.and_then(|v| v.try_into().ok());
        }
        _ => {}
    }
}

/// Inflates an ICC profile, after its name and the compression method.
fn icc(data: &[u8]) -> Option<Vec<u8>> {
    let name = data.iter().take(80).position(|b| *b == 0)?;
    inflated(data.get(name + 2..)?, LARGEST_ICC)
}

/// XMP packet of an international text chunk: keyword, compression flag, method, language,
/// translated keyword, text.
fn xmp(data: &[u8]) -> Option<Vec<u8>> {
    let rest = data.strip_prefix(XMP)?.strip_prefix(&[0])?;
    let (flags, rest) = rest.split_at_checked(2)?;
    let text = rest.splitn(3, |b| *b == 0).nth(2)?;
    match flags[0] {
        0 => (text.len() <= LARGEST_XMP).then(|| text.to_vec()),
        _ => inflated(text, LARGEST_XMP),
    }
}

/// Inflates a stream; `None` if it is damaged or has more than `most` bytes.
fn inflated(data: &[u8], most: usize) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    ZlibDecoder::new(data).take(most as u64 + 1).read_to_end(&mut out).ok()?;
    (out.len() <= most).then_some(out)
}
