//! Lengths in a scene, and the scale that known lengths give it (docs/use/metres.md).
use super::view::Viewer;
use crate::format::scene_dir::Scene;
use crate::gpu;
use crate::photo::stem;
use crate::scene::{Camera, Image, LanguageField, Scale};
use crate::{Error, Result};
use glam::{DVec2, DVec3};
use std::str::FromStr;

/// An end of a length.
#[derive(Clone, Debug, PartialEq)]
pub enum Place {
    /// `x,y,z` in the scene's own coordinates.
    Point(DVec3),
    /// `VIEW:x,y`: the surface at a pixel of a view.
    Pixel(String, DVec2),
}

impl Place {
    fn parse(text: &str) -> Option<Place> {
        match text.rsplit_once(':') {
            Some((view, pixel)) => match finite_numbers(pixel)?[..] {
                [x, y] => Some(Place::Pixel(stem(view.trim()).to_owned(), DVec2::new(x, y))),
                _ => None,
            },
            None => match finite_numbers(text)?[..] {
                [x, y, z] => Some(Place::Point(DVec3::new(x, y, z))),
                _ => None,
            },
        }
    }
}

/// Parses numbers between commas; `None` unless all are finite.
pub(super) fn finite_numbers(text: &str) -> Option<Vec<f64>> {
    text.split(',').map(|n| n.trim().parse().ok().filter(|v: &f64| v.is_finite())).collect()
}

/// `A - B`, or with its true length `A - B = 0.21`: metres, or a number with `m`, `cm` or `mm`.
#[derive(Clone, Debug, PartialEq)]
pub struct Length {
    /// Original text.
    pub text: String,
    /// Both ends.
    pub ends: [Place; 2],
    /// True length, if stated.
    pub metres: Option<f64>,
}

impl FromStr for Length {
    type Err = String;

    fn from_str(text: &str) -> Result<Length, String> {
        let (places, metres) = match text.split_once('=') {
            Some((places, length)) => (places, Some(metres(length)?)),
            None => (text, None),
        };
        // A minus can also be a sign or part of a name: the first one between two places separates
        // them.
        let split =
            |(at, _): (usize, &str)| Some([Place::parse(&places[..at])?, Place::parse(&places[at + 1..])?]);
        let ends = places.match_indices('-').find_map(split).ok_or_else(|| {
            format!("\"{text}\": give two places as A - B, each x,y,z of the scene or VIEW:x,y in pixels")
        })?;
        Ok(Length { text: text.trim().to_owned(), ends, metres })
    }
}

fn metres(text: &str) -> Result<f64, String> {
    let distance = text.parse().ok().filter(Distance::is_positive);
    let (Distance::Metres(metres) | Distance::Units(metres)) = distance.ok_or_else(|| {
        format!("\"{text}\": a length is a positive number of metres, or one with m, cm or mm")
    })?;
    Ok(metres)
}

/// A distance: metres with m, cm or mm, otherwise units of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distance {
    /// Metres.
    Metres(f64),
    /// Scene units.
    Units(f64),
}

impl FromStr for Distance {
    type Err = String;

    fn from_str(text: &str) -> Result<Distance, String> {
        let text = text.trim();
        let metres = [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0)];
        let found = metres.iter().find_map(|(name, unit)| Some((text.strip_suffix(name)?, *unit)));
        let number = found.map_or(text, |(number, _)| number).trim().parse::<f64>().ok();
        let number = number.filter(|v| v.is_finite()).ok_or_else(|| {
            format!("\"{text}\": give a distance such as 2mm, 10cm, or 0.01 in the units of the scene")
        })?;
        Ok(found.map_or(Distance::Units(number), |(_, unit)| Distance::Metres(number * unit)))
    }
}

impl Distance {
    /// Whether it is above zero.
    pub fn is_positive(&self) -> bool {
        let (Distance::Metres(number) | Distance::Units(number)) = self;
        *number > 0.0
    }

    /// Scene units.
    ///
    /// # Errors
    /// Metres where the scale is not known.
    pub fn in_units(self, scene: &Scene) -> Result<f64> {
        match (self, &scene.world.scale) {
            (Distance::Units(units), _) => Ok(units),
            (Distance::Metres(metres), Some(scale)) => Ok(metres / scale.metres_per_unit),
            (Distance::Metres(metres), None) => Err(Error::input(format!(
                "{}: its scale is not known, so {metres} m cannot be used; state a length with splatvk measure --scale, \
                 or give a number in the units of the scene",
                scene.path.display()
            ))),
        }
    }
}

