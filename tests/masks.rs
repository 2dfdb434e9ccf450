//! Unused pixels: transparency, masks beside photos, and masks that a camera file names.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
use image::{DynamicImage, GrayImage, Luma, Rgba, RgbaImage};
use splatvk::format::scene_dir::{self, Contents};
use splatvk::format::{cameras, scene_photos};
use splatvk::photo::{self, Candidate, MaskChoice, Photo};
use splatvk::progress::{Recorded, Silent};
use splatvk::scene::{Camera, Outside, Pose, Seen, Splats, World};
use std::path::{Path, PathBuf};

/// Distinct photo of 96 × 64 pixels; from column `clear` on it is transparent red.
fn picture(seed: u32, clear: u32) -> DynamicImage {
    let pixel = |x: u32, y: u32| match x < clear {
        true => Rgba([(x * 7 + seed * 31) as u8, (y * 5) as u8, (x * y + seed) as u8, 255]),
        false => Rgba([255, 0, 0, 0]),
    };
    RgbaImage::from_fn(96, 64, pixel).into()
}

/// Mask that is black from column `dark` on.
fn mask(width: u32, height: u32, dark: u32) -> GrayImage {
    GrayImage::from_fn(width, height, |x, _| Luma([if x < dark { 255 } else { 0 }]))
}

