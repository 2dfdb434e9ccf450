//! `project.comp`.
use super::lanes::{LANES, Vec3s, log2, scatter};
use super::sh::{self, Coefficients};
use super::splat::{Camera, Splats};
use crate::gpu::NativeCall;
use crate::gpu::shaders::project::{COARSE_DROPPED, FINE_DROPPED, FINE_END, FINE_FIRST, HIDDEN_KEY};
use crate::gpu::shaders::shared::cutoffs::LOG2_ALPHA_MIN;
use crate::gpu::shaders::shared::layout::PROJECTED_FLOATS;
use crate::gpu::shaders::structs::CameraView;
use fearless_simd::{Level, Simd, dispatch, f32x8, mask32x8, prelude::*, u32x8};
use rayon::prelude::*;
use std::f32::consts::LOG2_E;
use std::ops::Range;

const FLOATS: usize = PROJECTED_FLOATS as usize;
/// Splats of a task.
const CHUNK: usize = 1 << 10;

#[inline(always)]
fn depth_keys<S: Simd>(z: f32x8<S>) -> u32x8<S> {
    let bits: u32x8<S> = z.bitcast();
    let (below, above) = (bits.min(FINE_FIRST), bits.max(FINE_END) - FINE_END);
    let fine = bits.max(FINE_FIRST).min(FINE_END) - FINE_FIRST;
    (below >> COARSE_DROPPED) + (fine >> FINE_DROPPED) + (above >> COARSE_DROPPED)
}

impl<S: Simd> Camera<S> {
    /// `is_on_image` of `project.comp`.
    #[inline(always)]
    fn shows(
        &self,
        centre: [f32x8<S>; 2],
        power: [f32x8<S>; 3],
        det: f32x8<S>,
        log2_opacity: f32x8<S>,
    ) -> mask32x8<S> {
        let k = (log2_opacity - LOG2_ALPHA_MIN as f32) / det;
        let is_outside = |axis: usize| {
            let reach = (-k * power[2 - 2 * axis]).max(0.0).sqrt().mul_add(1.001, 1.0);
            (centre[axis] + reach).simd_lt(0.0) | (centre[axis] - reach).simd_gt(self.far[axis])
        };
        !(is_outside(0) | is_outside(1))
    }
}

impl Splats<'_> {
    /// Colours of up to eight splats.
    #[inline(always)]
    fn colours<S: Simd, const N: usize>(&self, simd: S, offset: Vec3s<S>, own: &Range<usize>) -> Vec3s<S> {
        let direction = offset * (f32x8::simd_from(simd, 1.0) / offset.dot(offset).sqrt());
        let coefficients: [_; N] = self.sh.of(simd, own);
        let basis: [_; N] = sh::basis(simd, direction);
        let mut colour = Vec3s::splat(simd, [0.5; 3]);
        for k in 0..N {
            colour += Vec3s(coefficients[k]) * basis[k];
        }
        Vec3s([colour[0].max(0.0), colour[1].max(0.0), colour[2].max(0.0)])
    }

    /// Projects up to eight splats with `N` SH coefficients.
    #[inline(always)]
    fn project<S: Simd, const N: usize>(
        &self,
        simd: S,
        camera: &Camera<S>,
        own: Range<usize>,
        projected: &mut [[f32; FLOATS]],
        pairs: &mut [[u32; 2]],
    ) {
        let (mean, g) = self.geometry(simd, camera, &own);
        let mut log2_opacity = -log2(self.inverse_opacities(simd, &own));
        if self.antialiased {
            log2_opacity += log2(g.squared_area() * g.conic_det) * 0.5;
        }
        let colour = self.colours::<S, N>(simd, mean - camera.position, &own);
        let centre =
            |axis: usize| (camera.focal[axis] * g.t[axis]).mul_add(g.inverse_z, camera.centre[axis] - 0.5);
        let centre = [centre(0), centre(1)];
        let power = [g.conic[0] * (-0.5 * LOG2_E), g.conic[1] * -LOG2_E, g.conic[2] * (-0.5 * LOG2_E)];
        let det = g.conic_det * (0.25 * LOG2_E * LOG2_E);
        let is_shown = camera.shows(centre, power, det, log2_opacity);
        let visible = g.visible & log2_opacity.simd_ge(LOG2_ALPHA_MIN as f32) & is_shown;
        let hidden = f32x8::simd_from(simd, -1e4);
        let columns = [
            centre[0],
            centre[1],
            power[0],
            power[1],
            power[2],
            visible.select(log2_opacity, hidden),
            det,
            f32x8::simd_from(simd, 0.0),
            colour[0],
            colour[1],
            colour[2],
            g.t[2],
        ];
        scatter(&columns, projected);
        let keys = visible.select(depth_keys(g.t[2]), u32x8::simd_from(simd, HIDDEN_KEY));
        for ((pair, key), splat) in pairs.iter_mut().zip(keys.to_array()).zip(own) {
            *pair = [key, splat as u32];
        }
    }
}

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    sh::with_count!(run_with, call)
}

fn run_with<const N: usize>(call: &mut NativeCall) -> Result<(), String> {
    let [count, sh_stride, antialiased, sort_words, list_words] = call.words()?.map(|word| word as usize);
    let level = Level::new();
    let [camera, means, log_scales, quats, opacity_logits, sh, projected, pairs, splats, sort, list] =
        call.memory([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10])?;
    splats.of::<u32>()[..2].fill(count as u32);
    sort.of::<u32>()[..sort_words].fill(0);
    list.of::<u32>()[..list_words].fill(0);
    let view = camera.of::<CameraView>()[0];
    let splats = Splats {
        means: means.of(),
        log_scales: log_scales.of(),
        quats: quats.of(),
        opacity_logits: opacity_logits.of(),
        sh: Coefficients::new(sh.of(), sh_stride),
        antialiased: antialiased != 0,
    };
    let projected = projected.of::<[f32; FLOATS]>()[..count].par_chunks_mut(CHUNK);
    let pairs = pairs.of::<[u32; 2]>()[..count].par_chunks_mut(CHUNK);
    projected.zip(pairs).enumerate().for_each(|(chunk, (projected, pairs))| {
        dispatch!(level, simd => project::<_, N>(simd, &splats, &view, chunk * CHUNK, projected, pairs));
    });
    Ok(())
}

/// Projects splats from `first` on.
#[inline(always)]
fn project<S: Simd, const N: usize>(
    simd: S,
    splats: &Splats,
    view: &CameraView,
    first: usize,
    projected: &mut [[f32; FLOATS]],
    pairs: &mut [[u32; 2]],
) {
    let camera = Camera::new(simd, view);
    let eights = projected.chunks_mut(LANES).zip(pairs.chunks_mut(LANES));
    for (eight, (projected, pairs)) in eights.enumerate() {
        let first = first + eight * LANES;
        splats.project::<S, N>(simd, &camera, first..first + projected.len(), projected, pairs);
    }
}
