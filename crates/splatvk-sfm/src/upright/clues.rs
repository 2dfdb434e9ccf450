//! What tells which way is up, and how well a direction agrees with it.
use super::planes::Surface;
use glam::{DMat2, DVec2, DVec3};

/// Standard deviation of an edge's direction beside that of its ends, radians: lens and camera are
/// not quite right (0.3°).
const EDGE_FLOOR: f64 = 0.005;
/// Share of the edges' length that is as good as all of it: a table with a few boxes has a tenth of
/// it upright.
const ENOUGH_EDGES: f64 = 0.08;
/// Standard deviation of a surface's normal, radians (1.5°).
const SURFACE_SIGMA: f64 = 0.026;
/// Share of the points that is as good as all of them.
const ENOUGH_SURFACE: f64 = 0.2;
/// Standard deviation of the roll of a camera held by hand, radians (4°).
const ROLL_SIGMA: f64 = 0.07;
/// Standard deviation of how far cameras look up or down, radians (40°).
const PITCH_SIGMA: f64 = 0.7;
/// Standard deviation of a phone's gravity, radians (1.5°).
const GRAVITY_SIGMA: f64 = 0.026;

/// An edge and the centre of its camera span a plane that an upright edge shares with the direction
/// up.
#[derive(Clone, Copy, Debug)]
pub(super) struct EdgePlane {
    /// Unit.
    pub normal: DVec3,
    /// Standard deviation, radians.
    pub sigma: f64,
    /// Share of the length of its photo's edges, over the number of photos.
    pub weight: f64,
}

/// Everything that is known, in scene axes.
#[derive(Clone, Debug, Default)]
pub(super) struct Clues {
    pub edges: Vec<EdgePlane>,
    pub surfaces: Vec<Surface>,
    /// Right and up of every camera.
    pub cameras: Vec<[DVec3; 2]>,
    /// Up as phones measured it.
    pub gravity: Vec<DVec3>,
}

/// How much of each kind of evidence agrees with a direction, 0 to 1.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Agreement {
    pub gravity: f64,
    pub edges: f64,
    pub surface: f64,
    pub roll: f64,
}

impl Agreement {
    /// To compare directions by. A phone's own measurement outweighs all that is inferred; what is
    /// inferred must agree with how cameras are held, since edges and surfaces have three
    /// directions in a room.
    pub fn total(&self) -> f64 {
        3.0 * self.gravity + (0.5 + self.edges + self.surface) * self.roll
    }
}

/// 1 where an angle is 0, next to nothing beyond three standard deviations.
fn near(angle: f64, sigma: f64) -> f64 {
    (-0.5 * (angle / sigma).powi(2)).exp()
}

/// Angle between a direction and a plane.
fn off_plane(normal: DVec3, v: DVec3) -> f64 {
    normal.dot(v).clamp(-1.0, 1.0).asin().abs()
}

/// Angle between a direction and a line.
fn off_line(line: DVec3, v: DVec3) -> f64 {
    line.cross(v).length().atan2(line.dot(v).abs())
}

impl Clues {
    /// Agreement with the unit vector `v`, `blur` radians coarse.
    pub fn agreement(&self, v: DVec3, blur: f64) -> Agreement {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
        let edges: f64 = self
            .edges
            .iter()
            .map(|e| e.weight * near(off_plane(e.normal, v), e.sigma.hypot(EDGE_FLOOR).hypot(blur)))
            .sum();
        let level = |s: &Surface| s.share * near(off_line(s.normal, v), SURFACE_SIGMA.hypot(blur));
        let held = |[right, up]: &[DVec3; 2]| {
            near(off_plane(*right, v), 2.0 * ROLL_SIGMA) * near(up.angle_between(v), PITCH_SIGMA)
        };
        let measured = |g: &DVec3| near(g.angle_between(v), GRAVITY_SIGMA.hypot(blur));
        Agreement {
            gravity: mean(&self.gravity.iter().map(measured).collect::<Vec<_>>()),
            edges: (edges / ENOUGH_EDGES).min(1.0),
            surface: (self.surfaces.iter().map(level).sum::<f64>() / ENOUGH_SURFACE).min(1.0),
            roll: mean(&self.cameras.iter().map(held).collect::<Vec<_>>()),
        }
    }
}

