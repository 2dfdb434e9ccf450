//! PLY files: the Gaussian layout that 3DGS viewers expect
//! (docs/internals/method.md#gaussian-ply).
use super::degree::sh_degree;
use super::ply_header::header;
use super::ply_points::Colours;
pub use super::ply_points::{read_points, write_points};
use super::ply_table::{Table, table};
use super::usable;
use super::{ply_comments, ply_packed};
use crate::scene::{LanguageField, LevelField, SH_C0, Splats, sh_coefficients};
use crate::{Error, Result, files};
use std::fmt::Write as _;
use std::path::Path;

/// Reads Gaussians in the INRIA layout, of SH degree 0–3 (of degree 4 without band 4), and similar
/// layouts of other programs; notes name parts that are not read, a line each. ASCII or binary.
/// Compressed files of SuperSplat are supported, too.
pub fn read_noted(path: &Path, notes: &mut Vec<String>) -> Result<Splats> {
    let mut parse = |bytes: Vec<u8>| {
        if ply_packed::is_packed(&header(&bytes, "vertex")?.columns) {
            return ply_packed::parse(&bytes, notes);
        }
        gaussians(&table(bytes)?, notes)
    };
    parse(files::read(path)?).map_err(|what| Error::input(format!("{}: {what}", path.display())))
}

/// Like [`read_noted`], for a file of this program.
pub fn read_splats(path: &Path) -> Result<Splats> {
    read_noted(path, &mut Vec::new())
}

fn gaussians(t: &Table, notes: &mut Vec<String>) -> Result<Splats, String> {
    let no_column = |missing: String| {
        let has = files::listed(&t.names());
        format!("no column {missing}: this is not a Gaussian splat file of the INRIA layout; it has {has}")
    };
    let position = t.all(["x", "y", "z"]).map_err(no_column)?;
    let [opacity] = t.all(["opacity"]).map_err(no_column)?;
    let scale = scales(t, notes).map_err(no_column)?;
    let rotation = t.all(["rot_0", "rot_1", "rot_2", "rot_3"]).map_err(no_column)?;
    let dc = t.all(["f_dc_0", "f_dc_1", "f_dc_2"]);
    // nerfstudio optionally writes colours in place of the coefficients.
    let colours = if dc.is_err() { Colours::of(t, notes)? } else { None };
    if let (Err(missing), None) = (&dc, &colours) {
        return Err(no_column(missing.clone()));
    }
    let rest = t.series("f_rest_")?;
    let (degree, stored) = sh_degree(rest.len(), notes)?;
    let filter = t.column(FILTER);
    if filter.is_some() && scale.len() < 3 {
        return Err(format!(
            "a column {FILTER} and no scale_2: no program is known that writes both; remove one"
        ));
    }
    let mut s = Splats::with_capacity(t.rows, degree);
    for r in 0..t.rows {
        s.means.push(position.map(|c| t.at(r, c)));
        s.log_scales.push([0, 1, 2].map(|k| scale.get(k).map_or(f32::NEG_INFINITY, |c| t.at(r, *c))));
        s.quats.push(rotation.map(|c| t.at(r, c)));
        s.opacity_logits.push(t.at(r, opacity));
        match (&dc, &colours) {
            (Err(_), Some(c)) => s.sh.extend(c.at(t, r).map(|v| (v - 0.5) / SH_C0)),
            _ => s.sh.extend(dc.iter().flatten().map(|c| t.at(r, *c))),
        }
        for k in 0..s.sh_len() - 1 {
            s.sh.extend([0, 1, 2].map(|channel| t.at(r, rest[channel * stored + k])));
        }
        if let Some(filter) = filter {
            fold(&mut s.log_scales[r], &mut s.opacity_logits[r], t.at(r, filter));
        }
    }
    notes.extend(ply_comments::places(&t.comments));
    s.antialiased = ply_comments::antialiased(&t.comments, notes)?;
    if filter.is_some() {
        // Mip-Splatting renders with both of its filters.
        s.antialiased = true;
        notes.push(format!(
            "the 3-D filter of Mip-Splatting ({FILTER}) is worked into scales and opacities; its screen filter of 0.1 px² is \
             drawn as one of 0.3 px²"
        ));
    }
    let rest = rest.iter().map(|c| t.columns[*c].0.as_str());
    let base = colours.map_or(["f_dc_0", "f_dc_1", "f_dc_2"], |c| c.names(t));
    notes.extend(t.unread(&COLUMNS.into_iter().chain(base).chain(rest).collect::<Vec<_>>()));
    Ok(s)
}

