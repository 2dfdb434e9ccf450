//! The scene directory: written by a run and read by every other command.
use super::edits::{AppliedEdits, EditList};
use super::npy::{self, NpyArray};
use super::{
    cameras, colmap, create_folder, gaussians, level_arrays, picture, ply, scene_photos, transforms,
};
use crate::photo::Photo;
use crate::scene::{
    Camera, Codebook, LEVEL_NAMES, LanguageField, LevelField, MaskId, PointCloud, Seen, Splats, World,
};
use crate::{Error, Result, files};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Version of the layout; readers refuse newer ones.
pub const VERSION: u32 = 2;

/// Format name in the manifest.
const FORMAT: &str = "splatvk-scene";

/// Text embeddings of precomputed features, kept so that the scene answers queries by itself.
pub const TEXT_EMBEDDINGS: &str = "language/text_embeddings.npz";

/// The manifest.
pub(super) const MANIFEST: &str = "scene.json";

/// The Gaussians.
pub(super) const SPLATS: &str = "point_cloud.ply";

/// Blending weight of every splat in the photos, [N] f32 ([`Seen`]).
pub(super) const SEEN: &str = "seen.npy";

/// Splats behind the scene, which are no part of it: blurred colours of the surroundings.
pub(super) const BACKDROP: &str = "backdrop.ply";

/// Splats that edits took away.
pub(super) const HOLES: &str = "holes.ply";

/// A loaded scene.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct Scene {
    /// Path of the scene.
    pub path: PathBuf,
    /// The Gaussians.
    pub splats: Splats,
    /// Blending weights of the splats in the photos.
    pub seen: Seen,
    /// Splats behind the scene, which no photo shows; empty for a bare PLY.
    pub backdrop: Splats,
    /// Splats that edits took away from where they were, of SH degree 0: nothing is known of the
    /// space behind them, and pictures are hatched where it shows.
    pub holes: Splats,
    /// Training cameras at working resolution; empty for a bare PLY.
    pub cameras: Vec<Camera>,
    /// Direction up and scale, where known.
    pub world: World,
    /// Codebooks and features; `None` without language.
    pub language: Option<LanguageField>,
    /// The edits that it contains; `None` for a reconstruction as it is.
    pub edits: Option<AppliedEdits>,
    /// Notes for the user on parts of a file of Gaussians that were left out; a scene directory is
    /// read completely or refused.
    pub warnings: Vec<String>,
}

/// `scene.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Manifest {
    format: String,
    version: u32,
    generator: String,
    splats: usize,
    sh_degree: u32,
    cameras: usize,
    #[serde(default)]
    world: World,
    #[serde(default)]
    language: Option<LanguageManifest>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct LanguageManifest {
    space: String,
    levels: Vec<LevelManifest>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct LevelManifest {
    name: String,
    codes: usize,
    embedding_dim: usize,
    code_dim: usize,
    /// Whether the level has splats of its own ([`own_splats`]).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    own_splats: bool,
}

/// File of the splats of a level with a model of its own.
fn own_splats(language: &Path, level: &str) -> PathBuf {
    language.join(format!("splats_{level}.ply"))
}

/// Contents of a scene directory for [`write()`].
#[derive(Clone, Copy)]
pub struct Contents<'a> {
    /// The Gaussians.
    pub splats: &'a Splats,
    /// Blending weights of the splats in the photos.
    pub seen: &'a Seen,
    /// Splats behind the scene; may be empty.
    pub backdrop: &'a Splats,
    /// Splats that edits took away; may be empty.
    pub holes: &'a Splats,
    /// One per photo, at working resolution.
    pub cameras: &'a [Camera],
    /// Direction up and scale of the scene.
    pub world: &'a World,
    /// Photos to keep beside the cameras (undistorted, working resolution), for other tools; may be
    /// empty.
    pub photos: &'a [Photo],
    /// Points for the COLMAP model.
    pub points: Option<&'a PointCloud>,
    /// Language field with trained features.
    pub language: Option<&'a LanguageField>,
    /// `text_embeddings.npz` of precomputed features, copied into the scene.
    pub text_embeddings: Option<&'a Path>,
}

