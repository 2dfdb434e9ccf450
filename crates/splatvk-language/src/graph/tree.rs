//! Hierarchical region merging: superpixels → one binary tree.
use super::options::{Cues, DIFFERENT, EQUAL, GraphOptions};
use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

/// Statistics of the pixels of a node.
#[derive(Clone)]
pub(super) struct Region {
    pub area: f32,
    /// Border length in pixel sides, image border included.
    pub perimeter: f32,
    /// Pixel sides on the image border.
    pub frame: f32,
    /// Σ over the border, without the image border, of the learned boundary there, each in [0, 1].
    pub contour: f32,
    /// Σ of the colours.
    lab: [f32; 3],
}

/// The border that two regions share.
#[derive(Clone, Copy, Default)]
struct Border {
    length: f32,
    /// Σ of the learned boundary.
    edge: f32,
}

impl Border {
    fn add(&mut self, other: &Border) {
        self.length += other.length;
        self.edge += other.edge;
    }
}

/// A node: leaves first (one per superpixel), then merges in order.
pub(super) struct Node {
    pub children: Option<(usize, usize)>,
    pub parent: usize,
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
pub(super) fn build(cues: &Cues, options: &GraphOptions) -> Tree {
    let leaves = cues.count;
    let mut nodes: Vec<Node> = leaf_regions(cues)
        .into_iter()
        .map(|region| Node { children: None, parent: usize::MAX, region })
        .collect();
    let mut borders = leaf_borders(cues);
    for (node, own) in nodes.iter_mut().zip(&borders) {
        node.region.contour = own.values().map(|b| b.edge).sum();
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
    while let Some(MergeCandidate { a, b, .. }) = heap.pop() {
        if nodes[a].parent != usize::MAX || nodes[b].parent != usize::MAX {
            continue;
        }
        let id = nodes.len();
        let shared = borders[a].get(&b).copied().unwrap_or_default();
        let region = union(&nodes[a].region, &nodes[b].region, &shared);
        nodes.push(Node { children: Some((a, b)), parent: usize::MAX, region });
        (nodes[a].parent, nodes[b].parent) = (id, id);
        let mut joined: BTreeMap<usize, Border> = BTreeMap::new();
        for side in [a, b] {
            for (other, border) in std::mem::take(&mut borders[side]) {
                if other != a && other != b {
                    joined.entry(other).or_default().add(&border);
                    borders[other].remove(&side);
                }
            }
        }
        for (&other, border) in &joined {
            borders[other].insert(id, *border);
            heap.push(MergeCandidate { cost: cost(&nodes, other, id, border), a: other, b: id });
        }
        borders.push(joined);
    }
    Tree { nodes, leaves }
}

fn leaf_regions(cues: &Cues) -> Vec<Region> {
    let (width, height) = (cues.labels.width, cues.labels.height);
    let empty = Region { area: 0.0, perimeter: 0.0, frame: 0.0, contour: 0.0, lab: [0.0; 3] };
    let mut regions = vec![empty; cues.count];
    for p in 0..width * height {
        let (x, y) = (p % width, p / width);
        let region = &mut regions[cues.labels.data[p] as usize];
        region.area += 1.0;
        for c in 0..3 {
            region.lab[c] += cues.lab[p][c];
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
    let mut add_border = |p: usize, q: usize| {
        let (a, b) = (cues.labels.data[p] as usize, cues.labels.data[q] as usize);
        if a == b {
            return;
        }
        let border = Border { length: 1.0, edge: cues.edges.data[p].max(cues.edges.data[q]) };
        out[a].entry(b).or_default().add(&border);
        out[b].entry(a).or_default().add(&border);
    };
    for p in 0..width * height {
        if p % width + 1 < width {
            add_border(p, p + 1);
        }
        if p / width + 1 < height {
            add_border(p, p + width);
        }
    }
    out
}

fn union(a: &Region, b: &Region, shared: &Border) -> Region {
    let mut out = a.clone();
    out.area += b.area;
    out.perimeter = a.perimeter + b.perimeter - 2.0 * shared.length;
    out.frame += b.frame;
    out.contour += b.contour - 2.0 * shared.edge;
    for c in 0..3 {
        out.lab[c] += b.lab[c];
    }
    out
}

/// Cost of merging two neighbours: colour difference plus mean boundary strength, lowered by the
/// share of the smaller outline on their border, and weighted by size so that small regions merge
/// first.
fn merge_cost(a: &Region, b: &Region, border: &Border, total: f32, o: &GraphOptions) -> f32 {
    let small = if a.area <= b.area { a } else { b };
    let apart: f32 = (0..3).map(|c| (a.lab[c] / a.area - b.lab[c] / b.area).powi(2)).sum::<f32>().sqrt();
    let colour = 1.0 - (-apart / DIFFERENT).exp();
    // share of the smaller region's outline that faces the other: 1 when it is enclosed
    let share = (border.length / (small.perimeter - small.frame).max(1.0)).min(1.0);
    let cost = (colour + o.edge * border.edge / border.length).max(EQUAL);
    (small.area / total).powf(o.size_power) * cost * (1.0 - o.enclosure * share)
}
