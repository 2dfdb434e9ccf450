//! Orientation and scale of a scene's coordinates in the world: the direction up, and metres per
//! unit.
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// Evidence for the direction up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum UpEvidence {
    /// Gravity as the phone measured it (EXIF).
    Accelerometer,
    /// Edges of the photos that are upright in the scene.
    VerticalEdges,
    /// A horizontal surface: a table, a floor, the ground.
    LevelSurface,
    /// Cameras are held without much roll.
    CameraRoll,
}

impl UpEvidence {
    /// Name in messages and reports.
    pub fn text(self) -> &'static str {
        match self {
            UpEvidence::Accelerometer => "accelerometer",
            UpEvidence::VerticalEdges => "vertical edges",
            UpEvidence::LevelSurface => "level surface",
            UpEvidence::CameraRoll => "how the cameras were held",
        }
    }
}

/// The direction against gravity.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Up {
    /// Unit vector, scene axes.
    pub direction: DVec3,
    /// One standard deviation about the least certain axis, degrees.
    pub sigma_degrees: f64,
    /// The evidence that supports the direction.
    pub evidence: Vec<UpEvidence>,
}

/// Length of the scene's unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// Metres.
    pub metres_per_unit: f64,
    /// One standard deviation of its logarithm.
    pub log_sigma: f64,
    /// The stated lengths, as the user wrote them.
    pub stated: Vec<String>,
}

/// Direction up and scale of a scene, where known. The scene keeps its own coordinates.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct World {
    /// `None` where the evidence is not sufficient.
    #[serde(default)]
    pub up: Option<Up>,
    /// `None` until a length is stated.
    #[serde(default)]
    pub scale: Option<Scale>,
}

/// The axis that points up in coordinates outside the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UpAxis {
    /// −y: right, down, forward, as in cameras and files of Gaussians.
    MinusY,
    /// +y: right, up, back, as in glTF.
    PlusY,
    /// +z: right, forward, up, as in maps and nerfstudio.
    PlusZ,
}

impl UpAxis {
    /// Rotation from right, down, forward.
    fn turn(self) -> DMat3 {
        match self {
            UpAxis::MinusY => DMat3::IDENTITY,
            UpAxis::PlusY => DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)),
            UpAxis::PlusZ => DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y),
        }
    }
}

impl Up {
    /// Rotation from scene axes to axes with `axis` up; the smallest one beyond the change of axes,
    /// so that forward stays forward.
    pub fn levelled(&self, axis: UpAxis) -> DMat3 {
        axis.turn()
            * DMat3::from_quat(DQuat::from_rotation_arc(
                self.direction.normalize_or(DVec3::NEG_Y),
                DVec3::NEG_Y,
            ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levelled_up_keeps_forward() {
        let direction = DVec3::new(0.1, -0.9, -0.3).normalize();
        let up = Up { direction, sigma_degrees: 1.0, evidence: Vec::new() };
        for (axis, to, ahead) in [
            (UpAxis::MinusY, DVec3::NEG_Y, DVec3::Z),
            (UpAxis::PlusY, DVec3::Y, DVec3::NEG_Z),
            (UpAxis::PlusZ, DVec3::Z, DVec3::Y),
        ] {
            let turn = up.levelled(axis);
            assert!((turn * direction - to).length() < 1e-12, "{axis:?}");
            assert!((turn.determinant() - 1.0).abs() < 1e-12 && (turn * DVec3::Z).dot(ahead) > 0.9);
        }
        // Upside down there is no unique smallest rotation; any will do.
        let down = Up { direction: DVec3::Y, sigma_degrees: 1.0, evidence: Vec::new() };
        assert!((down.levelled(UpAxis::MinusY) * DVec3::Y - DVec3::NEG_Y).length() < 1e-12);
    }
}
