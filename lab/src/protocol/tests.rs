//! Each protocol against a plain computation in f64 that shares no code with it.
use super::*;
use glam::DVec3;
use splatvk::eval::{GroundTruth, Split};
use splatvk::math::Random;
use splatvk::query::TextQuery;
use splatvk::query::presence::Alternatives;
use splatvk::scene::{Codebook, Image, LanguageField, LevelField, Pose};

fn unit(random: &mut Random) -> Vec<f32> {
    let v: Vec<f64> = (0..3).map(|_| random.uniform() - 0.5).collect();
    let n = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    v.iter().map(|x| (x / n) as f32).collect()
}

/// Levels s and l with five codes each, m without any.
fn field(random: &mut Random) -> LanguageField {
    let level = |codes: usize, random: &mut Random| LevelField {
        codebook: Codebook {
            embedding_dim: 3,
            code_dim: 1,
            embeddings: (0..codes).flat_map(|_| unit(random)).collect(),
            ..Codebook::default()
        },
        ..LevelField::default()
    };
    LanguageField { levels: vec![level(5, random), level(0, random), level(5, random)], space: "test".into() }
}

fn query(text: &str, random: &mut Random) -> TextQuery {
    TextQuery {
        text: text.into(),
        embedding: unit(random),
        canonicals: (0..4).flat_map(|_| unit(random)).collect(),
        // A text with a colour, in other colours: published protocols have no rule of colours.
        alternatives: Alternatives {
            colours: (0..2).flat_map(|_| unit(random)).collect(),
            ..Default::default()
        },
        ..Default::default()
    }
}

/// Blocks of random codes, some without code.
fn codes(width: usize, height: usize, random: &mut Random) -> Vec<Image<i32>> {
    let level = |random: &mut Random| {
        let blocks: Vec<i32> = (0..48).map(|_| (random.uniform() * 6.0) as i32 - 1).collect();
        let data = (0..width * height).map(|p| blocks[p / width * 6 / height * 8 + p % width * 8 / width]);
        Image { width, height, data: data.collect() }
    };
    vec![level(random), Image::filled(width, height, -1), level(random)]
}

/// Relevancy of a vector in f64.
fn oracle_relevancy(phi: &[f32], q: &TextQuery) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| *x as f64 * *y as f64).sum::<f64>();
    let against = |n: &[f32]| {
        let (a, b) = ((10.0 * dot(phi, &q.embedding)).exp(), (10.0 * dot(phi, n)).exp());
        a / (a + b)
    };
    q.canonicals.chunks(3).map(against).fold(1.0, f64::min)
}

fn oracle_map(field: &LanguageField, codes: &[Image<i32>], level: usize, q: &TextQuery) -> Vec<f64> {
    let rows: Vec<&[f32]> = field.levels[level].codebook.embeddings.chunks(3).collect();
    // one value per code, as f32, so that equal pixels are equal in both computations
    let value = |&k: &i32| if k < 0 { 0.0 } else { oracle_relevancy(rows[k as usize], q) as f32 as f64 };
    codes[level].data.iter().map(value).collect()
}

/// Brute-force 30×30 mean, anchor 15, reflection without the edge.
fn oracle_box(map: &[f64], w: usize, h: usize) -> Vec<f64> {
    let mut out = vec![0.0; w * h];
    for y in 0..h as isize {
        for x in 0..w as isize {
            let mut sum = 0.0;
            for dy in -15..15 {
                for dx in -15..15 {
                    sum += map[reflect(y + dy, h) * w + reflect(x + dx, w)];
                }
            }
            out[y as usize * w + x as usize] = sum / 900.0;
        }
    }
    out
}

/// Index after reflection at both ends.
fn reflect(mut i: isize, n: usize) -> usize {
    loop {
        if i < 0 {
            i = -i;
        } else if i >= n as isize {
            i = 2 * (n as isize - 1) - i;
        } else {
            return i as usize;
        }
    }
}

fn maximum(v: &[f64]) -> f64 {
    v.iter().copied().fold(f64::MIN, f64::max)
}

