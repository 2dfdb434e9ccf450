//! Camera files: round trips, files of other programs, and distortion.
use super::some_cameras;
use glam::{DQuat, DVec3};
use splatvk::format::{cameras, colmap, transforms};
use splatvk::photo::stem;
use splatvk::scene::{Camera, Lens, PointCloud};
use std::path::Path;

/// Camera centres and rotations must survive text files (docs/internals/method.md#camera-files:
/// 1e-9); centres relative to their size.
fn assert_same_cameras(a: &[Camera], b: &[Camera]) {
    assert_eq!(a.len(), b.len());
    for (a, b) in a.iter().zip(b) {
        assert_eq!((a.width, a.height), (b.width, b.height));
        assert_eq!(stem(&a.name), stem(&b.name));
        for (x, y) in [(a.fx, b.fx), (a.fy, b.fy), (a.cx, b.cx), (a.cy, b.cy)] {
            assert_eq!(x, y);
        }
        let scale = 1.0 + a.pose.centre().length();
        assert!((a.pose.centre() - b.pose.centre()).length() < 1e-9 * scale);
        assert!(a.pose.rotation.abs_diff_eq(b.pose.rotation, 1e-12));
    }
}

#[test]
fn cameras_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    let cams = some_cameras();
    let (t, j, c) = (
        folder.path().join("transforms.json"),
        folder.path().join("cameras.json"),
        folder.path().join("model"),
    );
    transforms::write(&t, &cams, None).unwrap();
    assert_same_cameras(&cameras::read(&t).unwrap(), &cams);
    cameras::write_json(&j, &cams).unwrap();
    assert_same_cameras(&cameras::read(&j).unwrap(), &cams);
    let points = PointCloud {
        positions: vec![[0.1, 0.2, 0.3], [-4.0, 5.0, 6.5]],
        colours: vec![[1.0, 0.0, 0.2], [0.4, 0.6, 0.8]],
        ..PointCloud::default()
    };
    colmap::write(&c, &cams, Some(&points)).unwrap();
    assert_same_cameras(&cameras::read(&c).unwrap(), &cams);
    let back = colmap::read_points(&c).unwrap();
    assert_eq!((back.positions, back.colours), (points.positions.clone(), points.colours.clone()));
    let binary = folder.path().join("binary");
    colmap::write_binary(&binary, &cams, Some(&points)).unwrap();
    assert_same_cameras(&cameras::read(&binary).unwrap(), &cams);
    let back = colmap::read_points(&binary).unwrap();
    assert_eq!((back.positions, back.colours), (points.positions, points.colours));
}

