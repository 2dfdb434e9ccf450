//! Photos of a synthetic scene, with or without a fault of the set.
use super::render::{self, RayCast};
use super::scene::{SceneSpec, SyntheticScene, build_scene};
use super::shapes::Shape;
use super::spoil::Spoil;
use super::walker::{self, Walker};
use crate::{Error, Result};
use glam::{DMat3, DVec3};
use splatvk::scene::{Image, Pose, RgbImage};

/// Index of the spoilt photo where the fault concerns one photo: neither the first nor the last.
const SPOILT_PHOTO: usize = 1;

/// Offset of the other scene's seed, out of every range of seeds in docs/internals/data.md.
const OTHER_SCENE: u64 = 5000;
/// Side of the repeated tile, in units of the scene: about a tenth of the picture.
const TILE: f64 = 0.1;
/// Largest label of the background.
const BACKGROUND: u32 = 3;
/// Diagonal of the frame that "35 mm equivalent" refers to, millimetres (CIPA DCG-001).
const FULL_FRAME_DIAGONAL: f64 = 43.266615305567875;
/// Displacement of the moved object, in units of the scene: about its size.
const MOVED: DVec3 = DVec3::new(0.12, 0.05, 0.0);

/// Renders the photos of a scene, with the fault of its specification.
pub(super) struct Photos<'a> {
    scene: &'a SyntheticScene,
    spec: &'a SceneSpec,
    /// Scene that some of the photos show instead.
    other: Option<SyntheticScene>,
    walker: Option<Walker>,
}

/// A photo with a passer-by.
pub(super) struct Passed {
    /// The picture.
    pub image: RgbImage,
    /// Pixels that the passer-by does not touch.
    pub used: Image<bool>,
}

/// Builds the scene of a specification, with the faults that concern all photos alike.
pub(super) fn build(spec: &SceneSpec) -> Result<SyntheticScene> {
    let mut scene = build_scene(spec)?;
    match spec.spoil {
        Some(Spoil::Repeated) => {
            scene.objects.iter_mut().for_each(|o| o.paint.tile = Some(TILE * spec.unit()));
        }
        Some(Spoil::Identical) => turn_in_place(&mut scene, 0.0),
        Some(Spoil::Rotation) => turn_in_place(&mut scene, spec.baseline),
        _ => {}
    }
    Ok(scene)
}

/// Moves all cameras to the position of the first one and turns each by `step` degrees against the
/// one before, about the vertical.
fn turn_in_place(scene: &mut SyntheticScene, step: f64) {
    let middle = (scene.train.len() - 1) as f64 / 2.0;
    let first = scene.train[0].pose;
    for (i, (effects, camera)) in scene.photo_effects.iter_mut().zip(&mut scene.train).enumerate() {
        let rotation = first.rotation * DMat3::from_rotation_z(((i as f64 - middle) * step).to_radians());
        camera.pose = Pose { rotation, translation: -(rotation * first.centre()) };
        effects.camera.pose = camera.pose;
    }
}

impl<'a> Photos<'a> {
    pub(super) fn new(scene: &'a SyntheticScene, spec: &'a SceneSpec) -> Result<Photos<'a>> {
        let other = match spec.spoil {
            Some(Spoil::TwoScenes) => {
                Some(build_scene(&SceneSpec { seed: spec.seed.wrapping_add(OTHER_SCENE), ..spec.clone() })?)
            }
            Some(Spoil::Moving) => Some(with_moved_object(scene, spec.unit())),
            _ => None,
        };
        let walker = spec.walker.then(|| Walker::new(spec, scene)).transpose()?;
        Ok(Photos { scene, spec, other, walker })
    }

    /// Renders photo `i`; its noise is drawn from `seed`.
    pub(super) fn render(&self, i: usize, seed: u64) -> RayCast {
        let alone = i == SPOILT_PHOTO;
        let elsewhere = match self.spec.spoil {
            Some(Spoil::TwoScenes) => 2 * i >= self.spec.views,
            _ => alone,
        };
        let scene = self.other.as_ref().filter(|_| elsewhere).unwrap_or(self.scene);
        let mut seen = render::photo(scene, &self.scene.photo_effects[i], self.spec.photo_noise, seed);
        if let Some(spoil) = self.spec.spoil {
            spoil.draw_over(&mut seen.image);
            if alone {
                spoil.spoil_picture(&mut seen.image);
            }
        }
        seen
    }

    /// Photo `i` with the walker of the specification, if there is one; its noise is drawn from
    /// `seed`.
    pub(super) fn passed(&self, i: usize, seed: u64) -> Option<Passed> {
        let walker = self.walker.as_ref()?;
        let effects = &self.scene.photo_effects[i];
        let with = walker.scene(self.scene, i);
        let scene = with.as_ref().unwrap_or(self.scene);
        let image = render::photo(scene, effects, self.spec.photo_noise, seed).image;
        let mut used = render::shows(scene, &effects.camera, effects.lens.as_ref(), walker::LABEL);
        used.data.iter_mut().for_each(|shown| *shown = !*shown);
        Some(Passed { image, used })
    }

    /// EXIF data of photo `i`; `None`: its file has none.
    pub(super) fn exif(&self, i: usize) -> Result<Option<Vec<u8>>> {
        use exif::{Field, In, Tag, Value, experimental::Writer};
        if self.spec.spoil != Some(Spoil::SwappedExif) {
            return Ok(None);
        }
        let effects = &self.scene.photo_effects;
        let neighbour = &effects[if i ^ 1 < effects.len() { i ^ 1 } else { i - 1 }].camera;
        let diagonal = f64::from(neighbour.width).hypot(f64::from(neighbour.height));
        let millimetres = (neighbour.fx / diagonal * FULL_FRAME_DIAGONAL).round() as u16;
        let model = format!("Camera {}", i % 2 + 1);
        let fields = [
            (Tag::FocalLengthIn35mmFilm, Value::Short(vec![millimetres])),
            (Tag::Model, Value::Ascii(vec![model.into_bytes()])),
        ]
        .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        let mut raw = std::io::Cursor::new(Vec::new());
        writer.write(&mut raw, false).map_err(|e| Error::work(format!("cannot encode EXIF data: {e}")))?;
        Ok(Some(raw.into_inner()))
    }
}

