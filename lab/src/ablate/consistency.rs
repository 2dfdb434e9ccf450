//! Agreement of the codes of different photos on the same point, by true depth: needs no labels.
use crate::Result;
use glam::DVec2;
use serde::{Deserialize, Serialize};
use splatvk::eval::{GroundTruth, TruthFrame};
use splatvk::math::dot_f32;
use splatvk::scene::{Camera, Codebook, Image};

/// Relative difference of true depths within which two frames show one point.
const SAME_POINT: f64 = 0.02;

/// Agreement over all pairs of frames and the pixels that show the same point in both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Consistency {
    /// Pixels with a code in both frames.
    pub pixels: u64,
    /// Share of them with the same code.
    pub equal: f64,
    /// Mean cosine of the embeddings of their codes.
    pub cosine: f64,
}

/// A frame of the ground truth with its true depth.
struct DeepFrame<'t> {
    camera: &'t Camera,
    depth: Image<f32>,
}

/// Image position of a pixel of one size in an image of another size.
fn scaled(position: DVec2, camera: &Camera, size: (usize, usize)) -> Option<(usize, usize)> {
    let along = |at: f64, from: u32, to: usize| {
        let index = (at / f64::from(from) * to as f64).floor();
        (index >= 0.0 && index < to as f64).then_some(index as usize)
    };
    Some((along(position.x, camera.width, size.0)?, along(position.y, camera.height, size.1)?))
}

fn depth_at(frame: &DeepFrame, position: DVec2) -> Option<f64> {
    let (x, y) = scaled(position, frame.camera, (frame.depth.width, frame.depth.height))?;
    let depth = f64::from(frame.depth.at(x, y));
    (depth > 0.0).then_some(depth)
}

impl Consistency {
    /// Compares the code maps of frames; those without depth are left out. `None` if no two frames
    /// show the same point.
    pub fn of_frames<'t>(
        truth: &GroundTruth,
        maps: impl Iterator<Item = (&'t TruthFrame, &'t Image<i32>)>,
        book: &Codebook,
    ) -> Result<Option<Consistency>> {
        let mut frames = Vec::new();
        for (frame, codes) in maps {
            if let Some(depth) = truth.depth(frame)? {
                frames.push((DeepFrame { camera: &frame.camera, depth }, codes));
            }
        }
        Ok(Consistency::of(&frames, book))
    }

    fn of(frames: &[(DeepFrame, &Image<i32>)], book: &Codebook) -> Option<Consistency> {
        let row = |code: usize| &book.embeddings[code * book.embedding_dim..][..book.embedding_dim];
        let (mut pixels, mut equal, mut cosine) = (0u64, 0u64, 0.0f64);
        for (i, (from, codes)) in frames.iter().enumerate() {
            for (to, others) in frames.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, f)| (&f.0, f.1)) {
                for p in 0..codes.data.len() {
                    let at = DVec2::new((p % codes.width) as f64 + 0.5, (p / codes.width) as f64 + 0.5);
                    let size = DVec2::new(f64::from(from.camera.width), f64::from(from.camera.height));
                    let at = at * size / DVec2::new(codes.width as f64, codes.height as f64);
                    let own = usize::try_from(codes.data[p]).ok();
                    let other = || {
                        let (there, z) = to.camera.project(from.camera.unproject(at, depth_at(from, at)?));
                        let shown = z > 0.0 && (depth_at(to, there)? / z - 1.0).abs() < SAME_POINT;
                        let (x, y) = scaled(there, to.camera, (others.width, others.height))?;
                        usize::try_from(others.at(x, y)).ok().filter(|_| shown)
                    };
                    let Some((own, other)) = own.and_then(|own| Some((own, other()?))) else { continue };
                    pixels += 1;
                    equal += u64::from(own == other);
                    cosine += f64::from(dot_f32(row(own), row(other)));
                }
            }
        }
        let n = pixels as f64;
        (pixels > 0).then(|| Consistency { pixels, equal: equal as f64 / n, cosine: cosine / n })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::scene::{Pose, seeded};

    #[test]
    fn codes_of_the_same_point_are_compared() {
        // Two cameras a pixel apart before a wall, at the depth of the focal length in pixels.
        let camera = |x: f64| {
            let pose = Pose { translation: glam::DVec3::new(-x, 0.0, 0.0), ..Pose::IDENTITY };
            seeded::camera(8, 8, pose)
        };
        let (left, right) = (camera(0.0), camera(1.0));
        let frame = |camera| DeepFrame { camera, depth: Image::filled(8, 8, 7.2) };
        let book = Codebook {
            embedding_dim: 2,
            code_dim: 2,
            embeddings: vec![1.0, 0.0, 0.0, 1.0],
            codes: vec![1.0, 0.0, 0.0, 1.0],
            ..Codebook::default()
        };
        let columns = |first: i32, border: usize| Image {
            width: 8,
            height: 8,
            data: (0..64).map(|p| if p % 8 < border { first } else { 1 - first }).collect(),
        };
        // The right camera sees the border of the codes a column farther left.
        let (here, there, wrong) = (columns(0, 4), columns(0, 3), columns(1, 3));
        let of = |other| Consistency::of(&[(frame(&left), &here), (frame(&right), other)], &book).unwrap();
        let right = of(&there);
        assert_eq!((right.pixels, right.equal, right.cosine), (2 * 7 * 8, 1.0, 1.0));
        assert_eq!((of(&wrong).equal, of(&wrong).cosine), (0.0, 0.0));
        let unshifted = of(&here).equal;
        assert!((unshifted - 6.0 / 7.0).abs() < 1e-9, "{unshifted}");
    }
}
