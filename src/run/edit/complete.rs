//! Completes the selection of a thing: splats inside and behind it, which no photo shows and which
//! therefore have no code, and splats at its outline with the code of their background.
use crate::math::Nearest;
use crate::query::instances::CodeLists;
use crate::scene::{SH_C0, Splats};
use glam::Vec3;
use rayon::prelude::*;

/// Neighbours that decide.
const NEIGHBOURS: usize = 8;
/// Neighbours of those with which a splat of another code joins. On breakfast with 6 nothing of a
/// deleted mug stays in the air, and the table around it keeps all its splats.
const MOST: usize = 6;
/// Rounds of the latter: each may reach the next splat outwards.
const ROUNDS: usize = 2;
/// Difference of colour, sRGB 0 to 1, at which a neighbour counts e^-½ as much.
const COLOUR_SIGMA: f32 = 0.1;
/// Part of the size of the selection by which its surroundings reach beyond it.
const MARGIN: f32 = 0.1;

/// A selection on a level, ascending, with the splats that belong to it by their place:
///
/// * without code, where most neighbours with code are selected, by the likeness of their colours:
///   a table below a mug differs from it in colour, and the inside of the mug does not;
/// * of other codes, where [`MOST`] of their neighbours are selected.
pub(super) fn completed(selected: Vec<usize>, splats: &Splats, lists: &CodeLists) -> Vec<usize> {
    let near = surroundings(&selected, splats);
    let mut is_selected = vec![false; splats.len()];
    selected.iter().for_each(|i| is_selected[*i] = true);
    let mut has_code = vec![false; splats.len()];
    lists.splats_of(0..lists.counts().count()).into_iter().for_each(|i| has_code[i] = true);

    let hidden = hidden(&near, splats, &has_code, &is_selected);
    hidden.into_iter().for_each(|i| is_selected[i] = true);
    let positions: Vec<Vec3> = near.iter().map(|i| splats.means[*i].into()).collect();
    let tree = Nearest::new(&positions);
    for _ in 0..ROUNDS {
        let joins = |at: &usize| {
            let neighbours = tree.of::<NEIGHBOURS>(positions[*at], Some(*at)).into_iter().flatten();
            !is_selected[near[*at]] && neighbours.filter(|(n, _)| is_selected[near[*n]]).count() >= MOST
        };
        let joined: Vec<usize> = (0..near.len()).into_par_iter().filter(joins).collect();
        joined.into_iter().for_each(|at| is_selected[near[at]] = true);
    }
    (0..splats.len()).filter(|i| is_selected[*i]).collect()
}

/// Splats in the box of a selection, and around it.
fn surroundings(selected: &[usize], splats: &Splats) -> Vec<usize> {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for &i in selected {
        let mean = Vec3::from(splats.means[i]);
        (low, high) = (low.min(mean), high.max(mean));
    }
    let reach = Vec3::splat(MARGIN * (high - low).max_element());
    let is_near = |i: &usize| {
        let mean = Vec3::from(splats.means[*i]);
        mean.cmpge(low - reach).all() && mean.cmple(high + reach).all()
    };
    (0..splats.len()).into_par_iter().filter(is_near).collect()
}

/// Splats of `near` without code whose neighbours with code are selected.
fn hidden(near: &[usize], splats: &Splats, has_code: &[bool], is_selected: &[bool]) -> Vec<usize> {
    let known: Vec<usize> = near.iter().copied().filter(|i| has_code[*i]).collect();
    let positions: Vec<Vec3> = known.iter().map(|i| splats.means[*i].into()).collect();
    let tree = Nearest::new(&positions);
    let width = 3 * splats.sh_len();
    let colour = |i: usize| 0.5 + SH_C0 * Vec3::from_slice(&splats.sh[i * width..i * width + 3]);
    let joins = |i: &usize| {
        let votes = tree.of::<NEIGHBOURS>(splats.means[*i].into(), None).into_iter().flatten();
        let votes = votes.map(|(at, _)| {
            let square = colour(known[at]).distance_squared(colour(*i)) / (COLOUR_SIGMA * COLOUR_SIGMA);
            ((-0.5 * square).exp(), is_selected[known[at]])
        });
        let (own, all) = votes.fold((0.0, 0.0), |(own, all), (weight, is_own)| {
            (own + if is_own { weight } else { 0.0 }, all + weight)
        });
        2.0 * own > all
    };
    let without: Vec<usize> = near.iter().copied().filter(|i| !has_code[*i]).collect();
    without.into_par_iter().filter(joins).collect()
}
