//! Selections as text: words, ids, ranges, pixels and outlines in photos, joined with ` + `, ` - `
//! and ` & `.
use crate::format::edits::{Combine, Pick, Property, Term};
use crate::format::scene_dir::Scene;
use crate::photo::stem;
use crate::run::metric::{Distance, camera, finite_numbers};
use crate::scene::Camera;
use crate::{Error, Result};

/// Signs between the parts of a selection.
const SIGNS: [(&str, Combine); 3] =
    [(" + ", Combine::Add), (" - ", Combine::Remove), (" & ", Combine::Intersect)];

/// Name of the camera of the page, which is no photo.
const VIEW: &str = "view";
/// Parses a selection. `grow` is that of its words ([`Pick::Word`]). A size with m, cm or mm needs
/// the scale of the scene.
///
/// # Errors
/// An empty part, an unknown property or photo, and a value that is no number.
pub fn terms(text: &str, scene: &Scene, grow: f32) -> Result<Vec<Term>> {
    let mut terms = Vec::new();
    let (mut combine, mut rest) = (Combine::Add, text);
    loop {
        let next = SIGNS.iter().filter_map(|(sign, combine)| Some((rest.find(sign)?, *sign, *combine)));
        let next = next.min_by_key(|(at, ..)| *at);
        let part = next.map_or(rest, |(at, ..)| &rest[..at]).trim();
        if part.is_empty() {
            return Err(Error::input(format!(
                "\"{text}\": a part of the selection is empty; give words, ids (id:o3), ranges (opacity<0.1) or \
                 pixels (at:PHOTO:X,Y), joined with \" + \", \" - \" or \" & \""
            )));
        }
        terms.push(Term { combine, pick: pick(part, scene, grow)? });
        let Some((at, sign, following)) = next else { return Ok(terms) };
        (combine, rest) = (following, &rest[at + sign.len()..]);
    }
}

fn pick(part: &str, scene: &Scene, grow: f32) -> Result<Pick> {
    if let Some(id) = part.strip_prefix("id:") {
        return Ok(Pick::Thing { id: id.trim().to_owned() });
    }
    if let Some(place) = part.strip_prefix("at:") {
        let (pixels, camera) = in_view(part, place, scene)?;
        let [pixel] = pixels[..] else {
            return Err(Error::input(format!("\"{part}\": at: takes one pixel; in: takes an outline")));
        };
        return Ok(Pick::Click { camera, pixel, level: None });
    }
    if let Some(outline) = part.strip_prefix("in:") {
        let (polygon, camera) = in_view(part, outline, scene)?;
        return Ok(Pick::Outline { camera, polygon, through: false });
    }
    match part.find(['<', '>']) {
        Some(at) => range(part, at, scene),
        None => Ok(Pick::Word { text: part.to_owned(), grow }),
    }
}

/// `VIEW:x,y x,y …`: pixels, and the camera of the view.
fn in_view(part: &str, text: &str, scene: &Scene) -> Result<(Vec<[f64; 2]>, Camera)> {
    let pixels = |text: &str| -> Option<Vec<[f64; 2]>> {
        text.split_whitespace().map(|pixel| finite_numbers(pixel)?.try_into().ok()).collect()
    };
    let parsed = text.rsplit_once(':').and_then(|(view, text)| Some((view, pixels(text)?)));
    let (view, pixels) = parsed.ok_or_else(|| {
        Error::input(format!("\"{part}\": give a photo and pixels, as in at:IMG_1.jpg:112,140"))
    })?;
    Ok((pixels, camera(scene, stem(view.trim()))?.clone()))
}

/// `PROPERTY<VALUE` or `PROPERTY>VALUE`, with the sign at a position.
fn range(part: &str, at: usize, scene: &Scene) -> Result<Pick> {
    let (name, value) = (part[..at].trim(), &part[at + 1..]);
    let property = Property::ALL.iter().find(|known| known.0 == name).ok_or_else(|| {
        let names = Property::ALL.map(|known| known.0).join(", ");
        Error::input(format!("\"{part}\": no property is called \"{name}\"; there are {names}"))
    })?;
    let invalid = |reason: String| Error::input(format!("\"{part}\": {reason}"));
    let value = match value.parse::<Distance>().map_err(invalid)? {
        Distance::Metres(_) if property.1 != Property::Size => {
            return Err(Error::input(format!("\"{part}\": {name} has no unit; leave it out")));
        }
        distance => distance.in_units(scene)?,
    };
    let (least, most) = if part[at..].starts_with('<') { (None, Some(value)) } else { (Some(value), None) };
    Ok(Pick::Range { property: property.1, least, most })
}