/// Writes splats, cameras and language into `folder`, which exists (see [`super::Workspace`]). The
/// manifest comes last: a folder without it is not a scene.
pub fn write(folder: &Path, c: &Contents) -> Result<()> {
    ply::write_splats(&folder.join(SPLATS), c.splats, ply::PlyOptions::default())?;
    if !c.seen.pixels.is_empty() {
        npy::write(folder.join(SEEN), &NpyArray::f32(&[c.seen.pixels.len()], c.seen.pixels.clone()))?;
    }
    for (name, splats) in [(BACKDROP, c.backdrop), (HOLES, c.holes)].iter().filter(|(_, s)| !s.is_empty()) {
        // In its own degree: it is drawn behind the scene, not opened alone.
        let options = ply::PlyOptions { degree: splats.sh_degree, ..ply::PlyOptions::default() };
        ply::write_splats(&folder.join(name), splats, options)?;
    }
    let camera_folder = folder.join("cameras");
    create_folder(&camera_folder)?;
    let mut named = c.cameras.to_vec();
    if !c.photos.is_empty() {
        create_folder(&camera_folder.join("images"))?;
        for (camera, photo) in named.iter_mut().zip(c.photos) {
            camera.name = format!("{}.png", photo.stem);
            picture::write_photo(&camera_folder, &camera.name, photo)?;
        }
    }
    colmap::write(&camera_folder.join("colmap"), &named, c.points)?;
    if !c.photos.is_empty() {
        named.iter_mut().for_each(|camera| camera.name = format!("images/{}", camera.name));
    }
    transforms::write(&camera_folder.join("transforms.json"), &named, Some("../point_cloud.ply"))?;
    if !c.photos.is_empty() {
        write_originals(&camera_folder.join("original"), c)?;
        scene_photos::write(&camera_folder, c.photos)?;
    }
    let language = c.language.map(|l| write_language(folder, l, c.splats.len())).transpose()?;
    if let (Some(_), Some(table)) = (&language, c.text_embeddings) {
        let to = folder.join(TEXT_EMBEDDINGS);
        std::fs::copy(table, &to).map_err(Error::io(&to))?;
    }
    let manifest = Manifest {
        format: FORMAT.into(),
        version: VERSION,
        generator: format!("splatvk {}", env!("CARGO_PKG_VERSION")),
        splats: c.splats.len(),
        sh_degree: c.splats.sh_degree,
        cameras: c.cameras.len(),
        world: c.world.clone(),
        language,
    };
    super::write_json(&folder.join(MANIFEST), &manifest)
}

/// Writes the cameras of the original photos: at their own size, with their distortion.
fn write_originals(folder: &Path, c: &Contents) -> Result<()> {
    let cameras: Vec<Camera> =
        c.photos.iter().zip(c.cameras).map(|(photo, camera)| photo.original_camera(camera)).collect();
    let lenses: Vec<_> = c.photos.iter().map(Photo::lens).collect();
    colmap::write_lensed(&folder.join("colmap"), &cameras, &lenses)?;
    transforms::write_lensed(&folder.join("transforms.json"), &cameras, &lenses)
}

fn write_language(folder: &Path, field: &LanguageField, splats: usize) -> Result<LanguageManifest> {
    let folder = folder.join("language");
    create_folder(&folder)?;
    let mut levels = Vec::new();
    let mut features: Vec<(String, NpyArray)> = Vec::new();
    for (name, level) in LEVEL_NAMES.into_iter().zip(&field.levels).filter(|(_, l)| !l.codebook.is_empty()) {
        let book = &level.codebook;
        level_arrays::append(&mut features, name, level, splats, &[])?;
        write_codebook(&folder.join(format!("codebook_{name}.npz")), book, &field.space)?;
        if let Some(own) = &level.splats {
            // In the scene's own degree: no other program needs to open it.
            let options = ply::PlyOptions { degree: own.sh_degree, ..ply::PlyOptions::default() };
            ply::write_splats(&own_splats(&folder, name), own, options)?;
        }
        levels.push(LevelManifest {
            name: name.into(),
            codes: book.len(),
            embedding_dim: book.embedding_dim,
            code_dim: book.code_dim,
            own_splats: level.splats.is_some(),
        });
    }
    let arrays: Vec<(&str, &NpyArray)> = features.iter().map(|(n, a)| (n.as_str(), a)).collect();
    npy::write_packed_npz(folder.join("features.npz"), &arrays)?;
    Ok(LanguageManifest { space: field.space.clone(), levels })
}

