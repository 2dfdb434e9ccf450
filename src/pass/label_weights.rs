//! Blending weights of splats, summed over the pixels of each label
//! (docs/internals/method.md#lifting).
//!
//! The labels of a pixel on all levels are its label set. Regions are larger than tiles, so that a
//! tile of 8 × 8 pixels shows few sets. The shader sums the weights of each (splat, tile) over the
//! pixels of each set; the host adds these sums up per splat, in the order of the tiles, so that
//! the result has the same bits on every run.
use super::bands::Band;
use super::frame::{FrameBuffers, Tiles};
use super::raster_forward::{Cutoffs, ReferenceScene, walk};
use super::rasterizer::{RasterOptions, Rasterizer, SplatBuffers};
use super::tile_lists::{Lists, TILE};
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, shaders};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Label sets of one dispatch: the sums of an entry take as many bytes as its tile list, which the
/// device binds.
pub(super) const SLOTS: usize = shaders::label_weights::SLOTS as usize;

/// Label sets of the tiles of one band.
pub(super) struct LabelSets {
    levels: usize,
    tiles_x: usize,
    /// First row of tiles.
    first_row: usize,
    /// [rows, W] label set of each pixel within its tile, −1 without a label.
    slots: Buffer<i32>,
    /// [tiles] number of label sets.
    counts: Buffer<u32>,
    /// Per tile its sets, each [levels] labels.
    sets: Vec<Vec<i32>>,
}

impl LabelSets {
    /// Label sets of a band from its labels [levels, rows·W], −1 = none.
    pub(super) fn new(
        device: &Device,
        frame: &FrameBuffers,
        band: &Band,
        labels: &[i32],
    ) -> Result<LabelSets> {
        let (width, rows) = (frame.width as usize, band.rows);
        let [tiles_x, tiles_y] = [width, rows].map(|n| n.div_ceil(TILE as usize));
        let levels = labels.len() / (width * rows).max(1);
        let per_tile: Vec<(Vec<i32>, Vec<(usize, i32)>)> = (0..tiles_x * tiles_y)
            .into_par_iter()
            .map(|tile| sets_of_tile(labels, levels, [width, rows], [tile % tiles_x, tile / tiles_x]))
            .collect();
        let mut slots = vec![-1; width * rows];
        let (mut sets, mut counts) = (Vec::new(), Vec::new());
        for (own, pixels) in per_tile {
            pixels.into_iter().for_each(|(pixel, slot)| slots[pixel] = slot);
            counts.push((own.len() / levels.max(1)) as u32);
            sets.push(own);
        }
        Ok(LabelSets {
            levels,
            tiles_x,
            first_row: band.top / TILE as usize,
            slots: device.buffer_from("label slots", &slots)?,
            counts: device.buffer_from("label set counts", &counts)?,
            sets,
        })
    }

    /// Most label sets of the tiles of these rows.
    fn most(&self, tiles: &Tiles) -> usize {
        let row = |r: u32| (r as usize - self.first_row) * self.tiles_x;
        let all = &self.sets[row(tiles.rows.start)..row(tiles.rows.end).min(self.sets.len())];
        all.iter().map(Vec::len).max().unwrap_or(0) / self.levels.max(1)
    }

    /// First label set of each dispatch that these rows of tiles need.
    pub(super) fn dispatches(&self, tiles: &Tiles) -> impl Iterator<Item = usize> + use<> {
        (0..self.most(tiles)).step_by(SLOTS)
    }

    /// Records the sums over the label sets `first_slot .. first_slot + SLOTS` of each tile, for rows
    /// of tiles with present lists. Writes `weights`, [entries, SLOTS] in the order of the lists.
    pub(super) fn record(
        &self,
        rec: &mut Recorder,
        frame: &FrameBuffers,
        tiles: &Tiles,
        first_slot: usize,
        weights: &Buffer<f32>,
    ) {
        rec.pass("label weights");
        let call = shaders::label_weights::call(
            &shaders::label_weights::Bindings {
                projected: &frame.projected,
                tile_ranges: &frame.lists.ranges,
                tile_splats: &frame.lists.splats,
                slots: &self.slots,
                slot_counts: &self.counts,
                weights,
            },
            &shaders::label_weights::Push {
                width: frame.width,
                top: tiles.top,
                rows: frame.bands.rows as u32,
                first_row: tiles.rows.start,
                list_row: tiles.list_row,
                tiles_x: frame.tiles()[0],
                first_slot: first_slot as u32,
            },
        );
        rec.dispatch(call, [frame.tiles()[0], tiles.rows.len() as u32, 1]);
    }