fn oracle_lerf_mask(blended: &[f64], w: usize, h: usize, threshold: f64) -> Vec<bool> {
    let low = blended.iter().copied().fold(f64::MAX, f64::min);
    let span = maximum(blended) - low + 1e-9;
    let hot: Vec<bool> =
        blended.iter().map(|v| (2.0 * (v - low) / span - 1.0).clamp(0.0, 1.0) > threshold).collect();
    (0..w * h)
        .map(|p| {
            let (x, y) = ((p % w) as isize, (p / w) as isize);
            let mut votes = 0;
            for dy in -3..=3 {
                for dx in -3..=3 {
                    let (cx, cy) = ((x + dx).clamp(0, w as isize - 1), (y + dy).clamp(0, h as isize - 1));
                    votes += u32::from(hot[cy as usize * w + cx as usize]);
                }
            }
            votes >= 25
        })
        .collect()
}

fn oracle_iou(a: &[bool], b: &[bool]) -> f64 {
    let both = a.iter().zip(b).filter(|(x, y)| **x && **y).count();
    let either = a.iter().zip(b).filter(|(x, y)| **x || **y).count();
    if either == 0 { 0.0 } else { both as f64 / either as f64 }
}

fn camera(name: &str, x: f64, size: (u32, u32)) -> Camera {
    Camera {
        name: format!("{name}.jpg"),
        width: size.0,
        height: size.1,
        fx: 50.0,
        fy: 50.0,
        cx: size.0 as f64 / 2.0,
        cy: size.1 as f64 / 2.0,
        pose: Pose { translation: DVec3::new(-x, 0.1 * x * x, 0.0), ..Pose::IDENTITY },
    }
}

const W: usize = 64;
const H: usize = 50;

/// Two categories: "cup" of two objects, one with swapped corners; "plate" without a polygon.
fn lerf_label() -> serde_json::Value {
    serde_json::json!({
        "info": {"name": "frame_00001.jpg", "width": W, "height": H},
        "objects": [
            {"category": "cup", "bbox": [20.0, 22.0, 4.0, 3.0], "segmentation": [[4.9, 3.2], [20.0, 3.0], [20.7, 22.0], [4.0, 22.0]]},
            {"category": "cup", "bbox": [30.0, 30.0, 50.0, 49.0], "segmentation": [[30.0, 30.0], [50.0, 30.0], [40.0, 49.0]]},
            {"category": "plate", "bbox": [0.0, 0.0, 63.0, 49.0], "segmentation": []}
        ]
    })
}

#[test]
fn lerf_equals_plain_computation() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("frame_00001.json"), lerf_label().to_string()).unwrap();
    let scene = [camera("frame_00001", 0.0, (W as u32, H as u32))];
    for seed in 1000..1008 {
        let mut random = Random::new(seed);
        let (field, codes) = (field(&mut random), codes(W, H, &mut random));
        let mut protocol = open(ProtocolKind::Lerf, folder.path(), &scene, &[]).unwrap();
        assert_eq!(protocol.prompts(), ["cup", "plate"]);
        let queries: Vec<TextQuery> = protocol.prompts().iter().map(|p| query(p, &mut random)).collect();
        let scores = CodeScores::new(&field, &queries).unwrap();
        let masks = protocol.add(0, &DecodedView { codes: &codes, scores: &scores }).unwrap();
        let report = protocol.finish();
        assert_eq!(report.scores.len(), 4);
        let mut ious = Vec::new();
        for (k, q) in queries.iter().enumerate() {
            let maps: Vec<Vec<f64>> = [0, 2].map(|l| oracle_map(&field, &codes, l, q)).to_vec();
            let boxed: Vec<Vec<f64>> = maps.iter().map(|m| oracle_box(m, W, H)).collect();
            let blended: Vec<Vec<f64>> = maps
                .iter()
                .zip(&boxed)
                .map(|(m, b)| m.iter().zip(b).map(|(x, y)| 0.5 * (x + y)).collect())
                .collect();
            let level = usize::from(maximum(&blended[1]) > maximum(&blended[0]));
            let mask = oracle_lerf_mask(&blended[level], W, H, 0.6);
            assert_eq!(masks[k].1.data, mask, "seed {seed}");
            // truth by hand: a rectangle and a triangle, outlines included; nothing for the plate
            let truth: Vec<bool> = (0..W * H)
                .map(|p| {
                    let (x, y) = ((p % W) as f64, (p / W) as f64);
                    let rectangle = (4.0..=20.0).contains(&x) && (3.0..=22.0).contains(&y);
                    let half = (49.0 - y) * 10.0 / 19.0;
                    // the outline takes one pixel per row here (steps along y are longer): x
                    // rounded
                    let triangle = (30.0..=49.0).contains(&y) && (x - 40.0).abs() <= half.round().max(half);
                    k == 0 && (rectangle || triangle)
                })
                .collect();
            let iou = oracle_iou(&mask, &truth);
            let score = report.scores.iter().find(|s| s.phrase == q.text && s.rule == "thr0.6").unwrap();
            assert!((score.iou - iou).abs() < 1e-12, "seed {seed}: {} {iou}", score.iou);
            assert_eq!(score.level, Some([0, 2][level]));
            ious.push(iou);
            let best = usize::from(maximum(&boxed[1]) > maximum(&boxed[0]));
            // The program sums in f32: pixels within rounding of the top may be its top.
            let top = maximum(&boxed[best]);
            let near = |slack: f64| -> Vec<usize> {
                (0..W * H).filter(|&p| boxed[best][p] >= top - slack).collect()
            };
            let inside = |p: &usize| {
                let (x, y) = (p % W, p / W);
                k == 1
                    || ((4..=20).contains(&x) && (3..=22).contains(&y))
                    || ((30..=50).contains(&x) && (30..=49).contains(&y))
            };
            let (exact, close) = (near(0.0).iter().any(inside), near(1e-6).iter().any(inside));
            if exact == close {
                assert_eq!(score.localised, Some(exact), "seed {seed} {}", q.text);
            }
        }
        let summary = &report.summary["train"];
        assert!((summary.figures["miou"] - (ious[0] + ious[1]) / 2.0).abs() < 1e-12);
        assert_eq!((summary.figures["pairs"], summary.iou["plate"]), (2.0, 0.0));
    }
}

