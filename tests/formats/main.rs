//! File formats: round trips, files of other programs, and one-line errors for damaged files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod camera_files;

use glam::{DQuat, DVec3};
use splatvk::format::npy::{self, NpyArray};
use splatvk::format::{colmap, gaussians, ply, ply_packed, scene_dir, side_file, sog, splat};
use splatvk::photo::{self, stem};
use splatvk::scene::{
    Camera, Codebook, LanguageField, LevelField, MaskId, Pose, Seen, Splats, Up, UpEvidence, World,
};
use std::path::{Path, PathBuf};

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// Numbers in (−1, 1) from a hash: every value differs, so that exchanged columns are detected.
fn noise(i: usize) -> f32 {
    let h = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    ((h >> 40) as f32 / (1u64 << 23) as f32) - 1.0
}

fn splats(n: usize, sh_degree: u32) -> Splats {
    let mut next = 0;
    let mut value = || {
        next += 1;
        noise(next)
    };
    let mut s = Splats { sh_degree, ..Splats::default() };
    for _ in 0..n {
        s.means.push([value(), value(), value()]);
        s.log_scales.push([value(), value(), value()]);
        s.quats.push([value(), value(), value(), value()]);
        s.opacity_logits.push(value());
        s.sh.extend((0..s.sh_len() * 3).map(|_| value()));
    }
    s
}

fn some_cameras() -> Vec<Camera> {
    (0..3)
        .map(|i| Camera {
            name: format!("photo {i}.jpg"),
            width: 640 + i,
            height: 480,
            fx: 611.123456789012 + i as f64,
            fy: 612.0 / 7.0,
            cx: 320.1,
            cy: 239.7 - i as f64,
            pose: Pose {
                rotation: glam::DMat3::from_quat(
                    DQuat::from_xyzw(0.1, 0.2 * i as f64, -0.4, 0.8 - 0.9 * i as f64).normalize(),
                ),
                translation: DVec3::new(0.1, -2.0 / 3.0, 1e3 * i as f64),
            },
        })
        .collect()
}

#[test]
fn gaussian_ply_round_trips() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    for degree in 0..=3 {
        let s = splats(7, degree);
        ply::write_splats(&path, &s, ply::PlyOptions { degree, ..ply::PlyOptions::default() }).unwrap();
        assert_eq!(ply::read_splats(&path).unwrap(), s);
        // Padded to degree 3, as most viewers expect: the added coefficients are zero.
        ply::write_splats(&path, &s, ply::PlyOptions::default()).unwrap();
        let padded = ply::read_splats(&path).unwrap();
        assert_eq!((padded.sh_degree, &padded.means, &padded.quats), (3, &s.means, &s.quats));
        for i in 0..7 {
            let (row, own) =
                (&padded.sh[i * 48..(i + 1) * 48], &s.sh[i * s.sh_len() * 3..(i + 1) * s.sh_len() * 3]);
            assert_eq!(&row[..own.len()], own);
            assert!(row[own.len()..].iter().all(|v| *v == 0.0));
        }
    }
    ply::write_splats(&path, &splats(0, 0), ply::PlyOptions::default()).unwrap();
    assert!(ply::read_splats(&path).unwrap().is_empty());
}

#[test]
fn ply_fields_follow_format_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let s = splats(2, 1);
    ply::write_splats(
        &path,
        &s,
        ply::PlyOptions { degree: 1, language: Some(&field(2)), ..ply::PlyOptions::default() },
    )
    .unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let names: Vec<&str> =
        header.lines().filter(|l| l.starts_with("property")).map(|l| l.rsplit(' ').next().unwrap()).collect();
    let expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 \
                    f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 lang_s_0 lang_s_1 lang_l_0 \
                    lang_l_1 code_s code_l";
    assert_eq!(names.join(" "), expected);
    let row = |i: usize| {
        let start = end + i * names.len() * 4;
        bytes[start..start + names.len() * 4]
            .chunks(4)
            .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
            .collect::<Vec<_>>()
    };
    // Channel-major rest: R of coefficients 1–3, then G, then B; in memory they are interleaved.
    let sh = &s.sh[12..24];
    assert_eq!(row(1)[9..18], [sh[3], sh[6], sh[9], sh[4], sh[7], sh[10], sh[5], sh[8], sh[11]]);
    assert_eq!(row(1)[18], s.opacity_logits[1]);
    assert_eq!(row(1)[22..26], s.quats[1]);
    assert_eq!(row(0)[26..28], [0.6, 0.8], "features are written as unit vectors");
    assert_eq!((row(0)[30].to_bits(), row(1)[30].to_bits()), (1, 0), "nearest code");
    assert_eq!(row(1)[31].to_bits() as i32, -1, "a splat without feature has no code");
}

