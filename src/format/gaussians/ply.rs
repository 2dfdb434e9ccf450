//! PLY files: the Gaussian layout that 3DGS viewers expect
//! (docs/method.md#gaussian-ply).
use super::ply_packed;
use super::ply_table::{PropertyType, Table, header, open, table};
use super::usable;
use crate::scene::{LanguageField, LevelField, PointCloud, Splats, sh_coefficients};
use crate::{Error, Result, files};
use std::fmt::Write as _;
use std::path::Path;

/// Reads Gaussians in the INRIA layout, of any SH degree 0–3; unknown columns are skipped. ASCII or binary. Compressed
/// files as SuperSplat writes them are understood, too.
pub fn read_splats(path: &Path) -> Result<Splats> {
    let parse = |bytes: Vec<u8>| {
        if ply_packed::is_packed(&header(&bytes, "vertex")?.columns) {
            return ply_packed::parse(&bytes);
        }
        gaussians(&table(bytes)?)
    };
    parse(files::read(path)?).map_err(|what| Error::input(format!("{}: {what}", path.display())))
}

fn gaussians(t: &Table) -> Result<Splats, String> {
    let need = |missing: String| format!("no column {missing}: this is not a Gaussian splat file");
    let position = t.all(["x", "y", "z"]).map_err(need)?;
    let scale = t.all(["scale_0", "scale_1", "scale_2"]).map_err(need)?;
    let rotation = t.all(["rot_0", "rot_1", "rot_2", "rot_3"]).map_err(need)?;
    let [opacity] = t.all(["opacity"]).map_err(need)?;
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]).map_err(need)?;
    let rest = t.series("f_rest_");
    let sh_degree = (0..=3)
        .find(|&d| 3 * (sh_coefficients(d) - 1) == rest.len())
        .ok_or_else(|| format!("{} f_rest columns fit no SH degree 0–3 (0, 9, 24 or 45)", rest.len()))?;
    let per_channel = rest.len() / 3;
    let mut s = Splats::with_capacity(t.rows, sh_degree);
    for r in 0..t.rows {
        s.means.push(position.map(|c| t.at(r, c)));
        s.log_scales.push(scale.map(|c| t.at(r, c)));
        s.quats.push(rotation.map(|c| t.at(r, c)));
        s.opacity_logits.push(t.at(r, opacity));
        s.sh.extend(dc.map(|c| t.at(r, c)));
        for k in 0..per_channel {
            s.sh.extend([0, 1, 2].map(|channel| t.at(r, rest[channel * per_channel + k])));
        }
    }
    Ok(s)
}

/// Reads positions and colours (`red green blue` of any type, or `f_dc`); confidence 1, radius 0.
pub fn read_points(path: &Path) -> Result<PointCloud> {
    let t = open(path)?;
    let missing = |c| Error::input(format!("{}: no column {c}: this is not a point cloud", path.display()));
    let position = t.all(["x", "y", "z"]).map_err(missing)?;
    let colours = t.all(["red", "green", "blue"]).ok();
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]).ok();
    let mut p = PointCloud::default();
    for r in 0..t.rows {
        p.positions.push(position.map(|c| t.at(r, c)));
        p.colours.push(match (colours, dc) {
            (Some(c), _) => c.map(|c| {
                let full =
                    if matches!(t.columns[c].1, PropertyType::F32 | PropertyType::F64) { 1.0 } else { 255.0 };
                (t.at(r, c) / full).clamp(0.0, 1.0)
            }),
            (None, Some(c)) => c.map(|c| (0.5 + crate::scene::SH_C0 * t.at(r, c)).clamp(0.0, 1.0)),
            (None, None) => [0.5; 3],
        });
    }
    let n = p.positions.len();
    (p.confidence, p.view, p.radius) = (vec![1.0; n], vec![0; n], vec![0.0; n]);
    Ok(p)
}

/// How [`write_splats`] writes.
#[derive(Clone, Copy, Debug)]
pub struct PlyOptions<'a> {
    /// SH degree of the file: higher coefficients are zero, lower degrees cut them. INRIA's own loader asks for 3.
    pub degree: u32,
    /// Adds unit features and code indices per level after all standard columns; viewers skip what they do not know.
    pub language: Option<&'a LanguageField>,
}

impl Default for PlyOptions<'_> {
    fn default() -> Self {
        PlyOptions { degree: 3, language: None }
    }
}