#[test]
fn lerf_ties_prefer_finer_level() {
    let folder = tempfile::tempdir().unwrap();
    let label = serde_json::json!({
        "info": {"name": "a.jpg", "width": 2 * W, "height": 2 * H},
        "objects": [{"category": "x", "bbox": [0, 0, 63, 99], "segmentation": [[0, 0], [63, 0], [63, 99], [0, 99]]}]
    });
    std::fs::write(folder.path().join("a.json"), label.to_string()).unwrap();
    let scene = [camera("a", 0.0, (W as u32, H as u32))];
    let mut random = Random::new(7);
    let mut field = field(&mut random);
    field.levels[2] = field.levels[0].clone();
    let q = query("x", &mut random);
    let rows: Vec<f64> =
        field.levels[0].codebook.embeddings.chunks(3).map(|r| oracle_relevancy(r, &q)).collect();
    let best = (0..5).max_by(|&a, &b| rows[a].total_cmp(&rows[b])).unwrap() as i32;
    // the left half is the best code, the right half void; both levels alike
    let data = (0..W * H).map(|p| if p % W < W / 2 { best } else { -1 }).collect();
    let map = Image { width: W, height: H, data };
    let codes = vec![map.clone(), Image::filled(W, H, -1), map];
    let mut protocol = open(ProtocolKind::Lerf, folder.path(), &scene, &[]).unwrap();
    let scores = CodeScores::new(&field, &[q]).unwrap();
    protocol.add(0, &DecodedView { codes: &codes, scores: &scores }).unwrap();
    let report = protocol.finish();
    assert_eq!(report.scores[0].level, Some(0));
    assert_eq!(report.scores[0].localised, Some(true));
    // smoothing moves the edge by a few columns of 64
    assert!(report.scores[0].iou > 0.8, "{}", report.scores[0].iou);
}

