use super::*;

fn unit(v: &[f32]) -> Vec<f32> {
    let n = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    v.iter().map(|x| x / n).collect()
}

/// Three codes in a 4-dimensional space: axes 0, 1 and a near-copy of axis 0; canonical = axis 3.
fn field() -> LanguageField {
    let rows = [unit(&[1.0, 0.0, 0.0, 0.3]), unit(&[0.0, 1.0, 0.0, 0.3]), unit(&[0.95, 0.0, 0.1, 0.3])];
    let codebook = Codebook {
        embedding_dim: 4,
        code_dim: 3,
        embeddings: rows.concat(),
        codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        weights: vec![1.0; 3],
        members: vec![Vec::new(); 3],
        min_chord: 1.4,
    };
    let level = LevelField { codebook, ..LevelField::default() };
    LanguageField { levels: vec![LevelField::default(), level.clone(), level], space: "test".into() }
}

fn query(v: &[f32]) -> TextQuery {
    TextQuery {
        text: "q".into(),
        embedding: unit(v),
        canonicals: vec![0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.6, 0.8],
        ..Default::default()
    }
}

/// 60×40: code 1 everywhere, code 0 in a square, code 2 right of it, void in the first column.
fn frame() -> Image<i32> {
    let mut map = Image::filled(60, 40, 1);
    for y in 0..40 {
        for x in 0..60 {
            if x == 0 {
                map.data[y * 60 + x] = -1;
            } else if (10..25).contains(&y) && (20..44).contains(&x) {
                map.data[y * 60 + x] = if x < 36 { 0 } else { 2 };
            }
        }
    }
    map
}

#[test]
fn relevancy_is_lowest_pairwise_softmax() {
    let (field, q) = (field(), query(&[1.0, 0.2, 0.0, 0.1]));
    let got = code_relevancy(&field.levels[1].codebook, &q).unwrap();
    for (k, phi) in field.levels[1].codebook.embeddings.chunks(4).enumerate() {
        let dot = |n: &[f32]| phi.iter().zip(n).map(|(a, b)| (a * b) as f64).sum::<f64>();
        let pos = (10.0 * dot(&q.embedding)).exp();
        let expected =
            q.canonicals.chunks(4).map(|n| pos / (pos + (10.0 * dot(n)).exp())).fold(1.0, f64::min);
        assert!((got[k] as f64 - expected).abs() < 1e-5);
    }
    assert!(code_relevancy(&field.levels[0].codebook, &q).unwrap().is_empty());
    let wrong = TextQuery { embedding: vec![1.0; 3], ..q };
    assert!(code_relevancy(&field.levels[1].codebook, &wrong).unwrap_err().to_string().contains("3 values"));
}

#[test]
fn answer_mask_follows_code_borders() {
    let maps = vec![Image::filled(60, 40, -1), frame(), frame()];
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap();
    assert_eq!(r.level, 2, "the whole answers when it is as good as its part");
    let lerf = QueryOptions { mask: MaskRule::Lerf(0.6), ..QueryOptions::default() };
    let r1 = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &lerf).unwrap();
    assert_eq!(r1.level, 1, "protocol lerf: ties go to the finer level, empty levels are skipped");
    for (p, &k) in maps[1].data.iter().enumerate() {
        assert_eq!(r.mask.data[p], k == 0 || k == 2, "pixel {p}");
    }
    assert!(maps[1].at(r.location.0, r.location.1) != 1 && r.found && r.score > 0.95);
    assert_eq!(r.relevancy.data.len(), 2400);
    // raising the bar to the very best code leaves out its near-copy
    let strict = QueryOptions { mask: MaskRule::Codes(1.0), ..QueryOptions::default() };
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &strict).unwrap();
    assert!(maps[1].data.iter().zip(&r.mask.data).all(|(&k, &m)| m == (k == 0)));
    // without that code in the view, its near-copy is the best
    let mut maps = maps;
    maps.iter_mut().flat_map(|m| &mut m.data).filter(|k| **k == 0).for_each(|k| *k = 1);
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &strict).unwrap();
    assert!(maps[1].data.iter().zip(&r.mask.data).all(|(&k, &m)| m == (k == 2)));
}

