use super::score::{LevelState, fuse, match_proposals};
use super::*;
use crate::scene::{Camera, DenseWarp, DepthMap, Image, MaskId, Pose};
use crate::{LevelMasks, matcher};
use glam::DVec3;
use splatvk_test_support::breakfast::{TestView, train_views};
use std::collections::{BTreeMap, BTreeSet};

const DIM: usize = 32;

/// Deterministic noise.
struct Noise(u64);
impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 33) as f64 / (1u64 << 31) as f64
    }
    fn unit(&mut self) -> Vec<f32> {
        let v: Vec<f64> = (0..DIM).map(|_| (0..4).map(|_| self.uniform() - 0.5).sum()).collect();
        let n = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        v.iter().map(|x| (x / n) as f32).collect()
    }
    /// A unit vector whose cosine with `v` is about 1/√(1 + s²).
    fn near(&mut self, v: &[f32], s: f32) -> Vec<f32> {
        let n = self.unit();
        let w: Vec<f32> = v.iter().zip(&n).map(|(a, b)| a + s * b).collect();
        let norm = w.iter().map(|x| x * x).sum::<f32>().sqrt();
        w.iter().map(|x| x / norm).collect()
    }
}

fn exact_depth(depth: &Image<f32>) -> DepthMap {
    let known = depth.data.iter().map(|&z| f32::from(z > 0.0)).collect();
    DepthMap { depth: depth.clone(), confidence: Image { data: known, ..*depth } }
}

/// The breakfast views with their true masks; in level l every second view cuts every other object
/// in two.
struct Scene {
    views: Vec<ViewMasks>,
    cameras: Vec<Camera>,
    depths: Vec<DepthMap>,
    /// [view][mask of level l] true object.
    object: Vec<Vec<i32>>,
}

fn scene(split: bool) -> Scene {
    let mut noise = Noise(7);
    let axes: Vec<Vec<f32>> = (0..12).map(|_| noise.unit()).collect();
    let mut out = Scene { views: Vec::new(), cameras: Vec::new(), depths: Vec::new(), object: Vec::new() };
    for (t, view) in train_views().into_iter().enumerate() {
        let TestView { masks, depth, camera, .. } = view;
        let mut ids: BTreeMap<(i32, bool), usize> = BTreeMap::new();
        let mut level = LevelMasks { labels: masks.clone(), ..LevelMasks::default() };
        let mut objects = Vec::new();
        let rows: BTreeMap<i32, (usize, usize)> = (0..masks.data.len()).fold(BTreeMap::new(), |mut m, p| {
            let e = m.entry(masks.data[p]).or_insert((usize::MAX, 0));
            *e = (e.0.min(p / masks.width), e.1.max(p / masks.width));
            m
        });
        for p in 0..masks.data.len() {
            let k = masks.data[p];
            let (top, bottom) = rows[&k];
            let lower =
                split && k > 3 && (k as usize + t).is_multiple_of(2) && 2 * (p / masks.width) > top + bottom;
            let next = ids.len();
            level.labels.data[p] = *ids.entry((k, lower)).or_insert(next) as i32;
        }
        let mut names: Vec<(usize, i32)> = ids.iter().map(|(&(k, _), &id)| (id, k)).collect();
        names.sort_unstable();
        for (_, k) in names {
            objects.push(k);
            level.quality.push(1.0);
            // cosines between views of about 1/(1 + 0.5²) = 0.8
            level.features.extend(noise.near(&axes[k as usize], 0.5));
        }
        out.views.push(ViewMasks { levels: vec![level.clone(), level.clone(), level] });
        out.object.push(objects);
        out.depths.push(exact_depth(&depth));
        out.cameras.push(camera);
    }
    out
}