#[test]
fn polygons_equal_crossing_numbers_and_outlines() {
    let mut random = Random::new(1001);
    for case in 0..200 {
        let n = 1 + case % 7;
        let polygon: Vec<[f64; 2]> = (0..n).map(|_| [0; 2].map(|_| random.uniform() * 50.0 - 10.0)).collect();
        let mut mask = Image::filled(30, 30, false);
        polygon::fill(&mut mask, &polygon);
        let p: Vec<[f64; 2]> = polygon.iter().map(|v| v.map(f64::trunc)).collect();
        for y in 0..30 {
            for x in 0..30 {
                let (u, v) = (x as f64, y as f64);
                let (mut odd, mut on, mut tie) = (false, false, false);
                for i in 0..n {
                    let (a, b) = (p[i], p[(i + 1) % n]);
                    if (a[1] > v) != (b[1] > v) && u < a[0] + (v - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) {
                        odd = !odd;
                    }
                    // distance along the shorter axis of the edge at this step of the longer one
                    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
                    let (major, minor) = if dx.abs() >= dy.abs() { (0, 1) } else { (1, 0) };
                    let at = [u, v];
                    let (length, t) = (b[major] - a[major], at[major] - a[major]);
                    let s = if length == 0.0 { 0.0 } else { t / length };
                    if (0.0..=1.0).contains(&s) && (length != 0.0 || t == 0.0) {
                        let off = (at[minor] - a[minor] - s * (b[minor] - a[minor])).abs();
                        on |= off < 0.5 - 1e-9;
                        tie |= (off - 0.5).abs() <= 1e-9;
                    }
                }
                if !tie {
                    assert_eq!(mask.at(x, y), odd || on, "case {case} at {x} {y}: {p:?}");
                }
            }
        }
    }
    let mut empty = Image::filled(4, 4, false);
    polygon::fill(&mut empty, &[]);
    assert!(empty.data.iter().all(|m| !m));
}

fn write_mask(path: &Path, data: impl Fn(usize, usize) -> bool) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let value = |x: u32, y: u32| image::Luma([if data(x as usize, y as usize) { 255u8 } else { 0 }]);
    image::GrayImage::from_fn(W as u32, H as u32, value).save(path).unwrap();
}

