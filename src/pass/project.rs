//! Projection of splats to the screen (EWA, Zwicker et al. 2002; Kerbl et al. 2023,
//! docs/internals/method.md#projection).
//!
//! Per splat, with R_q of the unit quaternion, s = exp(log scale): `t = R μ + τ`, `M = R_q
//! diag(s)`, `B = J R M` (2×3), `Σ' = B Bᵀ + 0.3 I`, `(A, B, C) = Σ'⁻¹`, `u = fx t_x/t_z + cx − ½`,
//! colour = max(0, Σ_k B_k(dir) sh_k + ½), opacity = σ(logit); that of antialiased splats is
//! multiplied by √(det B Bᵀ / det Σ') (Yu et al. 2024, the 2-D Mip filter). J is evaluated at
//! t_x/t_z clamped to the image border plus 30 % of the half width, so that splats far outside do
//! not explode.
use super::frame::FrameBuffers;
use super::options::FeatureMode;
use super::params::Params;
use super::sort::{Sort, rows_of_groups};
use super::splat_buffers::SplatBuffers;
use super::view::View;
use crate::gpu::shaders::shared::splat::{DILATION, SMALLEST_AREA};
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Recorder, shaders};
use crate::scene::sh;
use glam::{DMat3, DVec3, DVec4};

/// Bits of the depth keys.
pub const DEPTH_BITS: u32 = shaders::project::DEPTH_BITS;

/// Sort key of a visible splat: the bits of camera z without the last ones, so that it grows with z
/// and is equal where depths differ by less than two millionths.
pub fn depth_key(z: f32) -> u32 {
    use shaders::project::{COARSE_DROPPED, FINE_DROPPED, FINE_END, FINE_FIRST};
    let bits = z.to_bits();
    let fine = bits.clamp(FINE_FIRST, FINE_END) - FINE_FIRST;
    let coarse = (bits.min(FINE_FIRST) >> COARSE_DROPPED) + (bits.saturating_sub(FINE_END) >> COARSE_DROPPED);
    coarse + (fine >> FINE_DROPPED)
}

/// Records the projection of all splats to `frame.projected`, with the
/// first (sh_degree + 1)² SH coefficients, and of their depth keys for `sort`. Writes their number
/// to `splat_count` and clears the counters of `sort` and of the tile lists.
pub(super) fn record(
    rec: &mut Recorder,
    splats: &SplatBuffers,
    camera: &Buffer<CameraView>,
    frame: &FrameBuffers,
    sh_degree: u32,
    (sort, splat_count): (&Sort, &Buffer<u32>),
) {
    let count = splats.count as u32;
    let (sort_zeros, sort_words) = sort.zeros(DEPTH_BITS);
    let (list_zeros, list_words) = frame.lists.zeros();
    let call = shaders::project::call(
        shaders::project::Variant { sh_degree },
        &shaders::project::Bindings {
            camera,
            means: &splats.means,
            log_scales: &splats.log_scales,
            quats: &splats.quats,
            opacity_logits: &splats.opacity_logits,
            sh: &splats.sh,
            projected: &frame.projected,
            depth_pairs: sort.unsorted(&frame.depth_pairs, DEPTH_BITS),
            splat_count,
            sort_zeros,
            list_zeros,
        },
        &shaders::project::Push {
            count,
            sh_stride: splats.sh_len() as u32,
            antialiased: splats.antialiased.into(),
            sort_words,
            list_words,
        },
    );
    // Without splats, one workgroup clears the counters.
    rec.dispatch(call, rows_of_groups(splats.count.div_ceil(shaders::project::WORKGROUP[0] as usize)));
}

/// Records the map from stored to rendered features, `frame.codes`. Records nothing without
/// features.
pub fn record_features(rec: &mut Recorder, splats: &SplatBuffers, frame: &FrameBuffers, mode: FeatureMode) {
    if splats.feature_dim == 0 {
        return;
    }
    let (count, dim) = (splats.count as u32, splats.feature_dim as u32);
    let call = shaders::features_forward::call(
        &shaders::features_forward::Bindings { features: &splats.features, codes: &frame.codes },
        &shaders::features_forward::Push {
            count,
            dim,
            stride: frame.code_stride(),
            width: mode.width(splats.feature_dim) as u32,
            epsilon: mode.epsilon(),
        },
    );
    rec.dispatch(
        call,
        rows_of_groups(splats.count.div_ceil(shaders::features_forward::WORKGROUP[0] as usize)),
    );
}