/// One level's bijection (docs/internals/method.md#codebook-file).
fn write_codebook(path: &Path, book: &Codebook, space: &str) -> Result<()> {
    let k = book.len();
    let mut offsets = vec![0i32];
    let mut members = Vec::new();
    for list in &book.members {
        members.extend(list.iter().flat_map(|m| [m.view as i32, m.mask as i32]));
        offsets.push(members.len() as i32 / 2);
    }
    let count = members.len() / 2;
    npy::write_npz(
        path,
        &[
            ("clip", &NpyArray::f32(&[k, book.embedding_dim], book.embeddings.clone())),
            ("code", &NpyArray::f32(&[k, book.code_dim], book.codes.clone())),
            ("weight", &NpyArray::f32(&[book.weights.len()], book.weights.clone())),
            ("members", &NpyArray::i32(&[count, 2], members)),
            ("offsets", &NpyArray::i32(&[offsets.len()], offsets)),
            ("delta_min", &NpyArray::f32(&[], vec![book.min_chord])),
            ("model", &NpyArray::text(space)),
            ("version", &NpyArray::i32(&[], vec![VERSION as i32])),
        ],
    )
}

/// Replaces the world data of a scene directory.
pub fn write_world(path: &Path, world: &World) -> Result<()> {
    let manifest = Manifest { world: world.clone(), ..read_manifest(path)? };
    super::write_whole_file(&path.join(MANIFEST), |file| super::write_json(file, &manifest))
}

/// Loads a scene directory with its edits, or a file of Gaussians ([`gaussians::read`]) without
/// cameras.
pub fn load(path: &Path) -> Result<Scene> {
    let scene = load_unedited(path)?;
    match path.is_dir() {
        true => EditList::read(path, &scene.splats).map(|list| list.apply(scene)),
        false => Ok(scene),
    }
}

/// Loads a scene like [`load`], as it was reconstructed.
pub fn load_unedited(path: &Path) -> Result<Scene> {
    if path.is_file() {
        let (splats, language, warnings) = gaussians::read_noted(path)?;
        return Ok(Scene { path: path.into(), splats, language, warnings, ..Scene::default() });
    }
    let manifest = read_manifest(path)?;
    let splats = read_own(&path.join(SPLATS))?;
    let cameras = cameras::read(&path.join("cameras/transforms.json"))?;
    let damaged =
        |what: String| Error::input(format!("{}: {what}; the scene is damaged, run again", path.display()));
    if splats.len() != manifest.splats || cameras.len() != manifest.cameras {
        return Err(damaged(format!(
            "{MANIFEST} counts {} splats, the PLY has {}",
            manifest.splats,
            splats.len()
        )));
    }
    let splats = cut_degree(splats, manifest.sh_degree);
    let language = manifest.language.map(|m| read_language(path, &m, splats.len())).transpose()?;
    let seen = read_seen(path, splats.len())?;
    let [backdrop, holes] =
        [BACKDROP, HOLES].map(|name| path.join(name)).map(|file| match is_missing(&file) {
            true => Ok(Splats::default()),
            false => read_own(&file),
        });
    let (backdrop, holes) = (backdrop?, holes?);
    let world = manifest.world;
    let path = path.into();
    let (edits, warnings) = (None, Vec::new());
    Ok(Scene { path, splats, seen, backdrop, holes, cameras, world, language, edits, warnings })
}

/// Reads Gaussians of this program: all of them or none.
fn read_own(path: &Path) -> Result<Splats> {
    let splats = ply::read_splats(path)?;
    gaussians::usable::check_read(path, &splats)?;
    Ok(splats)
}

/// A folder or a pipe in the place of a file does not count as missing.
pub(super) fn is_missing(file: &Path) -> bool {
    file.symlink_metadata().is_err_and(|e| e.kind() == std::io::ErrorKind::NotFound)
}

/// Reads [`SEEN`]; scenes of earlier versions lack the file.
fn read_seen(folder: &Path, splats: usize) -> Result<Seen> {
    let file = folder.join(SEEN);
    if is_missing(&file) {
        return Ok(Seen::default());
    }
    let array = npy::read(&file)?;
    if array.shape != [splats] {
        return Err(Error::input(format!(
            "{}: {:?} values for {splats} splats; the scene is damaged, run again",
            file.display(),
            array.shape
        )));
    }
    let pixels = array.to_f32();
    match pixels.iter().position(|v| !v.is_finite()) {
        Some(first) => Err(Error::input(format!(
            "{}: value {first} is not finite; the scene is damaged, run again",
            file.display()
        ))),
        None => Ok(Seen { pixels }),
    }
}

