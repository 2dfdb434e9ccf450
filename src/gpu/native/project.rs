//! `project.comp`.
use super::splat::{Camera, Geometry};
use crate::gpu::NativeCall;
use crate::gpu::shaders::project::{COARSE_DROPPED, FINE_DROPPED, FINE_END, FINE_FIRST, HIDDEN_KEY};
use crate::gpu::shaders::shared::cutoffs::LOG2_ALPHA_MIN;
use crate::gpu::shaders::shared::layout::PROJECTED_FLOATS;
use crate::gpu::shaders::structs::CameraView;
use crate::scene::{SH_C0, sh};
use glam::{Vec2, Vec3, Vec4};
use rayon::prelude::*;
use std::f32::consts::LOG2_E;

const FLOATS: usize = PROJECTED_FLOATS as usize;

fn depth_key(z: f32) -> u32 {
    let bits = z.to_bits();
    let (below, above) = (bits.min(FINE_FIRST), bits.max(FINE_END) - FINE_END);
    let fine = bits.clamp(FINE_FIRST, FINE_END) - FINE_FIRST;
    (below >> COARSE_DROPPED) + (fine >> FINE_DROPPED) + (above >> COARSE_DROPPED)
}

pub(super) fn run(call: &mut NativeCall) -> Result<(), String> {
    let [count, sh_stride, antialiased, sort_words, list_words] = call.words()?.map(|word| word as usize);
    let degree = call.variant()[0];
    let [camera, means, log_scales, quats, opacity_logits, sh, projected, pairs, splats, sort, list] =
        call.memory([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10])?;
    splats.of::<u32>()[..2].fill(count as u32);
    sort.of::<u32>()[..sort_words].fill(0);
    list.of::<u32>()[..list_words].fill(0);
    let camera = Camera::new(&camera.of::<CameraView>()[0]);
    let (means, log_scales): (&[[f32; 3]], &[[f32; 3]]) = (means.of(), log_scales.of());
    let (quats, opacity_logits): (&[[f32; 4]], &[f32]) = (quats.of(), opacity_logits.of());
    let sh: &[f32] = sh.of();
    let projected = projected.of::<[f32; FLOATS]>()[..count].par_iter_mut();
    let pairs = pairs.of::<[u32; 2]>()[..count].par_iter_mut();
    projected.zip(pairs).enumerate().with_min_len(1024).for_each(|(i, (out, pair))| {
        let mean = Vec3::from(means[i]);
        let g = Geometry::of(&camera, mean, log_scales[i].into(), Vec4::from(quats[i]));
        let mut log2_opacity = -(1.0 + (-opacity_logits[i]).min(80.0).exp()).log2();
        if antialiased != 0 {
            log2_opacity += 0.5 * (g.squared_area() * g.conic_det).log2();
        }
        let mut colour = 0.5 + SH_C0 * Vec3::from_slice(&sh[3 * i * sh_stride..]);
        if degree > 0 {
            let basis = sh::basis((mean - camera.position).normalize().as_dvec3(), degree);
            let others = basis.iter().enumerate().take(((degree + 1) * (degree + 1)) as usize).skip(1);
            for (k, basis) in others {
                colour += *basis as f32 * Vec3::from_slice(&sh[3 * (i * sh_stride + k)..]);
            }
        }
        let colour = colour.max(Vec3::ZERO);
        let centre = camera.focal * g.t.truncate() / g.t.z + camera.centre - 0.5;
        let power = Vec3::new(-0.5 * LOG2_E, -LOG2_E, -0.5 * LOG2_E) * g.conic;
        let det = 0.25 * LOG2_E * LOG2_E * g.conic_det;
        let k = (log2_opacity - LOG2_ALPHA_MIN as f32) / det;
        let reach = 1.001 * Vec2::new((-k * power.z).max(0.0).sqrt(), (-k * power.x).max(0.0).sqrt()) + 1.0;
        let is_outside = (centre + reach).cmplt(Vec2::ZERO).any() || (centre - reach).cmpgt(camera.far).any();
        let visible = g.visible && log2_opacity >= LOG2_ALPHA_MIN as f32 && !is_outside;
        *out = [
            centre.x,
            centre.y,
            power.x,
            power.y,
            power.z,
            if visible { log2_opacity } else { -1e4 },
            det,
            0.0,
            colour.x,
            colour.y,
            colour.z,
            g.t.z,
        ];
        *pair = [if visible { depth_key(g.t.z) } else { HIDDEN_KEY }, i as u32];
    });
    Ok(())
}
