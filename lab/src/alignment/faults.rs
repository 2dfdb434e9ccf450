//! Kinds of errors, one at a time.
use crate::generate::regions::InjectedErrors;
use glam::DVec2;
use splatvk::language::align::{PairLinks, links_from_warps};
use splatvk::math::Random;
use splatvk::scene::{Camera, DenseWarp, DepthMap, Image};
use std::collections::BTreeMap;

/// Side of a block that loses depth or matches together, pixels.
const BLOCK: usize = 12;
/// Relative difference of depth within which two views show one surface.
const SAME_SURFACE: f64 = 0.01;

/// One kind of error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fault {
    /// Name in tables.
    pub name: &'static str,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    None,
    /// Errors of masks and features; whether alike in all views and levels.
    Masks(InjectedErrors),
    /// Relative standard deviation of the depth of every pixel.
    DepthNoise(f64),
    /// Relative standard deviation of the depth of every view as a whole.
    DepthScale(f64),
    /// Share of blocks without depth.
    DepthHoles(f64),
    /// Share of blocks whose depth is the mean of the view.
    DepthFilled(f64),
    /// Share of blocks without matches.
    FewMatches(f64),
    /// Share of objects that match another object, in both directions.
    LookAlikes(f64),
    /// Step 3 uses cameras with errors of 0.1°.
    Cameras,
}

const EXACT: InjectedErrors = InjectedErrors::NONE;

const fn masks(errors: InjectedErrors, alike: bool) -> Kind {
    Kind::Masks(InjectedErrors { alike, ..errors })
}

const CUT: InjectedErrors = InjectedErrors { split: 0.3, ..EXACT };
const MERGED: InjectedErrors = InjectedErrors { merge: 0.3, ..EXACT };
const WRONG: InjectedErrors = InjectedErrors { wrong: 0.3, ..EXACT };

/// All kinds, without error first.
pub const FAULTS: [Fault; 16] = [
    Fault { name: "none", kind: Kind::None },
    Fault { name: "masks cut", kind: masks(CUT, false) },
    Fault { name: "masks cut, all views alike", kind: masks(CUT, true) },
    Fault { name: "masks merged", kind: masks(MERGED, false) },
    Fault { name: "masks merged, all views alike", kind: masks(MERGED, true) },
    Fault { name: "features of others", kind: masks(WRONG, false) },
    Fault { name: "features of others, all views alike", kind: masks(WRONG, true) },
    Fault { name: "noisy features", kind: masks(InjectedErrors { noise: 0.8, ..EXACT }, false) },
    Fault { name: "depth noise 3 %", kind: Kind::DepthNoise(0.03) },
    Fault { name: "depth of a view off by 4 %", kind: Kind::DepthScale(0.04) },
    Fault { name: "depth holes 40 %", kind: Kind::DepthHoles(0.4) },
    Fault { name: "depth filled 40 %", kind: Kind::DepthFilled(0.4) },
    Fault { name: "matches missing 80 %", kind: Kind::FewMatches(0.8) },
    Fault { name: "matches missing 97 %", kind: Kind::FewMatches(0.97) },
    Fault { name: "look-alikes match 30 %", kind: Kind::LookAlikes(0.3) },
    Fault { name: "cameras off", kind: Kind::Cameras },
];

impl Fault {
    /// The kind of this name.
    pub fn named(name: &str) -> Option<Fault> {
        FAULTS.iter().find(|f| f.name == name).copied()
    }
}

/// A kind of error in one scene.
pub struct Faults {
    kind: Kind,
    seed: u64,
    /// Errors of masks and features.
    pub masks: InjectedErrors,
}

impl Faults {
    /// Draws errors for a scene.
    pub fn new(fault: &Fault, seed: u64) -> Faults {
        let errors = if let Kind::Masks(errors) = fault.kind { errors } else { EXACT };
        Faults { kind: fault.kind, seed, masks: InjectedErrors { seed, ..errors } }
    }

    /// Whether step 3 uses cameras with errors.
    pub fn noisy_cameras(&self) -> bool {
        self.kind == Kind::Cameras
    }

    fn random(&self, salt: usize) -> Random {
        Random::new(self.seed ^ (salt as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15))
    }

    /// Depth of a view as step 3 gets it.
    pub fn depth(&self, view: usize, exact: &DepthMap) -> DepthMap {
        let mut random = self.random(view);
        let mut depth = exact.clone();
        let lost = |share: f64, random: &mut Random| blocks(&exact.depth, share, random);
        match self.kind {
            Kind::DepthNoise(sigma) => {
                depth.depth.data.iter_mut().for_each(|z| *z *= (1.0 + sigma * random.normal()) as f32);
            }
            Kind::DepthScale(sigma) => {
                let scale = (1.0 + sigma * random.normal()) as f32;
                depth.depth.data.iter_mut().for_each(|z| *z *= scale);
            }
            Kind::DepthHoles(share) => {
                let lost = lost(share, &mut random);
                depth.keep(|i| !lost[i]);
            }
            Kind::DepthFilled(share) => {
                let lost = lost(share, &mut random);
                let known = exact.depth.data.iter().filter(|z| **z > 0.0);
                let mean = known.clone().sum::<f32>() / known.count().max(1) as f32;
                let filled = depth.depth.data.iter_mut().zip(lost).filter(|(_, lost)| *lost);
                filled.for_each(|(z, _)| *z = mean);
            }
            _ => {}
        }
        depth
    }

