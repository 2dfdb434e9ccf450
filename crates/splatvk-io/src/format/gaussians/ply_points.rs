//! Coloured points of PLY files.
use super::ply_header::PropertyType;
use super::ply_table::{Table, table};
use super::{ply_comments, usable};
use crate::scene::{PointCloud, SH_C0};
use crate::{Error, Result, files};
use std::path::Path;

/// Usual names of colour columns, most common first; case-insensitive.
const COLOURS: [[&str; 3]; 3] =
    [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]];

/// Colour columns, and the value of white.
pub(super) struct Colours {
    columns: [usize; 3],
    white: f32,
}

impl Colours {
    /// Colour columns of a table. Bytes end at 255, unsigned shorts at 65535; for other types, and
    /// shorts that end at 255, the greatest value decides, which is noted.
    pub fn of(t: &Table, notes: &mut Vec<String>) -> Result<Option<Colours>, String> {
        let found = |names: &[&str; 3]| t.all_of_any_case(*names);
        let Some((names, columns)) = COLOURS.iter().find_map(|n| Some((n, found(n)?))) else {
            return Ok(None);
        };
        let kinds = columns.map(|c| t.columns[c].1);
        if kinds[1] != kinds[0] || kinds[2] != kinds[0] {
            return Err(format!("its colours {} have different types; write them alike", names.join(" ")));
        }
        let values = || (0..t.rows).flat_map(|r| columns.map(|c| t.at(r, c)));
        let greatest = values().filter(|v| v.is_finite()).fold(0f32, f32::max);
        if values().any(|v| v < 0.0) {
            notes.push(format!("colours {} below 0 are taken as 0", names.join(" ")));
        }
        let whole = !matches!(kinds[0], PropertyType::F32 | PropertyType::F64);
        let white = match kinds[0] {
            PropertyType::U8 => return Ok(Some(Colours { columns, white: 255.0 })),
            PropertyType::U16 if greatest > 255.0 => return Ok(Some(Colours { columns, white: 65535.0 })),
            // Photos of high dynamic range slightly exceed white; colours of 0 to 255 are never all
            // this dark.
            _ if !whole && greatest <= BRIGHTEST_SHARE => 1.0,
            _ if greatest <= 255.0 => 255.0,
            _ if greatest <= 65535.0 => 65535.0,
            _ => {
                return Err(format!(
                    "its colours {} go up to {greatest}: neither 0 to 1 nor 0 to 255 nor 0 to 65535; scale them",
                    names.join(" ")
                ));
            }
        };
        if whole || white > 1.0 || greatest > 1.0 {
            notes.push(format!(
                "its colours {} go up to {greatest}: they are read as 0 to {white}",
                names.join(" ")
            ));
        }
        Ok(Some(Colours { columns, white }))
    }

    /// Colour of a row, 0 to 1.
    pub fn at(&self, t: &Table, row: usize) -> [f32; 3] {
        self.columns.map(|c| (t.at(row, c) / self.white).clamp(0.0, 1.0))
    }

    /// Names of the columns.
    pub fn names<'a>(&self, t: &'a Table) -> [&'a str; 3] {
        self.columns.map(|c| t.columns[c].0.as_str())
    }
}

/// Greatest float colour that is read as relative to white.
const BRIGHTEST_SHARE: f32 = 4.0;

/// Reads positions and colours (`red green blue`, `r g b` or `diffuse_red …` of any type, or
/// `f_dc`), with notes on parts that are not read, a line each; confidence 1, radius 0.
pub fn read_points(path: &Path) -> Result<(PointCloud, Vec<String>)> {
    let place = path.display();
    let t = table(files::read(path)?).map_err(|e| Error::input(format!("{place}: {e}")))?;
    let mut notes = Vec::new();
    let cloud = points(&t, &mut notes).map_err(|e| Error::input(format!("{place}: {e}")))?;
    notes.extend(ply_comments::places(&t.comments));
    notes.extend(usable::precision(&cloud.positions));
    Ok((cloud, usable::finished(notes, path)))
}