fn folder_of(photos: &[(&str, DynamicImage)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for (name, picture) in photos {
        let path = folder.path().join("images").join(name);
        match name.ends_with("jpg") {
            true => picture.to_rgb8().save(path).unwrap(),
            false => picture.save(path).unwrap(),
        }
    }
    folder
}

fn read(folder: &Path, choice: &MaskChoice) -> splatvk::Result<(Vec<Photo>, Vec<String>)> {
    let progress = Recorded::new(&Silent);
    let mut found = photo::gather(&[folder.join("images")], &progress)?;
    photo::assign_masks(&mut found, choice, &progress)?;
    let photos = photo::load_each(&found, photo::MAX_SIZE, &progress)?;
    Ok((photos, progress.warnings()))
}

/// Share of the pixels of a column that are used.
fn used_share(photo: &Photo, x: usize) -> f32 {
    photo.coverage.as_ref().map_or(1.0, |c| c.share.at(x, 30))
}

#[test]
fn transparent_backgrounds_become_empty() {
    let folder = folder_of(&[("a.png", picture(1, 48)), ("b.png", picture(2, 40))]);
    let (photos, warnings) = read(folder.path(), &MaskChoice::default()).unwrap();
    assert!(warnings.len() == 1 && warnings[0].contains("taken for emptiness"), "{warnings:?}");
    for (photo, clear) in photos.iter().zip([48, 40]) {
        let coverage = photo.coverage.as_ref().unwrap();
        assert_eq!(coverage.outside, Outside::Empty);
        assert_eq!((used_share(photo, clear - 1), used_share(photo, clear)), (1.0, 0.0));
        // The red of transparent pixels is replaced, and renders are compared with black there.
        assert!(photo.image.at(90, 30)[0] < 0.9, "{:?}", photo.image.at(90, 30));
        assert_eq!((photo.target().at(90, 30), photo.target().at(3, 3)), ([0.0; 3], photo.image.at(3, 3)));
    }
}

#[test]
fn colours_under_alpha_do_not_bleed() {
    // At half size, the edge at column 95 crosses a pixel.
    let folder = folder_of(&[("a.png", cut_out(1)), ("b.png", cut_out(2))]);
    let found = photo::gather(&[folder.path().join("images")], &Silent).unwrap();
    let photos = photo::load_each(&found, 96, &Silent).unwrap();
    let photo = &photos[0];
    assert_eq!([46, 47, 48].map(|x| used_share(photo, x)), [1.0, 0.5, 0.0]);
    let own = [41.0f32, 80.0, 120.0].map(|v| v / 255.0);
    for x in [46, 47, 48] {
        assert!((0..3).all(|k| (photo.image.at(x, 30)[k] - own[k]).abs() < 1e-6), "column {x}");
    }
    assert!((photo.target().at(47, 30)[1] - 0.5 * own[1]).abs() < 1e-6, "half on black");
}

/// One colour; transparent red from column 95 on.
fn cut_out(seed: u8) -> DynamicImage {
    let own = Rgba([40 + seed, 80, 120, 255]);
    DynamicImage::from(RgbaImage::from_fn(192, 128, |x, _| if x < 95 { own } else { Rgba([255, 0, 0, 0]) }))
}

#[test]
fn transparency_of_some_photos_is_unused() {
    let folder = folder_of(&[("a.png", picture(1, 48)), ("b.png", picture(2, 96))]);
    let (photos, warnings) = read(folder.path(), &MaskChoice::default()).unwrap();
    assert_eq!(photos[0].coverage.as_ref().unwrap().outside, Outside::Unknown);
    assert!(photos[1].coverage.is_none());
    assert!(
        warnings.len() == 1
            && warnings[0].contains("transparent parts are not used")
            && warnings[0].ends_with(": a")
    );
}

#[test]
fn masks_beside_images_are_used() {
    for (first, second) in [("a.jpg.png", "b.png"), ("a.png", "b.jpg.png"), ("a.jpg", "b.png")] {
        let folder = folder_of(&[("a.jpg", picture(1, 96)), ("b.jpg", picture(2, 96))]);
        let masks = folder.path().join("masks");
        std::fs::create_dir(&masks).unwrap();
        mask(96, 64, 60).save(masks.join(first)).unwrap();
        // A mask of twice the size; 1 counts as white, as in labels of one object.
        GrayImage::from_fn(192, 128, |x, _| Luma([u8::from(x < 100)])).save(masks.join(second)).unwrap();
        let (photos, warnings) = read(folder.path(), &MaskChoice::default()).unwrap();
        assert_eq!(warnings, ["the masks beside 2 photos are used: what is black there is not"]);
        assert_eq!([used_share(&photos[0], 57), used_share(&photos[0], 63)], [1.0, 0.0], "{first}");
        assert_eq!([used_share(&photos[1], 49), used_share(&photos[1], 50)], [1.0, 0.0], "{second}");
        assert!(photos.iter().all(|p| p.coverage.as_ref().unwrap().outside == Outside::Unknown));
        // Labels of the ground truth are no masks.
        std::fs::write(folder.path().join("ground_truth.json"), "{}").unwrap();
        let (photos, _) = read(folder.path(), &MaskChoice::default()).unwrap();
        assert!(photos.iter().all(|p| p.coverage.is_none()));
    }
}

#[test]
fn masks_match_folders_of_cameras() {
    let folder = folder_of(&[]);
    for (camera, dark) in [("cam1", 30), ("cam2", 60)] {
        let create_folder = |kind: &str| {
            let made = folder.path().join(kind).join(camera);
            std::fs::create_dir_all(&made).unwrap();
            made
        };
        picture(dark, 96).to_rgb8().save(create_folder("images").join("0001.jpg")).unwrap();
        mask(96, 64, dark).save(create_folder("masks").join("0001.png")).unwrap();
    }
    let photos = ["cam1", "cam2"].map(|c| folder.path().join("images").join(c).join("0001.jpg"));
    let mut found = photos.map(|p| Candidate::file(&p));
    photo::assign_masks(&mut found, &MaskChoice::default(), &Silent).unwrap();
    let loaded = found.map(|c| c.load(photo::MAX_SIZE, &Silent).unwrap());
    assert_eq!([used_share(&loaded[0], 40), used_share(&loaded[1], 40)], [0.0, 1.0]);
}

#[test]
fn unmatched_masks_are_named() {
    let folder = folder_of(&[("a.jpg", picture(1, 96)), ("b.jpg", picture(2, 96))]);
    let masks = folder.path().join("masks");
    std::fs::create_dir(&masks).unwrap();
    mask(96, 64, 60).save(masks.join("other.png")).unwrap();
    let (_, warnings) = read(folder.path(), &MaskChoice::default()).unwrap();
    assert!(
        warnings[0].contains("no mask is named as a photo (a.png or a.jpg.png); none is used"),
        "{warnings:?}"
    );
    let given = MaskChoice { folder: Some(masks.clone()), ..MaskChoice::default() };
    assert!(refusal(folder.path(), &given).contains("no mask is named as a photo"));
    mask(96, 64, 60).save(masks.join("a.png")).unwrap();
    let (photos, warnings) = read(folder.path(), &given).unwrap();
    assert!(warnings[0].contains("masks of 1 of 2 photos are used; there is none for b.jpg"), "{warnings:?}");
    assert!(photos[0].coverage.is_some() && photos[1].coverage.is_none());
    mask(64, 96, 60).save(masks.join("a.png")).unwrap();
    let text = refusal(folder.path(), &given);
    assert!(text.contains("a.jpg: its mask") && text.contains("64 × 96, the photo 96 × 64"), "{text}");
    mask(96, 64, 0).save(masks.join("a.png")).unwrap();
    assert!(refusal(folder.path(), &given).contains("its mask leaves 0 of"));
    // Numbers of several objects are no mask by default.
    GrayImage::from_fn(96, 64, |x, _| Luma([(x / 24) as u8])).save(masks.join("a.png")).unwrap();
    let (photos, warnings) = read(folder.path(), &MaskChoice::default()).unwrap();
    assert!(
        photos[0].coverage.is_none() && warnings[0].contains("more than black and one other value"),
        "{warnings:?}"
    );
    let (photos, _) = read(folder.path(), &given).unwrap();
    assert_eq!([used_share(&photos[0], 23), used_share(&photos[0], 24)], [0.0, 1.0]);
}

fn refusal(folder: &Path, choice: &MaskChoice) -> String {
    let e = read(folder, choice).unwrap_err();
    assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "{e}");
    e.to_string()
}

