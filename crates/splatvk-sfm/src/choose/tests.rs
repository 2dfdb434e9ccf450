//! Choice from sets of photos with known faults.
use super::*;
use crate::progress::Silent;
use std::path::{Path, PathBuf};

fn breakfast(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/breakfast").join(name)
}

fn picture(image: &RgbImage) -> image::RgbImage {
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    image::RgbImage::from_fn(image.width as u32, image.height as u32, |x, y| {
        image::Rgb(image.at(x as usize, y as usize).map(byte))
    })
}

fn blurred(image: &RgbImage, sigma: f32) -> RgbImage {
    let channel = |k: usize| {
        let data = image.data.iter().map(|c| c[k]).collect();
        sift::blurred(&crate::scene::Image { width: image.width, height: image.height, data }, sigma)
    };
    let planes = [0, 1, 2].map(channel);
    let data = (0..image.data.len()).map(|i| [0, 1, 2].map(|k: usize| planes[k].data[i])).collect();
    RgbImage { width: image.width, height: image.height, data }
}

/// The four photos and faulty ones; the order of names would choose the faulty ones.
fn folder_with_faults() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for (i, name) in ["b", "d", "f", "h"].iter().enumerate() {
        std::fs::copy(breakfast(&format!("images/train_{i:02}.jpg")), path(&format!("{name}.jpg"))).unwrap();
    }
    let photo = |i: usize| photo::load(&breakfast(&format!("images/train_{i:02}.jpg"))).unwrap().image;
    picture(&blurred(&photo(0), 2.5)).save(path("a_blurred.png")).unwrap();
    // A second photo from the same place: two pixels aside and a third of a stop darker.
    let (shot, mut again) = (photo(1), photo(1));
    for y in 0..again.height {
        for x in 0..again.width {
            again.data[y * again.width + x] = shot.at((x + 2).min(shot.width - 1), y).map(|v| v * 0.9);
        }
    }
    picture(&again).save(path("e_again.png")).unwrap();
    // Another place: boxes of all sizes and colours.
    let mut elsewhere = image::RgbImage::new(640, 480);
    let mut state = 7u32;
    let mut next = |below: u32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) % below
    };
    for _ in 0..900 {
        let (x, y, w, h) = (next(620), next(460), 5 + next(60), 5 + next(60));
        let colour = image::Rgb([next(256) as u8, next(256) as u8, next(256) as u8]);
        for (v, u) in (y..(y + h).min(480)).flat_map(|v| (x..(x + w).min(640)).map(move |u| (v, u))) {
            elsewhere.put_pixel(u, v, colour);
        }
    }
    elsewhere.save(path("z_elsewhere.png")).unwrap();
    folder
}

#[test]
fn choose_leaves_out_faulty_photos() {
    let folder = folder_with_faults();
    let candidates = photo::gather(&[folder.path().to_path_buf()], &Silent).unwrap();
    assert_eq!(candidates.len(), 7);
    let (chosen, choice) = choose(&candidates, 4, &Silent).unwrap();
    let used = choice.used.clone();
    assert_eq!(chosen.len(), 4);
    // Either photo of one place may be chosen.
    let repeated_count =
        |list: &[String]| list.iter().filter(|n| ["d.jpg", "e_again.png"].contains(&n.as_str())).count();
    assert_eq!(repeated_count(&used), 1, "{choice:?}");
    assert!(["b.jpg", "f.jpg", "h.jpg"].iter().all(|n| used.iter().any(|u| u == n)), "{choice:?}");
    let reason = |name: &str| choice.left_out.iter().find(|l| l.photo == name).map(|l| l.reason.clone());
    assert_eq!(reason("a_blurred.png"), Some(Reason::Blurred));
    assert_eq!(reason("z_elsewhere.png"), Some(Reason::NoOverlap));
    let repeated =
        choice.left_out.iter().find(|l| ["d.jpg", "e_again.png"].contains(&l.photo.as_str())).unwrap();
    assert!(
        matches!(&repeated.reason, Reason::Duplicate(n) if *n != repeated.photo && used.contains(n)),
        "{choice:?}"
    );
    let message = choice.message();
    assert!(
        message.starts_with("using 4 of 7 photos: ") && message.contains("a_blurred.png (blurred)"),
        "{message}"
    );
    assert_eq!(choose(&candidates, 4, &Silent).unwrap(), (chosen, choice), "deterministic");
}

#[test]
fn photos_uses_all_when_few() {
    assert_eq!(photos(&[breakfast("images")], Some(4), &Silent).unwrap().0.len(), 4);
    let e = photos(&[breakfast("images")], Some(5), &Silent).unwrap_err();
    assert!(e.to_string().starts_with("--views 5: only 4"), "{e}");
}

#[test]
fn choice_message_shortens_long_lists() {
    let left_out =
        (0..30).map(|i| LeftOut { photo: format!("{i:02}.jpg"), reason: Reason::LittleNewArea }).collect();
    let choice = Choice { used: vec!["a.jpg".into(), "b.jpg".into()], left_out };
    let message = choice.message();
    assert!(
        message.contains("using 2 of 32 photos: a.jpg, b.jpg") && message.contains("05.jpg and 24 more"),
        "{message}"
    );
}

#[test]
fn graph_choose_keeps_to_one_place() {
    // Photos 0-2 and 6-8 show one place, 3-5 and 9-10 another.
    let is_second_place = |i: usize| i % 6 >= 3;
    let n = 11;
    let link = |i: usize, j: usize| {
        let matches = if i != j && is_second_place(i) == is_second_place(j) { 60 } else { 3 };
        SimilarityInliers { matches, parallax: 0.05 }
    };
    let links = (0..n).map(|i| (0..n).map(|j| link(i, j)).collect()).collect();
    let graph = Graph { links, quality: vec![1.0; n], same: vec![vec![false; n]; n] };
    let chosen = graph.choose(4);
    // Two of each place would cover more, but cannot be registered with each other.
    assert!(chosen.iter().all(|i| !is_second_place(*i)), "{chosen:?}");
    let names: Vec<String> = (0..n).map(|i| i.to_string()).collect();
    assert_eq!(graph.reason(4, &chosen, &names), Reason::NoOverlap);
    let left = [0, 1, 2, 6, 7, 8].into_iter().find(|i| !chosen.contains(i)).unwrap();
    assert_eq!(graph.reason(left, &chosen, &names), Reason::LittleNewArea);
}

#[test]
fn pairs_compares_photos_of_similar_colour() {
    // Consecutive photos differ: for up to four steps the colours are 9 apart and more.
    let colour = |k: usize| (37 * k % 60) as f32;
    let features = |k: usize| CandidateFeatures {
        features: Keypoints::default(),
        diagonal: 1.0,
        sharpness: 1.0,
        signature: vec![colour(k)],
    };
    let found = pairs(&(0..60).map(features).collect::<Vec<_>>());
    for (i, j) in (0..60).flat_map(|i| (i + 1..60).map(move |j| (i, j))) {
        let alike = (colour(i) - colour(j)).abs() <= 6.0;
        assert!(!alike || found.contains(&(i, j)), "{i} and {j}");
    }
    assert!(found.len() < 60 * 59 / 4, "{} pairs", found.len());
}