    /// Dense matches of two views from exact cameras and depth, and labels of objects.
    pub fn matches(
        &self,
        (i, j): (usize, usize),
        exact: [(&Camera, &DepthMap); 2],
        objects: [&Image<u32>; 2],
    ) -> PairLinks {
        let mut warps = [warp(exact[0], exact[1]), warp(exact[1], exact[0])];
        let mut random = self.random(1000 + 100 * i + j);
        match self.kind {
            Kind::FewMatches(share) => {
                for warp in &mut warps {
                    let lost = blocks(&warp.certainty, share, &mut random);
                    let certain = warp.certainty.data.iter_mut().zip(lost).filter(|(_, lost)| *lost);
                    certain.for_each(|(c, _)| *c = 0.0);
                }
            }
            Kind::LookAlikes(share) => look_alikes(&mut warps, objects, share, &mut random),
            _ => {}
        }
        let [forward, backward] = warps;
        links_from_warps(i, j, &forward, &backward)
    }
}

/// Pixels of randomly chosen square blocks.
fn blocks(image: &Image<f32>, share: f64, random: &mut Random) -> Vec<bool> {
    let across = image.width.div_ceil(BLOCK);
    let chosen: Vec<bool> =
        (0..across * image.height.div_ceil(BLOCK)).map(|_| random.uniform() < share).collect();
    let block = |p: usize| p / image.width / BLOCK * across + p % image.width / BLOCK;
    (0..image.data.len()).map(|p| chosen[block(p)]).collect()
}

/// Exact matches of a view in another one, certain where both show one surface.
fn warp(from: (&Camera, &DepthMap), to: (&Camera, &DepthMap)) -> DenseWarp {
    let ((camera, depth), (other, shown)) = (from, to);
    let (width, height) = (depth.depth.width, depth.depth.height);
    let mut warp = DenseWarp {
        target: Image::filled(width, height, [-1.0; 2]),
        certainty: Image::filled(width, height, 0.0),
    };
    for p in 0..width * height {
        let z = f64::from(depth.depth.data[p]);
        if z <= 0.0 {
            continue;
        }
        let pixel = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
        let (q, distance) = other.project(camera.unproject(pixel, z));
        let inside = q.x >= 0.0 && q.y >= 0.0 && q.x < width as f64 && q.y < height as f64;
        if inside && distance > 0.0 {
            let there = f64::from(shown.depth.at(q.x as usize, q.y as usize));
            warp.target.data[p] = [q.x as f32, q.y as f32];
            warp.certainty.data[p] = f32::from((there / distance - 1.0).abs() < SAME_SURFACE);
        }
    }
    warp
}

/// Lets randomly chosen objects match another one in the other view, box to box, in both directions.
fn look_alikes(warps: &mut [DenseWarp; 2], objects: [&Image<u32>; 2], share: f64, random: &mut Random) {
    let boxes = objects.map(boxes_of);
    let both: Vec<u32> = boxes[0].keys().filter(|k| boxes[1].contains_key(k)).copied().collect();
    for &own in &both {
        let other = both[random.below(both.len())];
        if random.uniform() >= share || other == own {
            continue;
        }
        for (side, (from, to)) in [(own, other), (other, own)].into_iter().enumerate() {
            let (from_box, to_box) = (boxes[side][&from], boxes[1 - side][&to]);
            let width = objects[side].width;
            for p in (0..objects[side].data.len()).filter(|p| objects[side].data[*p] == from) {
                let place = [(p % width) as f32 + 0.5, (p / width) as f32 + 0.5];
                let along = |k: usize| (place[k] - from_box[k]) / (from_box[k + 2] - from_box[k]);
                warps[side].target.data[p] =
                    [0, 1].map(|k| to_box[k] + along(k) * (to_box[k + 2] - to_box[k]) * 0.999);
                warps[side].certainty.data[p] = 1.0;
            }
        }
    }
}

/// Bounding box x0, y0, x1, y1 of every label but 0, pixels.
fn boxes_of(objects: &Image<u32>) -> BTreeMap<u32, [f32; 4]> {
    let mut boxes: BTreeMap<u32, [f32; 4]> = BTreeMap::new();
    for (p, label) in objects.data.iter().enumerate().filter(|(_, label)| **label > 0) {
        let (x, y) = ((p % objects.width) as f32, (p / objects.width) as f32);
        let b = boxes.entry(*label).or_insert([x, y, x + 1.0, y + 1.0]);
        *b = [b[0].min(x), b[1].min(y), b[2].max(x + 1.0), b[3].max(y + 1.0)];
    }
    boxes
}
