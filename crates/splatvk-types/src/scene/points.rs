//! Coloured points, as geometry initialisers produce them.
use serde::{Deserialize, Serialize};

/// Structure of arrays; all vectors have the same length N.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct PointCloud {
    /// [N, 3] world units, OpenCV axes.
    pub positions: Vec<[f32; 3]>,
    /// [N, 3] RGB in [0, 1].
    pub colours: Vec<[f32; 3]>,
    /// [N] confidence > 0.
    pub confidence: Vec<f32>,
    /// [N] index of the view of each point.
    pub view: Vec<u32>,
    /// [N] footprint of one pixel at the point's depth, `z / f`, world units.
    pub radius: Vec<f32>,
    /// [N, 3] unit normal of the surface, world axes, of either sign; zero where it is not known,
    /// and empty where none is.
    #[serde(default)]
    pub normals: Vec<[f32; 3]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }
    /// Points of the given rows, in their order.
    pub fn picked(&self, rows: &[usize]) -> PointCloud {
        fn rows_of<T: Copy>(all: &[T], rows: &[usize]) -> Vec<T> {
            rows.iter().map(|i| all[*i]).collect()
        }
        PointCloud {
            positions: rows_of(&self.positions, rows),
            colours: rows_of(&self.colours, rows),
            confidence: rows_of(&self.confidence, rows),
            view: rows_of(&self.view, rows),
            radius: rows_of(&self.radius, rows),
            normals: if self.normals.is_empty() { Vec::new() } else { rows_of(&self.normals, rows) },
        }
    }
    /// Appends the points of another cloud.
    pub fn append(&mut self, mut other: PointCloud) {
        if !self.normals.is_empty() || !other.normals.is_empty() {
            self.normals.resize(self.len(), [0.0; 3]);
            other.normals.resize(other.len(), [0.0; 3]);
            self.normals.append(&mut other.normals);
        }
        self.positions.append(&mut other.positions);
        self.colours.append(&mut other.colours);
        self.confidence.append(&mut other.confidence);
        self.view.append(&mut other.view);
        self.radius.append(&mut other.radius);
    }
    /// True without points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}
