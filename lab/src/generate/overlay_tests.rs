//! Overlays in generated photos are found by [`splatvk::pose::still`].
use super::Spoil;
use splatvk::photo::{self, Overlay, Photo};
use splatvk::pose::still::{description, mark};
use splatvk::pose::{align, leave_out};
use splatvk::progress::Silent;
use splatvk::scene::Camera;
use splatvk_test_support::breakfast::{folder, train_views};

/// The four photos of `breakfast`, with an overlay drawn over them.
fn breakfast(spoil: Option<Spoil>) -> Vec<Photo> {
    let names = ["train_00", "train_01", "train_02", "train_03"];
    let load = |name| photo::load(&folder().join("images").join(format!("{name}.jpg"))).unwrap();
    let mut photos: Vec<Photo> = names.map(load).into();
    photos.iter_mut().for_each(|p| spoil.iter().for_each(|s| s.draw_over(&mut p.image)));
    photos
}

/// Share of the pixels `within` that the overlay of the first photo hides.
fn hidden_share(photos: &[Photo], within: impl Fn(usize, usize) -> bool) -> f64 {
    let Some(Overlay { hidden: mask, .. }) = &photos[0].overlay else { return 0.0 };
    let inside: Vec<usize> =
        (0..mask.data.len()).filter(|i| within(i % mask.width, i / mask.width)).collect();
    inside.iter().filter(|i| mask.data[**i]).count() as f64 / inside.len() as f64
}

#[test]
fn mark_bonnet_hides_bonnet_only() {
    let mut photos = breakfast(Some(Spoil::Bonnet));
    mark(&mut photos);
    let (bonnet, scene) = (hidden_share(&photos, |_, y| y > 440), hidden_share(&photos, |_, y| y < 350));
    assert!(bonnet > 0.95 && scene < 0.01, "{bonnet} {scene}");
    let text = description(&photos).unwrap();
    assert!(text.ends_with("of the frame at the bottom"), "{text}");
}

#[test]
fn mark_finds_watermark_in_two_photos() {
    let mut photos = breakfast(Some(Spoil::Watermark));
    let plain = breakfast(None);
    mark(&mut photos[..2]);
    let drawn: Vec<bool> =
        photos[0].image.data.iter().zip(&plain[0].image.data).map(|(a, b)| a != b).collect();
    let width = plain[0].image.width;
    let found = hidden_share(&photos, |x, y| drawn[y * width + x]);
    assert!(found > 0.6, "{found}");
    assert!(description(&photos).unwrap().ends_with("across the picture"));
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn marked_watermark_keeps_poses_accurate() {
    let views = train_views();
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let depths = views.iter().flat_map(|v| &v.depth.data).filter(|z| **z > 0.0);
    let mean_depth = depths.clone().map(|z| f64::from(*z)).sum::<f64>() / depths.count() as f64;
    let mut photos = breakfast(Some(Spoil::Watermark));
    mark(&mut photos);
    let placed = leave_out::place(photos, Vec::new(), 0, &Silent).unwrap();
    assert_eq!(placed.photos.len(), 4);
    let errors = align::pose_errors(&placed.model.cameras, &cameras, mean_depth).rotation_degrees;
    println!("{errors:?}");
    assert!(errors.iter().all(|v| *v < 0.1), "{errors:?}");
}