/// Projected splat, f64 reference.
#[derive(Clone, Debug, PartialEq)]
pub struct Projected {
    /// Centre in index coordinates (centre of the first pixel = 0), pixels.
    pub centre: [f64; 2],
    /// (A, B, C): the inverse screen covariance, 1/pixels².
    pub conic: [f64; 3],
    /// Camera z, world units.
    pub depth: f64,
    /// o in (0, 1).
    pub opacity: f64,
    /// RGB ≥ 0.
    pub colour: DVec3,
}

/// Geometry of one splat, shared by forward and backward pass.
#[derive(Clone, Debug)]
pub(super) struct Geometry {
    pub t: DVec3,
    /// Unit quaternion (w, x, y, z) and the length of the raw one.
    pub quat: DVec4,
    pub quat_length: f64,
    pub rotation: DMat3,
    pub scale: DVec3,
    /// Clamped t_x/t_z and t_y/t_z, times t_z.
    pub clamped: [f64; 2],
    /// Whether each was inside the limits.
    pub inside: [bool; 2],
    /// Rows of J and of T = J R.
    pub jacobian: [DVec3; 2],
    pub to_screen: [DVec3; 2],
    /// Rows of B = T M.
    pub b: [DVec3; 2],
    pub conic: [f64; 3],
    /// B Bᵀ as (xx, xy, yy), and its determinant.
    pub undilated: [f64; 3],
    pub undilated_det: f64,
    /// √(det B Bᵀ / det Σ').
    pub compensation: f64,
}

/// R_q of a unit quaternion (w, x, y, z).
pub fn rotation_of(q: DVec4) -> DMat3 {
    let (r, x, y, z) = (q.x, q.y, q.z, q.w);
    // Each line below is one column.
    DMat3::from_cols(
        DVec3::new(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + r * z), 2.0 * (x * z - r * y)),
        DVec3::new(2.0 * (x * y - r * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + r * x)),
        DVec3::new(2.0 * (x * z + r * y), 2.0 * (y * z - r * x), 1.0 - 2.0 * (x * x + y * y)),
    )
}

/// Geometry of splat `i`; `None` where it is not beyond the near plane.
pub(super) fn geometry(params: &Params, i: usize, view: &View) -> Option<Geometry> {
    let t = view.rotation * params.means[i] + view.translation;
    if t.z <= view.near {
        return None;
    }
    let quat_length = params.quats[i].length();
    let quat = params.quats[i] / quat_length;
    let rotation = rotation_of(quat);
    let scale = params.log_scales[i].exp();
    let (negative, positive) = view.jacobian_limits();
    let slope = [t.x / t.z, t.y / t.z];
    let clamped = [0, 1].map(|a| slope[a].clamp(-negative[a], positive[a]) * t.z);
    let inside = [0, 1].map(|a| slope[a] >= -negative[a] && slope[a] <= positive[a]);
    let [fx, fy] = view.focal;
    let jacobian = [
        DVec3::new(fx / t.z, 0.0, -fx * clamped[0] / (t.z * t.z)),
        DVec3::new(0.0, fy / t.z, -fy * clamped[1] / (t.z * t.z)),
    ];
    let to_screen = jacobian.map(|row| view.rotation.transpose() * row);
    let b = to_screen.map(|row| (rotation.transpose() * row) * scale);
    let (xx, xy, yy) = (b[0].dot(b[0]), b[0].dot(b[1]), b[1].dot(b[1]));
    // det(BBᵀ + cI) by Lagrange's identity: no cancellation for needles, where xx·yy − xy² loses
    // every digit.
    let area = b[0].cross(b[1]).length_squared();
    let det = area + DILATION * (xx + yy) + DILATION * DILATION;
    let conic = [(yy + DILATION) / det, -xy / det, (xx + DILATION) / det];
    let undilated_det = area.max(SMALLEST_AREA);
    Some(Geometry {
        t,
        quat,
        quat_length,
        rotation,
        scale,
        clamped,
        inside,
        jacobian,
        to_screen,
        b,
        conic,
        undilated: [xx, xy, yy],
        undilated_det,
        compensation: (undilated_det / det).sqrt(),
    })
}