fn points(t: &Table, notes: &mut Vec<String>) -> Result<PointCloud, String> {
    let missing =
        |c: String| format!("no column {c}: this is not a point cloud; it has {}", files::listed(&t.names()));
    let position = t.all(["x", "y", "z"]).map_err(missing)?;
    let colours = Colours::of(t, notes)?;
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]).ok().filter(|_| colours.is_none());
    if colours.is_none() && dc.is_none() {
        notes.push(
            "no colours (red green blue, r g b, diffuse_red diffuse_green diffuse_blue or f_dc): points start grey"
                .into(),
        );
    }
    let mut read = vec!["x", "y", "z"];
    read.extend(colours.as_ref().map(|c| c.names(t)).into_iter().flatten());
    read.extend(dc.map(|_| ["f_dc_0", "f_dc_1", "f_dc_2"]).into_iter().flatten());
    notes.extend(t.unread(&read));
    let mut p = PointCloud::default();
    for r in 0..t.rows {
        p.positions.push(position.map(|c| t.at(r, c)));
        p.colours.push(match (&colours, dc) {
            (Some(c), _) => c.at(t, r),
            (None, Some(c)) => c.map(|c| (0.5 + SH_C0 * t.at(r, c)).clamp(0.0, 1.0)),
            (None, None) => [0.5; 3],
        });
    }
    let n = p.positions.len();
    (p.confidence, p.view, p.radius) = (vec![1.0; n], vec![0; n], vec![0.0; n]);
    Ok(p)
}

/// Writes a coloured point cloud in the layout of other tools: `x y z nx ny nz` float, `red green
/// blue` uchar.
pub fn write_points(path: &Path, p: &PointCloud) -> Result<()> {
    let mut bytes = String::from("ply\nformat binary_little_endian 1.0\n").into_bytes();
    let mut header = format!("element vertex {}\n", p.len());
    ["x", "y", "z", "nx", "ny", "nz"].iter().for_each(|n| header.push_str(&format!("property float {n}\n")));
    ["red", "green", "blue"].iter().for_each(|n| header.push_str(&format!("property uchar {n}\n")));
    bytes.extend_from_slice(header.as_bytes());
    bytes.extend_from_slice(b"end_header\n");
    for (position, colour) in p.positions.iter().zip(&p.colours) {
        for v in position.iter().chain(&[0.0; 3]) {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
        bytes.extend(colour.map(crate::format::to_byte));
    }
    std::fs::write(path, bytes).map_err(Error::unwritable(path))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two points, the second one white, with colours of this type and these names.
    fn read(kind: &str, names: &str, white: &str) -> Result<(PointCloud, Vec<String>)> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let columns: String = names.split(' ').map(|n| format!("property {kind} {n}\n")).collect();
        let dark = if white.contains('.') { "0.0" } else { "0" };
        std::fs::write(
            &path,
            format!(
                "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n{columns}\
                 end_header\n0 0 0 {dark} {dark} {dark}\n1 2 3 {white} {white} {white}\n"
            ),
        )
        .unwrap();
        read_points(&path)
    }

    #[test]
    fn colours_scale_by_type_and_range() {
        for (kind, names, white, noted) in [
            ("uchar", "red green blue", "255", false),
            ("ushort", "red green blue", "65535", false),
            ("ushort", "red green blue", "255", true),
            ("float", "red green blue", "1.0", false),
            ("float", "red green blue", "255.0", true),
            ("double", "r g b", "65535.0", true),
            ("int", "Red Green Blue", "255", true),
            ("uchar", "diffuse_red diffuse_green diffuse_blue", "255", false),
        ] {
            let (cloud, notes) = read(kind, names, white).unwrap();
            assert_eq!(cloud.colours, [[0.0; 3], [1.0; 3]], "{kind} {names} {white}");
            assert_eq!(notes.len(), usize::from(noted), "{kind} {white}: {notes:?}");
        }
        let e = read("float", "red green blue", "1000000.0").unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains("go up to 1000000"), "{e}");
    }

    #[test]
    fn unread_point_columns_are_noted() {
        let (cloud, notes) = read("float", "alpha intensity label", "1.0").unwrap();
        assert_eq!(cloud.colours, [[0.5; 3]; 2]);
        assert!(notes[0].contains("no colours") && notes[1].contains("alpha, intensity, label"), "{notes:?}");
    }

    #[test]
    fn points_far_from_origin_are_noted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let columns =
            ["x", "y", "z", "red", "green", "blue"].map(|n| format!("property double {n}\n")).concat();
        let rows = "500000.1 4000000.2 3 0 0 0\n500009.1 4000000.2 3 1 1 1\n";
        std::fs::write(
            &path,
            format!("ply\nformat ascii 1.0\nelement vertex 2\n{columns}end_header\n{rows}"),
        )
        .unwrap();
        let (_, notes) = read_points(&path).unwrap();
        assert!(
            notes.len() == 1 && notes[0].contains("4000000") && notes[0].contains("subtract"),
            "{notes:?}"
        );
    }
}