/// The scene with its first object moved by [`MOVED`].
fn with_moved_object(scene: &SyntheticScene, unit: f64) -> SyntheticScene {
    let mut moved = scene.clone();
    if let Some(object) = moved.objects.iter_mut().find(|o| o.label > BACKGROUND) {
        match &mut object.shape {
            Shape::Ball(position, _) | Shape::Block(position, ..) | Shape::Can(position, ..) => {
                *position += MOVED * unit;
            }
            Shape::Plane(..) => {}
        }
    }
    moved
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::pass::metrics::psnr;

    fn photos(spoil: Option<Spoil>) -> (SyntheticScene, Vec<RgbImage>) {
        let spec =
            SceneSpec { seed: 1000, size: (160, 120), photo_noise: 0.0, spoil, ..SceneSpec::default() };
        let scene = build(&spec).unwrap();
        let photos = Photos::new(&scene, &spec).unwrap();
        let images = (0..4).map(|i| photos.render(i, i as u64).image).collect();
        (scene, images)
    }

    /// PSNR of every spoilt photo against the same photo without the fault, dB.
    fn against_plain(spoil: Spoil) -> Vec<f64> {
        let (plain, spoilt) = (photos(None).1, photos(Some(spoil)).1);
        plain.iter().zip(&spoilt).map(|(a, b)| psnr(a, b)).collect()
    }

    #[test]
    fn single_photo_spoils_change_one_photo() {
        for spoil in [Spoil::Mirrored, Spoil::Moving, Spoil::Defocused, Spoil::Overexposed, Spoil::Black] {
            for (i, psnr) in against_plain(spoil).into_iter().enumerate() {
                assert_eq!(psnr.is_infinite(), i != SPOILT_PHOTO, "{spoil:?}, photo {i}: {psnr} dB");
            }
        }
        let (plain, mirrored) = (photos(None).1, photos(Some(Spoil::Mirrored)).1);
        assert_eq!(plain[1].at(0, 7), mirrored[1].at(159, 7));
        assert!(photos(Some(Spoil::Black)).1[1].data.iter().all(|c| *c == [0.0; 3]));
    }

    #[test]
    fn set_spoils_change_stated_photos() {
        let same = photos(Some(Spoil::Identical)).1;
        assert!(same.iter().all(|p| *p == same[0]));
        let two = against_plain(Spoil::TwoScenes);
        assert!(two[0].is_infinite() && two[1].is_infinite() && two[2] < 25.0 && two[3] < 25.0, "{two:?}");
        assert!(against_plain(Spoil::Repeated).iter().all(|p| *p < 30.0));
        let (turned, _) = photos(Some(Spoil::Rotation));
        let centre = turned.train[0].pose.centre();
        for (effects, camera) in turned.photo_effects.iter().zip(&turned.train) {
            assert_eq!(effects.camera, *camera);
            assert!((camera.pose.centre() - centre).length() < 1e-12);
        }
        let axis = |i: usize| turned.train[i].pose.rotation.row(2);
        let step = axis(0).angle_between(axis(1)).to_degrees();
        // A turn about the vertical moves axes that look down by less than the step of 20 degrees.
        assert!((14.0..20.0).contains(&step), "{step}");
    }

    #[test]
    fn exif_states_other_cameras_focal_length() {
        let effects = super::super::Effects { focal: true, two_cameras: true, ..Default::default() };
        let spec = SceneSpec {
            seed: 1000,
            views: 3,
            effects,
            spoil: Some(Spoil::SwappedExif),
            ..SceneSpec::default()
        };
        let scene = build(&spec).unwrap();
        let photos = Photos::new(&scene, &spec).unwrap();
        for (i, other) in [(0, 1), (1, 0), (2, 1)] {
            let read = exif::Reader::new().read_raw(photos.exif(i).unwrap().unwrap()).unwrap();
            let field = read.get_field(exif::Tag::FocalLengthIn35mmFilm, exif::In::PRIMARY).unwrap();
            let stated = f64::from(field.value.get_uint(0).unwrap()) / FULL_FRAME_DIAGONAL * 800.0;
            assert!((stated / scene.train[other].fx - 1.0).abs() < 0.02, "{i}: {stated}");
        }
        assert!((scene.train[0].fx / scene.train[1].fx - 1.0).abs() > 0.05, "the two differ");
    }
}