#[test]
fn transforms_are_opengl_camera_to_world() {
    // A camera at (1, 2, 3) that looks along world +x with world −z up: OpenCV right = +y...
    // computed by hand.
    let text = r#"{"fl_x": 400, "w": 640, "h": 480, "frames": [{"file_path": "a.png", "fl_x": 500,
        "transform_matrix": [[0, 0, -1, 1], [1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1]]}]}"#;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("transforms.json");
    std::fs::write(&path, text).unwrap();
    let c = &cameras::read(&path).unwrap()[0];
    assert_eq!((c.fy, c.cx, c.cy), (500.0, 320.0, 240.0), "what a frame says of itself wins");
    // OpenGL: right = world +y, up = world −z, forward = −z axis = world +x.
    let (pixel, depth) = c.project(DVec3::new(1.0 + 4.0, 2.0, 3.0));
    assert!(
        (depth - 4.0).abs() < 1e-12 && (pixel - glam::DVec2::new(320.0, 240.0)).length() < 1e-9,
        "straight ahead"
    );
    let (pixel, _) = c.project(DVec3::new(5.0, 3.0, 3.0));
    assert!((pixel.x - (320.0 + 125.0)).abs() < 1e-9, "right of the camera is world +y: {pixel}");
    let (pixel, _) = c.project(DVec3::new(5.0, 2.0, 2.0));
    assert!((pixel.y - (240.0 - 125.0)).abs() < 1e-9, "above the camera is world −z: {pixel}");
    // Blender states the angle across the picture: at 90° the focal length is half of its width.
    let angle = format!(r#""camera_angle_x": {}"#, std::f64::consts::FRAC_PI_2);
    std::fs::write(&path, text.replace(r#""fl_x": 400"#, &angle).replace(r#" "fl_x": 500,"#, "")).unwrap();
    assert!((cameras::read(&path).unwrap()[0].fx - 320.0).abs() < 1e-9);
}

#[test]
fn colmap_binary_model_round_trips() {
    let folder = tempfile::tempdir().unwrap();
    let cams = some_cameras();
    let (mut c, mut im) = (3u64.to_le_bytes().to_vec(), 3u64.to_le_bytes().to_vec());
    for (i, cam) in cams.iter().enumerate() {
        c.extend((i as u32 + 7).to_le_bytes());
        c.extend(1u32.to_le_bytes());
        c.extend((cam.width as u64).to_le_bytes());
        c.extend((cam.height as u64).to_le_bytes());
        [cam.fx, cam.fy, cam.cx, cam.cy].iter().for_each(|v| c.extend(v.to_le_bytes()));
        im.extend((i as u32 + 1).to_le_bytes());
        let q = DQuat::from_mat3(&cam.pose.rotation);
        let t = cam.pose.translation;
        [q.w, q.x, q.y, q.z, t.x, t.y, t.z].iter().for_each(|v| im.extend(v.to_le_bytes()));
        im.extend((i as u32 + 7).to_le_bytes());
        im.extend(cam.name.as_bytes());
        im.push(0);
        im.extend(2u64.to_le_bytes());
        im.extend([1u8; 48]);
    }
    std::fs::write(folder.path().join("cameras.bin"), &c).unwrap();
    std::fs::write(folder.path().join("images.bin"), &im).unwrap();
    assert_same_cameras(&cameras::read(folder.path()).unwrap(), &cams);
    std::fs::write(folder.path().join("images.bin"), &im[..im.len() - 1]).unwrap();
    assert!(
        cameras::read(folder.path()).unwrap_err().to_string().contains("images.bin: the file ends early")
    );
}

#[test]
fn colmap_reads_single_focal_models() {
    let folder = tempfile::tempdir().unwrap();
    let (mut cameras, mut images) = (String::new(), String::new());
    for (i, model) in ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"].into_iter().enumerate() {
        // f, the principal point, and as many distortion terms as the model has.
        cameras += &format!("{i} {model} 640 480 500 321 242{}\n", " 0".repeat(i));
        images += &format!("{i} 1 0 0 0 0 0 0 {i} {i}.png\n\n");
    }
    std::fs::write(folder.path().join("cameras.txt"), cameras).unwrap();
    std::fs::write(folder.path().join("images.txt"), images).unwrap();
    let read = colmap::read(folder.path()).unwrap();
    assert!(read.len() == 3 && read.iter().all(|c| intrinsics_of(&c.camera) == [500.0, 500.0, 321.0, 242.0]));
}

fn intrinsics_of(c: &Camera) -> [f64; 4] {
    [c.fx, c.fy, c.cx, c.cy]
}

#[test]
fn impossible_pinholes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.json");
    let identity = "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";
    let cases = [
        ("{", "not a JSON camera file"),
        ("{}", "neither transforms.json"),
        (r#"{"frames": []}"#, "no cameras"),
        (&frame_with("", identity), "no focal length"),
        (&frame_with(r#""fl_x": -50,"#, identity), "must be positive"),
        (&frame_with(r#""fl_x": 50,"#, "[[1,0,0,0]]"), "4 × 4"),
        (&frame_with(r#""fl_x": 50,"#, "[[2,0,0,0],[0,1,0,0],[0,0,1,0]]"), "not a rotation"),
    ];
    for (text, words) in cases {
        std::fs::write(&path, text).unwrap();
        let e = cameras::read(&path).unwrap_err();
        assert!(
            e.exit_code() == 2 && e.to_string().contains(words) && e.to_string().contains("t.json"),
            "{e}"
        );
        assert_eq!(e.to_string().lines().count(), 1);
    }
    assert_eq!(cameras::read(&folder.path().join("none.json")).unwrap_err().exit_code(), 2);
    assert_eq!(cameras::read(folder.path()).unwrap_err().exit_code(), 2);
}

fn frame_with(extra: &str, m: &str) -> String {
    format!(r#"{{"w": 64, "h": 48, {extra} "frames": [{{"file_path": "a.png", "transform_matrix": {m}}}]}}"#)
}

#[test]
fn original_cameras_include_lens() {
    let dir = tempfile::tempdir().unwrap();
    let list: Vec<Camera> = some_cameras().into_iter().chain(some_cameras()).collect();
    let list: Vec<Camera> = list
        .into_iter()
        .enumerate()
        .map(|(k, c)| Camera { name: format!("{k}.jpg"), fy: 611.0, ..c })
        .collect();
    let lenses = [
        Lens::radial(-0.12, 0.03),
        Lens::radial(0.05, 0.0),
        Lens::NONE,
        Lens { p1: 0.001, p2: -0.002, ..Lens::radial(0.01, 0.0) },
        Lens { k3: 0.002, k4: 0.01, k5: -0.003, k6: 0.0001, p1: 0.001, ..Lens::radial(0.01, 0.02) },
        Lens { k3: 0.002, k4: -0.0001, fisheye: true, ..Lens::radial(0.01, 0.02) },
    ];
    colmap::write_lensed(dir.path(), &list, &lenses).unwrap();
    let text = std::fs::read_to_string(dir.path().join("cameras.txt")).unwrap();
    let line = text.lines().find(|l| l.starts_with("1 ")).unwrap();
    assert!(line.starts_with("1 OPENCV 640 ") && line.ends_with(" -0.12 0.03 0 0"), "{line}");
    let file = dir.path().join("transforms.json");
    transforms::write_lensed(&file, &list, &lenses).unwrap();
    let json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    assert_eq!(json["camera_model"], "OPENCV");
    assert_eq!((&json["frames"][0]["k1"], &json["frames"][0]["k2"]), (&(-0.12).into(), &0.03.into()));
    for path in [dir.path(), file.as_path(), &dir.path().join("images.txt")] {
        let read = cameras::read_file(path).unwrap();
        assert_eq!(read.cameras.iter().map(|c| c.lens).collect::<Vec<_>>(), lenses);
        assert_same_cameras(&read.cameras.iter().map(|c| c.camera.clone()).collect::<Vec<_>>(), &list);
        // Rendered views use the pinholes, with a warning.
        let (pinholes, warnings) = read.pinholes();
        assert!(
            pinholes.len() == 6 && warnings.len() == 1 && warnings[0].starts_with("5 of 6"),
            "{warnings:?}"
        );
    }
}

/// A `transforms.json` of one frame with more keys.
fn one_frame(extra: &str) -> String {
    format!(
        r#"{{"w": 64, "h": 48, "fl_x": 50, {extra} "frames": [{{"file_path": "a.png", "transform_matrix":
            [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}]}}"#
    )
}

#[test]
fn camera_models_are_read_or_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.json");
    let read = |extra: &str| {
        std::fs::write(&path, one_frame(extra)).unwrap();
        cameras::read_file(&path)
    };
    let lens = |extra: &str| read(extra).unwrap().cameras[0].lens;
    assert_eq!(lens(r#""k1": null, "k2": 0, "is_fisheye": false, "camera_model": null,"#), Lens::NONE);
    assert_eq!(lens(r#""k1": 1e-9,"#), Lens::radial(1e-9, 0.0));
    let tangential = Lens { k3: 0.01, p1: 0.001, p2: 0.002, ..Lens::radial(0.1, 0.02) };
    assert_eq!(
        lens(r#""camera_model": "OPENCV", "k1": 0.1, "k2": 0.02, "k3": 0.01, "p1": 0.001, "p2": 0.002,"#),
        tangential
    );
    let round = Lens { k3: 0.01, k4: 0.001, fisheye: true, ..Lens::radial(0.1, 0.02) };
    for model in [r#""is_fisheye": true,"#, r#""camera_model": "OPENCV_FISHEYE","#] {
        assert_eq!(lens(&format!(r#"{model} "k1": 0.1, "k2": 0.02, "k3": 0.01, "k4": 0.001,"#)), round);
    }
    for (extra, words) in [
        (r#""k4": 0.1,"#, "FULL_OPENCV"),
        (r#""camera_model": "ORTHOPHOTO","#, "ORTHOPHOTO is not read"),
        (r#""camera_model": "EQUIRECTANGULAR","#, "EQUIRECTANGULAR is not read"),
        (r#""camera_model": "FISHEYE624","#, "FISHEYE624 is not read"),
        (r#""camera_model": "FOV","#, "FOV is not read"),
        (r#""ftheta_p0": 0.0,"#, "ftheta_p0"),
        (r#""latlong": true,"#, "latlong"),
        (r#""is_fisheye": true, "p1": 0.1,"#, "p1 = 0.1"),
        (r#""is_fisheye": false, "camera_model": "OPENCV_FISHEYE","#, "is_fisheye is false"),
        // The corner of 64 × 48 at f = 50 is at r = 0.8, the fold of k1 = −0.8 at 0.65.
        (r#""k1": -0.8,"#, "folds back"),
        (r#""k1": 1e999,"#, "not a JSON camera file"),
    ] {
        let e = read(extra).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains(words), "{extra}: {e}");
    }
    // Values of a frame take precedence over shared values of the file.
    let own = one_frame(r#""k1": 0.1,"#)
        .replace(r#""file_path""#, r#""k1": 0.05, "camera_model": "OPENCV", "file_path""#);
    std::fs::write(&path, own).unwrap();
    assert_eq!(cameras::read_file(&path).unwrap().cameras[0].lens, Lens::radial(0.05, 0.0));
    assert_eq!(read(r#""rolling_shutter": [0, 0, 1, 0],"#).unwrap().warnings.len(), 1);
}

#[test]
fn transforms_skip_frames_without_matrix() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.json");
    let more = |frame: &str| one_frame("").replace(r#""frames": ["#, &format!(r#""frames": [{frame}, "#));
    for matrix in ["", r#", "transform_matrix": null"#] {
        std::fs::write(&path, more(&format!(r#"{{"file_path": "b.png"{matrix}}}"#))).unwrap();
        let read = cameras::read_file(&path).unwrap();
        assert!(read.cameras.len() == 1 && read.warnings.len() == 1 && read.warnings[0].ends_with("b.png"));
    }
    std::fs::write(&path, r#"{"fl_x": 50, "frames": [{"file_path": "b.png"}]}"#).unwrap();
    assert!(cameras::read_file(&path).unwrap_err().to_string().contains("b.png"));
    // The same name twice, spelled in two ways.
    let again = one_frame("").replace(
        "]]}",
        r#"]]}, {"file_path": "./a.png", "transform_matrix":
        [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
    );
    std::fs::write(&path, again).unwrap();
    assert!(cameras::read_file(&path).unwrap_err().to_string().contains("two cameras have the name"));
}

/// Writes a COLMAP model in text.
fn model(folder: &Path, cameras: &str, images: &str) {
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join("cameras.txt"), cameras).unwrap();
    std::fs::write(folder.join("images.txt"), images).unwrap();
}

#[test]
fn colmap_text_reads_handwritten_variants() {
    let folder = tempfile::tempdir().unwrap();
    let cases = [
        (
            "\u{feff}# cameras\r\n1 PINHOLE 64 48 50 50 32 24\r\n",
            "\u{feff}# images\r\n7 1 0 0 0 0 0 0 1 a b.jpg\r\n\r\n",
        ),
        ("1\tPINHOLE\t64\t48\t50\t50\t32\t24\n", "7\t1\t0\t0\t0\t0\t0\t0\t1\ta b.jpg\n1.5\t2.5\t-1\n"),
        ("  1  PINHOLE 64  48 50 50 32 24 \n", " 7  1 0 0 0  0 0 0 1   a b.jpg \n\n"),
        (
            "  # c\n1 pinhole 64 48 50 50 32 24\n2 FOV 64 48 50 50 32 24 0.9\n",
            "7 1 0 0 0 0 0 0 1 a b.jpg\n\n",
        ),
    ];
    for (cameras, images) in cases {
        model(folder.path(), cameras, images);
        let read = colmap::read(folder.path()).unwrap();
        assert!(read.len() == 1 && read[0].camera.name == "a b.jpg" && read[0].camera.cx == 32.0, "{read:?}");
    }
    model(folder.path(), "2 FOV 64 48 50 50 32 24 0.9\n", "7 1 0 0 0 0 0 0 2 a.jpg\n\n");
    let e = colmap::read(folder.path()).unwrap_err().to_string();
    assert!(e.contains("camera 2 is FOV") && e.contains("colmap image_undistorter --image_path"), "{e}");
    model(folder.path(), "2 LOMO 64 48 1 2\n", "7 1 0 0 0 0 0 0 2 a.jpg\n\n");
    assert!(colmap::read(folder.path()).unwrap_err().to_string().contains("\"LOMO\" is not known"));
}

#[test]
fn models_are_found_in_data_sets() {
    for below in
        ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "dense/sparse", "dense/0/sparse", "colmap"]
    {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join(below);
        model(&place, "1 PINHOLE 64 48 50 50 32 24\n", "1 1 0 0 0 0 0 0 1 a.jpg\n\n");
        std::fs::write(place.join("points3D.txt"), "1 1 2 3 255 0 0 0.5\n").unwrap();
        assert_eq!(cameras::read_file(folder.path()).unwrap().cameras.len(), 1, "{below}");
        assert_eq!(colmap::read_points(folder.path()).unwrap().positions, [[1.0, 2.0, 3.0]], "{below}");
    }
    let folder = tempfile::tempdir().unwrap();
    for number in ["0", "1"] {
        let place = folder.path().join("sparse").join(number);
        model(&place, "1 PINHOLE 64 48 50 50 32 24\n", "1 1 0 0 0 0 0 0 1 a.jpg\n\n");
    }
    let warnings = cameras::read_file(folder.path()).unwrap().warnings;
    assert!(warnings.len() == 1 && warnings[0].contains("sparse/1"), "{warnings:?}");
    let e = colmap::read_points(folder.path()).unwrap_err();
    assert!(e.exit_code() == 2 && e.to_string().contains("no points3D"), "{e}");
}
