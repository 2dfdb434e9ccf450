//! Tags of TIFF files and EXIF blocks, each value within a bound: counts and offsets come from the
//! file, and a thousand tags may share the same bytes.

/// Largest value that is read, bytes: the largest value in a JPEG.
const LARGEST_VALUE: usize = 64 << 10;

/// Tags of the first directory that [`digest`] keeps: kind and channels of the image, make, model,
/// orientation, signs of raw files.
const FIRST: [u16; 8] = [0xfe, 0x106, 0x10f, 0x110, 0x112, 0x14a, 0x152, 0xc612];
/// Tags of the EXIF directory that it keeps: lens, sensor, size, colour space, processing, the
/// maker's note.
const EXIF: [u16; 10] = [0x920a, 0x927c, 0xa001, 0xa002, 0xa003, 0xa20e, 0xa210, 0xa401, 0xa405, 0xa434];
/// Tag of the first directory with the offset of the EXIF one, and tag of that with the offset of
/// the interoperability directory.
const TO_EXIF: u16 = 0x8769;
const TO_INTEROPERABILITY: u16 = 0xa005;
/// InteroperabilityIndex.
const INDEX: u16 = 1;
/// ICC profile and XMP packet in the first directory of a TIFF file.
pub(super) const ICC: u16 = 0x8773;
pub(super) const XMP: u16 = 0x2bc;

/// A tag with the bytes of its value.
struct Entry<'a> {
    tag: u16,
    kind: u16,
    count: u32,
    value: &'a [u8],
}

/// Bytes per value of the types 1 to 13.
const SIZES: [usize; 14] = [0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4];

/// Directories of a file or block, borrowed from it.
pub(super) struct Directories<'a> {
    big_endian: bool,
    first: Vec<Entry<'a>>,
    exif: Vec<Entry<'a>>,
    interoperability: Vec<Entry<'a>>,
}

#[derive(Clone, Copy)]
struct Order(bool);

impl Order {
    fn short(self, bytes: &[u8], at: usize) -> Option<u16> {
        let b: [u8; 2] = bytes.get(at..at.checked_add(2)?)?.try_into().ok()?;
        Some(if self.0 { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) })
    }

    fn long(self, bytes: &[u8], at: usize) -> Option<u32> {
        let b: [u8; 4] = bytes.get(at..at.checked_add(4)?)?.try_into().ok()?;
        Some(if self.0 { u32::from_be_bytes(b) } else { u32::from_le_bytes(b) })
    }

    fn put_short(self, v: u16) -> [u8; 2] {
        if self.0 { v.to_be_bytes() } else { v.to_le_bytes() }
    }

    fn put_long(self, v: u32) -> [u8; 4] {
        if self.0 { v.to_be_bytes() } else { v.to_le_bytes() }
    }

    /// Entries of the directory at an offset; those outside of the bytes are left out.
    fn directory(self, bytes: &[u8], at: usize) -> Vec<Entry<'_>> {
        let count = self.short(bytes, at).unwrap_or(0);
        let entry = |k: usize| {
            let at = at.checked_add(2 + 12 * k)?;
            let (tag, kind) = (self.short(bytes, at)?, self.short(bytes, at + 2)?);
            let count = self.long(bytes, at + 4)?;
            let size = SIZES.get(usize::from(kind))?.checked_mul(count as usize)?;
            let start = if size > 4 { self.long(bytes, at + 8)? as usize } else { at + 8 };
            Some(Entry { tag, kind, count, value: bytes.get(start..start.checked_add(size)?)? })
        };
        (0..usize::from(count)).filter_map(entry).collect()
    }

    fn subdirectory<'a>(self, bytes: &'a [u8], from: &[Entry], tag: u16) -> Vec<Entry<'a>> {
        let at = from.iter().find(|e| e.tag == tag).and_then(|e| self.long(e.value, 0));
        at.map(|at| self.directory(bytes, at as usize)).unwrap_or_default()
    }
}