/// Share of the edges that count as independent: an edge has two sides, and what stands in a row
/// leans in a row.
const INDEPENDENT_EDGES: f64 = 0.25;
/// What all evidence of one kind may be off by together, radians: edges (0.4°), surfaces (0.6°),
/// cameras of one photographer (1.5°), phones (0.6°).
const FLOORS: [f64; 4] = [0.007, 0.01, 0.026, 0.01];

/// A quadratic in the plane tangent to the sphere at a direction: information, and information
/// times the way to its optimum.
#[derive(Clone, Copy, Debug, Default)]
struct Quadratic {
    information: DMat2,
    pull: DVec2,
}

impl Quadratic {
    fn add(&mut self, gradient: DVec2, residual: f64, weight: f64) {
        self.information += DMat2::from_cols(gradient * gradient.x, gradient * gradient.y) * weight;
        self.pull -= gradient * (weight * residual);
    }

    /// With an error that all of it shares.
    fn with_floor(self, floor: f64) -> Quadratic {
        let shrink = (DMat2::IDENTITY + self.information * (floor * floor)).inverse();
        Quadratic { information: shrink * self.information, pull: shrink * self.pull }
    }
}

/// A direction near another that agrees better, and its standard deviation about the least certain
/// axis, radians.
#[derive(Clone, Copy, Debug)]
pub(super) struct Refined {
    pub direction: DVec3,
    pub sigma: f64,
}

impl Clues {
    /// One step of iteratively re-weighted least squares from the unit vector `v`, with weights
    /// `blur` radians coarse.
    pub fn refined(&self, v: DVec3, blur: f64) -> Refined {
        let (x, y) = v.any_orthonormal_pair();
        let tangent = |n: DVec3| DVec2::new(n.dot(x), n.dot(y));
        let mut kinds = [Quadratic::default(); 4];
        let [edges, surfaces, rolls, gravity] = &mut kinds;
        for e in &self.edges {
            let sigma = e.sigma.hypot(EDGE_FLOOR);
            let weight =
                near(off_plane(e.normal, v), sigma.hypot(blur)) * INDEPENDENT_EDGES / (sigma * sigma);
            edges.add(tangent(e.normal), e.normal.dot(v), weight);
        }
        let line = |kind: &mut Quadratic, line: DVec3, sigma: f64, share: f64| {
            let weight = share * near(off_line(line, v), sigma.hypot(blur)) / (sigma * sigma);
            let to = tangent(line * line.dot(v).signum());
            kind.add(DVec2::X, -to.x, weight);
            kind.add(DVec2::Y, -to.y, weight);
        };
        for s in &self.surfaces {
            line(surfaces, s.normal, SURFACE_SIGMA, (s.share / ENOUGH_SURFACE).min(1.0));
        }
        self.gravity.iter().for_each(|g| line(gravity, *g, GRAVITY_SIGMA, 1.0));
        for [right, up] in &self.cameras {
            let weight = near(off_plane(*right, v), 2.0 * ROLL_SIGMA) / (ROLL_SIGMA * ROLL_SIGMA);
            if up.dot(v) > 0.0 {
                rolls.add(tangent(*right), right.dot(v), weight);
            }
        }
        let mut all = Quadratic::default();
        for (kind, floor) in kinds.into_iter().zip(FLOORS) {
            let kind = kind.with_floor(floor);
            all.information += kind.information;
            all.pull += kind.pull;
        }
        let [a, b, c] = [all.information.x_axis.x, all.information.x_axis.y, all.information.y_axis.y];
        let least = 0.5 * (a + c) - (0.5 * (a - c)).hypot(b);
        if least < 1.0 {
            // Beyond a radian a direction is not known at all.
            return Refined { direction: v, sigma: 1.0 };
        }
        let step = (all.information.inverse() * all.pull).clamp_length_max(0.1);
        Refined { direction: (v + x * step.x + y * step.y).normalize(), sigma: least.sqrt().recip() }
    }
}
