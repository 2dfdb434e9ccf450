//! The built-in language defaults end to end in 2D: graph masks, `words` features, XFeat matches,
//! alignment, codebook and queries on the training targets (the output of a perfectly trained
//! field).
use crate::infer::words::RegionWords;
use crate::infer::{Registry, hed::Hed, xfeat::XFeat};
use crate::language::align::{PairLinks, links_from_warps};
use crate::language::graph::{GraphOptions, segment};
use crate::language::{BuildOptions, ViewMasks, build, matcher};
use crate::progress::Silent;
use crate::query::*;
use crate::run::stages::{SharedEncoder, masks::describe};
use crate::scene::DepthMap;
use crate::scene::Image;
use splatvk_test_support::breakfast::{TestView, phrases, train_views};

struct Inputs {
    views: Vec<TestView>,
    masks: Vec<ViewMasks>,
    depths: Vec<DepthMap>,
    matched: Vec<PairLinks>,
    queries: Vec<(i32, TextQuery)>,
}

fn inputs() -> Inputs {
    let views = train_views();
    let registry = Registry::open(None).unwrap();
    let (mut hed, mut xfeat) = (Hed::load(&registry).unwrap(), XFeat::load(&registry).unwrap());
    let words = SharedEncoder::new(Box::new(RegionWords::load(registry).unwrap()), String::new());
    let (mut masks, mut depths, mut dense) = (Vec::new(), Vec::new(), Vec::new());
    for v in &views {
        let known = v.depth.data.iter().map(|&z| f32::from(z > 0.0)).collect();
        let depth = DepthMap { depth: v.depth.clone(), confidence: Image { data: known, ..v.depth } };
        let edges = hed.edges(&v.image).unwrap();
        masks.push(segment(&v.image, &edges, &GraphOptions::default()).unwrap());
        dense.push(xfeat.dense(&v.image).unwrap());
        depths.push(depth);
    }
    describe(&mut masks, views.iter().map(|v| &v.image), &words, &Silent).unwrap();
    let mut matched = Vec::new();
    for i in 0..views.len() {
        for j in i + 1..views.len() {
            let (there, back) = matcher::xfeat(&dense[i], &dense[j], (&views[i].camera, &views[j].camera));
            matched.push(links_from_warps(i, j, &there, &back));
        }
    }
    let canonicals = words.with(|e| e.embed_texts(&CANONICAL_PHRASES)).unwrap();
    let query = |(k, text): (i32, String)| {
        let embedding = words.with(|e| e.embed_texts(&[&text])).unwrap();
        (k, TextQuery { text, embedding, canonicals: canonicals.clone(), ..Default::default() })
    };
    let queries = phrases().into_iter().filter(|(k, _)| *k > 3).map(query).collect();
    Inputs { views, masks, depths, matched, queries }
}

/// (IoU, localised) per phrase and view.
fn score(x: &Inputs) -> Vec<(String, Vec<(f32, bool)>)> {
    let cameras: Vec<_> = x.views.iter().map(|v| v.camera.clone()).collect();
    let built = build(&x.masks, &cameras, &x.depths, &x.matched, &BuildOptions::default(), &Silent).unwrap();
    let mut out = Vec::new();
    for (k, query) in &x.queries {
        let mut row = Vec::new();
        for (t, view) in x.views.iter().enumerate() {
            let maps: Vec<Image<i32>> = built.field.levels.iter().map(|l| l.targets[t].clone()).collect();
            let r = answer(&maps, &built.field, query, &QueryOptions::default()).unwrap();
            let mask = r.mask();
            let pairs = view.masks.data.iter().map(|o| o == k).zip(&mask.data);
            let (both, either) =
                pairs.fold((0, 0), |(b, e), (o, &m)| (b + u32::from(o && m), e + u32::from(o || m)));
            row.push((both as f32 / either.max(1) as f32, view.masks.at(r.location.0, r.location.1) == *k));
        }
        out.push((query.text.clone(), row));
    }
    out
}

#[test]
fn lemon_and_mug_are_found() {
    let x = inputs();
    let rows = score(&x);
    for (text, row) in &rows {
        println!("R {text}: {row:.2?}");
    }
    // The plate is not queried: with exact depth the built-in masks of one view join it to the
    // table; the smoother depth of stereo does not (`splatvk eval` measures that).
    for name in ["lemon", "blue mug"] {
        let row = &rows.iter().find(|r| r.0 == name).unwrap().1;
        assert!(row.iter().filter(|r| r.1).count() >= 3, "{name}: {row:?}");
    }
}