/// Levels s and l of two splats, m empty.
fn field(n: usize) -> LanguageField {
    let book = Codebook {
        embedding_dim: 3,
        code_dim: 2,
        embeddings: vec![1.0, 0.0, 0.0, 0.0, 0.6, 0.8],
        codes: vec![1.0, 0.0, 0.0, 1.0],
        weights: vec![12.0, 3.5],
        members: vec![vec![MaskId::new(0, 4), MaskId::new(2, 1)], vec![]],
        min_chord: 2f32.sqrt(),
    };
    let mut features = vec![0.0; n * 2];
    features[..4].copy_from_slice(&[3.0, 4.0, 2.0, 0.5]);
    let s = LevelField { codebook: book.clone(), features: features.clone(), ..LevelField::default() };
    features[2..4].fill(0.0);
    let l = LevelField { codebook: book, features, ..LevelField::default() };
    LanguageField { levels: vec![s, LevelField::default(), l], space: "test/space".into() }
}

#[test]
fn ply_of_other_programs_is_read() {
    // Written by trimesh, kept in the brush repository: 100 coloured points, no Gaussians.
    let points = ply::read_points(&data("formats/brush_init.ply")).unwrap().0;
    assert!(
        points.len() == 100 && points.positions.iter().flatten().all(|v| v.is_finite() && v.abs() < 10.0)
    );
    let e = ply::read_splats(&data("formats/brush_init.ply")).unwrap_err().to_string();
    assert!(e.contains("not a Gaussian splat file"), "{e}");
    // An ASCII cloud with columns in another order, of other types, and an element before the
    // vertices.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("points.ply");
    let text = "ply\nformat ascii 1.0\ncomment x\nelement camera 1\nproperty float f\nelement vertex 2\nproperty uchar red\n\
                property uchar green\nproperty uchar blue\nproperty double x\nproperty float y\nproperty float z\nelement face 0\n\
                property list uchar int vertex_indices\nend_header\n9\n255 0 51 1.5 2 3\n0 0 0 -1 -2 -3\n";
    std::fs::write(&path, text).unwrap();
    let (p, notes) = ply::read_points(&path).unwrap();
    assert!(notes.len() == 1 && notes[0].contains("elements camera"), "{notes:?}");
    assert_eq!(
        (p.positions.as_slice(), p.colours[0]),
        (&[[1.5, 2.0, 3.0], [-1.0, -2.0, -3.0]][..], [1.0, 0.0, 0.2])
    );
    // Big-endian.
    let header = "ply\nformat binary_big_endian 1.0\nelement vertex 1\nproperty double x\nproperty float y\n\
                  property short z\nend_header\n";
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend(1.5f64.to_be_bytes().into_iter().chain((-2f32).to_be_bytes()).chain(300i16.to_be_bytes()));
    std::fs::write(&path, bytes).unwrap();
    assert_eq!(ply::read_points(&path).unwrap().0.positions, [[1.5, -2.0, 300.0]]);
}

#[test]
fn damaged_ply_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    ply::write_splats(&path, &splats(3, 0), ply::PlyOptions::default()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for cut in (0..whole.len()).step_by(37) {
        std::fs::write(&path, &whole[..cut]).unwrap();
        let e = ply::read_splats(&path).unwrap_err();
        assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "cut at {cut}: {e}");
    }
    let liar = String::from_utf8_lossy(&whole).replace("vertex 3", "vertex 99999999999999");
    std::fs::write(&path, liar.as_bytes()).unwrap();
    assert_eq!(
        ply::read_splats(&path).unwrap_err().exit_code(),
        2,
        "no memory is taken on the word of a header"
    );
    std::fs::write(&path, "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
        .unwrap();
    assert!(ply::read_splats(&path).unwrap_err().to_string().contains("no column y"));
}