/// A term as text, for messages and lists; those of an expression read as they were given.
pub fn text(term: &Term) -> String {
    let sign = match term.combine {
        Combine::Add => "",
        Combine::Remove => " - ",
        Combine::Intersect => " & ",
    };
    let pick = match &term.pick {
        Pick::Word { text, .. } => format!("\"{text}\""),
        Pick::Thing { id } => format!("id:{id}"),
        Pick::Range { property, least, most } => {
            let name = Property::ALL.iter().find(|known| known.1 == *property).map_or("", |known| known.0);
            let bound = |sign: &str, value: &Option<f64>| value.map(|v| format!("{name}{sign}{v}"));
            [bound(">", least), bound("<", most)].into_iter().flatten().collect::<Vec<_>>().join(" & ")
        }
        Pick::Click { camera, pixel: [x, y], .. } if camera.name == VIEW => {
            format!("click at {x:.0}, {y:.0}")
        }
        Pick::Click { camera, pixel: [x, y], .. } => format!("at:{}:{x},{y}", stem(&camera.name)),
        Pick::Outline { camera, polygon, .. } if camera.name == VIEW => {
            format!("outline of {} corners", polygon.len())
        }
        Pick::Outline { camera, polygon, .. } => {
            format!("outline of {} corners in {}", polygon.len(), stem(&camera.name))
        }
        Pick::Floaters { thorough } => if *thorough { "thorough floaters" } else { "floaters" }.to_owned(),
    };
    sign.to_owned() + &pick
}

/// Terms as text.
pub fn texts(terms: &[Term]) -> String {
    let joined = |(k, term): (usize, &Term)| match (k, term.combine) {
        (1.., Combine::Add) => format!(" + {}", text(term)),
        _ => text(term),
    };
    terms.iter().enumerate().map(joined).collect()
}

/// Parses a colour of CSS: `#rgb` or `#rrggbb`, to sRGB in 0..1.
pub fn colour(text: &str) -> Result<[f32; 3]> {
    let invalid = || Error::input(format!("\"{text}\": give a colour as #rrggbb or #rgb, for example #c33"));
    let digits: Option<Vec<u32>> =
        text.trim().strip_prefix('#').and_then(|hex| hex.chars().map(|c| c.to_digit(16)).collect());
    match digits.ok_or_else(invalid)?[..] {
        [r, g, b] => Ok([r, g, b].map(|v| (17 * v) as f32 / 255.0)),
        [r, s, g, h, b, c] => Ok([[r, s], [g, h], [b, c]].map(|[a, b]| (16 * a + b) as f32 / 255.0)),
        _ => Err(invalid()),
    }
}

