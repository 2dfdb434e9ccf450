//! Fine over-segmentation: graph merging after Felzenszwalb and Huttenlocher (IJCV 2004).
use crate::scene::Image;
use rayon::prelude::*;

/// Disjoint sets of pixels with size and internal difference.
struct Forest {
    parent: Vec<u32>,
    size: Vec<u32>,
    threshold: Vec<f32>,
}

impl Forest {
    fn find(&mut self, mut p: usize) -> usize {
        while self.parent[p] as usize != p {
            self.parent[p] = self.parent[self.parent[p] as usize];
            p = self.parent[p] as usize;
        }
        p
    }
    fn join(&mut self, a: usize, b: usize, threshold: f32) {
        let (big, small) = if self.size[a] >= self.size[b] { (a, b) } else { (b, a) };
        self.parent[small] = big as u32;
        self.size[big] += self.size[small];
        self.threshold[big] = threshold;
    }
}

/// Merges pixels along edges of rising weight while the edge is no heavier than both sides'
/// internal difference plus `scale / size`; regions below `min_size` then join their most similar
/// neighbour. Returns compact labels and their number.
///
/// `weight(p, q)` is the dissimilarity of two neighbouring pixels (8-neighbourhood).
pub fn superpixels(
    width: usize,
    height: usize,
    scale: f32,
    min_size: u32,
    weight: impl Fn(usize, usize) -> f32,
) -> (Image<i32>, usize) {
    let count = width * height;
    let mut edges: Vec<(f32, u32, u32)> = Vec::with_capacity(4 * count);
    for y in 0..height {
        for x in 0..width {
            let p = y * width + x;
            let mut add = |q: usize| edges.push((weight(p, q), p as u32, q as u32));
            if x + 1 < width {
                add(p + 1);
            }
            if y + 1 < height {
                add(p + width);
                if x + 1 < width {
                    add(p + width + 1);
                }
                if x > 0 {
                    add(p + width - 1);
                }
            }
        }
    }
    // No two edges compare equal.
    edges.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut forest =
        Forest { parent: (0..count as u32).collect(), size: vec![1; count], threshold: vec![scale; count] };
    for &(w, p, q) in &edges {
        let (a, b) = (forest.find(p as usize), forest.find(q as usize));
        if a != b && w <= forest.threshold[a] && w <= forest.threshold[b] {
            let size = forest.size[a] + forest.size[b];
            forest.join(a, b, w + scale / size as f32);
        }
    }
    for &(w, p, q) in &edges {
        let (a, b) = (forest.find(p as usize), forest.find(q as usize));
        if a != b && (forest.size[a] < min_size || forest.size[b] < min_size) {
            forest.join(a, b, w);
        }
    }
    let mut index = vec![-1i32; count];
    let mut next = 0;
    let mut labels = Image::filled(width, height, 0i32);
    for p in 0..count {
        let root = forest.find(p);
        if index[root] < 0 {
            index[root] = next;
            next += 1;
        }
        labels.data[p] = index[root];
    }
    (labels, next as usize)
}