impl<'a> Directories<'a> {
    /// Parses the directories; `None` without a TIFF header.
    pub fn of(bytes: &'a [u8]) -> Option<Directories<'a>> {
        let big_endian = match bytes.get(..4)? {
            b"II*\0" => false,
            b"MM\0*" => true,
            _ => return None,
        };
        let order = Order(big_endian);
        let first = order.directory(bytes, order.long(bytes, 4)? as usize);
        let exif = order.subdirectory(bytes, &first, TO_EXIF);
        let interoperability = order.subdirectory(bytes, &exif, TO_INTEROPERABILITY);
        Some(Directories { big_endian, first, exif, interoperability })
    }

    /// Bytes of a value of the first directory.
    pub fn bytes(&self, tag: u16) -> Option<&'a [u8]> {
        self.first.iter().find(|e| e.tag == tag).map(|e| e.value)
    }

    /// DCF: "R03" means Adobe RGB in files without an ICC profile.
    pub fn is_adobe_rgb(&self) -> bool {
        self.interoperability.iter().any(|e| e.tag == INDEX && e.value.starts_with(b"R03"))
    }

    /// ExtraSamples 1: colours are stored multiplied by alpha (TIFF 6.0, section 18).
    pub fn has_associated_alpha(&self) -> bool {
        let extra = self.bytes(0x152);
        extra.and_then(|v| Order(self.big_endian).short(v, 0)) == Some(1)
    }

    /// A TIFF block of the needed tags, each once and with at most [`LARGEST_VALUE`] bytes.
    pub fn digest(&self) -> Vec<u8> {
        let order = Order(self.big_endian);
        let (first, exif) = (chosen(&self.first, &FIRST), chosen(&self.exif, &EXIF));
        let size = |entries: usize| 2 + 12 * entries + 4;
        let (first_at, exif_at) = (8, 8 + size(first.len() + 1));
        let mut values_at = exif_at + size(exif.len());
        let mut values: Vec<u8> = Vec::new();
        let mut out = if self.big_endian { *b"MM\0*" } else { *b"II*\0" }.to_vec();
        out.extend(order.put_long(first_at as u32));
        let pointer = order.put_long(exif_at as u32);
        let pointer = Entry { tag: TO_EXIF, kind: 4, count: 1, value: &pointer };
        let first: Vec<&Entry> = first.into_iter().chain([&pointer]).collect();
        for directory in [first, exif] {
            out.extend(order.put_short(directory.len() as u16));
            for e in directory {
                out.extend([order.put_short(e.tag), order.put_short(e.kind)].concat());
                out.extend(order.put_long(e.count));
                if e.value.len() <= 4 {
                    let mut inline = e.value.to_vec();
                    inline.resize(4, 0);
                    out.extend(inline);
                } else {
                    out.extend(order.put_long(values_at as u32));
                    values.extend(e.value);
                    values_at += e.value.len();
                }
            }
            out.extend([0; 4]);
        }
        out.extend(values);
        out
    }
}

/// The wanted entries of at most [`LARGEST_VALUE`] bytes, in the order of `wanted`.
fn chosen<'e>(entries: &'e [Entry<'e>], wanted: &[u16]) -> Vec<&'e Entry<'e>> {
    let find = |tag: &u16| entries.iter().find(|e| e.tag == *tag && e.value.len() <= LARGEST_VALUE);
    wanted.iter().filter_map(find).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiff_digest_is_bounded() {
        // 60,000 tags that share the same megabyte.
        let (tags, size) = (60_000u32, 1u32 << 20);
        let mut bytes = b"II*\0\x08\0\0\0".to_vec();
        bytes.extend((tags as u16).to_le_bytes());
        let at = 8 + 2 + 12 * tags + 4;
        for k in 0..tags {
            let tag = [0x10f, 0x110, 0x927c, 0x8769][k as usize % 4];
            bytes.extend([u16::to_le_bytes(tag), u16::to_le_bytes(2)].concat());
            bytes.extend([size.to_le_bytes(), at.to_le_bytes()].concat());
        }
        bytes.resize(at as usize + size as usize, 0);
        let digest = Directories::of(&bytes).unwrap().digest();
        assert!(digest.len() < 100, "{} bytes", digest.len());
        for cut in 0..40 {
            Directories::of(&bytes[..cut]).map(|d| d.digest());
        }
    }
}
