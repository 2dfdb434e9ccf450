//! Evidence for the direction up, and its agreement with a direction.
use super::planes::Surface;
use glam::{DMat2, DVec2, DVec3};

/// σ of an edge's direction from lens and camera, radians (0.3°), beside that of its ends.
const EDGE_FLOOR: f64 = 0.005;
/// Share of upright edges, by length, for full agreement: a table with a few boxes has a tenth.
const ENOUGH_EDGES: f64 = 0.08;
/// Standard deviation of a surface's normal, radians (1.5°).
const SURFACE_SIGMA: f64 = 0.026;
/// Share of the points on level surfaces for full agreement.
const ENOUGH_SURFACE: f64 = 0.2;
/// Standard deviation of the roll of a camera held by hand, radians (4°).
const ROLL_SIGMA: f64 = 0.07;
/// Standard deviation of the pitch of cameras, radians (40°).
const PITCH_SIGMA: f64 = 0.7;
/// Standard deviation of a phone's gravity, radians (1.5°).
const GRAVITY_SIGMA: f64 = 0.026;

/// Plane through an edge and its camera's centre; contains the direction up if the edge is upright.
#[derive(Clone, Copy, Debug)]
pub(super) struct EdgePlane {
    /// Unit normal.
    pub normal: DVec3,
    /// Standard deviation, radians.
    pub sigma: f64,
    /// Share of the edge length in its photo, divided by the number of photos.
    pub weight: f64,
}

/// All evidence, in scene axes.
#[derive(Clone, Debug, Default)]
pub(super) struct Evidence {
    pub edges: Vec<EdgePlane>,
    pub surfaces: Vec<Surface>,
    /// Right and up of every camera.
    pub cameras: Vec<[DVec3; 2]>,
    /// Up by accelerometers.
    pub gravity: Vec<DVec3>,
}

/// Agreement of each kind of evidence with a direction, 0 to 1.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Agreement {
    pub gravity: f64,
    pub edges: f64,
    pub surface: f64,
    pub roll: f64,
}

impl Agreement {
    /// Score of the direction. An accelerometer outweighs inferred evidence, which must agree with
    /// the roll of the cameras, since edges and surfaces of a room have three directions.
    pub fn score(&self) -> f64 {
        3.0 * self.gravity + (0.5 + self.edges + self.surface) * self.roll
    }
}

/// Gaussian of an angle, with a maximum of 1.
fn gaussian(angle: f64, sigma: f64) -> f64 {
    (-0.5 * (angle / sigma).powi(2)).exp()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Angle between a direction and a plane.
fn angle_to_plane(normal: DVec3, v: DVec3) -> f64 {
    normal.dot(v).clamp(-1.0, 1.0).asin().abs()
}

/// Angle between a direction and a line.
fn angle_to_line(line: DVec3, v: DVec3) -> f64 {
    line.cross(v).length().atan2(line.dot(v).abs())
}

impl Evidence {
    /// Agreement with the unit vector `v`; `blur` (radians) adds to every σ.
    pub fn agreement(&self, v: DVec3, blur: f64) -> Agreement {
        let edges: f64 = self
            .edges
            .iter()
            .map(|e| e.weight * gaussian(angle_to_plane(e.normal, v), e.sigma.hypot(EDGE_FLOOR).hypot(blur)))
            .sum();
        let surface_agreement =
            |s: &Surface| s.share * gaussian(angle_to_line(s.normal, v), SURFACE_SIGMA.hypot(blur));
        let roll_agreement = |[right, up]: &[DVec3; 2]| {
            gaussian(angle_to_plane(*right, v), 2.0 * ROLL_SIGMA) * gaussian(up.angle_between(v), PITCH_SIGMA)
        };
        let gravity_agreement = |g: &DVec3| gaussian(g.angle_between(v), GRAVITY_SIGMA.hypot(blur));
        Agreement {
            gravity: mean(&self.gravity.iter().map(gravity_agreement).collect::<Vec<_>>()),
            edges: (edges / ENOUGH_EDGES).min(1.0),
            surface: (self.surfaces.iter().map(surface_agreement).sum::<f64>() / ENOUGH_SURFACE).min(1.0),
            roll: mean(&self.cameras.iter().map(roll_agreement).collect::<Vec<_>>()),
        }
    }
}

/// Share of independent edges: an edge has two sides, and objects in a row lean alike.
const INDEPENDENT_EDGES: f64 = 0.25;
/// σ of the error that all evidence of one kind shares, radians: edges (0.4°), surfaces (0.6°),
/// cameras of one photographer (1.5°), phones (0.6°).
const SHARED_ERRORS: [f64; 4] = [0.007, 0.01, 0.026, 0.01];

/// Quadratic in the plane tangent to the sphere at a direction, in information form.
#[derive(Clone, Copy, Debug, Default)]
struct Quadratic {
    information: DMat2,
    vector: DVec2,
}

impl Quadratic {
    fn add(&mut self, gradient: DVec2, residual: f64, weight: f64) {
        self.information += DMat2::from_cols(gradient * gradient.x, gradient * gradient.y) * weight;
        self.vector -= gradient * (weight * residual);
    }

    /// Adds an error that all evidence shares.
    fn with_shared_error(self, floor: f64) -> Quadratic {
        let shrink = (DMat2::IDENTITY + self.information * (floor * floor)).inverse();
        Quadratic { information: shrink * self.information, vector: shrink * self.vector }
    }
}

/// Refined direction, and its standard deviation about the least certain axis, radians.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    pub direction: DVec3,
    pub sigma: f64,
}