#[test]
fn camera_file_names_its_masks() {
    let folder = folder_of(&[("a.jpg", picture(1, 96)), ("b.jpg", picture(2, 96))]);
    let file = folder.path().join("transforms.json");
    let masks_with = |mask: &str| {
        let frame = |photo: &str| serde_json::json!({ "file_path": photo, "mask_path": mask });
        let all = serde_json::json!({ "frames": [frame("images/a.jpg"), { "file_path": "images/b.jpg" }] });
        std::fs::write(&file, all.to_string()).unwrap();
        cameras::masks(None, Some(&file))
    };
    std::fs::create_dir(folder.path().join("dynamic")).unwrap();
    mask(96, 64, 60).save(folder.path().join("dynamic/x.png")).unwrap();
    let choice = masks_with("dynamic/x.png").unwrap();
    let (photos, _) = read(folder.path(), &choice).unwrap();
    assert_eq!([used_share(&photos[0], 59), used_share(&photos[0], 60)], [1.0, 0.0]);
    assert!(photos[1].coverage.is_none());
    assert!(masks_with("dynamic/y.png").unwrap_err().to_string().contains("y.png is not there"));
    for outside in ["../x.png", "/etc/hostname"] {
        assert!(
            masks_with(outside).unwrap_err().to_string().contains("out of the file's folder"),
            "{outside}"
        );
    }
}

#[test]
fn mask_orientation_follows_photo_or_file() {
    use image::ImageEncoder;
    let folder = folder_of(&[("b.png", picture(2, 96))]);
    // Stored lying on its side: upright it is 64 wide and 96 high.
    let path = folder.path().join("images/a.png");
    let mut exif = exif::experimental::Writer::new();
    let field = exif::Field {
        tag: exif::Tag::Orientation,
        ifd_num: exif::In::PRIMARY,
        value: exif::Value::Short(vec![6]),
    };
    exif.push_field(&field);
    let mut block = std::io::Cursor::new(Vec::new());
    exif.write(&mut block, false).unwrap();
    let mut encoder = image::codecs::png::PngEncoder::new(std::fs::File::create(&path).unwrap());
    encoder.set_exif_metadata(block.into_inner()).unwrap();
    let stored = picture(1, 96).to_rgb8();
    encoder.write_image(&stored, 96, 64, image::ExtendedColorType::Rgb8).unwrap();
    let masks = folder.path().join("m");
    std::fs::create_dir(&masks).unwrap();
    let choice = MaskChoice { folder: Some(masks.clone()), ..MaskChoice::default() };
    // Black below row 60 of the upright photo, which is right of column 60 of the file.
    let upright = GrayImage::from_fn(64, 96, |_, y| Luma([if y < 60 { 255 } else { 0 }]));
    for picture in [upright, mask(96, 64, 60)] {
        picture.save(masks.join("a.png")).unwrap();
        let (photos, _) = read(folder.path(), &choice).unwrap();
        let share = &photos[0].coverage.as_ref().unwrap().share;
        assert_eq!((share.width, share.at(30, 59), share.at(30, 60)), (64, 1.0, 0.0));
    }
    let one: PathBuf = path;
    assert!(Candidate::file(&one).load(64, &Silent).unwrap().coverage.is_none());
}

#[test]
fn scene_keeps_pixel_coverage() {
    let splats = Splats {
        means: vec![[0.0, 0.0, 2.0]],
        log_scales: vec![[-2.0; 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        opacity_logits: vec![0.0],
        sh: vec![0.1; 3],
        sh_degree: 0,
        antialiased: false,
    };
    let transparent = folder_of(&[("a.png", picture(1, 48)), ("b.png", picture(2, 40))]);
    let masked = folder_of(&[("a.png", picture(1, 96)), ("b.png", picture(2, 96))]);
    std::fs::create_dir(masked.path().join("masks")).unwrap();
    mask(96, 64, 50).save(masked.path().join("masks/a.png")).unwrap();
    for folder in [transparent, masked] {
        let (photos, _) = read(folder.path(), &MaskChoice::default()).unwrap();
        let contents = Contents {
            splats: &splats,
            seen: &Seen { pixels: vec![3.0] },
            backdrop: &Default::default(),
            holes: &Default::default(),
            cameras: &[camera("a.png"), camera("b.png")],
            world: &World::default(),
            photos: &photos,
            points: None,
            language: None,
            text_embeddings: None,
        };
        let scene = tempfile::tempdir().unwrap();
        scene_dir::write(scene.path(), &contents).unwrap();
        let back = scene_photos::load(scene.path()).unwrap();
        for (back, photo) in back.iter().zip(&photos) {
            assert_eq!(back.coverage, photo.coverage, "{}", photo.stem);
            // The picture has 8 bits.
            let near = |a: [f32; 3], b: [f32; 3]| (0..3).all(|k| (a[k] - b[k]).abs() <= 0.6 / 255.0);
            assert!(near(back.target().at(3, 3), photo.target().at(3, 3)));
            assert!(near(back.target().at(90, 9), photo.target().at(90, 9)));
        }
    }
}

fn camera(name: &str) -> Camera {
    Camera {
        name: name.into(),
        width: 96,
        height: 64,
        fx: 90.0,
        fy: 90.0,
        cx: 48.0,
        cy: 32.0,
        pose: Pose::IDENTITY,
    }
}
