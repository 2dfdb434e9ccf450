//! Hierarchical region merging: superpixels → one binary tree.
use super::options::{Cues, MergeOptions};
use super::pixels::{self, BINS, COLOUR_BINS};
use super::plane::PlaneFit;
use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

/// Statistics of the pixels of a node.
#[derive(Clone)]
pub(super) struct Region {
    pub area: f32,
    /// x0, y0, x1, y1, inclusive.
    pub bbox: [usize; 4],
    /// Border length in pixel sides, image border included.
    pub perimeter: f32,
    /// Pixel sides on the image border.
    pub frame: f32,
    /// Σ over the border, without the image border, of the evidence for a contour there, each in [0, 1].
    pub contour: f32,
    lab: [f32; 3],
    histogram: [f32; BINS],
    pub fit: PlaneFit,
}

/// The border that two regions share.
#[derive(Clone, Copy, Default)]
struct Border {
    length: f32,
    gradient: f32,
    edge: f32,
    contour: f32,
    /// Σ signed relative depth step, from the region with the smaller index to the other.
    step: f32,
    /// Pixel pairs with known depth on both sides.
    step_count: f32,
}

impl Border {
    fn add(&mut self, other: &Border) {
        self.length += other.length;
        self.gradient += other.gradient;
        self.edge += other.edge;
        self.contour += other.contour;
        self.step += other.step;
        self.step_count += other.step_count;
    }
    fn flipped(mut self) -> Border {
        self.step = -self.step;
        self
    }
}

/// A node: leaves first (one per superpixel), then merges in order.
pub(super) struct Node {
    pub children: Option<(usize, usize)>,
    pub parent: usize,
    /// Monotone merge cost.
    pub height: f32,
    pub region: Region,
}

/// The merge tree of one image.
pub(super) struct Tree {
    pub nodes: Vec<Node>,
    pub leaves: usize,
}

#[derive(PartialEq)]
struct MergeCandidate {
    cost: f32,
    a: usize,
    b: usize,
}
impl Eq for MergeCandidate {}
impl PartialOrd for MergeCandidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for MergeCandidate {
    // BinaryHeap pops the largest: the cheapest merge, then the smallest ids, must be largest
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then((other.a, other.b).cmp(&(self.a, self.b)))
    }
}

/// Merges until one region is left.
pub(super) fn build(cues: &Cues, options: &MergeOptions) -> Tree {
    let leaves = cues.count;
    let mut nodes: Vec<Node> = leaf_regions(cues)
        .into_iter()
        .map(|region| Node { children: None, parent: usize::MAX, height: 0.0, region })
        .collect();
    let mut borders = leaf_borders(cues);
    for (node, own) in nodes.iter_mut().zip(&borders) {
        node.region.contour = own.values().map(|b| b.contour).sum();
    }
    let mut heap = BinaryHeap::new();
    let total = cues.labels.data.len() as f32;
    let cost = |nodes: &[Node], a: usize, b: usize, border: &Border| {
        merge_cost(&nodes[a].region, &nodes[b].region, border, total, options)
    };
    for a in 0..leaves {
        for (&b, border) in borders[a].range(a + 1..) {
            heap.push(MergeCandidate { cost: cost(&nodes, a, b, border), a, b });
        }
    }
    let mut level = 0.0f32;
    while let Some(MergeCandidate { cost: c, a, b }) = heap.pop() {
        if nodes[a].parent != usize::MAX || nodes[b].parent != usize::MAX {
            continue;
        }
        level = level.max(c);
        let id = nodes.len();
        let shared = borders[a].get(&b).copied().unwrap_or_default();
        let region = union(&nodes[a].region, &nodes[b].region, &shared);
        nodes.push(Node { children: Some((a, b)), parent: usize::MAX, height: level, region });
        (nodes[a].parent, nodes[b].parent) = (id, id);
        let mut mine: BTreeMap<usize, Border> = BTreeMap::new();
        for side in [a, b] {
            for (other, border) in std::mem::take(&mut borders[side]) {
                if other == a || other == b {
                    continue;
                }
                // stored from the smaller to the larger index; the new node has the largest
                let seen = if side < other { border.flipped() } else { border };
                mine.entry(other).or_default().add(&seen);
                borders[other].remove(&side);
            }
        }
        for (&other, border) in &mine {
            borders[other].insert(id, *border);
            heap.push(MergeCandidate { cost: cost(&nodes, other, id, border), a: other, b: id });
        }
        borders.push(mine);
    }
    Tree { nodes, leaves }
}

fn leaf_regions(cues: &Cues) -> Vec<Region> {
    let (width, height) = (cues.labels.width, cues.labels.height);
    let empty = Region {
        area: 0.0,
        bbox: [usize::MAX, usize::MAX, 0, 0],
        perimeter: 0.0,
        frame: 0.0,
        contour: 0.0,
        lab: [0.0; 3],
        histogram: [0.0; BINS],
        fit: PlaneFit::default(),
    };
    let mut regions = vec![empty; cues.count];
    for p in 0..width * height {
        let (x, y) = (p % width, p / width);
        let region = &mut regions[cues.labels.data[p] as usize];
        region.area += 1.0;
        let b = &mut region.bbox;
        *b = [b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)];
        for c in 0..3 {
            region.lab[c] += cues.lab[p][c];
        }
        for v in pixels::votes(&cues.lab, width, height, p) {
            region.histogram[v] += 1.0;
        }
        let sides =
            u8::from(x == 0) + u8::from(y == 0) + u8::from(x + 1 == width) + u8::from(y + 1 == height);
        region.frame += f32::from(sides);
        region.perimeter += f32::from(sides);
        for q in neighbours(p, width, height) {
            if cues.labels.data[q] != cues.labels.data[p] {
                region.perimeter += 1.0;
            }
        }
        if let Some(depth) = cues.depth {
            region.fit.add(cues.ray(x, y), depth.depth.data[p], depth.confidence.data[p]);
        }
    }
    regions
}