#[test]
fn splat_file_has_documented_layout() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.splat");
    let mut s = splats(2, 1);
    (s.opacity_logits[0], s.opacity_logits[1]) = (-5.0, 0.0);
    s.quats[1] = [2.0, 0.0, -2.0, 0.0];
    splat::write_splats(&path, &s).unwrap();
    let b = std::fs::read(&path).unwrap();
    assert_eq!(b.len(), 64);
    let f = |k: usize| f32::from_le_bytes(b[4 * k..4 * k + 4].try_into().unwrap());
    assert_eq!([f(0), f(1), f(2)], s.means[1], "the more visible splat comes first");
    assert_eq!(f(4), s.log_scales[1][1].exp());
    assert_eq!((b[24], b[27]), (((0.5 + 0.2820948 * s.sh[12]) * 255.0).round() as u8, 128));
    assert_eq!(b[28..32], [219, 128, 37, 128]);
}

/// Largest differences of two scenes: positions, log scales, rotations (1 − |q·q'|), opacities, SH.
fn differences(a: &Splats, b: &Splats) -> [f32; 5] {
    let turn = a.quats.iter().zip(&b.quats).fold(0f32, |m, (p, q)| {
        m.max(1.0 - normalised(p).iter().zip(normalised(q)).map(|(x, y)| x * y).sum::<f32>().abs())
    });
    [
        max_difference(a.means.as_flattened(), b.means.as_flattened()),
        max_difference(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
        turn,
        max_difference(&opacities(a), &opacities(b)),
        max_difference(&a.sh, &b.sh),
    ]
}

fn opacities(s: &Splats) -> Vec<f32> {
    s.opacity_logits.iter().map(|v| 1.0 / (1.0 + (-v).exp())).collect::<Vec<_>>()
}

fn normalised(q: &[f32; 4]) -> [f32; 4] {
    q.map(|v| v / q.iter().map(|v| v * v).sum::<f32>().sqrt())
}

fn max_difference(x: &[f32], y: &[f32]) -> f32 {
    assert_eq!(x.len(), y.len());
    x.iter().zip(y).fold(0f32, |m, (x, y)| m.max((x - y).abs()))
}

/// Half a step of each format (positions and scales of the packed PLY: of 10 bits over the range −1
/// to 1 of the noise).
#[test]
fn packed_formats_round_trip_within_precision() {
    let folder = tempfile::tempdir().unwrap();
    for degree in 0..=3 {
        let mut s = splats(700, degree);
        // The palette of a .sog has room for fifty rows of SH, not for 700.
        let width = 3 * s.sh_len();
        for i in 50..700 {
            let row = s.sh[i % 50 * width + 3..][..width - 3].to_vec();
            s.sh[i * width + 3..][..width - 3].copy_from_slice(&row);
        }
        let language = field(700);
        for (name, bounds) in [
            ("a.spz", [1e-6, 0.0313, 1e-5, 0.002, 0.0132]),
            ("a.compressed.ply", [1e-3, 1e-3, 1e-5, 0.002, 0.0158]),
            ("a.sog", [2.2e-5, 0.006, 4e-5, 0.002, 0.006]),
        ] {
            let path = folder.path().join(name);
            gaussians::write(&path, &s, Some(&language)).unwrap();
            let (back, field) = gaussians::read(&path).unwrap();
            // Row r of a compressed PLY or a .sog is splat order[r].
            let order = match name {
                "a.spz" => (0..700).collect(),
                "a.sog" => sog::write_splats(&folder.path().join("order.sog"), &s).unwrap(),
                _ => ply_packed::write_splats(&folder.path().join("order.ply"), &s).unwrap(),
            };
            let rows: Vec<usize> =
                (0..700).map(|j| order.iter().position(|i| *i == j as u32).unwrap()).collect();
            // The language follows the order of the splats: the two with features are 0 and 1.
            let features = &field.unwrap().levels[0].features;
            assert_eq!(features[2 * rows[0]..2 * rows[0] + 2], [3.0, 4.0], "{name}");
            assert_eq!(features[2 * rows[1]..2 * rows[1] + 2], [2.0, 0.5], "{name}");
            let pick = |v: &[f32], w: usize| {
                rows.iter().flat_map(|r| v[r * w..(r + 1) * w].to_vec()).collect::<Vec<_>>()
            };
            let back = Splats {
                means: rows.iter().map(|r| back.means[*r]).collect(),
                log_scales: rows.iter().map(|r| back.log_scales[*r]).collect(),
                quats: rows.iter().map(|r| back.quats[*r]).collect(),
                opacity_logits: pick(&back.opacity_logits, 1),
                sh: pick(&back.sh, 3 * back.sh_len()),
                sh_degree: back.sh_degree,
                antialiased: false,
            };
            for (k, (got, bound)) in differences(&back, &s).iter().zip(bounds).enumerate() {
                assert!(got <= &bound, "{name} degree {degree}, quantity {k}: {got} > {bound}");
            }
        }
    }
}

#[test]
fn splat_transform_files_are_read() {
    // Four Gaussians at the corners of a square in x and z. splat-transform (MIT, see the licence
    // there) wrote .splat and versions 3 and 4 from one scene; the version 2 files contain the same
    // bytes, made by hand without the rotation of the axes.
    let corners = [[-1.0, 0.0, -1.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]];
    let plain = gaussians::read(&data("formats/minimal.splat")).unwrap().0;
    assert_eq!(plain.means, corners);
    assert!(plain.log_scales.as_flattened().iter().all(|s| (s - 0.1f32.ln()).abs() < 1e-6));
    for version in ["raw", "v2", "v3", "v4"] {
        let s = gaussians::read(&data(&format!("formats/minimal-{version}.spz"))).unwrap().0;
        assert_eq!((s.len(), s.sh_degree), (4, 0), "{version}");
        let by_hand = matches!(version, "raw" | "v2");
        let turn = if by_hand { -1.0 } else { 1.0 };
        let means: Vec<[f32; 3]> = s.means.iter().map(|m| [m[0], turn * m[1], turn * m[2]]).collect();
        assert_eq!(means, corners, "{version}");
        // The same byte is another colour in the two formats.
        let slope = if by_hand { 0.282_094_8 / 0.15 } else { 1.0 };
        for i in 0..4 {
            assert!((1.0 / (1.0 + (-s.opacity_logits[i]).exp()) - 0.9).abs() < 0.004, "{version}");
            for k in 0..3 {
                // Half a step: 1/76 of an SH coefficient, 1/32 of a log scale.
                let colour = slope * plain.sh[3 * i + k];
                assert!((s.sh[3 * i + k] - colour).abs() < 0.0132, "{version}: colour {i} {k}");
                assert!((s.log_scales[i][k] - 0.1f32.ln()).abs() < 0.0313, "{version}");
            }
            assert!(s.quats[i][0] > 0.9999, "{version}: no rotation");
        }
    }
}

/// splat-transform 2.7.1 wrote `splats(24, 2)` with a palette of 16 rows, so that eight or more
/// Gaussians have one of their own.
#[test]
fn sog_of_splat_transform_is_read() {
    let minimal = gaussians::read(&data("formats/minimal.sog")).unwrap().0;
    let plain = gaussians::read(&data("formats/minimal.splat")).unwrap().0;
    assert!(minimal.len() == 4 && minimal.sh_degree == 0);
    assert!(plain.means.iter().all(|m| minimal.means.iter().any(|n| max_difference(m, n) < 3e-5)));

    let (back, _, notes) = gaussians::read_noted(&data("formats/sh2.sog")).unwrap();
    let s = splats(24, 2);
    assert!(back.len() == 24 && back.sh_degree == 2 && notes.is_empty(), "{notes:?}");
    let nearest = |m: &[f32; 3]| {
        let away = |i: &usize| max_difference(&back.means[*i], m);
        (0..24).min_by(|a, b| away(a).total_cmp(&away(b))).unwrap()
    };
    let rows: Vec<usize> = s.means.iter().map(nearest).collect();
    let back = back.picked(&rows);
    let base = |s: &Splats| s.sh.chunks(27).flat_map(|row| row[..3].to_vec()).collect::<Vec<_>>();
    let [means, scales, rotations, opacities, _] = differences(&back, &s);
    // It rounds down where this program rounds: a whole step instead of half of one.
    assert!(
        means < 5e-5 && scales < 0.01 && rotations < 2e-4 && opacities < 0.004,
        "{:?}",
        differences(&back, &s)
    );
    assert!(max_difference(&base(&back), &base(&s)) < 0.01);
    let own = |i: &usize| max_difference(&back.sh[27 * i + 3..][..24], &s.sh[27 * i + 3..][..24]) < 0.01;
    assert!((0..24).filter(own).count() >= 8, "{}", (0..24).filter(own).count());

    // Unpacked files in a folder, and refused ones.
    let folder = tempfile::tempdir().unwrap();
    let file = std::fs::File::open(data("formats/sh2.sog")).unwrap();
    zip::ZipArchive::new(file).unwrap().extract(folder.path()).unwrap();
    let meta = folder.path().join("meta.json");
    assert_eq!(gaussians::read(&meta).unwrap().0.picked(&rows), back);
    let text = std::fs::read_to_string(&meta).unwrap();
    for (from, to, words) in [
        ("\"version\":2", "\"version\":3", "version 3 of SOG is not known"),
        ("\"version\":2,", "", "first version of SOG"),
        ("\"count\":24", "\"count\":25000", "pixels for 25000"),
        ("\"count\":24", "\"count\":99999999999", "far more than"),
        ("means_l.webp", "../means_l.webp", "outside of its folder"),
        ("scales.webp", "absent.webp", "absent.webp"),
        ("\"bands\":2", "\"bands\":1", "not 192 pixels wide"),
    ] {
        assert!(text.contains(from), "{from}");
        std::fs::write(&meta, text.replacen(from, to, 1)).unwrap();
        let e = gaussians::read(&meta).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains(words), "{from} to {to}: {e}");
    }
}

