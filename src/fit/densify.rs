//! Clone and split where splats are pulled hard across the screen (Kerbl et al. 2023; docs/method.md#densification).
//! Optional: with stereo points the density is already one per pixel, and cloning fits each view's residual error with
//! floaters.
use crate::math::Random;
use crate::pass::compact::NEW;
use crate::scene::Splats;
use glam::{Quat, Vec3};

/// When and what to densify.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DensifyOptions {
    /// First step.
    pub from: usize,
    /// Last step.
    pub until: usize,
    /// Every so many steps.
    pub every: usize,
    /// Mean screen gradient (loss per half image side, over the views that saw the splat) above which it multiplies.
    pub gradient: f32,
    /// Splats larger than this fraction of the scene extent split, smaller ones are cloned.
    pub split_size: f32,
    /// No more splats than this.
    pub max_splats: usize,
}

impl Default for DensifyOptions {
    /// The published constants, with a cap.
    fn default() -> Self {
        DensifyOptions {
            from: 500,
            until: 15_000,
            every: 100,
            gradient: 2e-4,
            split_size: 0.01,
            max_splats: 2_000_000,
        }
    }
}

/// The scale of the two halves of a split, relative to the whole (Kerbl et al. 2023: 1/(0.8·2)).
const SPLIT_SHRINK: f32 = 1.6;

/// The densified splats and, per row, the old row whose optimiser state it inherits ([`NEW`] = none).
pub fn densify(
    splats: &Splats,
    mean_gradient: &[f32],
    extent: f32,
    options: &DensifyOptions,
    random: &mut Random,
) -> (Splats, Vec<u32>) {
    let mut out = Splats { sh_degree: splats.sh_degree, ..Splats::default() };
    let mut source = Vec::new();
    let mut added = Splats { sh_degree: splats.sh_degree, ..Splats::default() };
    let mut room = options.max_splats.saturating_sub(splats.len());
    for i in 0..splats.len() {
        let size = splats.log_scales[i].iter().fold(f32::MIN, |m, &s| m.max(s)).exp();
        let multiply = room > 0 && mean_gradient.get(i).is_some_and(|&g| g > options.gradient);
        room -= usize::from(multiply);
        if multiply && size > options.split_size * extent {
            for _ in 0..2 {
                push(&mut added, splats, i);
                let last = added.len() - 1;
                let offset = sample(splats, i, random);
                added.means[last] = (Vec3::from(added.means[last]) + offset).into();
                added.log_scales[last] = splats.log_scales[i].map(|s| s - SPLIT_SHRINK.ln());
            }
        } else {
            push(&mut out, splats, i);
            source.push(i as u32);
            if multiply {
                push(&mut added, splats, i);
            }
        }
    }
    for i in 0..added.len() {
        push(&mut out, &added, i);
        source.push(NEW);
    }
    (out, source)
}

/// Appends row `i` of `from`.
fn push(to: &mut Splats, from: &Splats, i: usize) {
    let k = 3 * from.sh_len();
    to.means.push(from.means[i]);
    to.log_scales.push(from.log_scales[i]);
    to.quats.push(from.quats[i]);
    to.opacity_logits.push(from.opacity_logits[i]);
    to.sh.extend_from_slice(&from.sh[i * k..(i + 1) * k]);
}

/// A draw from N(0, Σ) of splat `i`.
fn sample(splats: &Splats, i: usize, random: &mut Random) -> Vec3 {
    let [w, x, y, z] = splats.quats[i];
    let rotation = Quat::from_xyzw(x, y, z, w).normalize();
    let local = splats.log_scales[i].map(|s| s.exp() * random.normal() as f32);
    rotation * Vec3::from(local)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> Splats {
        Splats {
            means: vec![[0.0; 3], [5.0; 3]],
            log_scales: vec![[0.001f32.ln(); 3], [0.5f32.ln(); 3]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![0.1, 0.2],
            sh_degree: 0,
            sh: vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        }
    }

    #[test]
    fn small_ones_are_cloned_and_large_ones_split() {
        let options = DensifyOptions::default();
        let (out, source) = densify(&two(), &[1.0, 1.0], 1.0, &options, &mut Random::new(2));
        assert_eq!(source, [0, NEW, NEW, NEW], "the split parent is gone, halves and clone are new");
        assert_eq!(out.means[1], [0.0; 3]);
        for half in 2..4 {
            assert!((out.log_scales[half][0].exp() - 0.5 / 1.6).abs() < 1e-6);
            assert!(Vec3::from(out.means[half]).distance(Vec3::splat(5.0)) < 5.0 * 0.5);
            assert_eq!(out.sh[3 * half..3 * half + 3], [0.4, 0.5, 0.6]);
        }
    }

    #[test]
    fn calm_splats_and_a_full_scene_stay() {
        let options = DensifyOptions { max_splats: 3, ..DensifyOptions::default() };
        assert_eq!(densify(&two(), &[1e-5, 0.0], 1.0, &options, &mut Random::new(2)).0, two());
        assert_eq!(densify(&two(), &[1.0, 1.0], 1.0, &options, &mut Random::new(2)).0.len(), 3);
    }
}
