//! Connected pieces of a view, each with one scale and one shift of a depth prior.
use crate::stereo::surface::neighbours;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Pitch of the seeds of pieces, share of the view's width: about 400 pieces. On room_a and
/// breakfast (10 % prior) half and twice as many give the same AbsRel to 0.002.
pub const SIDE_SHARE: f32 = 1.0 / 24.0;
/// Relative step of the prior between neighbouring pixels that costs as much as the side of a
/// piece: pieces end at the prior's own depth edges, where its errors change.
const FULL_STEP: f32 = 0.05;

/// Pieces of one view.
pub struct Pieces {
    /// Piece of every pixel, or [`NO_PIECE`].
    pub of: Vec<u32>,
    /// Number of pieces.
    pub count: usize,
    /// Pairs of neighbouring pieces (a < b) with the length of their border, pixels.
    pub borders: Vec<(u32, u32, f32)>,
}

/// Piece of a pixel without prior.
pub const NO_PIECE: u32 = u32::MAX;

impl Pieces {
    /// Assigns pixels to the seed of the shortest path from a grid; steps of `prior` (inverse
    /// depth, 0 = unknown) lengthen a path.
    pub fn cut(prior: &[f32], width: usize, height: usize) -> Pieces {
        let side = ((SIDE_SHARE * width as f32) as usize).max(4);
        let mut of = vec![NO_PIECE; prior.len()];
        let mut cost = vec![f32::INFINITY; prior.len()];
        let mut heap = BinaryHeap::new();
        let mut count = 0;
        let mut seed = |k: usize, cost: &mut [f32], of: &mut [u32], heap: &mut BinaryHeap<_>| {
            (cost[k], of[k]) = (0.0, count);
            heap.push((Reverse(0u32), k as u32));
            count += 1;
        };
        for y in (side / 2..height).step_by(side) {
            for x in (side / 2..width).step_by(side) {
                if prior[y * width + x] > 0.0 {
                    seed(y * width + x, &mut cost, &mut of, &mut heap);
                }
            }
        }
        // Areas that no seed of the grid reaches, islands between holes, get a seed afterwards.
        for k in 0..=prior.len() {
            while let Some((Reverse(bits), p)) = heap.pop() {
                let (p, here) = (p as usize, f32::from_bits(bits));
                if here > cost[p] {
                    continue;
                }
                for n in neighbours(p, width, height).filter(|&n| prior[n] > 0.0) {
                    let step = (prior[n] / prior[p]).ln().abs() / FULL_STEP;
                    let total = here + 1.0 + side as f32 * step;
                    if total < cost[n] {
                        cost[n] = total;
                        of[n] = of[p];
                        // Bit patterns of non-negative floats sort like the floats.
                        heap.push((Reverse(total.to_bits()), n as u32));
                    }
                }
            }
            if k < prior.len() && prior[k] > 0.0 && of[k] == NO_PIECE {
                seed(k, &mut cost, &mut of, &mut heap);
            }
        }
        let borders = borders(&of, width);
        Pieces { of, count: count as usize, borders }
    }
}

fn borders(of: &[u32], width: usize) -> Vec<(u32, u32, f32)> {
    let mut pairs = Vec::new();
    for (k, &a) in of.iter().enumerate() {
        let right = (k % width + 1 < width).then(|| of[k + 1]);
        for b in right.into_iter().chain(of.get(k + width).copied()) {
            if a != b && a != NO_PIECE && b != NO_PIECE {
                pairs.push((a.min(b), a.max(b)));
            }
        }
    }
    pairs.sort_unstable();
    let mut out: Vec<(u32, u32, f32)> = Vec::new();
    for (a, b) in pairs {
        match out.last_mut() {
            Some(last) if (last.0, last.1) == (a, b) => last.2 += 1.0,
            _ => out.push((a, b, 1.0)),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cut_ends_pieces_at_depth_steps() {
        let (width, height) = (96, 48);
        // Two planes that meet at column 41, and a hole with an island in it.
        let mut prior: Vec<f32> =
            (0..width * height).map(|k| if k % width < 41 { 1.0 } else { 0.5 }).collect();
        for y in 10..17 {
            for x in 60..67 {
                prior[y * width + x] = if (x, y) == (63, 13) { 0.5 } else { 0.0 };
            }
        }
        let pieces = Pieces::cut(&prior, width, height);
        for (k, (&value, &piece)) in prior.iter().zip(&pieces.of).enumerate() {
            assert_eq!(value > 0.0, piece != NO_PIECE, "pixel {k}");
        }
        let mut sides = vec![[0usize; 2]; pieces.count];
        for (k, &piece) in pieces.of.iter().enumerate().filter(|(_, p)| **p != NO_PIECE) {
            sides[piece as usize][usize::from(k % width >= 41)] += 1;
        }
        assert!(sides.iter().all(|s| s[0] == 0 || s[1] == 0), "a piece lies on both planes");
        assert!(sides.iter().all(|s| s[0] + s[1] > 0), "a piece without pixels");
        assert!(pieces.borders.iter().any(|&(a, b, _)| sides[a as usize][0] > 0 && sides[b as usize][1] > 0));
    }
}
