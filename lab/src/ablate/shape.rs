//! Shape of splats: needles, and growth in the language stage.
use serde::{Deserialize, Serialize};
use splatvk::scene::{Camera, DepthMap, Splats};

/// Ratio of the longest to the second axis from which a splat is a needle.
const NEEDLE: f32 = 10.0;
/// Tolerance of depth, relative, within which a photo shows the centre of a splat.
const SHOWN: f64 = 0.05;

/// Shape of the splats after the language stage, beside that after the colour stage; means over the
/// models of the levels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Shape {
    /// Share of the splats whose longest axis has at least ten times the length of the second.
    pub needles: f64,
    /// Geometric mean of the growth of the longest axis, over splats that a photo shows. `None`:
    /// the models have other splats, or a photo shows none.
    pub growth: Option<f64>,
    /// Growth of the splats that no photo shows.
    pub growth_unseen: Option<f64>,
}

impl Shape {
    /// Compares `models`, those of the levels or that of all, with the splats `before`, which the
    /// photos of `views` show.
    pub fn of(before: &Splats, models: &[&Splats], views: &[(&Camera, &DepthMap)]) -> Shape {
        let shown: Vec<bool> = before.means.iter().map(|m| views.iter().any(|v| is_shown(*m, *v))).collect();
        let growth = |wanted: bool| {
            let pairs = models.iter().filter(|m| m.len() == before.len()).flat_map(|m| {
                let axes = m.log_scales.iter().zip(&before.log_scales).zip(&shown);
                axes.filter(|(_, shown)| **shown == wanted)
                    .map(|((a, b), _)| f64::from(longest(a) - longest(b)))
            });
            let (sum, n) = pairs.fold((0.0, 0usize), |(sum, n), log| (sum + log, n + 1));
            (n > 0).then(|| (sum / n as f64).exp())
        };
        let needles = models.iter().flat_map(|m| &m.log_scales).filter(|s| is_needle(s)).count();
        let splats: usize = models.iter().map(|m| m.len()).sum();
        Shape {
            needles: needles as f64 / splats.max(1) as f64,
            growth: growth(true),
            growth_unseen: growth(false),
        }
    }
}

fn longest(log_scales: &[f32; 3]) -> f32 {
    log_scales.iter().copied().fold(f32::MIN, f32::max)
}

fn is_needle(log_scales: &[f32; 3]) -> bool {
    let mut sorted = *log_scales;
    sorted.sort_unstable_by(f32::total_cmp);
    sorted[2] - sorted[1] >= NEEDLE.ln()
}

/// Whether a photo shows a point: in front of its surface, or behind it within the tolerance.
fn is_shown(point: [f32; 3], (camera, depth): (&Camera, &DepthMap)) -> bool {
    let (pixel, z) = camera.project(glam::Vec3::from(point).as_dvec3());
    let (x, y) = (pixel.x.floor(), pixel.y.floor());
    let (width, height) = (depth.depth.width, depth.depth.height);
    if z <= 0.0 || x < 0.0 || y < 0.0 || x >= width as f64 || y >= height as f64 {
        return false;
    }
    let surface = f64::from(depth.depth.at(x as usize, y as usize));
    surface > 0.0 && z <= surface * (1.0 + SHOWN)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::scene::{Image, Pose, seeded};

    fn splats(log_scales: [[f32; 3]; 2]) -> Splats {
        let mut out = Splats::with_capacity(2, 0);
        for (z, scale) in [2.0, 6.0].into_iter().zip(log_scales) {
            out.means.push([0.0, 0.0, z]);
            out.log_scales.push(scale);
            out.quats.push([1.0, 0.0, 0.0, 0.0]);
            out.opacity_logits.push(0.0);
            out.sh.extend([0.0; 3]);
        }
        out
    }

    #[test]
    fn growth_is_that_of_hidden_splats_and_needles_are_long_along_one_axis() {
        let camera = seeded::camera(8, 8, Pose::IDENTITY);
        let depth = Image::filled(8, 8, 2.0);
        let confidence = Image::filled(8, 8, 1.0);
        let before = splats([[-3.0, -3.0, -6.0]; 2]);
        // The hidden splat doubles along one axis of one of two models; there it is also a needle.
        let after = splats([[-3.0, -3.0, -6.0], [-3.0 + 2f32.ln(), -6.0, -6.0]]);
        let views = [(&camera, &DepthMap { depth, confidence })];
        let shape = Shape::of(&before, &[&before, &after], &views);
        assert_eq!((shape.needles, shape.growth), (0.25, Some(1.0)));
        assert!((shape.growth_unseen.unwrap() - 2f64.sqrt()).abs() < 1e-6, "{shape:?}");
    }
}