/// Parses a displacement to scene units: `X,Y,Z` along the scene's axes, or `up D` and `down D`.
///
/// # Errors
/// Numbers that are none, metres without a scale, and up where the scene does not state it.
pub fn displacement(text: &str, scene: &Scene) -> Result<[f64; 3]> {
    let invalid = |reason: String| Error::input(format!("{reason}; a displacement is X,Y,Z or \"up D\""));
    let text = text.trim();
    for (word, sign) in [("up ", 1.0), ("down ", -1.0)] {
        if let Some(distance) = text.strip_prefix(word) {
            let up = scene.world.up.as_ref().ok_or_else(|| {
                Error::input(format!(
                    "{}: which way is up is not known; give X,Y,Z in the axes of the scene",
                    scene.path.display()
                ))
            })?;
            let distance = distance.parse::<Distance>().map_err(invalid)?.in_units(scene)?;
            return Ok((up.direction.normalize_or_zero() * sign * distance).to_array());
        }
    }
    let parts: Vec<&str> = text.split(',').collect();
    let [x, y, z] = parts[..] else { return Err(invalid(format!("\"{text}\": not three numbers"))) };
    let mut by = [0.0; 3];
    for (value, part) in by.iter_mut().zip([x, y, z]) {
        *value = part.parse::<Distance>().map_err(invalid)?.in_units(scene)?;
    }
    Ok(by)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Pose, Scale, Up, World};
    use glam::DVec3;

    fn scene() -> Scene {
        let up = Up { direction: DVec3::NEG_Y, sigma_degrees: 1.0, evidence: Vec::new() };
        let scale = Scale { metres_per_unit: 0.5, log_sigma: 0.1, stated: Vec::new() };
        let mut scene = Scene::default();
        scene.world = World { up: Some(up), scale: Some(scale) };
        let camera = |name: &&str| Camera {
            name: (*name).to_owned(),
            width: 9,
            height: 9,
            fx: 9.0,
            fy: 9.0,
            cx: 4.5,
            cy: 4.5,
            pose: Pose::IDENTITY,
        };
        scene.cameras = ["a.jpg", "b.jpg"].iter().map(camera).collect();
        scene
    }

    #[test]
    fn places_and_outlines_are_in_photos() {
        let found = terms("at:a:3.5,4 - in:b.jpg:0,0 9,0 9,9", &scene(), 0.0).unwrap();
        let [a, b] = &scene().cameras[..] else { unreachable!() };
        let click = Pick::Click { camera: a.clone(), pixel: [3.5, 4.0], level: None };
        let polygon = vec![[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]];
        let outline = Pick::Outline { camera: b.clone(), polygon, through: false };
        let expected = [(Combine::Add, click), (Combine::Remove, outline)];
        assert_eq!(found, expected.map(|(combine, pick)| Term { combine, pick }));
        assert_eq!(texts(&found), "at:a:3.5,4 - outline of 3 corners in b");
    }

    #[test]
    fn selections_join_words_ids_and_ranges() {
        let found = terms("t-shirt + id:l3.2 & opacity > 0.5 - size<10cm", &scene(), 0.25).unwrap();
        let word = Pick::Word { text: "t-shirt".into(), grow: 0.25 };
        let range = |property, least, most| Pick::Range { property, least, most };
        let expected = [
            (Combine::Add, word),
            (Combine::Add, Pick::Thing { id: "l3.2".into() }),
            (Combine::Intersect, range(Property::Opacity, Some(0.5), None)),
            (Combine::Remove, range(Property::Size, None, Some(0.2))),
        ];
        assert_eq!(found, expected.map(|(combine, pick)| Term { combine, pick }));
        assert_eq!(texts(&found), "\"t-shirt\" + id:l3.2 & opacity>0.5 - size<0.2");
        for (text, words) in [
            ("", "empty"),
            ("mug + ", "empty"),
            ("age<3", "no property is called \"age\""),
            ("opacity<3cm", "has no unit"),
            ("seen<x", "give a distance"),
            ("at:3,4", "give a photo and pixels"),
            ("at:c:3,4", "it has a, b"),
            ("at:a:3,4,5", "give a photo and pixels"),
            ("at:a:3,4 5,6", "at: takes one pixel"),
        ] {
            let error = terms(text, &scene(), 0.0).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains(words), "{error}");
        }
        assert!(terms("size<1cm", &Scene::default(), 0.0).is_err());
    }

    #[test]
    fn colours_are_hexadecimal() {
        assert_eq!(colour("#c33").unwrap(), [0.8, 0.2, 0.2]);
        assert_eq!(colour(" #00FF80 ").unwrap(), [0.0, 1.0, 128.0 / 255.0]);
        for text in ["c33", "#12", "#1234", "#ggg", "red"] {
            assert_eq!(colour(text).unwrap_err().exit_code(), 2, "{text}");
        }
    }

    #[test]
    fn displacements_are_in_units_of_the_scene() {
        assert_eq!(displacement("1, -10cm,0", &scene()).unwrap(), [1.0, -0.2, 0.0]);
        assert_eq!(displacement("up 5cm", &scene()).unwrap(), [0.0, -0.1, 0.0]);
        assert_eq!(displacement("down 1", &scene()).unwrap(), [0.0, 1.0, 0.0]);
        for text in ["1,2", "up", "a,b,c", ""] {
            assert_eq!(displacement(text, &scene()).unwrap_err().exit_code(), 2, "{text}");
        }
        assert!(displacement("up 1", &Scene::default()).is_err());
    }
}