/// Writes Gaussians in the INRIA layout, binary little-endian.
pub fn write_splats(path: &Path, s: &Splats, options: PlyOptions) -> Result<()> {
    use std::io::Write as _;
    usable::check_written(s)?;
    let levels = options.language.map(|l| named_levels(l, s.len())).transpose()?.unwrap_or_default();
    let rest = sh_coefficients(options.degree) - 1;
    let file = std::fs::File::create(path).map_err(Error::unwritable(path))?;
    let mut out = std::io::BufWriter::new(file);
    let mut row: Vec<u8> = Vec::new();
    let mut write = |bytes: &[u8]| out.write_all(bytes).map_err(Error::unwritable(path));
    write(splat_header(s.len(), rest, &levels).as_bytes())?;
    let have = s.sh_len();
    for i in 0..s.len() {
        row.clear();
        let mut push = |v: f32| row.extend_from_slice(&v.to_le_bytes());
        let sh = |k: usize, channel: usize| if k < have { s.sh[(i * have + k) * 3 + channel] } else { 0.0 };
        s.means[i].into_iter().for_each(&mut push);
        [0.0; 3].into_iter().for_each(&mut push);
        (0..3).for_each(|channel| push(sh(0, channel)));
        (0..3).for_each(|channel| (1..=rest).for_each(|k| push(sh(k, channel))));
        push(s.opacity_logits[i]);
        s.log_scales[i].into_iter().for_each(&mut push);
        s.quats[i].into_iter().for_each(&mut push);
        for (_, level) in &levels {
            unit(level, i).into_iter().for_each(&mut push);
        }
        for (_, level) in &levels {
            row.extend_from_slice(&nearest_code(level, i).to_le_bytes());
        }
        write(&row)?;
    }
    out.flush().map_err(Error::unwritable(path))
}

fn named_levels(field: &LanguageField, n: usize) -> Result<Vec<(&'static str, &LevelField)>> {
    let levels: Vec<_> = crate::scene::LEVEL_NAMES
        .into_iter()
        .zip(&field.levels)
        .filter(|(_, l)| !l.codebook.is_empty())
        .collect();
    match levels.iter().find(|(_, l)| l.features.len() != n * l.codebook.code_dim) {
        Some((name, _)) => {
            Err(Error::work(format!("level {name} has features for another number of splats")))
        }
        None => Ok(levels),
    }
}

fn splat_header(n: usize, rest: usize, levels: &[(&str, &LevelField)]) -> String {
    let mut h = String::from("ply\nformat binary_little_endian 1.0\n");
    if let Some((_, first)) = levels.first() {
        let names = levels.iter().map(|l| l.0).collect::<Vec<_>>().join(",");
        let d = first.codebook.code_dim;
        // Writing to a String cannot fail.
        let _ = writeln!(
            h,
            "comment splatvk features d={d} levels={names} codebook=language/codebook_<level>.npz"
        );
    }
    let _ = writeln!(h, "element vertex {n}");
    let names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into_iter();
    let names = names
        .chain((0..3 * rest).map(|k| format!("f_rest_{k}")))
        .chain(
            ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
                .map(String::from),
        )
        .chain(
            levels.iter().flat_map(|(l, f)| (0..f.codebook.code_dim).map(move |k| format!("lang_{l}_{k}"))),
        );
    names.for_each(|name| {
        let _ = writeln!(h, "property float {name}");
    });
    levels.iter().for_each(|(l, _)| {
        let _ = writeln!(h, "property int code_{l}");
    });
    h.push_str("end_header\n");
    h
}

/// The unit feature of splat i; zero where the raw feature is zero.
fn unit(level: &LevelField, i: usize) -> Vec<f32> {
    let d = level.codebook.code_dim;
    let raw = &level.features[i * d..(i + 1) * d];
    let norm = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
    raw.iter().map(|v| if norm > 0.0 { v / norm } else { 0.0 }).collect()
}

/// Index of the code nearest to the feature of splat i; −1 without a feature.
fn nearest_code(level: &LevelField, i: usize) -> i32 {
    let feature = unit(level, i);
    if feature.iter().all(|v| *v == 0.0) {
        return -1;
    }
    level.codebook.decode(&feature).map_or(-1, |k| k as i32)
}

/// Writes a coloured point cloud as other tools expect it: `x y z nx ny nz` float, `red green blue` uchar.
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