/// σ of a clicked position, pixels.
const CLICK_SIGMA: f64 = 1.0;
/// Relative σ of depth. With 1.5 % two thirds of 85 lengths between the middles of the things on
/// `breakfast` err by no more than their stated deviation, half by no more than 0.7 of it.
const DEPTH_SIGMA: f64 = 0.015;

/// A length measured in the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Measured {
    /// Both ends, scene coordinates.
    pub ends: [DVec3; 2],
    /// Length, scene units.
    pub units: f64,
    /// One standard deviation of `units`.
    pub sigma: f64,
}

/// Measures lengths; opens a device if one of them names pixels.
pub fn measure(scene: &Scene, lengths: &[Length], device: Option<&str>) -> Result<Vec<Measured>> {
    let places = || lengths.iter().flat_map(|l| &l.ends);
    let mut depths: Vec<(&str, Image<f32>)> = Vec::new();
    if places().any(|p| matches!(p, Place::Pixel(..))) {
        let device = gpu::open(device)?;
        let mut viewer = Viewer::new(&device, &scene.splats, &LanguageField::default())?;
        for place in places() {
            let Place::Pixel(view, _) = place else { continue };
            if depths.iter().all(|d| d.0 != view) {
                depths.push((view, viewer.view(camera(scene, view)?)?.rendered.depth));
            }
        }
    }
    lengths.iter().map(|length| measure_one(scene, &depths, length)).collect()
}

/// Measures a length; `depths` holds the rendered depth of every view that it names.
fn measure_one(scene: &Scene, depths: &[(&str, Image<f32>)], length: &Length) -> Result<Measured> {
    let ends = [position(scene, depths, &length.ends[0])?, position(scene, depths, &length.ends[1])?];
    let units = ends[0].distance(ends[1]);
    if units <= 0.0 {
        return Err(Error::input(format!("\"{}\": both ends are at one place", length.text)));
    }
    let along = (ends[1] - ends[0]) / units;
    let sigma = position_sigma(scene, ends[0], along).hypot(position_sigma(scene, ends[1], along));
    Ok(Measured { ends, units, sigma })
}

/// Scene coordinates of a place.
fn position(scene: &Scene, depths: &[(&str, Image<f32>)], place: &Place) -> Result<DVec3> {
    let (view, pixel) = match place {
        Place::Point(p) => return Ok(*p),
        Place::Pixel(view, pixel) => (view, pixel),
    };
    let camera = camera(scene, view)?;
    let (x, y) = (pixel.x.floor(), pixel.y.floor());
    let inside = x >= 0.0 && y >= 0.0 && x < f64::from(camera.width) && y < f64::from(camera.height);
    if !inside {
        return Err(Error::input(format!(
            "{view}:{},{}: the view has {} × {} pixels",
            pixel.x, pixel.y, camera.width, camera.height
        )));
    }
    let depth = depths.iter().find(|d| d.0 == view).map_or(0.0, |d| d.1.at(x as usize, y as usize));
    match depth > 0.0 {
        true => Ok(camera.unproject(*pixel, f64::from(depth))),
        false => Err(Error::input(format!("{view}:{},{}: the scene shows nothing there", pixel.x, pixel.y))),
    }
}

/// Camera of a view by its name without ending.
pub(super) fn camera<'a>(scene: &'a Scene, view: &str) -> Result<&'a Camera> {
    scene.cameras.iter().find(|c| stem(&c.name) == view).ok_or_else(|| {
        let names: Vec<&str> = scene.cameras.iter().map(|c| stem(&c.name)).collect();
        Error::input(format!("{view}: no view of the scene; it has {}", names.join(", ")))
    })
}

/// σ of a position along a direction, scene units, from the nearest camera that has it in front; 0
/// without cameras.
fn position_sigma(scene: &Scene, position: DVec3, along: DVec3) -> f64 {
    let in_front = scene.cameras.iter().map(|c| (c, c.project(position).1)).filter(|s| s.1 > 0.0);
    let Some((camera, depth)) = in_front.min_by(|a, b| a.1.total_cmp(&b.1)) else { return 0.0 };
    let ray = (position - camera.pose.centre()).normalize_or_zero();
    let axial = ray.dot(along);
    let lateral = (1.0 - axial * axial).max(0.0).sqrt();
    (DEPTH_SIGMA * depth * axial).hypot(CLICK_SIGMA * depth / camera.fx * lateral)
}