#[test]
fn answer_ignores_better_speck() {
    let mut part = frame();
    // level 1 shows the better code 0 on a few pixels only, level 2 its near-copy over the whole
    // square
    part.data.iter_mut().filter(|k| **k == 0 || **k == 2).for_each(|k| *k = 1);
    for p in [12 * 60 + 25, 12 * 60 + 26, 13 * 60 + 25] {
        part.data[p] = 0;
    }
    let mut whole = frame();
    whole.data.iter_mut().filter(|k| **k == 0).for_each(|k| *k = 2);
    let maps = vec![Image::filled(60, 40, -1), part, whole];
    let level_with = |slack: Slack| {
        let options = QueryOptions { slack, ..QueryOptions::default() };
        answer(&maps, &field(), &query(&[1.0, 0.0, -0.02, 0.1]), &options).unwrap().level
    };
    assert_eq!((level_with(Slack { margin: 0.0, share: 0.0 }), level_with(SLACK)), (2, 2));
    // LERF's rule uses only the peak
    let lerf = QueryOptions { mask: MaskRule::Lerf(0.6), ..QueryOptions::default() };
    assert!(answer(&maps, &field(), &query(&[1.0, 0.0, -0.02, 0.1]), &lerf).is_ok());
}

#[test]
fn answer_prefers_clearly_better_part() {
    // Level 1 and level 2 show one thing; the part's code is nearer to the phrase by the tilt.
    let chosen_level = |tilt: f32| {
        let entry = |first: f32| unit(&[first, 1.0, 0.0, 0.0]);
        let level = |embedding: Vec<f32>| LevelField {
            codebook: Codebook { embedding_dim: 4, embeddings: embedding, ..Codebook::default() },
            ..LevelField::default()
        };
        let levels = vec![LevelField::default(), level(entry(1.0 + tilt)), level(entry(1.0))];
        let field = LanguageField { levels, ..LanguageField::default() };
        let maps = vec![Image::filled(60, 40, -1), Image::filled(60, 40, 0), Image::filled(60, 40, 0)];
        answer(&maps, &field, &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap().level
    };
    // Margins: cosine 0.707 of the whole; 0.74 (within 0.02 and a tenth) and 0.89 of the part.
    assert_eq!((chosen_level(0.1), chosen_level(1.0)), (2, 1));
}

#[test]
fn answer_all_equals_single_answers() {
    let (one, two) = (vec![frame(), frame(), frame()], vec![Image::filled(60, 40, -1), frame(), frame()]);
    let q = query(&[1.0, 0.0, 0.0, 0.0]);
    let together = answer_all(&[&one, &two], &field(), &q, &QueryOptions::default()).unwrap();
    for (codes, all) in [&one, &two].into_iter().zip(&together) {
        let alone = answer(codes, &field(), &q, &QueryOptions::default()).unwrap();
        assert_eq!((alone.level, alone.location, &alone.mask), (all.level, all.location, &all.mask));
        assert_eq!(alone.relevancy, all.relevancy);
    }
}

#[test]
fn answer_unrelated_text_is_not_found() {
    let maps = vec![Image::filled(60, 40, -1), frame(), frame()];
    let r = answer(&maps, &field(), &query(&[0.0, 0.0, -1.0, 0.0]), &QueryOptions::default()).unwrap();
    assert!(!r.found && r.score < 0.5);
    let empty = LanguageField::default();
    assert!(answer(&maps, &empty, &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).is_err());
}

#[test]
fn answer_void_frame_has_empty_mask() {
    let maps = vec![Image::filled(60, 40, -1); 3];
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap();
    assert!(!r.found && r.mask.data.iter().all(|m| !m));
}

/// Distinct unit vectors per object that share a strong common direction, as image features of one
/// photo set do.
fn oracle_vectors(count: usize, dim: usize) -> Vec<Vec<f32>> {
    let mut state = 11u64;
    let mut normal = || {
        let mut sum = 0.0f32;
        for _ in 0..6 {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            sum += (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5;
        }
        sum
    };
    let common = unit(&(0..dim).map(|_| normal()).collect::<Vec<_>>());
    let mut own = || unit(&(0..dim).map(|_| normal()).collect::<Vec<_>>());
    (0..count)
        .map(|_| unit(&own().iter().zip(&common).map(|(a, c)| a + 0.8 * c).collect::<Vec<_>>()))
        .collect()
}

#[test]
fn answer_distinct_features_find_every_phrase() {
    use crate::scene::DepthMap;
    use crate::{BuildOptions, LevelMasks, ViewMasks, build};
    use splatvk_test_support::breakfast::{phrases, train_views};
    let (views, phrases) = (train_views(), phrases());
    let vectors = oracle_vectors(16, 64);
    let masks: Vec<ViewMasks> = views
        .iter()
        .map(|v| {
            let labels = Image { data: v.masks.data.iter().map(|&k| k.max(0)).collect(), ..v.masks };
            let features = vectors[..12].concat();
            let level = LevelMasks { labels, quality: vec![1.0; 12], features, ..LevelMasks::default() };
            ViewMasks { levels: vec![level.clone(), level.clone(), level] }
        })
        .collect();
    let depths: Vec<DepthMap> = views
        .iter()
        .map(|v| DepthMap {
            depth: v.depth.clone(),
            confidence: Image { data: v.depth.data.iter().map(|&z| f32::from(z > 0.0)).collect(), ..v.depth },
        })
        .collect();
    let cameras: Vec<_> = views.iter().map(|v| v.camera.clone()).collect();
    let built =
        build(&masks, &cameras, &depths, &[], &BuildOptions::default(), &crate::progress::Silent).unwrap();
    let mut codes_per_level = Vec::new();
    for level in &built.field.levels {
        codes_per_level.push(level.codebook.len());
    }
    // eleven things, whichever views show them
    assert_eq!(codes_per_level, [11, 11, 11]);
    for (object, text) in &phrases {
        let embedding = vectors[*object as usize].clone();
        let query = TextQuery {
            text: text.clone(),
            embedding,
            canonicals: vectors[12..].concat(),
            ..Default::default()
        };
        for (t, view) in views.iter().enumerate() {
            let maps: Vec<Image<i32>> = built.field.levels.iter().map(|l| l.targets[t].clone()).collect();
            let r = answer(&maps, &built.field, &query, &QueryOptions::default()).unwrap();
            if view.masks.data.contains(object) {
                assert!(
                    view.masks.data.iter().zip(&r.mask.data).all(|(k, &m)| m == (k == object)),
                    "{text} {t}"
                );
                assert_eq!(view.masks.at(r.location.0, r.location.1), *object);
                assert!(r.found);
            }
        }
    }
}

#[test]
fn answer_location_respects_finer_level() {
    // The whole (level 2) spans a rectangle; on level 1 only its right part matches, as a plate
    // around a lemon does.
    let map = |from: usize| {
        let inside = |p: usize| (from..180).contains(&(p % 200)) && (20..100).contains(&(p / 200));
        let data = (0..200 * 120).map(|p| if inside(p) { 0 } else { 1 }).collect();
        Image { width: 200, height: 120, data }
    };
    let maps = [Image::filled(200, 120, -1), map(120), map(20)];
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap();
    assert_eq!(r.level, 2);
    assert!((120..180).contains(&r.location.0) && (20..100).contains(&r.location.1), "{:?}", r.location);
}
