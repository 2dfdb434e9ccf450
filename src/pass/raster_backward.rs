//! Gradients through the blending by every screen-space splat
//! (docs/internals/method.md#backward-rasterisation).
//!
//! Upstream planes [(4 + d) + 1, H, W]: ∂L/∂(RGB on background), ∂L/∂Σwz, ∂L/∂features, ∂L/∂alpha
//! (alpha = 1 − T_f). For a contributor with w = αT, own = c·g: `∂c += w g`, `∂α = T own − (S − g_A
//! T_f)/(1 − α)` with S the weighted upstream sum of everything behind it, background included. The
//! pass walks front to back and computes S as the total of the pixel minus the sum up to here, so
//! that T needs no division and no list of contributors.
//!
//! With σ = ∂α · α (0 where α was clamped), the shader only sums six moments: Σσ, Σσdx, Σσdy,
//! Σσdx², Σσdxdy, Σσdy². Every geometry gradient follows per splat: ∂o = m₀/o, ∂(u, v) = −(A m₁ + B
//! m₂, C m₂ + B m₁), ∂(A, B, C) = (−½ m₃, −m₄, −½ m₅).
use super::adam::rows_of_threads;
use super::channels::{BASE_CHANNELS, Block, blocks};
use super::frame::{EntryBuffers, FrameBuffers, GRADIENT_FLOATS, GradientReduction, TileSums, Tiles};
use super::raster_forward::{Cutoffs, ReferenceScene, channels_of, push, walk};
use crate::gpu::{Buffer, Recorder, shaders};

/// Moments of one splat in the gradient buffer; RGB and z follow.
pub const MOMENTS: usize = shaders::shared::layout::MOMENTS as usize;

/// Clears the sums that [`record`] adds to.
pub(super) fn record_clear(rec: &mut Recorder, frame: &FrameBuffers) {
    rec.fill(&frame.projected_grad, 0);
    if frame.feature_dim > 0 {
        rec.fill(&frame.codes_grad, 0);
    }
}

/// Records the back-propagation of `frame.planes_grad` to `frame.projected_grad` and
/// `frame.codes_grad` of `count` splats, for rows of tiles with present lists. Adds to the sums
/// that [`record_clear`] cleared; [`GradientReduction::Entries`] overwrites them where these are
/// `all` tiles of the image. `features_move_geometry` = false restricts the gradient of the feature
/// planes to the features.
pub(super) fn record(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    tiles: &Tiles,
    count: usize,
    features_move_geometry: bool,
    all: bool,
) {
    let coupling = if features_move_geometry { 1.0 } else { 0.0 };
    match frame.summation {
        GradientReduction::Atomics => {
            for block in blocks(frame.feature_dim as u32) {
                if frame.tile_sums == TileSums::Shared && block.channels == BASE_CHANNELS as u32 {
                    record_shared(rec, frame, tiles);
                } else {
                    record_atomic(rec, frame, tiles, block, coupling);
                }
            }
        }
        GradientReduction::Entries => match frame.gradient_entries.buffers(rec.device(), frame) {
            Ok(entries) => record_stored(rec, frame, tiles, &entries, count, coupling, !all),
            Err(e) => rec.fail_with(e),
        },
    }
}

/// Records [`GradientReduction::Entries`]: all blocks of channels, each summed per splat.
fn record_stored(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    tiles: &Tiles,
    entries: &EntryBuffers,
    count: usize,
    coupling: f32,
    add: bool,
) {
    for block in blocks(frame.feature_dim as u32) {
        record_entries(rec, frame, tiles, entries, block, coupling);
        if block.features > 0 {
            // Only the vectors of the block: a write behind them would hit the next splat.
            let columns = Columns {
                width: block.vectors(),
                vectors: block.features.div_ceil(4),
                stride: frame.code_stride() / 4,
                first_vector: block.first_vector,
            };
            record_sum(rec, frame, count, &entries.codes, &frame.codes_grad, columns, add);
        }
    }
    let vectors = GRADIENT_FLOATS as u32 / 4;
    let columns = Columns { width: vectors, vectors, stride: vectors, first_vector: 0 };
    record_sum(rec, frame, count, &entries.splats, &frame.projected_grad, columns, add);
}

fn record_atomic(rec: &mut Recorder, frame: &FrameBuffers, tiles: &Tiles, block: Block, coupling: f32) {
    let call = shaders::raster_backward::call(
        shaders::raster_backward::Variant { channels: block.channels },
        &shaders::raster_backward::Bindings {
            projected: &frame.projected,
            tile_ranges: &frame.lists.ranges,
            tile_splats: &frame.lists.splats,
            codes: &frame.codes,
            codes_grad: &frame.codes_grad,
            planes: &frame.planes,
            planes_grad: &frame.planes_grad,
            transmittance: &frame.transmittance,
            projected_grad: &frame.projected_grad,
        },
        &push!(raster_backward, frame, tiles, block, alpha_plane: alpha_plane(frame), coupling: coupling),
    );
    rec.dispatch(call, [frame.tiles()[0], tiles.rows.len() as u32, 1]);
}

