//! Extension records of `.spz`: a sequence of type, length and content.
use crate::format::transform;
use crate::scene::{Similarity, Splats};
use glam::{DMat3, DVec3};

/// Record of the axes of a file: one number.
const COORDINATE_SYSTEM: u32 = 0xadbe_0003;
/// Known records that do not concern the Gaussians.
const OTHERS: [(u32, &str); 2] =
    [(0xadbe_0002, "SPZ_ADOBE_safe_orbit_camera"), (0x4e53_0001, "SPZ_NIANTIC_georeference")];
/// Record of a draft that stored SH in another range.
const SH_QUANTISATION: u32 = 0xadbe_0001;

/// Directions of the first, second and third axis by number: right or left, up or down, front or
/// back. 0 is "not specified". Numbers from 9 on follow Niantic's present loader; the first one
/// with these axes had 9 to 12 and 13 to 16 exchanged.
const SYSTEMS: [&str; 17] = [
    "RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD",
    "LBU", "RBU",
];

/// Applies the records to Gaussians that were read as right, up, back; notes name those that are
/// not read.
pub(super) fn apply(s: &mut Splats, mut records: &[u8], notes: &mut Vec<String>) -> Result<(), String> {
    let mut axes = None;
    while !records.is_empty() {
        let (kind, length) = (word(records, 0)?, word(records, 4)? as usize);
        let content = records[8..].get(..length).ok_or(TRUNCATED)?;
        match kind {
            COORDINATE_SYSTEM => {
                let number = if length == 4 { word(records, 8)? as usize } else { usize::MAX };
                let system = SYSTEMS
                    .get(number)
                    .ok_or("SPZ_ADOBE_coordinate_system states axes that are not known")?;
                if number > 8 {
                    notes.push(format!(
                        "axes {system} by number {number}; the first loaders meant others by it"
                    ));
                }
                if axes.replace(*system).is_some_and(|other| other != *system) {
                    return Err(
                        "SPZ_ADOBE_coordinate_system states two kinds of axes; write the file again".into()
                    );
                }
            }
            SH_QUANTISATION => {
                return Err(
                    "SPZ_ADOBE_sh_quantization stores SH in a range of its own; write the file without"
                        .into(),
                );
            }
            _ => {
                let name =
                    OTHERS.iter().find(|o| o.0 == kind).map_or(String::new(), |o| format!(" ({})", o.1));
                notes.push(format!("its extension {kind:#010x}{name} of {length} bytes is not read"));
            }
        }
        records = &records[8 + content.len()..];
    }
    if let Some(system) = axes {
        turn(s, system);
    }
    Ok(())
}

const TRUNCATED: &str = "its extension records end early; copy the file again";

/// The little-endian word at an offset.
fn word(records: &[u8], at: usize) -> Result<u32, &'static str> {
    let b = records.get(at..at + 4).ok_or(TRUNCATED)?;
    Ok(u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

/// Transforms Gaussians that were read as right, up, back from the actual axes of their file.
fn turn(s: &mut Splats, system: &str) {
    // Columns: the axes of the file in those of a scene (right, down, forward).
    let axes: Vec<DVec3> = system.chars().map(direction).collect();
    let [x, y, z] = [0, 1, 2].map(|k| axes.get(k).copied().unwrap_or_default());
    let read_as = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let mut rotation = DMat3::from_cols(x, y, z) * read_as.transpose();
    if rotation == DMat3::IDENTITY {
        return;
    }
    if rotation.determinant() < 0.0 {
        // Axes of opposite handedness: a mirror about z, then a proper rotation.
        transform::mirror_z(s);
        rotation.z_axis = -rotation.z_axis;
    }
    transform::transform_splats(s, &Similarity { scale: 1.0, rotation, translation: DVec3::ZERO });
}

fn direction(letter: char) -> DVec3 {
    match letter {
        'R' => DVec3::X,
        'L' => DVec3::NEG_X,
        'D' => DVec3::Y,
        'U' => DVec3::NEG_Y,
        'F' => DVec3::Z,
        _ => DVec3::NEG_Z,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::seeded;

    fn record(kind: u32, content: &[u8]) -> Vec<u8> {
        [&kind.to_le_bytes()[..], &(content.len() as u32).to_le_bytes(), content].concat()
    }

    fn applied(records: &[u8]) -> Result<(Splats, Vec<String>), String> {
        // As read in right, up, back; the file itself contains (1, 2, 3).
        let mut s = Splats { means: vec![[1.0, -2.0, -3.0]; 4], ..seeded::small(4, 32, 24, 3, 1004).0 };
        let mut notes = Vec::new();
        apply(&mut s, records, &mut notes).map(|()| (s, notes))
    }

    #[test]
    fn stated_axes_are_applied() {
        let plain = applied(&[]).unwrap().0;
        for (number, mean) in [
            (0u32, [1.0, -2.0, -3.0]),
            (4, [1.0, -2.0, -3.0]),
            (6, [1.0, 2.0, 3.0]),
            (12, [1.0, -3.0, 2.0]),
            (8, [1.0, -2.0, 3.0]),
            (1, [-1.0, 2.0, -3.0]),
        ] {
            let (s, notes) = applied(&record(COORDINATE_SYSTEM, &number.to_le_bytes())).unwrap();
            assert_eq!((s.means[0], notes.len()), (mean, usize::from(number > 8)), "{number}");
            assert_eq!(s.log_scales, plain.log_scales);
            assert_eq!(s == plain, number == 0 || number == 4, "{number}");
        }
    }

    #[test]
    fn other_records_are_named_or_refused() {
        let two = [record(0xadbe_0002, &[0; 12]), record(0x1234_0001, &[])].concat();
        let (_, notes) = applied(&two).unwrap();
        assert!(notes[0].contains("safe_orbit_camera") && notes[1].contains("0x12340001"), "{notes:?}");
        let six = 6u32.to_le_bytes();
        let systems =
            [record(COORDINATE_SYSTEM, &six), record(COORDINATE_SYSTEM, &4u32.to_le_bytes())].concat();
        for (records, words) in [
            (record(COORDINATE_SYSTEM, &17u32.to_le_bytes()), "not known"),
            (record(COORDINATE_SYSTEM, &[6]), "not known"),
            (systems, "two kinds"),
            (record(SH_QUANTISATION, &[0; 12]), "range of its own"),
            (record(COORDINATE_SYSTEM, &six)[..10].to_vec(), "end early"),
            (vec![1, 2, 3], "end early"),
        ] {
            let e = applied(&records).unwrap_err();
            assert!(e.contains(words), "{e}");
        }
    }
}
