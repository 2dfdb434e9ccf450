//! Sizes of things against those of true objects, as photos show them.
use glam::{DVec2, DVec3};
use serde_json::{Value, json};
use splatvk::scene::{Camera, Image};
use std::collections::BTreeMap;

/// IoU over all photos from which a thing is an object.
const MATCH: f64 = 0.5;

/// A photo with its true camera, object (0 = none) and depth (camera z, 0 = unknown) of every
/// pixel.
pub struct TruePhoto {
    /// Camera in the true world.
    pub camera: Camera,
    /// [H, W] object.
    pub objects: Image<u32>,
    /// [H, W] depth.
    pub depth: Image<f32>,
}

/// Size of an object along the axes of the true world, in its units.
#[derive(Clone, Debug, PartialEq)]
pub struct Size {
    /// Name of the object.
    pub name: String,
    /// Size of the thing.
    pub found: DVec3,
    /// Size of the surface that the photos show.
    pub known: DVec3,
}

impl Size {
    /// Relative errors of the three.
    pub fn errors(&self) -> DVec3 {
        self.found / self.known - 1.0
    }

    /// The size for programs.
    pub fn json(&self) -> Value {
        json!({ "name": self.name, "found": self.found.to_array(), "truth": self.known.to_array() })
    }
}

/// Per object the size of the surface that photos show.
pub fn extents(photos: &[TruePhoto]) -> BTreeMap<u32, DVec3> {
    let mut boxes: BTreeMap<u32, (DVec3, DVec3)> = BTreeMap::new();
    for photo in photos {
        let shown = photo.objects.data.iter().zip(&photo.depth.data).enumerate();
        for (i, (object, depth)) in shown.filter(|(_, (object, depth))| **object > 0 && **depth > 0.0) {
            let (x, y) = (i % photo.depth.width, i / photo.depth.width);
            let point = photo.camera.unproject(DVec2::new(x as f64, y as f64) + 0.5, f64::from(*depth));
            let (low, high) = boxes.entry(*object).or_insert((point, point));
            (*low, *high) = (low.min(point), high.max(point));
        }
    }
    boxes.into_iter().map(|(object, (low, high))| (object, high - low)).collect()
}

/// Per thing the object that it is, from the thing and the object of every pixel of all photos.
pub fn matches<'a>(photos: impl Iterator<Item = (&'a Image<u32>, &'a Image<u32>)>) -> BTreeMap<u32, u32> {
    let (mut found, mut known, mut both) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    for (things, objects) in photos {
        for pixel in things.data.iter().copied().zip(objects.data.iter().copied()) {
            *found.entry(pixel.0).or_insert(0usize) += 1;
            *known.entry(pixel.1).or_insert(0usize) += 1;
            *both.entry(pixel).or_insert(0usize) += 1;
        }
    }
    let is_match = |((thing, object), common): &((u32, u32), usize)| {
        let union = found[thing] + known[object] - common;
        *thing > 0 && *object > 0 && *common as f64 > MATCH * union as f64
    };
    both.into_iter().filter(is_match).map(|(pair, _)| pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::scene::Pose;

    fn image<T>(data: Vec<T>) -> Image<T> {
        Image { width: 4, height: data.len() / 4, data }
    }

    #[test]
    fn size_is_that_of_the_shown_surface() {
        let camera = Camera {
            name: String::new(),
            width: 4,
            height: 2,
            fx: 2.0,
            fy: 2.0,
            cx: 2.0,
            cy: 1.0,
            pose: Pose::IDENTITY,
        };
        // Pixels are half a unit apart at depth 1 and a unit at depth 2.
        let photo = TruePhoto {
            camera,
            objects: image(vec![0, 1, 1, 0, 0, 1, 1, 2]),
            depth: image(vec![1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 0.0]),
        };
        let sizes = extents(&[photo]);
        assert_eq!(sizes.len(), 1);
        assert!((sizes[&1] - DVec3::new(1.0, 0.75, 1.0)).length() < 1e-9, "{sizes:?}");
        let size = Size { name: "cup".into(), found: DVec3::new(1.1, 0.6, 1.0), known: sizes[&1] };
        assert!((size.errors() - DVec3::new(0.1, -0.2, 0.0)).length() < 1e-9);
    }

    #[test]
    fn thing_is_the_object_that_it_covers_by_more_than_half() {
        let things = [image(vec![7, 7, 7, 0]), image(vec![8, 8, 7, 0])];
        let objects = [image(vec![1, 1, 1, 1]), image(vec![2, 2, 2, 2])];
        // 7 is three of the five pixels of the union with 1, 8 two of four of that with 2.
        assert_eq!(matches(things.iter().zip(&objects)), BTreeMap::from([(7, 1)]));
    }
}