#[test]
fn damaged_packed_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let s = splats(300, 1);
    for name in ["a.spz", "a.compressed.ply", "a.splat", "a.sog"] {
        let path = folder.path().join(name);
        gaussians::write(&path, &s, None).unwrap();
        let whole = std::fs::read(&path).unwrap();
        for cut in (0..whole.len()).step_by(97).skip(1) {
            // A .splat file cut between two rows is a valid file of fewer Gaussians.
            if name == "a.splat" && cut % 32 == 0 {
                continue;
            }
            std::fs::write(&path, &whole[..cut]).unwrap();
            let e = gaussians::read(&path).err().unwrap_or_else(|| panic!("{name} cut at {cut} is read"));
            assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "{name} cut at {cut}: {e}");
        }
    }
    for version in ["v2", "v3", "v4", "raw"] {
        let whole = std::fs::read(data(&format!("formats/minimal-{version}.spz"))).unwrap();
        let path = folder.path().join("b.spz");
        for cut in 0..whole.len() {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let e = gaussians::read(&path).err().unwrap_or_else(|| panic!("{version} cut at {cut} is read"));
            assert_eq!(e.exit_code(), 2, "{version} cut at {cut}");
        }
    }
    assert_eq!(gaussians::read(Path::new("scene.xyz")).unwrap_err().exit_code(), 2);
}