    /// Reads the sums that [`LabelSets::record`] wrote and adds them to those of the splats.
    pub(super) fn add(
        &self,
        frame: &FrameBuffers,
        tiles: &Tiles,
        first_slot: usize,
        weights: &Buffer<f32>,
        sums: &mut LabelWeights,
    ) -> Result<()> {
        let lists = tiles.rows.len() * self.tiles_x;
        let ranges = frame.lists.ranges.read_range(0..lists + 1)?;
        let entries = ranges[lists] as usize;
        let listed = frame.lists.splats.read_range(0..2 * entries)?;
        let weights = weights.read_range(0..SLOTS * entries)?;
        let first = (tiles.rows.start as usize - self.first_row) * self.tiles_x;
        for (list, range) in ranges.windows(2).enumerate() {
            let sets = self.sets[first + list].chunks_exact(self.levels).skip(first_slot).take(SLOTS);
            for (slot, set) in sets.enumerate() {
                for entry in range[0] as usize..range[1] as usize {
                    sums.add(listed[2 * entry + 1] as usize, set, weights[SLOTS * entry + slot]);
                }
            }
        }
        Ok(())
    }
}

/// The label sets of a tile, each [levels] labels, and its labelled pixels with their sets.
fn sets_of_tile(
    labels: &[i32],
    levels: usize,
    [width, rows]: [usize; 2],
    [column, row]: [usize; 2],
) -> (Vec<i32>, Vec<(usize, i32)>) {
    let edge = TILE as usize;
    let (mut sets, mut pixels): (Vec<i32>, _) = (Vec::new(), Vec::new());
    for y in row * edge..((row + 1) * edge).min(rows) {
        for x in column * edge..((column + 1) * edge).min(width) {
            let pixel = y * width + x;
            let of = |level: usize| labels[level * width * rows + pixel];
            if (0..levels).all(|level| of(level) < 0) {
                continue;
            }
            let known = sets.chunks_exact(levels).position(|set| (0..levels).all(|l| set[l] == of(l)));
            let slot = known.unwrap_or_else(|| {
                sets.extend((0..levels).map(of));
                sets.len() / levels - 1
            });
            pixels.push((pixel, slot as i32));
        }
    }
    (sets, pixels)
}

/// Sums of blending weights per splat, level and label.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabelWeights {
    /// Per splat its labels with their sums, `Σ_px w`, pixels.
    rows: Vec<Vec<(i32, f32)>>,
}

impl LabelWeights {
    /// Zero sums of `splats` splats.
    pub fn new(splats: usize) -> LabelWeights {
        LabelWeights { rows: vec![Vec::new(); splats] }
    }

    fn add(&mut self, splat: usize, set: &[i32], weight: f32) {
        if weight == 0.0 {
            return;
        }
        let row = &mut self.rows[splat];
        for &label in set.iter().filter(|label| **label >= 0) {
            match row.iter_mut().find(|(known, _)| *known == label) {
                Some((_, sum)) => *sum += weight,
                None => row.push((label, weight)),
            }
        }
    }

    /// The labels of a splat with their sums. Labels of all levels are distinct numbers.
    pub fn of(&self, splat: usize) -> &[(i32, f32)] {
        &self.rows[splat]
    }
}

impl Rasterizer {
    /// Adds the blending weights of the last set view to `sums`, by label. `labels` are
    /// [levels, H·W], −1 for pixels without one. Grows tile lists that are too short.
    pub fn add_label_weights(
        &mut self,
        params: &SplatBuffers,
        options: &RasterOptions,
        labels: &[i32],
        sums: &mut LabelWeights,
    ) -> Result<()> {
        self.check(params)?;
        let mut is_projected = false;
        for index in 0..self.frame().bands.count() {
            let band = self.frame().bands.get(index);
            let labels = self.frame().bands.cut_inner(&band, labels, -1);
            let sets = LabelSets::new(&self.device, self.frame(), &band, &labels)?;
            let mut row = band.inner.start;
            // Strips become narrower where the lists of one do not fit.
            while let Some(tiles) = self.strips(&band, row..band.inner.end).into_iter().next() {
                let mut rec = Recorder::new(&self.device, "tile lists");
                if !is_projected {
                    self.record_projection(&mut rec, params, options);
                }
                self.record_lists(&mut rec, params, &tiles, Lists::Used);
                rec.download(&self.frame().status);
                rec.run()?;
                is_projected = true;
                if let Some(needed) = self.overflow()? {
                    self.grow(needed)?;
                    continue;
                }
                let room = SLOTS * self.frame().lists.capacity;
                let weights = self.device.buffer::<f32>("label weights", room)?;
                for first_slot in sets.dispatches(&tiles) {
                    let mut rec = Recorder::new(&self.device, "label weights");
                    sets.record(&mut rec, self.frame(), &tiles, first_slot, &weights);
                    rec.run()?;
                    sets.add(self.frame(), &tiles, first_slot, &weights, sums)?;
                }
                row = (tiles.rows.end * TILE) as usize;
            }
        }
        Ok(())
    }
}

