use super::frame::HostSearch;
use super::maps::CodeMaps;
use super::*;
use crate::scene::{Codebook, Image, LanguageField, LevelField};
use std::sync::Arc;

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
    let mask = r.mask();
    for (p, &k) in maps[1].data.iter().enumerate() {
        assert_eq!(mask.data[p], k == 0 || k == 2, "pixel {p}");
    }
    assert!(maps[1].at(r.location.0, r.location.1) != 1 && r.found && r.score > 0.95);
    assert_eq!(r.relevancy().data.len(), 2400);
    assert_eq!(r.mask_pixels(), mask.data.iter().filter(|m| **m).count());
    // raising the bar to the very best code leaves out its near-copy
    let strict = QueryOptions { mask: MaskRule::Codes(1.0), ..QueryOptions::default() };
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &strict).unwrap();
    assert!(maps[1].data.iter().zip(&r.mask().data).all(|(&k, &m)| m == (k == 0)));
    // without that code in the view, its near-copy is the best
    let mut maps = maps;
    maps.iter_mut().flat_map(|m| &mut m.data).filter(|k| **k == 0).for_each(|k| *k = 1);
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &strict).unwrap();
    assert!(maps[1].data.iter().zip(&r.mask().data).all(|(&k, &m)| m == (k == 2)));
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
    let (one, two) = ([frame(), frame(), frame()], [Image::filled(60, 40, -1), frame(), frame()]);
    let (field, q, options) = (field(), query(&[1.0, 0.0, 0.0, 0.0]), QueryOptions::default());
    let frames = [&one, &two].map(|codes| Arc::new(CodeMaps::new(codes).unwrap()));
    let relevancy = field_relevancy(&field, &q).unwrap();
    let together = answer_all(&frames, &relevancy, &options, None).unwrap();
    // The search of a device finds the peaks of all levels before one is chosen.
    let searched = answer_all(&frames, &relevancy, &options, Some(&mut HostSearch(&frames))).unwrap();
    for ((codes, all), searched) in [&one, &two].into_iter().zip(&together).zip(&searched) {
        let alone = answer(codes, &field, &q, &options).unwrap();
        for other in [all, searched] {
            assert_eq!(
                (alone.level, alone.location, alone.mask()),
                (other.level, other.location, other.mask())
            );
            assert_eq!(alone.relevancy(), other.relevancy());
        }
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
    assert!(!r.found && r.mask().data.iter().all(|m| !m));
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
                    view.masks.data.iter().zip(&r.mask().data).all(|(k, &m)| m == (k == object)),
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

/// [`answer_with`] for [`MaskRule::Codes`] in plain steps over whole images of f32.
struct PlainAnswer {
    level: usize,
    score: f32,
    relevancy: Image<f32>,
    mask: Image<bool>,
    /// Summed relevancy of all levels in the box of every pixel.
    evidence: Image<f32>,
    /// Value of every level.
    peaks: Vec<f32>,
}

fn plain_answer(codes: &[Image<i32>], relevancy: &[Vec<f32>], share: f32) -> PlainAnswer {
    let highest = |map: &Image<f32>| map.data.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let smooth = |map: &Image<f32>| filter::blend(map, &filter::box30(map));
    let raw: Vec<Image<f32>> = codes.iter().zip(relevancy).map(|(m, r)| relevancy_map(m, r)).collect();
    let peaks: Vec<f32> = raw
        .iter()
        .map(|raw| {
            let data = raw.data.iter().map(|v| (2.0 * v - 1.0).max(0.0)).collect();
            let peak = highest(&smooth(&Image { data, ..*raw }));
            score::margin(if peak > 0.0 { 0.5 + 0.5 * peak } else { highest(raw).min(0.5) })
        })
        .collect();
    let level = coarsest_good(&peaks, SLACK).unwrap();
    let value = |k: i32| usize::try_from(k).ok().and_then(|k| relevancy[level].get(k)).copied();
    let top = codes[level].data.iter().filter_map(|k| value(*k)).fold(0.0, f32::max);
    let bar = code_bar(top, share);
    let mask = codes[level].data.iter().map(|k| value(*k).is_some_and(|r| r > 0.0 && r >= bar));
    let mut sum = raw[0].clone();
    for other in &raw[1..] {
        sum.data.iter_mut().zip(&other.data).for_each(|(s, v)| *s += v);
    }
    PlainAnswer {
        level,
        score: highest(&raw[level]).max(0.0),
        relevancy: smooth(&raw[level]),
        mask: Image { width: sum.width, height: sum.height, data: mask.collect() },
        evidence: filter::box30(&sum),
        peaks,
    }
}

/// A map of rectangles of random codes, some void, with single pixels of others.
fn random_map(random: &mut crate::math::Random, [width, height]: [usize; 2], codes: usize) -> Image<i32> {
    let mut map = Image::filled(width, height, random.below(codes + 1) as i32 - 1);
    for k in 0..40 {
        let (x, y) = (random.below(width), random.below(height));
        let edge = if k < 20 { 1 + random.below(width.max(height) / 2 + 1) } else { 1 };
        let code = random.below(codes + 1) as i32 - 1;
        for y in y..(y + edge).min(height) {
            map.data[y * width + x..y * width + (x + edge).min(width)].fill(code);
        }
    }
    map
}

#[test]
fn answers_equal_plain_steps_on_random_maps() {
    let mut random = crate::math::Random::new(9);
    let (mut levels, mut partial) = ([0; 3], 0);
    for trial in 0..60 {
        let size = [[97, 71], [20, 9], [33, 130], [160, 31]][trial % 4];
        let counts = [12, 8, 4];
        let codes = counts.map(|count| random_map(&mut random, size, count));
        // The last code of a level is unknown to the codebook. Every third trial fits nothing.
        let most = if trial % 3 == 2 { 0.5 } else { 0.98 };
        let relevancy: Vec<Vec<f32>> = counts
            .iter()
            .map(|count| (1..*count).map(|_| most * random.uniform().powi(2) as f32).collect())
            .collect();
        let plain = plain_answer(&codes, &relevancy, CODE_SHARE);
        let got = answer_with(&codes, &relevancy, &QueryOptions::default()).unwrap();
        let top = plain.peaks.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let bar = ((1.0 - SLACK.share) * top - SLACK.margin).max(0.0);
        // Margins within rounding of the bar may fall on either side.
        if plain.peaks.iter().any(|p| (p - bar).abs() < 1e-4 || (p - top).abs() < 1e-4 && *p != top) {
            continue;
        }
        assert_eq!((got.level, got.score, got.mask()), (plain.level, plain.score, plain.mask), "{trial}");
        levels[got.level] += 1;
        let (mask, relevancy) = (got.mask(), got.relevancy());
        let difference = relevancy.data.iter().zip(&plain.relevancy.data).map(|(a, b)| (a - b).abs());
        // Half a unit of 2⁻²⁰, and rounding to f32.
        assert!(difference.fold(0.0, f32::max) < 7e-7, "{trial}");
        let any = mask.data.contains(&true);
        partial += usize::from(any && mask.data.contains(&false));
        let evidence = |p: usize| plain.evidence.data[p];
        let inside = (0..mask.data.len()).filter(|p| !any || mask.data[*p]);
        let best = inside.map(evidence).fold(f32::NEG_INFINITY, f32::max);
        let own = got.location.1 * size[0] + got.location.0;
        assert!((!any || mask.data[own]) && best - evidence(own) < 3e-6, "{trial}");
        assert_eq!(got.mask_pixels(), mask.data.iter().filter(|m| **m).count());
    }
    assert!(levels.iter().all(|n| *n > 0) && partial > 20, "{levels:?} {partial}");
}