/// Columns that are read, except those of the colours.
const COLUMNS: [&str; 12] =
    ["x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", FILTER];

/// Columns of the scales: three, or two of 2-D Gaussians (Huang et al. 2024), whose third scale is
/// 0.
fn scales(t: &Table, notes: &mut Vec<String>) -> Result<Vec<usize>, String> {
    if let ([_, _], None) = (t.all(["scale_0", "scale_1"])?, t.column("scale_2")) {
        notes.push(
            "no column scale_2: read as flat Gaussians (2DGS), of standard deviation 0 along the third axis"
                .into(),
        );
        return t.all(["scale_0", "scale_1"]).map(Vec::from);
    }
    t.all(["scale_0", "scale_1", "scale_2"]).map(Vec::from)
}

/// Column of the 3-D smoothing filter of Mip-Splatting: a standard deviation per Gaussian.
const FILTER: &str = "filter_3D";

/// Folds a 3-D filter of standard deviation f into a Gaussian (Yu et al. 2024, eq. 9): s' = √(s² +
/// f²), o' = o ∏ s / s'.
fn fold(log_scales: &mut [f32; 3], logit: &mut f32, filter: f32) {
    let (mut log_ratio, variance) = (0.0, f64::from(filter).powi(2));
    for log_scale in log_scales {
        let s = f64::from(*log_scale).exp();
        let widened = 0.5 * (s * s + variance).ln();
        log_ratio += f64::from(*log_scale) - widened;
        *log_scale = widened as f32;
    }
    let opacity = log_ratio.exp() / (1.0 + (-f64::from(*logit)).exp());
    *logit = crate::format::logit(opacity as f32);
}

/// Options of [`write_splats`].
#[derive(Clone, Copy, Debug)]
pub struct PlyOptions<'a> {
    /// SH degree of the file: missing coefficients are zero, coefficients above it are cut. INRIA's
    /// own loader requires 3.
    pub degree: u32,
    /// Appends unit features and code indices per level after all standard columns; viewers skip
    /// unknown columns.
    pub language: Option<&'a LanguageField>,
    /// Appends the property `int object`: the number of the thing of every splat, 0 = none.
    pub objects: Option<&'a [u32]>,
}