impl Evidence {
    /// One step of iteratively re-weighted least squares from the unit vector `v`; `blur` (radians)
    /// widens the weights.
    pub fn refined(&self, v: DVec3, blur: f64) -> Refined {
        let (x, y) = v.any_orthonormal_pair();
        let tangent = |n: DVec3| DVec2::new(n.dot(x), n.dot(y));
        let mut kinds = [Quadratic::default(); 4];
        let [edges, surfaces, rolls, gravity] = &mut kinds;
        for e in &self.edges {
            let sigma = e.sigma.hypot(EDGE_FLOOR);
            let weight = gaussian(angle_to_plane(e.normal, v), sigma.hypot(blur)) * INDEPENDENT_EDGES
                / (sigma * sigma);
            edges.add(tangent(e.normal), e.normal.dot(v), weight);
        }
        let add_line = |kind: &mut Quadratic, line: DVec3, sigma: f64, share: f64| {
            let weight = share * gaussian(angle_to_line(line, v), sigma.hypot(blur)) / (sigma * sigma);
            let to = tangent(line * line.dot(v).signum());
            kind.add(DVec2::X, -to.x, weight);
            kind.add(DVec2::Y, -to.y, weight);
        };
        for s in &self.surfaces {
            add_line(surfaces, s.normal, SURFACE_SIGMA, (s.share / ENOUGH_SURFACE).min(1.0));
        }
        self.gravity.iter().for_each(|g| add_line(gravity, *g, GRAVITY_SIGMA, 1.0));
        for [right, up] in &self.cameras {
            let weight = gaussian(angle_to_plane(*right, v), 2.0 * ROLL_SIGMA) / (ROLL_SIGMA * ROLL_SIGMA);
            if up.dot(v) > 0.0 {
                rolls.add(tangent(*right), right.dot(v), weight);
            }
        }
        let mut all = Quadratic::default();
        for (kind, floor) in kinds.into_iter().zip(SHARED_ERRORS) {
            let kind = kind.with_shared_error(floor);
            all.information += kind.information;
            all.vector += kind.vector;
        }
        let [a, b, c] = [all.information.x_axis.x, all.information.x_axis.y, all.information.y_axis.y];
        let least = 0.5 * (a + c) - (0.5 * (a - c)).hypot(b);
        if least < 1.0 {
            // With σ above a radian the direction is unknown.
            return Refined { direction: v, sigma: 1.0 };
        }
        let step = (all.information.inverse() * all.vector).clamp_length_max(0.1);
        Refined { direction: (v + x * step.x + y * step.y).normalize(), sigma: least.sqrt().recip() }
    }
}