#[test]
fn ovs_rules_equal_plain_computations() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("segmentations");
    std::fs::create_dir_all(&root).unwrap();
    std::fs::write(root.join("classes.txt"), "hand\nwood wall\n\ncat\n").unwrap();
    write_mask(&root.join("00/hand.png"), |x, _| x < 20);
    write_mask(&root.join("00/wood wall.png"), |x, y| x >= 20 && y < 25);
    let scene = [camera("00", 0.0, (W as u32, H as u32))];
    let truth = |c: usize, p: usize| [p % W < 20, p % W >= 20 && p / W < 25][c];
    // the scene is rendered at twice the size of the labels
    let up = |p: usize| (2 * (p / W) + 1) * 2 * W + 2 * (p % W) + 1;
    let down = |mask: &[bool]| -> Vec<bool> { (0..W * H).map(|p| mask[up(p)]).collect() };
    let (mut passed, mut substituted) = (0, 0);
    for seed in 1000..1030 {
        let mut random = Random::new(seed);
        let (field, codes) = (field(&mut random), codes(2 * W, 2 * H, &mut random));
        let mut protocol = open(ProtocolKind::Ovs, folder.path(), &scene, &[]).unwrap();
        assert_eq!(protocol.prompts(), ["hand", "wood wall", "cat"]);
        let mut queries: Vec<TextQuery> = protocol.prompts().iter().map(|p| query(p, &mut random)).collect();
        if seed % 2 == 0 {
            // phrases that most codes answer to: masks large enough for the rule
            for q in &mut queries {
                q.canonicals = q.embedding.iter().map(|v| -v).collect();
            }
        }
        let scores = CodeScores::new(&field, &queries).unwrap();
        protocol.add(0, &DecodedView { codes: &codes, scores: &scores }).unwrap();
        let report = protocol.finish();
        let value = |level: usize, c: usize, p: usize| -> Option<f64> {
            let k = usize::try_from(codes[level].data[p]).ok()?;
            let row = &field.levels[level].codebook.embeddings[3 * k..3 * k + 3];
            Some(row.iter().zip(&queries[c].embedding).map(|(a, b)| a * b).sum::<f32>() as f64)
        };
        for c in 0..2 {
            let target: Vec<bool> = (0..W * H).map(|p| truth(c, p)).collect();
            let find = |rule: &str| {
                report.scores.iter().find(|s| s.phrase == queries[c].text && s.rule == rule).unwrap()
            };
            // the paper's text, on the maps and on normalised ones
            let maps = [0, 2].map(|l| oracle_map(&field, &codes, l, &queries[c]));
            let scaled = maps.clone().map(|m| {
                let low = m.iter().copied().fold(f64::INFINITY, f64::min) as f32;
                let range = maximum(&m) as f32 - low;
                m.iter().map(|v| ((*v as f32 - low) / range) as f64).collect::<Vec<f64>>()
            });
            // 2000 of 1440 x 1080 pixels
            let least = 2000.0 / (1440.0 * 1080.0) * maps[0].len() as f64;
            for (rule, by) in [("paper", &maps), ("normalised", &scaled)] {
                let mut candidates: Vec<(f64, usize)> = Vec::new();
                for l in 0..2 {
                    let above = maps[l].iter().zip(&by[l]).filter(|(_, v)| **v > 0.8f32 as f64);
                    let inside: Vec<f64> = above.map(|(v, _)| *v).collect();
                    if inside.len() as f64 > least {
                        candidates.push((inside.iter().sum::<f64>() / inside.len() as f64, l));
                    }
                }
                let best = candidates.iter().copied().reduce(|a, b| if b.0 > a.0 { b } else { a });
                let (level, mask): (usize, Vec<bool>) = match best {
                    Some((_, l)) => (l, by[l].iter().map(|v| *v > 0.8f32 as f64).collect()),
                    None => {
                        let l = usize::from(maximum(&maps[1]) > maximum(&maps[0]));
                        let bar = (0.95f32 * maximum(&maps[l]) as f32) as f64;
                        (l, maps[l].iter().map(|v| *v > bar).collect())
                    }
                };
                let iou = oracle_iou(&down(&mask), &target);
                assert!((find(rule).iou - iou).abs() < 1e-12, "{rule}, seed {seed} class {c}");
                assert_eq!(find(rule).level, Some([0, 2][level]));
                assert_eq!(find(rule).substituted, best.is_none());
                if rule == "paper" {
                    passed += usize::from(best.is_some());
                    substituted += usize::from(best.is_none());
                }
            }
            // the authors' script: of m and l only l has codes here
            let cosines: Vec<Option<f64>> = (0..4 * W * H).map(|p| value(2, c, p)).collect();
            let top = cosines.iter().flatten().copied().fold(f64::MIN, f64::max);
            let bar = (0.85f32 * top as f32) as f64;
            let mask: Vec<bool> = cosines.iter().map(|v| v.is_some_and(|v| v > bar)).collect();
            assert!(
                (find("authors").iou - oracle_iou(&down(&mask), &target)).abs() < 1e-12,
                "seed {seed} class {c}"
            );
        }
        // argmax over the class list and both levels
        let mut right = 0;
        let mut labelled = 0;
        let mut claimed = vec![vec![false; W * H]; 3];
        for p in 0..W * H {
            let mut best: Option<(f64, usize)> = None;
            for c in 0..3 {
                for l in [0, 2] {
                    if let Some(v) = value(l, c, up(p)).filter(|v| best.is_none_or(|b| *v > b.0)) {
                        best = Some((v, c));
                    }
                }
            }
            if let Some((_, c)) = best {
                claimed[c][p] = true;
            }
            if truth(0, p) || truth(1, p) {
                labelled += 1;
                right += usize::from(best.is_some_and(|(_, c)| c < 2 && truth(c, p)));
            }
        }
        let mean = (0..2)
            .map(|c| oracle_iou(&claimed[c], &(0..W * H).map(|p| truth(c, p)).collect::<Vec<_>>()))
            .sum::<f64>()
            / 2.0;
        let figures = &report.summary["train"].figures;
        assert!((figures["miou_argmax"] - mean).abs() < 1e-12);
        assert!((figures["accuracy_argmax"] - right as f64 / labelled as f64).abs() < 1e-12);
        assert_eq!(figures["pairs"], 2.0, "the frame does not label the cat");
    }
    assert!(passed > 0 && substituted > 0, "both branches of the paper's rule: {passed} {substituted}");
}