/// Records [`TileSums::Shared`] for an image without features.
fn record_shared(rec: &mut Recorder, frame: &FrameBuffers, tiles: &Tiles) {
    let call = shaders::raster_backward_shared::call(
        &shaders::raster_backward_shared::Bindings {
            projected: &frame.projected,
            tile_ranges: &frame.lists.ranges,
            tile_splats: &frame.lists.splats,
            planes: &frame.planes,
            planes_grad: &frame.planes_grad,
            transmittance: &frame.transmittance,
            projected_grad: &frame.projected_grad,
        },
        &shaders::raster_backward_shared::Push {
            width: frame.width,
            top: tiles.top,
            rows: frame.bands.rows as u32,
            first_row: tiles.rows.start,
            list_row: tiles.list_row,
            tiles_x: frame.tiles()[0],
            alpha_plane: alpha_plane(frame),
        },
    );
    rec.dispatch(call, [frame.tiles()[0], tiles.rows.len() as u32, 1]);
}

fn record_entries(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    tiles: &Tiles,
    entries: &EntryBuffers,
    block: Block,
    coupling: f32,
) {
    let call = shaders::raster_backward_entries::call(
        shaders::raster_backward_entries::Variant { channels: block.channels },
        &shaders::raster_backward_entries::Bindings {
            projected: &frame.projected,
            tile_ranges: &frame.lists.ranges,
            tile_splats: &frame.lists.splats,
            codes: &frame.codes,
            code_entries: &entries.codes,
            planes: &frame.planes,
            planes_grad: &frame.planes_grad,
            transmittance: &frame.transmittance,
            splat_entries: &entries.splats,
        },
        &push!(raster_backward_entries, frame, tiles, block, alpha_plane: alpha_plane(frame), coupling: coupling),
    );
    rec.dispatch(call, [frame.tiles()[0], tiles.rows.len() as u32, 1]);
}

/// Index of the alpha plane in the stack.
fn alpha_plane(frame: &FrameBuffers) -> u32 {
    (BASE_CHANNELS + frame.feature_dim) as u32
}

/// Columns of [`record_sum`], in vectors of four.
struct Columns {
    /// Vectors of an entry.
    width: u32,
    /// Number of its first vectors that are summed.
    vectors: u32,
    /// Vectors of a splat in the sums.
    stride: u32,
    /// First vector of a splat to write.
    first_vector: u32,
}

/// Records the sums of `from` [entries, width] per splat, written or `add`ed to columns of `to` [N,
/// stride].
fn record_sum(
    rec: &mut Recorder,
    frame: &FrameBuffers,
    count: usize,
    from: &Buffer<f32>,
    to: &Buffer<f32>,
    columns: Columns,
    add: bool,
) {
    let Columns { width, vectors, stride, first_vector } = columns;
    let call = shaders::gradient_sum::call(
        &shaders::gradient_sum::Bindings {
            depth_pairs: &frame.depth_pairs,
            tile_counts: &frame.lists.counts,
            starts: &frame.lists.starts,
            entry_count: &frame.lists.entry_count,
            entries: from,
            sums: to,
        },
        &shaders::gradient_sum::Push {
            count: count as u32,
            width,
            vectors,
            stride,
            first_vector,
            add: u32::from(add),
        },
    );
    rec.dispatch(call, rows_of_threads(count * vectors as usize));
}

/// Gradient by one screen-space splat, in the layout of the GPU buffer.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SplatGradient {
    /// Σσ, Σσdx, Σσdy, Σσdx², Σσdxdy, Σσdy².
    pub moments: [f64; MOMENTS],
    /// By RGB and z.
    pub channels: [f64; BASE_CHANNELS],
}

/// Gradients by all screen-space splats.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScreenGradients {
    /// [N].
    pub geometry: Vec<SplatGradient>,
    /// [N, d] by the rendered features.
    pub features: Vec<f64>,
}

/// CPU reference: back-propagates `upstream` [(4 + d) + 1, H, W].
pub fn reference(scene: &ReferenceScene, cutoffs: &Cutoffs, upstream: &[f64]) -> ScreenGradients {
    let [width, height] = scene.view.size;
    let pixels = width as usize * height as usize;
    let dim = scene.feature_dim;
    let channels = BASE_CHANNELS + dim;
    let values: Vec<_> = (0..scene.projected.len()).map(|i| channels_of(scene, i)).collect();
    let mut out = ScreenGradients {
        geometry: vec![SplatGradient::default(); scene.projected.len()],
        features: vec![0.0; scene.projected.len() * dim],
    };
    for pixel in 0..pixels {
        let (list, last) =
            walk(scene, cutoffs, (pixel % width as usize) as u32, (pixel / width as usize) as u32);
        let g = |channel: usize| upstream[channel * pixels + pixel];
        let mut behind = last * (0..3).map(|k| scene.view.background[k] * g(k)).sum::<f64>();
        for c in list.iter().rev() {
            let weight = c.alpha * c.transmittance;
            let own: f64 = values[c.splat].iter().enumerate().map(|(k, v)| v * g(k)).sum();
            let target = &mut out.geometry[c.splat];
            for k in 0..BASE_CHANNELS {
                target.channels[k] += weight * g(k);
            }
            for k in 0..dim {
                out.features[c.splat * dim + k] += weight * g(BASE_CHANNELS + k);
            }
            let by_alpha =
                c.transmittance * own - behind / (1.0 - c.alpha) + g(channels) * last / (1.0 - c.alpha);
            behind += weight * own;
            if c.clamped {
                continue;
            }
            let sigma = by_alpha * c.alpha;
            let [dx, dy] = c.d;
            for (m, factor) in target.moments.iter_mut().zip([1.0, dx, dy, dx * dx, dx * dy, dy * dy]) {
                *m += sigma * factor;
            }
        }
    }
    out
}