/// Whether a folder is a scene directory, by the content of its manifest, as other programs use
/// that file name, too.
pub fn is_scene(folder: &Path) -> bool {
    read_manifest(folder).is_ok()
}

fn read_manifest(path: &Path) -> Result<Manifest> {
    let file = path.join(MANIFEST);
    if !file.is_file() {
        return Err(Error::input(format!(
            "{}: not a scene directory (no {MANIFEST}); give one that splatvk run wrote",
            path.display()
        )));
    }
    let manifest: Manifest = files::read_json(&file, "the scene is damaged, run again")?;
    if manifest.format != FORMAT || manifest.version > VERSION {
        return Err(Error::input(format!(
            "{}: format {} version {}; this program reads {FORMAT} up to version {VERSION}, update it",
            file.display(),
            manifest.format,
            manifest.version
        )));
    }
    Ok(manifest)
}

/// Drops the coefficients above a degree. The PLY is padded to degree 3 for other viewers; the
/// scene's own degree renders the same in less time.
pub fn cut_degree(splats: Splats, degree: u32) -> Splats {
    let (have, keep) = (splats.sh_len(), crate::scene::sh_coefficients(degree.min(splats.sh_degree)));
    let sh = splats.sh.chunks_exact(have * 3).flat_map(|c| c[..keep * 3].iter().copied()).collect();
    Splats { sh, sh_degree: degree.min(splats.sh_degree), ..splats }
}

fn read_language(path: &Path, manifest: &LanguageManifest, splats: usize) -> Result<LanguageField> {
    let folder = path.join("language");
    let file = folder.join("features.npz");
    let features = npy::read_npz_of(&file, splats)?;
    let mut field = LanguageField {
        levels: vec![LevelField::default(); LEVEL_NAMES.len()],
        space: manifest.space.clone(),
    };
    for m in &manifest.levels {
        let damaged = |what: String| {
            Error::input(format!("{}: {what}; the scene is damaged, run again", file.display()))
        };
        let Some(at) = LEVEL_NAMES.iter().position(|n| *n == m.name) else {
            return Err(damaged(format!("no level is named {:?}", m.name)));
        };
        let codebook = read_codebook(&folder.join(format!("codebook_{}.npz", m.name)))?;
        if codebook.code_dim != m.code_dim || codebook.len() != m.codes {
            return Err(damaged(format!("the codebook of level {} is another one", m.name)));
        }
        let level = &mut field.levels[at];
        level.codebook = codebook;
        level_arrays::read(&features, &m.name, splats, level).map_err(damaged)?;
        if m.own_splats {
            let own = read_own(&own_splats(&folder, &m.name))?;
            if own.len() != splats {
                return Err(damaged(format!(
                    "level {} has {} splats, the scene {splats}",
                    m.name,
                    own.len()
                )));
            }
            level.splats = Some(own);
        }
    }
    Ok(field)
}

fn read_codebook(path: &Path) -> Result<Codebook> {
    let arrays: BTreeMap<String, NpyArray> = npy::read_npz(path)?;
    let damaged =
        |what: String| Error::input(format!("{}: {what}; the scene is damaged, run again", path.display()));
    let get = |name: &str| arrays.get(name).ok_or_else(|| damaged(format!("no array {name:?}")));
    let parts = [get("clip")?, get("code")?, get("weight")?, get("delta_min")?];
    let book = level_arrays::codebook(parts).map_err(damaged)?;
    let (members, offsets) = (get("members")?.to_i32(), get("offsets")?.to_i32());
    let bounds = |w: &[i32]| members.get(w[0].max(0) as usize * 2..w[1].max(0) as usize * 2);
    let members: Option<Vec<Vec<MaskId>>> = offsets
        .windows(2)
        .map(|w| {
            Some(
                bounds(w)?.chunks_exact(2).map(|p| MaskId { view: p[0] as u32, mask: p[1] as u32 }).collect(),
            )
        })
        .collect();
    let members = members.filter(|m| m.len() == book.len());
    let members = members.ok_or_else(|| damaged("its members do not fit its codes".to_owned()))?;
    Ok(Codebook { members, ..book })
}
