//! Placement of written splats in the world: `--up`, `--metres`, `--raw`, and their statement.
use crate::format::gaussians::SplatFormat;
use crate::format::scene_dir::Scene;
use crate::format::transform::transform_splats;
use crate::scene::{PointCloud, Scale, Similarity, Up, UpAxis};
use crate::{Error, Result};
use glam::{DMat3, DVec3, Vec3};
use serde_json::{Value, json};

/// Value of `--up`.
///
/// # Errors
/// Another text than -y, y or z.
pub fn up_axis(text: &str) -> Result<UpAxis, String> {
    match text {
        "-y" => Ok(UpAxis::MinusY),
        "y" => Ok(UpAxis::PlusY),
        "z" => Ok(UpAxis::PlusZ),
        _ => Err("give -y, y or z".into()),
    }
}

/// Why an export keeps the axes or the unit of its source.
#[derive(Clone, Copy, PartialEq)]
enum Kept {
    /// `--raw`.
    Asked,
    /// The scene does not state it.
    Unknown,
    /// A file of Gaussians states neither.
    File,
}

/// Placement that the user asks for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Asked {
    /// `--up`
    pub up: Option<UpAxis>,
    /// `--metres`
    pub metres: bool,
    /// `--raw`
    pub raw: bool,
}

/// Where an export places the scene.
pub struct Placement {
    up: Result<(UpAxis, Up), Kept>,
    metres: Result<Scale, Kept>,
    /// Whether the writer of the format converts right, down, forward to right, up, back.
    y_up: bool,
}

impl Placement {
    /// Upright along the axis of the format, and in metres, as far as the scene states them.
    ///
    /// # Errors
    /// `--up` or `--metres` where the scene does not state it, or an axis that the format excludes.
    pub fn new(scene: &Scene, asked: Asked, format: &str) -> Result<Placement> {
        let y_up = SplatFormat::named(format).is_some_and(|format| format.y_up);
        if y_up && asked.up.is_some_and(|axis| axis != UpAxis::PlusY) {
            return Err(Error::input(format!("--up: {format} has y up by definition; give --up y")));
        }
        let unknown = |why: &str| Error::input(format!("{}: {why}", scene.path.display()));
        let missing = if scene.cameras.is_empty() { Kept::File } else { Kept::Unknown };
        let axis = asked.up.unwrap_or(if y_up { UpAxis::PlusY } else { UpAxis::MinusY });
        let up = match &scene.world.up {
            _ if asked.raw && asked.up.is_none() => Err(Kept::Asked),
            Some(up) => Ok((axis, up.clone())),
            None if asked.up.is_some() => {
                return Err(unknown("which way is up is not known; leave --up out"));
            }
            None => Err(missing),
        };
        let metres = match &scene.world.scale {
            _ if asked.raw && !asked.metres => Err(Kept::Asked),
            Some(scale) => Ok(scale.clone()),
            None if asked.metres => {
                return Err(unknown(
                    "its scale is not known; state a length with splatvk measure --scale, or leave --metres out",
                ));
            }
            None => Err(missing),
        };
        Ok(Placement { up, metres, y_up })
    }

    /// Transform from the scene's own coordinates; `None` where they stay.
    fn transform(&self) -> Option<Similarity> {
        if self.up.is_err() && self.metres.is_err() {
            return None;
        }
        let rotation = self.up.as_ref().map_or(DMat3::IDENTITY, |(axis, up)| {
            // The writer of a format with y up makes +y of −y.
            up.levelled(if self.y_up { UpAxis::MinusY } else { *axis })
        });
        let scale = self.metres.as_ref().map_or(1.0, |scale| scale.metres_per_unit);
        Some(Similarity { scale, rotation, translation: DVec3::ZERO })
    }

    /// Moves splats, cameras and points of a scene together.
    pub fn apply(&self, scene: &mut Scene, points: &mut Option<PointCloud>) {
        let Some(by) = self.transform() else { return };
        let levels = scene.language.iter_mut().flat_map(|field| &mut field.levels);
        let own = levels.filter_map(|level| level.splats.as_mut());
        own.chain([&mut scene.splats]).for_each(|splats| transform_splats(splats, &by));
        scene.cameras.iter_mut().for_each(|c| *c = by.camera(c));
        if let Some(points) = points {
            for p in &mut points.positions {
                *p = by.transform(Vec3::from_array(*p).as_dvec3()).as_vec3().to_array();
            }
            points.radius.iter_mut().for_each(|r| *r *= by.scale as f32);
        }
    }

    /// Statement of the axes and of the unit.
    pub fn text(&self) -> String {
        let turned = if self.y_up { " (as right, up, back)" } else { "" };
        let upright = self.up.as_ref().map(|(axis, up)| {
            let axis = match axis {
                UpAxis::MinusY => "−y",
                UpAxis::PlusY => "+y",
                UpAxis::PlusZ => "+z",
            };
            format!("upright ({axis} is up, ±{:.1}°)", up.sigma_degrees)
        });
        let metres = self.metres.as_ref().map(|scale| {
            let percent = 100.0 * scale.log_sigma;
            format!("in metres (±{percent:.*} %)", usize::from(percent < 0.95))
        });
        let measure = "metres are not known: splatvk measure --scale states them";
        match (upright, metres) {
            (Ok(upright), Ok(metres)) => format!("{upright}, {metres}"),
            (Ok(upright), Err(Kept::Asked)) => format!("{upright}, in the scene's own unit"),
            (Ok(upright), Err(_)) => format!("{upright}, in the scene's own unit ({measure})"),
            (Err(Kept::Asked), Ok(metres)) => format!("in the scene's own axes{turned}, {metres}"),
            (Err(_), Ok(metres)) => {
                format!("in the scene's own axes{turned} (which way is up is not known), {metres}")
            }
            (Err(Kept::File), _) => {
                format!("in the axes{turned} and the unit of the file, which states neither up nor metres")
            }
            (Err(Kept::Unknown), Err(Kept::Unknown)) => {
                format!("in the scene's own axes{turned} and unit (which way is up is not known; {measure})")
            }
            (Err(_), Err(_)) => format!("in the scene's own axes{turned} and unit"),
        }
    }

    /// Statement of the axes and of the unit, for `--json`.
    pub fn json(&self) -> Value {
        let up = self.up.as_ref().ok().map(|(axis, up)| {
            let axis = match axis {
                UpAxis::MinusY => "-y",
                UpAxis::PlusY => "y",
                UpAxis::PlusZ => "z",
            };
            json!({ "axis": axis, "sigma_degrees": up.sigma_degrees })
        });
        let metres =
            self.metres.as_ref().ok().map(
                |scale| json!({ "metres_per_unit": scale.metres_per_unit, "log_sigma": scale.log_sigma }),
            );
        json!({ "up": up, "metres": metres })
    }
}