/// Projects splat `i`; `None` where it is not beyond the near plane, or its opacity is below
/// `alpha_min` and it can change no pixel.
pub fn reference(params: &Params, i: usize, view: &View, alpha_min: f64) -> Option<Projected> {
    let g = geometry(params, i, view)?;
    let own = 1.0 / (1.0 + (-params.opacity_logits[i]).exp());
    let opacity = if params.antialiased { own * g.compensation } else { own };
    if opacity < alpha_min {
        return None;
    }
    let colour = (raw_colour(params, i, view) + 0.5).max(DVec3::ZERO);
    let [fx, fy] = view.focal;
    Some(Projected {
        centre: [fx * g.t.x / g.t.z + view.centre[0] - 0.5, fy * g.t.y / g.t.z + view.centre[1] - 0.5],
        conic: g.conic,
        depth: g.t.z,
        opacity,
        colour,
    })
}

/// Σ_k B_k(dir) sh_k, before the offset of ½ and the clamp.
pub(super) fn raw_colour(params: &Params, i: usize, view: &View) -> DVec3 {
    let direction = (params.means[i] - view.position()).normalize();
    let basis = sh::basis(direction, params.sh_degree);
    params.sh_of(i).iter().zip(basis).map(|(&c, b)| c * b).sum()
}

/// CPU reference of the map from raw to rendered features, [N, d]
/// (docs/internals/method.md#feature-gauge).
pub fn features_reference(features: &[f64], dim: usize, mode: FeatureMode) -> Vec<f64> {
    match mode {
        FeatureMode::Linear => features.to_vec(),
        FeatureMode::Gauge { epsilon, .. } => features
            .chunks(mode.width(dim))
            .flat_map(|f| {
                let length = f.iter().map(|x| x * x).sum::<f64>().sqrt();
                f.iter().map(move |x| x / (length + f64::from(epsilon)))
            })
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice, native, options, test_device};
    use crate::math::Random;
    use crate::pass::{RasterOptions, Rasterizer};
    use crate::scene::seeded;
    use glam::Vec3;

    #[test]
    fn depth_keys_grow_with_depth() {
        let keys = |first: f32, ratio: f32| {
            let depths = std::iter::successors(Some(first), move |z| Some(z * ratio));
            depths.take_while(|z| *z < 3e38).map(depth_key)
        };
        // A step of the coarse octaves, and one of the fine ones.
        assert!(keys(1e-37, 1.0 + 7e-5).is_sorted_by(|a, b| a < b));
        assert!(keys(1.0 / 256.0, 1.0 + 2e-6).take(8_000_000).is_sorted_by(|a, b| a < b));
        assert!(depth_key(f32::MAX) < shaders::project::HIDDEN_KEY);
    }

    /// Depths of any scale, without a near plane, by shaders and by native code.
    #[test]
    fn splats_of_any_depth_are_in_order() {
        let natives = TestDevice::open(&Options { natives: native::ALL, ..options(None) }).unwrap();
        let mut random = Random::new(3);
        let (mut splats, camera) = seeded::small(300, 40, 30, 0, 3);
        for mean in &mut splats.means {
            let z = random.between(-12.0, 18.0).exp2() * random.between(1e-4, 1.0);
            *mean = camera.pose.inverse().transform(DVec3::Z * z).as_vec3().to_array();
        }
        for device in [&test_device(), &natives] {
            let params = SplatBuffers::upload(device, &splats, &[], 0).unwrap();
            let mut raster = Rasterizer::new(device, 300, 0, 40, 30).unwrap();
            raster.set_view(&View::new(&camera, 0.0)).unwrap();
            raster.forward(&params, &RasterOptions::default()).unwrap();
            let mean = |splat: u32| Vec3::from(splats.means[splat as usize]).as_dvec3();
            let z = |splat: u32| camera.pose.transform(mean(splat)).z;
            let pairs = raster.frame().depth_pairs.read().unwrap();
            let shown = pairs.chunks(2).filter(|pair| pair[0] < shaders::project::HIDDEN_KEY);
            let depths: Vec<f64> = shown.map(|pair| z(pair[1])).collect();
            assert!(depths.len() > 250 && depths.is_sorted_by(|a, b| *a <= b * (1.0 + 1e-4)), "{depths:?}");
        }
    }
}