impl Scene {
    fn pairs(&self) -> Vec<(usize, usize)> {
        let n = self.views.len();
        (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect()
    }
    fn projected(&self) -> Vec<PairLinks> {
        let (c, d) = (&self.cameras, &self.depths);
        self.pairs().iter().map(|&(i, j)| links_from_depth(i, j, (&c[i], &c[j]), (&d[i], &d[j]))).collect()
    }
    fn matched(&self) -> Vec<PairLinks> {
        let (c, d) = (&self.cameras, &self.depths);
        let warp = |i: usize, j: usize| matcher::geometry(&c[i], &d[i], &c[j], &d[j]);
        self.pairs().iter().map(|&(i, j)| links_from_warps(i, j, &warp(i, j), &warp(j, i))).collect()
    }
    /// Share of same-component pairs that show one object, and share of same-object pairs that are
    /// together; large masks only (100 pixels).
    fn purity_completeness(&self, a: &Alignment, level: usize) -> (f64, f64) {
        let mut owner = BTreeMap::new();
        for (k, c) in a.components[level].iter().enumerate() {
            for &m in &c.members {
                let labels = &a.views[m.view as usize].levels[level].labels;
                if labels.data.iter().filter(|&&l| l == m.mask as i32).count() >= 100 {
                    owner.insert(m, k);
                }
            }
        }
        let (mut together, mut right, mut same) = (0, 0, 0);
        for (x, kx) in &owner {
            for (y, ky) in owner.range(MaskId { view: x.view + 1, mask: 0 }..) {
                let equal = self.object[x.view as usize][x.mask as usize]
                    == self.object[y.view as usize][y.mask as usize];
                together += usize::from(kx == ky);
                right += usize::from(kx == ky && equal);
                same += usize::from(equal);
            }
        }
        (right as f64 / together.max(1) as f64, right as f64 / same.max(1) as f64)
    }
}

#[test]
fn align_links_whole_objects_only() {
    let s = scene(false);
    let (matched, projected) = (s.matched(), s.projected());
    let mut cosine = Vec::new();
    for (matching, reprojection) in [(true, false), (false, true), (true, true)] {
        let options = AlignOptions { matching, reprojection, ..AlignOptions::default() };
        let a = align(&s.views, &matched, &projected, &options).unwrap();
        for level in 0..3 {
            let (purity, completeness) = s.purity_completeness(&a, level);
            assert!(purity >= 0.98 && completeness >= 0.95, "level {level}: {purity} {completeness}");
        }
        cosine.push(a.report[2].mean_cosine);
    }
    assert!(cosine.iter().all(|&c| (0.6..0.95).contains(&c)), "{cosine:?}");
}

#[test]
fn fusion_joins_pieces_above_finest_level() {
    let s = scene(true);
    let a = align(&s.views, &s.matched(), &s.projected(), &AlignOptions::default()).unwrap();
    let (purity, completeness) = s.purity_completeness(&a, 2);
    println!("purity {purity:.3} completeness {completeness:.3} fused {:?}", a.report[2].fused);
    // a part that covers less than 37 % of the whole cannot reach τ1 at a cosine of 0.8, so some
    // halves stay alone
    assert!(purity >= 0.98 && completeness >= 0.8, "{purity} {completeness}");
    let unfused = AlignOptions { fusion: false, ..AlignOptions::default() };
    let b = align(&s.views, &s.matched(), &s.projected(), &unfused).unwrap();
    assert!(completeness > s.purity_completeness(&b, 2).1 + 0.2, "fusion must help");
    assert!(a.report[0].fused.is_empty() && a.report[2].fused.len() >= 8);
    for components in &a.components {
        for c in components {
            let views: BTreeSet<u32> = c.members.iter().map(|m| m.view).collect();
            assert_eq!(views.len(), c.members.len(), "two masks of one view in one thing");
        }
    }
    // running again on the result changes nothing
    let again = align(&a.views, &s.matched(), &s.projected(), &AlignOptions::default()).unwrap();
    assert_eq!(again.components, a.components);
    assert!(again.report.iter().all(|r| r.fused.is_empty()));
}

/// Components as sets of (original view, mask id).
fn partition(a: &Alignment, order: &[u32], level: usize) -> BTreeSet<BTreeSet<(u32, u32)>> {
    let rename = |c: &Component| c.members.iter().map(|m| (order[m.view as usize], m.mask)).collect();
    a.components[level].iter().map(rename).collect()
}

#[test]
fn align_ignores_view_order() {
    let s = scene(true);
    let options = AlignOptions::default();
    let base = align(&s.views, &s.matched(), &s.projected(), &options).unwrap();
    for order in [[2u32, 0, 3, 1], [3, 2, 1, 0]] {
        let place = |v: usize| order.iter().position(|&o| o as usize == v).unwrap();
        let views: Vec<ViewMasks> = order.iter().map(|&o| s.views[o as usize].clone()).collect();
        let moved = |links: Vec<PairLinks>| -> Vec<PairLinks> {
            let rename = |p: PairLinks| {
                let p = PairLinks { i: place(p.i), j: place(p.j), ..p };
                if p.i < p.j { p } else { p.swapped() }
            };
            links.into_iter().map(rename).rev().collect()
        };
        let a = align(&views, &moved(s.matched()), &moved(s.projected()), &options).unwrap();
        for level in 0..3 {
            assert_eq!(partition(&a, &order, level), partition(&base, &[0, 1, 2, 3], level));
        }
    }
}

#[test]
fn align_higher_threshold_adds_no_edges() {
    let s = scene(true);
    let (matched, projected) = (s.matched(), s.projected());
    let mut previous: Option<BTreeSet<(MaskId, MaskId)>> = None;
    for tau in [0.3, 0.5, 0.7, 0.9] {
        let options = AlignOptions { tau1: tau, tau2: tau, fusion: false, ..AlignOptions::default() };
        let a = align(&s.views, &matched, &projected, &options).unwrap();
        let keys = a.report[0].edges.iter().map(|e| (e.from.min(e.to), e.from.max(e.to))).collect();
        if let Some(p) = &previous {
            assert!(p.is_superset(&keys), "tau {tau}");
        }
        previous = Some(keys);
    }
}

/// A view of a wall at z = 4 with a thin pole at z = 2, camera shifted by `x` and backed off by
/// `back`.
fn pole_view(x: f64, back: f64) -> (Camera, DepthMap, Image<i32>) {
    let (width, height) = (160, 120);
    let pose = Pose { translation: DVec3::new(-x, 0.0, back), ..Pose::IDENTITY };
    let camera = Camera {
        name: String::new(),
        width: 160,
        height: 120,
        fx: 150.0,
        fy: 150.0,
        cx: 80.0,
        cy: 60.0,
        pose,
    };
    let mut depth = Image::filled(width, height, 0.0f32);
    let mut labels = Image::filled(width, height, 0);
    for row in 0..height {
        for col in 0..width {
            let ray = camera.ray(glam::DVec2::new(col as f64 + 0.5, row as f64 + 0.5));
            let (pole, wall) = (2.0 + back, 4.0 + back);
            let point = |z: f64| DVec3::new(ray.x * z + x, ray.y * z, z);
            let p = row * width + col;
            if point(pole).x.abs() < 0.06 {
                (depth.data[p], labels.data[p]) = (pole as f32, 1);
            } else {
                // a picture on the wall
                let on = point(wall);
                let picture = on.x.abs() < 0.9 && on.y.abs() < 0.7;
                (depth.data[p], labels.data[p]) = (wall as f32, if picture { 2 } else { 0 });
            }
        }
    }
    (camera, exact_depth(&depth), labels)
}

/// Three masks with equal features, so that only geometry separates them.
fn alike(labels: Image<i32>) -> ViewMasks {
    let mut row = [0.0; DIM];
    row[0] = 1.0;
    let level =
        LevelMasks { labels, quality: vec![1.0; 3], features: row.repeat(3), ..LevelMasks::default() };
    ViewMasks { levels: vec![level] }
}

#[test]
fn align_keeps_pole_and_wall_apart() {
    let (a, b) = (pole_view(-0.3, 0.0), pole_view(0.4, 0.0));
    let views = [alike(a.2), alike(b.2)];
    let projected = [links_from_depth(0, 1, (&a.0, &b.0), (&a.1, &b.1))];
    let warps = (matcher::geometry(&a.0, &a.1, &b.0, &b.1), matcher::geometry(&b.0, &b.1, &a.0, &a.1));
    let matched = [links_from_warps(0, 1, &warps.0, &warps.1)];
    let out = align(&views, &matched, &projected, &AlignOptions::default()).unwrap();
    let pairs: BTreeSet<BTreeSet<u32>> =
        out.components[0].iter().map(|c| c.members.iter().map(|m| m.mask).collect()).collect();
    assert_eq!(pairs, [0, 1, 2].map(|k| BTreeSet::from([k])).into());
    assert!(out.components[0].iter().all(|c| c.members.len() == 2));
}

#[test]
fn likeness_is_equal_in_spaces_with_other_cosines() {
    // Two views of `count` things whose features share `common` and differ a little between views.
    let views = |count: usize, common: f32| {
        let mut random = crate::math::Random::new(7);
        let mut draw =
            |scale: f64| -> Vec<f32> { (0..64).map(|_| (scale * random.normal()) as f32).collect() };
        let things: Vec<Vec<f32>> = (0..count).map(|_| draw(1.0)).collect();
        [0, 1].map(|_| {
            let row = |thing: &Vec<f32>| -> Vec<f32> {
                thing.iter().zip(draw(0.5)).map(|(t, noise)| t + noise + common).collect()
            };
            let mut features: Vec<f32> = things.iter().flat_map(row).collect();
            crate::dir::normalise_rows(&mut features, 64);
            let labels = Image { width: count, height: 1, data: (0..count as i32).collect() };
            let level = LevelMasks { labels, quality: vec![1.0; count], features, ..LevelMasks::default() };
            ViewMasks { levels: vec![level] }
        })
    };
    let (a, b) = (MaskId::new(0, 0), [MaskId::new(1, 0), MaskId::new(1, 1)]);
    let mut cosines = Vec::new();
    for common in [0.0, 1.0, 5.0] {
        let state = LevelState::new(&views(8, common), 0, true);
        let [same, other] = b.map(|b| state.likeness(a, b));
        assert!(same == 1.0 && other < 0.98, "{common}: {same} {other}");
        cosines.push(b.map(|b| state.cosine(a, b)));
    }
    // Another thing of the last space has a higher cosine than the thing itself in the first one.
    assert!(cosines[2][1] > cosines[0][0], "{cosines:?}");
    let few = LevelState::new(&views(3, 1.0), 0, true);
    assert_eq!(few.likeness(a, b[0]), few.cosine(a, b[0]));
}

#[test]
fn reprojection_deletes_contradicted_matches() {
    // Matches join the mask of view 0 with the first mask of view 1, geometry with the second.
    let (width, height) = (60, 10);
    let view = |features: &[f32], label: &dyn Fn(usize) -> i32| {
        let data = (0..width * height).map(|p| label(p % width)).collect();
        let level = LevelMasks {
            labels: Image { width, height, data },
            quality: vec![1.0; features.len() / 2],
            features: features.to_vec(),
            ..LevelMasks::default()
        };
        ViewMasks { levels: vec![level] }
    };
    let views = [view(&[1.0, 0.0], &|_| 0), view(&[1.0, 0.0, 0.6, 0.8], &|x| i32::from(x >= 20))];
    let links = |first: bool| {
        let same: Vec<bool> = (0..width * height).map(|p| (p % width < 20) == first).collect();
        links_from_overlay(0, 1, &same)
    };
    let things = |projected: &[PairLinks]| -> Vec<Vec<MaskId>> {
        let out = align(&views, &[links(true)], projected, &AlignOptions::default()).unwrap();
        out.components[0].iter().map(|c| c.members.clone()).collect()
    };
    let [whole, first, second] = [MaskId::new(0, 0), MaskId::new(1, 0), MaskId::new(1, 1)];
    assert_eq!(things(&[]), [vec![whole, first], vec![second]]);
    assert_eq!(things(&[links(false)]), [vec![whole, second], vec![first]]);
}

#[test]
fn area_score_coverage_ignores_distance() {
    // view 1 has twice the distance from the picture and shows it with a quarter of the pixels
    let (near, far) = (pole_view(0.0, 0.0), pole_view(0.0, 4.0));
    let views = [alike(near.2), alike(far.2)];
    let warps = (
        matcher::geometry(&near.0, &near.1, &far.0, &far.1),
        matcher::geometry(&far.0, &far.1, &near.0, &near.1),
    );
    let matched = [links_from_warps(0, 1, &warps.0, &warps.1)];
    let state = LevelState::new(&views, 0, false);
    let scores = |area: AreaScore| {
        let options = AlignOptions { area, tau1: 0.0, ..AlignOptions::default() };
        let table = match_proposals(&state, &matched, &options, 1);
        (table[&(0, 2, 1)].score, table[&(1, 2, 0)].score)
    };
    let (out, back) = scores(AreaScore::Coverage);
    assert!(out > 0.8 && back > 0.8, "{out} {back}");
    let (_, back) = scores(AreaScore::Paper);
    // the far view can match at most a quarter of the near picture's pixels
    assert!(back < 0.3 + 0.7 * 0.3, "{back}");
}

#[test]
fn align_handles_degenerate_views() {
    let s = scene(false);
    let twice = [s.views[0].clone(), s.views[0].clone()];
    let (w, h) = (640, 480);
    let home = |p: usize| [(p % w) as f32 + 0.5, (p / w) as f32 + 0.5];
    let target = Image { width: w, height: h, data: (0..w * h).map(home).collect() };
    let same = DenseWarp { target, certainty: Image::filled(w, h, 1.0) };
    let matched = [links_from_warps(0, 1, &same, &same)];
    let a = align(&twice, &matched, &[], &AlignOptions::default()).unwrap();
    assert!(!a.report[1].edges.is_empty());
    for e in &a.report[1].edges {
        // S = 0.3 + 0.7 up to f32 features
        assert!((e.score - 1.0).abs() < 1e-6 && e.from.mask == e.to.mask);
    }
    let alone = align(&s.views[..1], &[], &[], &AlignOptions::default()).unwrap();
    assert_eq!(alone.components[0].len(), s.object[0].len());
    let mut holed = s.views.clone();
    holed[1].levels[0] = LevelMasks { labels: Image::filled(w, h, -1), ..LevelMasks::default() };
    let a = align(&holed, &s.matched(), &s.projected(), &AlignOptions::default()).unwrap();
    assert!(a.components[0].iter().flat_map(|c| &c.members).all(|m| m.view != 1));
    assert!(align(&[], &[], &[], &AlignOptions::default()).unwrap().components.is_empty());
}

#[test]
fn fuse_takes_feature_of_stronger_set() {
    // View 0 has pieces 0, 1, 2 side by side; a mask of view 1 covers 0 and 1, one of view 2 covers
    // 1 and 2.
    let (width, height) = (120, 10);
    let view = |rows: &[[f32; 3]], label: &dyn Fn(usize) -> i32| {
        let unit = |r: &[f32; 3]| r.map(|v| v / r.iter().map(|v| v * v).sum::<f32>().sqrt());
        let data = (0..width * height).map(|p| label(p % width)).collect();
        let level = LevelMasks {
            labels: Image { width, height, data },
            quality: vec![1.0; rows.len()],
            features: rows.iter().flat_map(unit).collect(),
            ..LevelMasks::default()
        };
        ViewMasks { levels: vec![level] }
    };
    let first = view(&[[1.0, 0.0, 0.0]; 3], &|x| if x < 60 { x as i32 / 20 } else { -1 });
    let left = view(&[[1.0, 0.3, 0.0]], &|x| if x < 40 { 0 } else { -1 });
    let right = view(&[[1.0, 0.0, 0.3]], &|x| if (20..60).contains(&x) { 0 } else { -1 });
    // Matches cover all rows of one target and eight of ten rows of the other.
    let links = |view: usize, rows: usize| {
        let same: Vec<bool> = (0..width * height).map(|p| p / width < rows).collect();
        links_from_overlay(0, view, &same)
    };
    for (rows, stronger) in [([10, 8], 1), ([8, 10], 2)] {
        let mut state = LevelState::new(&[first.clone(), left.clone(), right.clone()], 0, false);
        let pairs = [links(1, rows[0]), links(2, rows[1])];
        let fused = fuse(&mut state, &pairs, &AlignOptions::default());
        assert_eq!(fused.len(), 2, "all three pieces are one mask");
        assert_eq!(state.feature(MaskId::new(0, 0)), state.feature(MaskId::new(stronger, 0)), "{rows:?}");
    }
}

/// One view whose mask swallows a neighbour must not fuse the two masks of all other views.
#[test]
fn fuse_follows_most_views() {
    let (width, height) = (120, 10);
    let view = |pieces: i32| {
        // Without pieces the view shows nothing.
        let label = |x: usize| if x < 40 && pieces > 0 { x as i32 / (40 / pieces) } else { -1 };
        let data = (0..width * height).map(|p| label(p % width));
        let level = LevelMasks {
            labels: Image { width, height, data: data.collect() },
            quality: vec![1.0; pieces as usize],
            features: [1.0, 0.0, 0.0].repeat(pieces as usize),
            ..LevelMasks::default()
        };
        ViewMasks { levels: vec![level] }
    };
    let pairs: Vec<PairLinks> =
        (1..4).map(|k| links_from_overlay(0, k, &vec![true; width * height])).collect();
    for (others, votes, fused) in
        [([1, 2, 2], true, 0), ([1, 2, 2], false, 1), ([1, 1, 2], true, 1), ([1, 2, 0], true, 1)]
    {
        let views: Vec<ViewMasks> = [2].into_iter().chain(others).map(view).collect();
        let mut state = LevelState::new(&views, 0, false);
        let options = AlignOptions { votes, ..AlignOptions::default() };
        assert_eq!(fuse(&mut state, &pairs, &options).len(), fused, "{others:?} {votes}");
    }
}

#[test]
fn same_place_score_fails_under_motion() {
    // One thing of ten pixels' width, moved to the right by `shift` pixels in view 1.
    let (width, height) = (60, 10);
    let view = |first: usize| {
        let data =
            (0..width * height).map(|p| if (first..first + 10).contains(&(p % width)) { 0 } else { -1 });
        let labels = Image { width, height, data: data.collect() };
        let level =
            LevelMasks { labels, quality: vec![1.0], features: vec![1.0, 0.0], ..LevelMasks::default() };
        ViewMasks { levels: vec![level] }
    };
    let warp = |shift: f32, from: usize| DenseWarp {
        target: Image {
            width,
            height,
            data: (0..width * height)
                .map(|p| [(p % width) as f32 + 0.5 + shift, (p / width) as f32 + 0.5])
                .collect(),
        },
        certainty: Image {
            width,
            height,
            data: (0..width * height)
                .map(|p| f32::from(u8::from((from..from + 10).contains(&(p % width)))))
                .collect(),
        },
    };
    for (shift, agree) in [(0, true), (20, false)] {
        let pairs = [links_from_warps(0, 1, &warp(shift as f32, 5), &warp(-(shift as f32), 5 + shift))];
        let edges = |area: AreaScore| {
            let options = AlignOptions { area, ..AlignOptions::default() };
            match_proposals(&LevelState::new(&[view(5), view(5 + shift)], 0, false), &pairs, &options, 1)
                .len()
        };
        assert_eq!((edges(AreaScore::Coverage), edges(AreaScore::Paper)), (2, 2), "{shift}");
        assert_eq!(edges(AreaScore::SamePlace) > 0, agree, "{shift}");
    }
}