#[test]
fn scannet_counts_labels_and_places_frames() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("scene0000_00");
    for sub in ["color", "label-filt", "pose", "intrinsic"] {
        std::fs::create_dir_all(dir.join(sub)).unwrap();
    }
    // raw id 1 → wall, 40 → chair, 99 → 35 (a lamp: other), 7 → unlabelled
    let tsv = "id\traw_category\tnyu40id\n1\twall\t1\n40\tchair\t5\n99\tlamp\t35\n7\tunknown\t0\n";
    std::fs::write(folder.path().join("scannetv2-labels.combined.tsv"), tsv).unwrap();
    std::fs::write(dir.join("intrinsic/intrinsic_color.txt"), "50 0 32 0\n0 50 25 0\n0 0 1 0\n0 0 0 1\n")
        .unwrap();
    let raw = |x: usize, y: usize| -> u16 {
        match (x < 16, x < 40, y < 30) {
            (true, _, _) => 1,
            (_, true, true) => 40,
            (_, true, false) => 99,
            _ => [7, 1234][y % 2],
        }
    };
    for (k, x) in [(0, 0.0), (10, 1.0), (20, 2.0)] {
        let photo = image::RgbImage::new(W as u32, H as u32);
        photo.save(dir.join(format!("color/{k}.png"))).unwrap();
        let label = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_fn(W as u32, H as u32, |x, y| {
            image::Luma([raw(x as usize, y as usize)])
        });
        label.save(dir.join(format!("label-filt/{k}.png"))).unwrap();
        let pose = format!("1 0 0 {x}\n0 1 0 {}\n0 0 1 0\n0 0 0 1\n", 0.1 * x * x);
        std::fs::write(dir.join(format!("pose/{k}.txt")), pose).unwrap();
    }
    // the scene's world is half as large and turned
    let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.3, -0.5, 0.2)).rotation;
    let scene: Vec<Camera> = [(0, 0.0), (10, 1.0)]
        .iter()
        .map(|(k, x)| {
            let centre = turn * DVec3::new(*x, 0.1 * x * x, 0.0) * 0.5;
            let rotation = turn.transpose();
            let pose = Pose { rotation, translation: -(rotation * centre) };
            Camera { pose, ..camera(&k.to_string(), 0.0, (W as u32, H as u32)) }
        })
        .collect();
    let mut protocol = open(ProtocolKind::ScanNet, &dir, &scene, &[]).unwrap();
    let views = protocol.views().to_vec();
    let splits: Vec<_> = views.iter().map(|v| (v.stem.as_str(), v.split)).collect();
    assert_eq!(splits, [("0", Split::Train), ("10", Split::Train), ("20", Split::Test)]);
    let expected = turn * DVec3::new(2.0, 0.4, 0.0) * 0.5;
    assert!((views[2].camera.pose.centre() - expected).length() < 1e-9);
    assert_eq!((views[2].camera.cx, views[2].camera.cy), (32.0, 25.0));

    let mut random = Random::new(1004);
    let (field, codes) = (field(&mut random), codes(W, H, &mut random));
    let queries: Vec<TextQuery> = protocol.prompts().iter().map(|p| query(p, &mut random)).collect();
    let scores = CodeScores::new(&field, &queries).unwrap();
    for index in 0..3 {
        protocol.add(index, &DecodedView { codes: &codes, scores: &scores }).unwrap();
    }
    let report = protocol.finish();
    let label = |x: usize, y: usize| match raw(x, y) {
        1 => Some(0),
        40 => Some(3),
        99 => Some(7),
        _ => None,
    };
    let predicted = |p: usize| -> Option<usize> {
        let mut best: Option<(f32, usize)> = None;
        for (c, q) in queries.iter().enumerate() {
            for l in [0, 2] {
                let Ok(k) = usize::try_from(codes[l].data[p]) else { continue };
                let row = &field.levels[l].codebook.embeddings[3 * k..3 * k + 3];
                let v: f32 = row.iter().zip(&q.embedding).map(|(a, b)| a * b).sum();
                if best.is_none_or(|b| v > b.0) {
                    best = Some((v, c));
                }
            }
        }
        best.map(|b| b.1)
    };
    let (mut right, mut all) = (0, 0);
    let mut ious = Vec::new();
    for k in [0, 3, 7] {
        let (mut both, mut either) = (0, 0);
        for p in 0..W * H {
            let Some(t) = label(p % W, p / W) else { continue };
            let hit = predicted(p) == Some(k);
            both += usize::from(hit && t == k);
            either += usize::from(hit || t == k);
            if k == 0 {
                all += 1;
                right += usize::from(predicted(p) == Some(t));
            }
        }
        ious.push(both as f64 / either as f64);
    }
    for split in ["train", "test"] {
        let summary = &report.summary[split];
        assert!((summary.figures["miou"] - ious.iter().sum::<f64>() / 3.0).abs() < 1e-12);
        assert!((summary.figures["accuracy"] - right as f64 / all as f64).abs() < 1e-12);
        assert_eq!(summary.iou.len(), 3, "labels that the truth never shows do not count");
    }
    assert_eq!(report.summary["train"].figures["pixels"], 2.0 * all as f64);
    // without the table, raw ids beyond NYU40 are refused
    std::fs::remove_file(folder.path().join("scannetv2-labels.combined.tsv")).unwrap();
    let mut bare = open(ProtocolKind::ScanNet, &dir, &scene, &[]).unwrap();
    let error = bare.add(0, &DecodedView { codes: &codes, scores: &scores }).unwrap_err().to_string();
    assert!(error.contains("scannetv2-labels.combined.tsv"), "{error}");
}