impl Default for PlyOptions<'_> {
    fn default() -> Self {
        PlyOptions { degree: 3, language: None, objects: None }
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
    if options.objects.is_some_and(|objects| objects.len() != s.len()) {
        return Err(Error::work("numbers of things for another number of splats"));
    }
    write(splat_header(s, rest, &levels, options.objects.is_some()).as_bytes())?;
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
        if let Some(objects) = options.objects {
            row.extend_from_slice(&objects[i].to_le_bytes());
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

fn splat_header(s: &Splats, rest: usize, levels: &[(&str, &LevelField)], objects: bool) -> String {
    let mut h = String::from("ply\nformat binary_little_endian 1.0\n");
    if s.antialiased {
        h.push_str(ply_comments::MIP);
    }
    if let Some((_, first)) = levels.first() {
        let names = levels.iter().map(|l| l.0).collect::<Vec<_>>().join(",");
        let d = first.codebook.code_dim;
        // Writing to a String cannot fail.
        let _ = writeln!(
            h,
            "comment splatvk features d={d} levels={names} codebook=language/codebook_<level>.npz"
        );
    }
    let _ = writeln!(h, "element vertex {}", s.len());
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
    if objects {
        h.push_str("property int object\n");
    }
    h.push_str("end_header\n");
    h
}

/// Unit feature of splat i; zero where the raw feature is zero.
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A text file of one Gaussian with these columns, all 0.5 except the last one, which is
    /// `last`.
    fn read(comments: &str, columns: &str, last: f32) -> Result<(Splats, Vec<String>)> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        let names: Vec<&str> = columns.split(' ').collect();
        let properties: String = names.iter().map(|n| format!("property float {n}\n")).collect();
        let values = "0.5 ".repeat(names.len() - 1);
        let text = format!(
            "ply\nformat ascii 1.0\n{comments}element vertex 1\n{properties}end_header\n{values}{last}\n"
        );
        std::fs::write(&path, text).unwrap();
        let mut notes = Vec::new();
        read_noted(&path, &mut notes).map(|s| (s, notes))
    }

    const FLAT: &str = "x y z f_dc_0 f_dc_1 f_dc_2 opacity rot_0 rot_1 rot_2 rot_3 scale_0 scale_1";

    fn with(columns: &str) -> String {
        format!("{FLAT} scale_2 {columns}").trim_end().to_owned()
    }

    #[test]
    fn flat_gaussians_are_read_with_note() {
        let (s, notes) = read("", FLAT, 0.25).unwrap();
        assert_eq!(s.log_scales[0], [0.5, 0.25, f32::NEG_INFINITY]);
        assert!(notes.len() == 1 && notes[0].contains("standard deviation 0"), "{notes:?}");
        let (s, notes) = read("comment SplatRenderMode: default\n", &with(""), 0.25).unwrap();
        assert!(s.log_scales[0] == [0.5, 0.5, 0.25] && !s.antialiased && notes.is_empty(), "{notes:?}");
    }

    #[test]
    fn antialiased_comment_survives_reading_and_writing() {
        let (s, notes) = read("comment antialiased 1\n", &with(""), 0.25).unwrap();
        assert!(s.antialiased && notes.is_empty());
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.ply", "b.compressed.ply", "c.spz"] {
            let path = folder.path().join(name);
            crate::format::gaussians::write(&path, &s, None).unwrap();
            let (back, _, notes) = crate::format::gaussians::read_noted(&path).unwrap();
            assert!(back.antialiased && notes.is_empty(), "{name}: {notes:?}");
        }
    }

    /// Yu et al. 2024, equation 9, by hand: s² = e, f² = 3.
    #[test]
    fn mip_splatting_filter_is_worked_in() {
        let (s, notes) = read("", &with("filter_3D"), 3f32.sqrt()).unwrap();
        let widened = 0.5 * (1f32.exp() + 3.0).ln();
        assert!((s.log_scales[0][0] - widened).abs() < 1e-6, "{:?}", s.log_scales);
        let ratio = (3.0 * (0.5 - widened)).exp();
        let opacity = 1.0 / (1.0 + (-s.opacity_logits[0]).exp());
        assert!((opacity - ratio / (1.0 + (-0.5f32).exp())).abs() < 1e-6);
        assert!(s.antialiased && notes.iter().any(|n| n.contains("0.1 px²")), "{notes:?}");
    }

    #[test]
    fn other_sh_degrees_are_named() {
        let rest = |n: usize| (0..n).map(|k| format!("f_rest_{k}")).collect::<Vec<_>>().join(" ");
        let (s, notes) = read("", &with(&rest(72)), 9.0).unwrap();
        assert_eq!((s.sh_degree, s.sh.len(), s.sh.contains(&9.0)), (3, 48, false));
        assert!(notes.len() == 1 && notes[0].contains("band 4"), "{notes:?}");
        for (columns, words) in [(rest(10), "10 f_rest columns"), (rest(9) + " f_rest_10", "gap at f_rest_9")]
        {
            let e = read("", &with(&columns), 1.0).unwrap_err().to_string();
            assert!(e.contains(words), "{e}");
        }
    }

    #[test]
    fn unread_columns_are_noted() {
        let (_, notes) = read("comment Vertical Axis: z\n", &with("nx semantic_0 label"), 1.0).unwrap();
        assert!(notes.iter().any(|n| n.ends_with("not read: columns semantic_0, label")), "{notes:?}");
        assert!(notes.iter().any(|n| n.contains("Vertical Axis: z")) && notes.len() == 2, "{notes:?}");
        let renamed = FLAT.replace("opacity", "opacities");
        let e = read("", &renamed, 1.0).unwrap_err().to_string();
        assert!(e.contains("no column opacity") && e.contains("opacities"), "{e}");
        let coloured = with("").replace("f_dc_0 f_dc_1 f_dc_2", "red green blue");
        let (s, _) = read("", &coloured, 1.0).unwrap();
        assert_eq!(s.sh, [0.0; 3]);
    }
}
