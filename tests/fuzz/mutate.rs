//! Seeded damage to bytes.
use std::ops::Range;

/// SplitMix64 (Steele et al. 2014).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Random {
        Random(seed)
    }
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// Uniform below `n` > 0.
    pub fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
    pub fn pick<'a, T>(&mut self, list: &'a [T]) -> &'a T {
        &list[self.below(list.len())]
    }
    fn range(&mut self, length: usize, most: usize) -> Range<usize> {
        let start = self.below(length + 1);
        start..(start + self.below(most + 1)).min(length)
    }
}

/// Replacements of numbers and words in texts.
const WORDS: [&str; 20] = [
    "0",
    "-1",
    "1",
    "1e308",
    "-1e400",
    "nan",
    "inf",
    "1e-320",
    "0.5",
    "255",
    "65536",
    "2147483648",
    "4294967296",
    "18446744073709551615",
    "99999999999999999999999",
    "null",
    "\"\"",
    "[]",
    "{}",
    "\u{1b}[31m\0",
];

/// False lengths.
const LENGTHS: [u64; 14] = [
    0,
    1,
    2,
    255,
    256,
    65535,
    65536,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    u64::MAX / 16,
    u64::MAX - 7,
    u64::MAX,
];

const FLOATS: [f32; 8] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -0.0, 1e-45, 1e20, -200.0];

/// A copy of a file, damaged in one to five places: a reader stops at the first damage that it
/// notices.
pub fn damaged(whole: &[u8], others: &[&[u8]], random: &mut Random) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    for _ in 0..1 + random.below(2) * random.below(5) {
        once(&mut bytes, others, random);
    }
    bytes
}

fn once(bytes: &mut Vec<u8>, others: &[&[u8]], random: &mut Random) {
    if bytes.is_empty() {
        return bytes.extend((0..random.below(64)).map(|_| 0));
    }
    let n = bytes.len();
    // Counts are in headers.
    let at = if random.below(2) == 0 { random.below(n.min(256)) } else { random.below(n) };
    match random.below(12) {
        0 => bytes[at] ^= 1 << random.below(8),
        1 => bytes[at] = *random.pick(&[0, 1, 0x7f, 0x80, 0xff, b'\n', b'"', b'[', b'-', b'9']),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(random.range(n, 64))),
        4 => {
            let again = bytes[random.range(n, 256)].to_vec();
            bytes.splice(at..at, again);
        }
        5 => {
            let other = random.pick(others);
            let part = other[random.range(other.len(), 256)].to_vec();
            let end = (at + if random.below(2) == 0 { part.len() } else { 0 }).min(n);
            bytes.splice(at..end, part);
        }
        6 | 7 => {
            let length = match random.below(3) {
                0 => n as u64 + random.below(5) as u64,
                _ => *random.pick(&LENGTHS),
            };
            let width = *random.pick(&[2, 4, 8]);
            let word = match random.below(4) {
                0 => length.to_be_bytes()[8 - width..].to_vec(),
                _ => length.to_le_bytes()[..width].to_vec(),
            };
            put(bytes, at, &word);
        }
        8 => put(bytes, at / 4 * 4, &random.pick(&FLOATS).to_le_bytes()),
        9 | 10 => word(bytes, at, random),
        _ => {
            let many = random
                .pick(&[&b"["[..], b"{\"a\":", b"[0,", b"0 ", b"\n", b"\xff", b"a=", b"\0\0\0\0"])
                .repeat(300);
            bytes.splice(at..at, many);
        }
    }
}

fn put(bytes: &mut [u8], at: usize, word: &[u8]) {
    bytes[at..].iter_mut().zip(word).for_each(|(b, w)| *b = *w);
}

/// Replaces the number or name around a byte by another word.
fn word(bytes: &mut Vec<u8>, at: usize, random: &mut Random) {
    let inside = |b: &u8| b.is_ascii_alphanumeric() || b"+-._".contains(b);
    let start = at - bytes[..at].iter().rev().take_while(|b| inside(b)).count();
    let end = at + bytes[at..].iter().take_while(|b| inside(b)).count();
    bytes.splice(start..end, random.pick(&WORDS).bytes());
}