#[test]
fn ground_truth_serves_lerf_and_ovs() {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast"));
    let truth = GroundTruth::read(folder).unwrap();
    let scene: Vec<Camera> =
        truth.frames.iter().filter(|f| f.split == Split::Train).map(|f| f.camera.clone()).collect();
    let objects = truth.objects(&truth.frames[0]).unwrap().unwrap();
    // Codes = object indices, embeddings = unit axes, prompts = the axes: every answer is exact.
    let mut embeddings = vec![0.0f32; 12 * 13];
    (0..12).for_each(|k| embeddings[k * 13 + k] = 1.0);
    let codebook = Codebook { embedding_dim: 13, code_dim: 1, embeddings, ..Codebook::default() };
    let field =
        LanguageField { levels: vec![LevelField { codebook, ..LevelField::default() }], space: "x".into() };
    let data = objects.data.iter().map(|&o| o as i32).collect();
    let codes = [Image { width: objects.width, height: objects.height, data }];
    let ask = |phrase: &String| {
        let label = truth.labels.iter().find(|(_, p)| *p == phrase).unwrap().0;
        let axis = |k: u32| (0..13).map(|i| f32::from(u8::from(i == k))).collect::<Vec<f32>>();
        TextQuery {
            text: phrase.clone(),
            embedding: axis(*label),
            canonicals: axis(12),
            ..Default::default()
        }
    };
    for (kind, figure) in [(ProtocolKind::Lerf, "localisation"), (ProtocolKind::Ovs, "accuracy_argmax")] {
        let mut protocol = open(kind, folder, &scene, &[]).unwrap();
        assert_eq!(protocol.views().len(), 18);
        let queries: Vec<TextQuery> = protocol.prompts().iter().map(ask).collect();
        let scores = CodeScores::new(&field, &queries).unwrap();
        protocol.add(0, &DecodedView { codes: &codes, scores: &scores }).unwrap();
        let ProtocolSummary { figures, iou } = protocol.finish().summary["train"].clone();
        assert_eq!(figures[figure], 1.0, "{kind:?}");
        // The table competes as a label, but is no object to find.
        assert!(iou.contains_key("lemon") && !iou.contains_key("wooden table"), "{kind:?}: {iou:?}");
        match kind {
            // masks are cut from smoothed maps: edges and thin parts move
            ProtocolKind::Lerf => assert!(figures["miou"] > 0.6, "{figures:?}"),
            _ => assert_eq!((figures["miou_argmax"], figures["miou_authors"]), (1.0, 1.0)),
        }
    }
}

#[test]
fn protocols_refuse_folders_of_other_layouts() {
    let folder = tempfile::tempdir().unwrap();
    let scene = [camera("a", 0.0, (W as u32, H as u32))];
    for (kind, expected) in [
        (ProtocolKind::Lerf, "frame_*.json"),
        (ProtocolKind::Ovs, "classes.txt"),
        (ProtocolKind::ScanNet, "label-filt"),
    ] {
        let error = open(kind, folder.path(), &scene, &[]).err().unwrap();
        assert!(error.exit_code() == 2 && error.to_string().contains(expected), "{error}");
    }
    std::fs::write(folder.path().join("b.json"), lerf_label().to_string()).unwrap();
    let error = open(ProtocolKind::Lerf, folder.path(), &scene, &[]).err().unwrap().to_string();
    assert!(error.contains("--cameras"), "{error}");
    std::fs::write(folder.path().join("b.json"), "{}").unwrap();
    let error = open(ProtocolKind::Lerf, folder.path(), &scene, &[]).err().unwrap().to_string();
    assert!(error.contains("not a LERF-OVS label file"), "{error}");
}
