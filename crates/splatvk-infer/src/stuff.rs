//! Names of surfaces that the geometry of a scene shows and ImageNet has no class for: "wall",
//! "floor", "sky" (docs/internals/method.md#stuff).
use super::classify::CLASSES;

/// Number of kinds.
pub const COUNT: usize = 8;

/// A kind of surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Stuff {
    /// Upright plane.
    Wall,
    /// Level plane below everything else.
    Floor,
    /// Level plane above the cameras.
    Ceiling,
    /// Level plane between the two.
    Top,
    /// Bright or blue, without depth or beyond everything else.
    Sky,
    /// Rough and green, upright.
    Plants,
    /// Rough and green, level.
    Grass,
    /// Inclined plane above the cameras.
    Roof,
}

/// Names of the kinds in the order of [`Stuff`], the first one for display.
const NAMES: [&str; COUNT] = [
    "wall|facade|partition|brick wall|stone wall|house wall",
    "floor|ground|carpet|rug|pavement|road|street|path|driveway|cobblestone|paving|paving stone|parquet|asphalt|courtyard|\
     floorboard|terrace|patio|sidewalk|lawn|soil",
    "ceiling",
    "table|desk|countertop|worktop|tabletop|counter|table top|kitchen counter|dining table|work surface|coffee table",
    "sky|cloud",
    "tree|bush|shrub|leaf|foliage|hedge|ivy|forest|plant|climbing plant|vegetation|greenery",
    "grass|lawn|meadow|turf",
    "roof|rooftop|tiled roof|tile roof",
];

/// Class numbers of a name, behind those of ImageNet.
pub fn classes_of(name: &str) -> impl Iterator<Item = usize> {
    let kinds = NAMES.iter().enumerate();
    let named = kinds.filter(move |(_, names)| names.split('|').any(|n| n == name));
    named.map(|(kind, _)| CLASSES + kind)
}

/// Whether a name is that of a kind, with or without a colour before it.
pub fn is_name(text: &str) -> bool {
    names().any(|name| text == name || text.ends_with(&format!(" {name}")))
}

/// Name of each kind.
pub fn names() -> impl Iterator<Item = &'static str> {
    NAMES.iter().map(|names| names.split('|').next().unwrap_or_default())
}

/// Shape and colour of a region of a photo.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Surface {
    /// Share of the photo.
    pub share: f32,
    /// Share of its pixels that show the sky.
    pub sky: f32,
    /// Share of its pixels with depth, the sky's included.
    pub known: f32,
    /// Cosine of its mean normal to the direction up: 1 = level and seen from above.
    pub level: f32,
    /// Length of the mean of its unit normals: 1 = plane.
    pub flat: f32,
    /// Mean height: 0 = the lowest level surface of the scene, 1 = the cameras. `None` without a
    /// level surface.
    pub height: Option<f32>,
    /// Share of the points around it that lie behind its plane: none behind a wall.
    pub behind: f32,
    /// Share of its pixels in which green exceeds red and blue.
    pub green: f32,
    /// Whether the scene has level surfaces at several heights.
    pub storeys: bool,
}

/// Share of a photo from which a surface is rather wall or floor than a part of a thing.
const HALF_SHARE: f32 = 0.01;

/// Soft step: 0.1 at `from`, 0.9 at `to`; falling if `to` is smaller.
fn step(value: f32, from: f32, to: f32) -> f32 {
    let middle = 0.5 * (from + to);
    1.0 / (1.0 + (-4.4 * (value - middle) / (to - from)).exp())
}

/// Probability of each kind for a surface; they sum to at most 1.
pub fn probabilities(s: &Surface) -> [f32; COUNT] {
    let flat = step(s.flat, 0.7, 0.9);
    let seen = step(s.known - s.sky, 0.2, 0.5);
    let large = s.share / (s.share + HALF_SHARE);
    let upright = step(s.level.abs(), 0.5, 0.25);
    let level = step(s.level, 0.6, 0.85);
    let height = s.height.unwrap_or(0.0);
    let low = step(height, 0.3, 0.1);
    let below_cameras = step(height, 1.1, 0.8);
    let green = step(s.green, 0.3, 0.6);
    let rough = step(s.flat, 0.75, 0.55);
    let last = step(s.behind, 0.35, 0.15);
    // With a single height, and nothing below, a level surface may be a floor or the top of a table.
    let (floor, top) = match s.storeys {
        true => (low, (1.0 - low) * below_cameras),
        false => (0.5 * last, 1.0 - 0.5 * last),
    };
    let mut all = [0.0; COUNT];
    all[Stuff::Wall as usize] = step(s.flat, 0.85, 0.95) * upright * last * large;
    all[Stuff::Floor as usize] = step(s.flat, 0.5, 0.8) * level * floor * large * (1.0 - green);
    all[Stuff::Ceiling as usize] = flat * step(s.level, -0.6, -0.85) * step(height, 0.9, 1.2) * large;
    all[Stuff::Top as usize] = flat * level * top * large;
    all[Stuff::Plants as usize] = green * rough * (1.0 - level) * large;
    all[Stuff::Grass as usize] = green * level * low.max(0.5) * large;
    all[Stuff::Roof as usize] =
        flat * step(s.level, 0.2, 0.4) * step(s.level, 0.95, 0.8) * step(height, 0.9, 1.2) * large;
    all.iter_mut().for_each(|p| *p *= seen);
    all[Stuff::Sky as usize] = step(s.sky, 0.3, 0.7) * (1.0 - green);
    let total: f32 = all.iter().sum();
    if total > 1.0 { all.map(|p| p / total) } else { all }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_name_plain_surfaces() {
        let base = Surface { share: 0.2, known: 1.0, flat: 0.97, storeys: true, ..Surface::default() };
        let best = |s: Surface| {
            let all = probabilities(&s);
            assert!(all.iter().sum::<f32>() <= 1.001, "{all:?}");
            let (kind, p) = all.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap();
            (kind, *p > 0.5)
        };
        for (surface, kind) in [
            (Surface { level: 0.02, height: Some(0.8), ..base }, Stuff::Wall),
            (Surface { level: 0.99, height: Some(0.02), ..base }, Stuff::Floor),
            (Surface { level: 0.99, height: Some(0.5), ..base }, Stuff::Top),
            (Surface { level: -0.99, height: Some(1.6), ..base }, Stuff::Ceiling),
            (Surface { sky: 0.95, level: -0.3, ..base }, Stuff::Sky),
            (Surface { level: 0.1, flat: 0.5, green: 0.7, height: Some(1.0), ..base }, Stuff::Plants),
            (Surface { level: 0.9, flat: 0.8, green: 0.8, height: Some(0.0), ..base }, Stuff::Grass),
            (Surface { level: 0.6, height: Some(1.8), ..base }, Stuff::Roof),
        ] {
            assert_eq!(best(surface), (kind as usize, true), "{surface:?}");
        }
        // A speck, and a region without depth.
        for unknown in
            [Surface { share: 0.0005, level: 0.0, ..base }, Surface { known: 0.0, flat: 0.0, ..base }]
        {
            assert!(!best(unknown).1, "{unknown:?}");
        }
    }
}