fn neighbours(p: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x, y) = (p % width, p / width);
    let near = [
        (x > 0).then(|| p - 1),
        (x + 1 < width).then(|| p + 1),
        (y > 0).then(|| p - width),
        (y + 1 < height).then(|| p + width),
    ];
    near.into_iter().flatten()
}

/// Per region, the borders to each neighbour.
fn leaf_borders(cues: &Cues) -> Vec<BTreeMap<usize, Border>> {
    let (width, height) = (cues.labels.width, cues.labels.height);
    let mut out: Vec<BTreeMap<usize, Border>> = vec![BTreeMap::new(); cues.count];
    let mut visit = |p: usize, q: usize| {
        let (a, b) = (cues.labels.data[p] as usize, cues.labels.data[q] as usize);
        if a == b {
            return;
        }
        let mut border = Border {
            length: 1.0,
            gradient: cues.gradient.data[p].max(cues.gradient.data[q]),
            edge: cues.edges.map_or(0.0, |e| e.data[p].max(e.data[q])),
            contour: 0.0,
            step: 0.0,
            step_count: 0.0,
        };
        border.contour = contour_strength(cues, &border);
        if let Some(step) = cues.depth_step(p, q) {
            border.step = if a < b { step } else { -step };
            border.step_count = 1.0;
        }
        out[a].entry(b).or_default().add(&border);
        out[b].entry(a).or_default().add(&border);
    };
    for p in 0..width * height {
        if p % width + 1 < width {
            visit(p, p + 1);
        }
        if p / width + 1 < height {
            visit(p, p + width);
        }
    }
    out
}

/// Evidence for a contour between two neighbouring pixels: the learned boundary where there is one, else the gradient.
fn contour_strength(cues: &Cues, border: &Border) -> f32 {
    let gradient = 1.0 - (-border.gradient / 8.0).exp();
    if cues.edges.is_some() { 0.7 * border.edge + 0.3 * gradient } else { gradient }
}

fn union(a: &Region, b: &Region, shared: &Border) -> Region {
    let mut out = a.clone();
    out.area += b.area;
    out.bbox = [
        a.bbox[0].min(b.bbox[0]),
        a.bbox[1].min(b.bbox[1]),
        a.bbox[2].max(b.bbox[2]),
        a.bbox[3].max(b.bbox[3]),
    ];
    out.perimeter = a.perimeter + b.perimeter - 2.0 * shared.length;
    out.frame += b.frame;
    out.contour += b.contour - 2.0 * shared.contour;
    for c in 0..3 {
        out.lab[c] += b.lab[c];
    }
    for k in 0..BINS {
        out.histogram[k] += b.histogram[k];
    }
    out.fit.merge(&b.fit);
    out
}

/// χ² distances of the colour and the texture histograms, each in [0, 1].
fn histogram_distance(a: &Region, b: &Region) -> (f32, f32) {
    let part = |range: std::ops::Range<usize>, parts: f32| {
        let mut sum = 0.0;
        for k in range {
            let (x, y) = (a.histogram[k] / a.area, b.histogram[k] / b.area);
            if x + y > 0.0 {
                sum += (x - y) * (x - y) / (x + y);
            }
        }
        0.5 * sum / parts
    };
    (part(0..3 * COLOUR_BINS, 3.0), part(3 * COLOUR_BINS..BINS, 1.0))
}

/// Cost of merging two neighbours: how different they look, how strong the border between them is, how little of the
/// smaller one's outline it makes up, all weighed by size so that small regions go first.
fn merge_cost(a: &Region, b: &Region, border: &Border, total: f32, o: &MergeOptions) -> f32 {
    let (small, large) = if a.area <= b.area { (a, b) } else { (b, a) };
    let (colour, texture) = histogram_distance(a, b);
    let mean: f32 = (0..3).map(|c| (a.lab[c] / a.area - b.lab[c] / b.area).powi(2)).sum::<f32>().sqrt();
    // saturating maps put every cue on [0, 1): 20 Lab units and 8 per pixel are clearly visible differences
    let mean = 1.0 - (-mean / 20.0).exp();
    let gradient = 1.0 - (-border.gradient / border.length / 8.0).exp();
    let edge = border.edge / border.length;
    let mut cost =
        o.colour * colour + o.mean * mean + o.texture * texture + o.gradient * gradient + o.edge * edge;
    if border.step_count > 0.0 {
        let known = border.step_count / border.length;
        let step = (border.step / border.step_count).abs();
        cost += o.step * known * (1.0 - (-step / o.step_scale).exp());
        cost += o.bend * known * PlaneFit::bend(&small.fit, &large.fit, o.depth_noise);
    }
    // share of the smaller region's outline that faces the other: 1 when it is enclosed
    let share = (border.length / (small.perimeter - small.frame).max(1.0)).min(1.0);
    let size = (small.area / total).powf(o.size_power);
    size * cost.max(1e-4) * (1.0 - o.enclosure * share)
}