#[test]
fn language_of_another_file_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    gaussians::write(&path, &splats(5, 0), Some(&field(5))).unwrap();
    gaussians::write(&folder.path().join("b.spz"), &splats(6, 0), None).unwrap();
    std::fs::rename(side_file::path(&path), folder.path().join("b.spz.language.npz")).unwrap();
    let e = gaussians::read(&folder.path().join("b.spz")).unwrap_err();
    assert!(e.exit_code() == 2 && e.to_string().contains("another file"), "{e}");
    assert!(gaussians::read(&path).unwrap().1.is_none());
}

#[test]
fn scene_directory_round_trips() {
    let folder = tempfile::tempdir().unwrap();
    let three = [0, 1, 2].map(|i| data(&format!("breakfast/images/train_{i:02}.jpg")));
    let photos = photo::load_all(&three, &splatvk::progress::Silent).unwrap();
    let (s, cams, mut language) = (splats(5, 2), some_cameras(), field(5));
    // One level as mixes of its codes, as after training, and one as plain features.
    let raw = std::mem::take(&mut language.levels[0].features);
    language.levels[0].set_features(raw);
    language.levels[0].reliability = [0u8, 255, 128, 3, 77].map(|r| f32::from(r) / 255.0).to_vec();
    assert_eq!(language.levels[0].mixes.len(), 5);
    let seen = Seen { pixels: vec![0.0, 1.0, 2.5, 0.01, 7.0] };
    let up = Up {
        // Halves and quarters survive JSON exactly.
        direction: glam::DVec3::new(0.5, -0.75, 0.25),
        sigma_degrees: 0.7,
        evidence: vec![UpEvidence::VerticalEdges],
    };
    let world = World { up: Some(up), scale: None };
    let contents = scene_dir::Contents {
        splats: &s,
        seen: &seen,
        backdrop: &Default::default(),
        holes: &Default::default(),
        cameras: &cams,
        world: &world,
        photos: &photos,
        points: None,
        language: Some(&language),
        text_embeddings: None,
    };
    scene_dir::write(folder.path(), &contents).unwrap();
    let scene = scene_dir::load(folder.path()).unwrap();
    assert_eq!(scene.splats, s, "with its own SH degree, though the PLY is padded to 3");
    assert_eq!(scene.language.as_ref(), Some(&language));
    assert_eq!((&scene.seen, scene.seen.unseen()), (&seen, 2));
    assert_eq!(scene.world, world);
    let stems: Vec<_> = scene.cameras.iter().map(|c| stem(&c.name)).collect();
    assert_eq!(stems, photos.iter().map(|p| p.stem.clone()).collect::<Vec<_>>());
    assert!((scene.cameras[2].pose.centre() - cams[2].pose.centre()).length() < 1e-6);
    assert_eq!(colmap::read(&folder.path().join("cameras/colmap")).unwrap().len(), 3);
    let kept = photo::load(&folder.path().join("cameras/images/train_00.png")).unwrap();
    assert_eq!(kept.image, photos[0].image, "8-bit photos survive unchanged");

    let features = folder.path().join("language/features.npz");
    let arrays = npy::read_npz(&features).unwrap();
    let load_with = |name: &str, array: &NpyArray| {
        let own = arrays.iter().filter(|(n, _)| n.as_str() != name).map(|(n, a)| (n.as_str(), a));
        npy::write_npz(&features, &own.chain([(name, array)]).collect::<Vec<_>>()).unwrap();
        scene_dir::load(folder.path())
    };
    let e = load_with("first_s", &NpyArray::u8(&[5], vec![0, 1, 7, 0, 0])).unwrap_err().to_string();
    assert!(e.contains("names codes that its codebook of 2 lacks"), "{e}");
    let e = load_with("share_s", &NpyArray::u8(&[4], vec![0; 4])).unwrap_err().to_string();
    assert!(e.contains("share_s has the shape [4] for 5 splats"), "{e}");
    // Version 1: plain features under the name of the level.
    let plain = |l: usize| NpyArray::f32(&[5, 2], language.levels[l].features.clone());
    npy::write_npz(&features, &[("s", &plain(0)), ("l", &plain(2))]).unwrap();
    let old = scene_dir::load(folder.path()).unwrap().language.unwrap();
    assert_eq!(old.levels[0].features, language.levels[0].features);
    assert!(old.levels[0].mixes.is_empty() && old.levels[0].reliability.is_empty());

    let bare = scene_dir::load(&folder.path().join("point_cloud.ply")).unwrap();
    assert_eq!(bare.world, World::default());
    assert!(bare.language.is_none() && bare.cameras.is_empty() && bare.splats.len() == 5);
    assert!(bare.seen.pixels.is_empty(), "what is not known is not guessed");
    npy::write(folder.path().join("seen.npy"), &NpyArray::f32(&[2], vec![0.0; 2])).unwrap();
    assert!(scene_dir::load(folder.path()).unwrap_err().to_string().contains("2] values for 5 splats"));
    std::fs::remove_file(folder.path().join("seen.npy")).unwrap();
    assert_eq!(scene_dir::load(folder.path()).unwrap().seen, Seen::default(), "scenes of earlier versions");
    let manifest = folder.path().join("scene.json");
    let text = std::fs::read_to_string(&manifest).unwrap();
    std::fs::write(&manifest, text.replace("\"version\": 2", "\"version\": 99")).unwrap();
    assert!(scene_dir::load(folder.path()).unwrap_err().to_string().contains("update it"));
    std::fs::remove_file(&manifest).unwrap();
    assert!(scene_dir::load(folder.path()).unwrap_err().to_string().contains("not a scene directory"));
}