/// Scale from the stated lengths: their mean in the log domain, weighted by 1/σ². Its σ grows with
/// their disagreement.
pub fn scale(lengths: &[Length], measured: &[Measured]) -> Option<Scale> {
    let stated = || lengths.iter().zip(measured).filter_map(|(l, m)| Some((l, m, l.metres?)));
    let logs: Vec<(f64, f64)> = stated()
        .map(|(_, m, metres)| ((metres / m.units).ln(), (m.sigma / m.units).max(1e-6).powi(-2)))
        .collect();
    let weight: f64 = logs.iter().map(|l| l.1).sum();
    let mean = logs.iter().map(|(log, w)| log * w).sum::<f64>() / weight;
    let misfit: f64 = logs.iter().map(|(log, w)| w * (log - mean).powi(2)).sum();
    // Birge ratio: scatter of the lengths over the scatter that their σ predict, at least 1.
    let excess = (misfit / (logs.len().max(2) - 1) as f64).max(1.0);
    (!logs.is_empty()).then(|| Scale {
        metres_per_unit: mean.exp(),
        log_sigma: (excess / weight).sqrt(),
        stated: stated().map(|s| s.0.text.clone()).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_have_units_or_are_the_scenes() {
        assert_eq!("2mm".parse(), Ok(Distance::Metres(0.002)));
        assert_eq!(" -0.5 cm".parse(), Ok(Distance::Metres(-0.005)));
        assert_eq!("0.01".parse(), Ok(Distance::Units(0.01)));
        for text in ["", "mm", "inf", "2 inches"] {
            assert!(text.parse::<Distance>().is_err(), "{text}");
        }
        let error = Distance::Metres(0.002).in_units(&Scene::default()).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("splatvk measure --scale"));
    }

    #[test]
    fn lengths_parse_all_notations() {
        let point = |x, y, z| Place::Point(DVec3::new(x, y, z));
        let read = |text: &str| text.parse::<Length>();
        let plain = read("0.1,-0.2,1.3 - -0.4,0.5,1 = 0.21").unwrap();
        assert_eq!((plain.ends, plain.metres), ([point(0.1, -0.2, 1.3), point(-0.4, 0.5, 1.0)], Some(0.21)));
        assert_eq!(read("1e-2,0,1-0,0,1").unwrap().ends, [point(0.01, 0.0, 1.0), point(0.0, 0.0, 1.0)]);
        let pixel = |view: &str, x, y| Place::Pixel(view.into(), DVec2::new(x, y));
        let named = read("img-1.jpg:12,30.5-img-2:4,5=21 cm").unwrap();
        assert_eq!(named.ends, [pixel("img-1", 12.0, 30.5), pixel("img-2", 4.0, 5.0)]);
        assert!((named.metres.unwrap() - 0.21).abs() < 1e-12);
        assert_eq!(read("0,0,1 - 1,0,1 = 5mm").unwrap().metres, Some(0.005));
        for bad in [
            "0,0,1",
            "0,0 - 1,1",
            "0,0,1 - 1,0,1 = ",
            "0,0,1 - 1,0,1 = -2",
            "a:1,2,3 - b:1,2",
            "0,0,nan - 0,0,1",
        ] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn scale_weights_lengths_by_certainty() {
        let length = |metres| Length { metres: Some(metres), ..read("0,0,1 - 1,0,1") };
        fn read(text: &str) -> Length {
            text.parse().unwrap()
        }
        let measured = |units: f64, sigma| Measured { ends: [DVec3::ZERO; 2], units, sigma };
        let one = scale(&[length(0.5)], &[measured(2.0, 0.02)]).unwrap();
        assert!((one.metres_per_unit - 0.25).abs() < 1e-12 && (one.log_sigma - 0.01).abs() < 1e-12);
        let two = [measured(2.0, 0.02), measured(1.0, 0.1)];
        let agreeing = scale(&[length(0.5), length(0.25)], &two).unwrap();
        assert!((agreeing.metres_per_unit - 0.25).abs() < 1e-12 && agreeing.log_sigma < 0.01);
        // 40 % apart; their σ predict 10 %.
        let apart = scale(&[length(0.5), length(0.35)], &two).unwrap();
        assert!((0.25..0.252).contains(&apart.metres_per_unit) && apart.log_sigma > 0.03, "{apart:?}");
        assert_eq!(scale(&[read("0,0,1 - 1,0,1")], &two[..1]), None);
    }
}