/// CPU reference, in f64: sums per splat and label of the labels [levels, H·W] of a view.
pub fn reference(scene: &ReferenceScene, labels: &[i32]) -> Vec<BTreeMap<i32, f64>> {
    let [width, height] = scene.view.size;
    let pixels = (width * height) as usize;
    let mut sums = vec![BTreeMap::new(); scene.projected.len()];
    for pixel in 0..pixels {
        let (x, y) = (pixel as u32 % width, pixel as u32 / width);
        for contribution in walk(scene, &Cutoffs::STANDARD, x, y).0 {
            for label in labels[pixel..].iter().step_by(pixels).filter(|label| **label >= 0) {
                let weight = contribution.alpha * contribution.transmittance;
                *sums[contribution.splat].entry(*label).or_insert(0.0) += weight;
            }
        }
    }
    sums
}

impl LabelWeights {
    /// Checks the sums against the reference: the sum of all differences, over that of the weights.
    pub fn difference(&self, expected: &[BTreeMap<i32, f64>]) -> f64 {
        let mut difference = 0.0;
        for (row, expected) in self.rows.iter().zip(expected) {
            for (label, weight) in expected {
                let own = row.iter().find(|(known, _)| known == label).map_or(0.0, |found| found.1);
                difference += (f64::from(own) - weight).abs();
            }
            let extra = row.iter().filter(|(label, _)| !expected.contains_key(label));
            difference += extra.map(|(_, weight)| f64::from(weight.abs())).sum::<f64>();
        }
        difference / expected.iter().flat_map(BTreeMap::values).sum::<f64>().max(f64::MIN_POSITIVE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice};
    use crate::pass::params::Params;
    use crate::pass::reference as render;
    use crate::pass::{FeatureMode, RasterOptions, Rasterizer, SplatBuffers, View};
    use crate::scene::{Camera, Splats, seeded};

    const SIZE: [usize; 2] = [75, 173];

    /// Two levels: stripes of five pixels that are labels 0 to 3, and columns that are 4 to 11 or
    /// none. Tiles show up to six sets.
    fn labels() -> Vec<i32> {
        let [width, height] = SIZE;
        let pixels = (0..width * height).map(|p| (p % width, p / width));
        let stripes = pixels.clone().map(|(x, y)| ((x + y) / 5 % 4) as i32);
        let columns =
            pixels.map(|(x, y)| if x / 3 % 5 == 0 { -1 } else { 4 + ((x / 3 + y / 20) % 8) as i32 });
        stripes.chain(columns).collect()
    }

    /// Sums on a device, and the number of bands.
    fn sums(device: &Device, splats: &Splats, camera: &Camera) -> (LabelWeights, usize) {
        let params = SplatBuffers::upload(device, splats, &[], 0).unwrap();
        let [width, height] = SIZE.map(|n| n as u32);
        let mut raster = Rasterizer::new(device, splats.len(), 0, width, height).unwrap();
        raster.set_view(&View::new(camera, 0.05)).unwrap();
        let mut sums = LabelWeights::new(splats.len());
        raster.add_label_weights(&params, &RasterOptions::default(), &labels(), &mut sums).unwrap();
        (sums, raster.frame().bands.count())
    }

    #[test]
    fn label_weights_match_reference_also_in_bands() {
        let (splats, camera) = seeded::benchmark(900, SIZE[0] as u32, SIZE[1] as u32, 0, 2);
        let view = View::new(&camera, 0.05);
        let params = Params::new(&splats, &[], 0);
        let image = render::forward(&params, &view, FeatureMode::Linear, &Cutoffs::STANDARD);
        let scene = ReferenceScene {
            projected: &image.projected,
            features: &[],
            feature_dim: 0,
            order: &image.order,
            view: &view,
        };
        let expected = reference(&scene, &labels());
        let (whole, bands) = sums(&crate::gpu::test_device(), &splats, &camera);
        assert_eq!(bands, 1);
        // f32 and f64 may disagree at the two thresholds for a pair in ten thousand.
        let difference = whole.difference(&expected);
        assert!(difference < 1e-3, "{difference}");
        let small = Options { max_binding: Some(256 << 10), ..crate::gpu::options(None) };
        let (in_bands, bands) = sums(&TestDevice::open(&small).unwrap(), &splats, &camera);
        let difference = in_bands.difference(&expected);
        assert!(bands > 1 && difference < 1e-3, "{bands} bands: {difference}");
    }
}
