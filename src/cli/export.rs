//! `splatvk export`
use super::outputs::{WrittenFile, WrittenFiles, check_file};
use super::print::listing;
use super::progress;
use super::scene;
use crate::files::{Kind, check_place};
use crate::format::gaussians::{FORMATS, Reserved, SplatFormat, WriteOptions};
use crate::format::scene_dir::Scene;
use crate::format::transform::transform_splats;
use crate::format::{colmap, ply, spz, transforms};
use crate::scene::{Camera, PointCloud, SH_C0, Similarity, Splats, UpAxis};
use crate::{Error, Result};
use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser};
use glam::{DMat3, DVec3, Vec3};
use std::path::{Path, PathBuf};

/// `splatvk export`
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Scene directory, or a file of Gaussians: .ply (compressed, too), .splat, .spz, .glb, .gltf
    pub scene: PathBuf,
    /// Format of the file; language goes beside the files of Gaussians, into OUT.language.npz (ply:
    /// --with-features) [default: by the ending of --out]
    #[arg(long, value_parser = formats(), value_name = "FORMAT")]
    pub format: Option<String>,
    /// File, or folder (colmap, colmap-bin)
    #[arg(long, value_name = "PATH")]
    pub out: PathBuf,
    /// Write over what is there: an ordinary file, or those of the same names in a folder
    #[arg(long)]
    pub force: bool,
    /// ply: spherical-harmonics degree of the file, padded with zeros; most viewers ask for 3
    #[arg(long, default_value_t = 3, value_parser = super::args::whole::<u32>(0..=3), value_name = "0-3")]
    pub ply_degree: u32,
    /// spz: version of the file; 3 is read by most programs, 4 by the newest ones only
    #[arg(long, value_parser = clap::value_parser!(u32).range(2..=4), value_name = "2-4")]
    pub spz_version: Option<u32>,
    /// ply: add the language features and codes as extra columns
    #[arg(long)]
    pub with_features: bool,
    /// Keep what no photo shows: surfaces continued beyond the photos and behind what stands in
    /// front, and the blurred colours behind the scene
    #[arg(long)]
    pub guessed: bool,
    /// The default since guessed surfaces are left out; kept for scripts.
    #[arg(long, hide = true, conflicts_with = "guessed")]
    pub only_seen: bool,
    /// Turn the scene so that up, where the scene states it, is this axis: -y (right, down,
    /// forward), y (right, up, back) or z (right, forward, up); spz, glb and gltf know only y
    /// [default: the scene's own axes]
    #[arg(long, value_parser = up_axis, allow_hyphen_values = true, value_name = "AXIS")]
    pub up: Option<UpAxis>,
    /// Scale the scene to metres, where its scale is known (splatvk measure --scale)
    #[arg(long)]
    pub metres: bool,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

fn formats() -> PossibleValuesParser {
    let splats = FORMATS.iter().map(|f| PossibleValue::new(f.name).help(f.about));
    let cameras = [
        ("colmap", "COLMAP text model"),
        ("colmap-bin", "COLMAP binary model"),
        ("transforms", "nerfstudio transforms.json"),
    ];
    PossibleValuesParser::new(splats.chain(cameras.map(|(name, about)| PossibleValue::new(name).help(about))))
}

fn up_axis(text: &str) -> Result<UpAxis, String> {
    match text {
        "-y" => Ok(UpAxis::MinusY),
        "y" => Ok(UpAxis::PlusY),
        "z" => Ok(UpAxis::PlusZ),
        _ => Err("give -y, y or z".into()),
    }
}

/// Transform of `--up` and `--metres` from the scene's own coordinates; `None` without them.
fn placement(scene: &Scene, args: &ExportArgs, format: &str) -> Result<Option<Similarity>> {
    let scale = match (args.metres, &scene.world.scale) {
        (false, _) => 1.0,
        (true, Some(scale)) => scale.metres_per_unit,
        (true, None) => {
            return Err(Error::input(format!(
                "{}: its scale is not known; state a length with splatvk measure --scale, or leave --metres out",
                args.scene.display()
            )));
        }
    };
    let rotation = rotation(scene, args, format)?;
    let placed = args.metres || args.up.is_some();
    Ok(placed.then_some(Similarity { scale, rotation, translation: DVec3::ZERO }))
}

fn rotation(scene: &Scene, args: &ExportArgs, format: &str) -> Result<DMat3> {
    let Some(axis) = args.up else { return Ok(DMat3::IDENTITY) };
    let up = scene.world.up.as_ref().ok_or_else(|| {
        Error::input(format!("{}: which way is up is not known; leave --up out", args.scene.display()))
    })?;
    let axis = match SplatFormat::named(format) {
        // Their writers convert right, down, forward to right, up, back.
        Some(format) if format.y_up => match axis {
            UpAxis::PlusY => UpAxis::MinusY,
            _ => {
                return Err(Error::input(format!(
                    "--up: {} has y up by definition; give --up y",
                    format.name
                )));
            }
        },
        _ => axis,
    };
    Ok(up.levelled(axis))
}

/// Transforms splats, cameras and points of a scene.
fn transform_scene(scene: &mut Scene, points: &mut Option<PointCloud>, by: &Similarity) {
    let levels = scene.language.iter_mut().flat_map(|field| &mut field.levels);
    let own = levels.filter_map(|level| level.splats.as_mut());
    own.chain([&mut scene.splats]).for_each(|splats| transform_splats(splats, by));
    scene.cameras.iter_mut().for_each(|c| *c = by.camera(c));
    if let Some(points) = points {
        for p in &mut points.positions {
            *p = by.transform(Vec3::from_array(*p).as_dvec3()).as_vec3().to_array();
        }
        points.radius.iter_mut().for_each(|r| *r *= by.scale as f32);
    }
}

pub fn export(args: &ExportArgs) -> Result<()> {
    write(args)?;
    listing(std::slice::from_ref(&args.out), args.json)
}

/// Writes the file or the folder of an export.
pub fn write(args: &ExportArgs) -> Result<()> {
    let format = format(args)?;
    let out = Output::reserve(args, format)?;
    let mut scene = scene::load(&args.scene)?;
    if args.guessed {
        add_backdrop(&mut scene);
    } else {
        keep_seen(&mut scene);
    }
    let placement = placement(&scene, args, format)?;
    let mut points = match format.starts_with("colmap") {
        true => colmap::read_points(&args.scene.join("cameras/colmap")).ok(),
        false => None,
    };
    if let Some(by) = placement {
        transform_scene(&mut scene, &mut points, &by);
    }
    progress::reporter().check()?;
    match out {
        Output::Folder(mut folder) => {
            let cameras = cameras(&scene, args)?;
            let [text, binary] = colmap::FILES;
            let (write, other): (fn(&_, &_, _) -> _, _) = match format {
                "colmap" => (colmap::write, binary),
                _ => (colmap::write_binary, text),
            };
            write(folder.folder(), cameras, points.as_ref())?;
            folder.outdate(other.into_iter());
            folder.keep()?;
        }
        Output::Splats(files, splat_format) => {
            warn_of_losses(&scene.splats, splat_format);
            warn_of_models(&scene);
            let options = WriteOptions { spz_version: args.spz_version.unwrap_or(spz::DEFAULT_VERSION) };
            files.write(&scene.splats, scene.language.as_ref(), splat_format, options)?;
        }
        Output::File(file) if format == "transforms" => {
            let cameras = cameras(&scene, args)?;
            file.keep(|path| transforms::write(path, cameras, None))?;
        }
        Output::File(file) => {
            let language = if args.with_features { scene.language.as_ref() } else { None };
            if args.with_features && language.is_none() {
                return Err(Error::input(format!(
                    "{}: the scene has no language; leave --with-features out",
                    args.scene.display()
                )));
            }
            if args.with_features {
                warn_of_models(&scene);
            }
            let options = ply::PlyOptions { degree: args.ply_degree, language, objects: None };
            file.keep(|path| ply::write_splats(path, &scene.splats, options))?;
        }
    }
    if let Some(warning) = check_ending(&args.out, format)? {
        progress::reporter().warn(&warning);
    }
    Ok(())
}

/// Reserved output of a format.
enum Output {
    /// The files of a COLMAP model.
    Folder(WrittenFiles),
    /// One file: cameras, or a PLY, the only format with language inside and any SH degree.
    File(WrittenFile),
    /// Splats, with the language beside them.
    Splats(Reserved, &'static SplatFormat),
}

impl Output {
    /// Reserves the output, or refuses a place that may not be written, before the scene is read.
    fn reserve(args: &ExportArgs, format: &str) -> Result<Output> {
        let is_folder = is_folder(format);
        if args.spz_version.is_some() && format != "spz" {
            return Err(Error::input("--spz-version: only --format spz has versions; leave it out"));
        }
        check_ending(&args.out, format)?;
        // Refuses a link wherever it leads.
        check_place(&args.out, if is_folder { Kind::Folder } else { Kind::File }, true)?;
        if let (Ok(out), Ok(scene)) = (args.out.canonicalize(), args.scene.canonicalize())
            && scene.is_dir()
            && out.starts_with(&scene)
        {
            return Err(Error::input(format!(
                "{}: a part of the scene that is exported; choose another --out",
                args.out.display()
            )));
        }
        let inputs = [args.scene.as_path()];
        if is_folder {
            return WrittenFiles::open(&args.out, args.force, &inputs).map(Output::Folder);
        }
        match SplatFormat::named(format).filter(|format| format.name != "ply") {
            Some(format) => {
                check_file(&args.out, args.force, &inputs)?;
                Ok(Output::Splats(Reserved::open(&args.out, args.force)?, format))
            }
            None => WrittenFile::open(&args.out, args.force, &inputs).map(Output::File),
        }
    }
}

/// Formats with a file ending: (name, ending).
fn endings() -> impl Iterator<Item = (&'static str, &'static str)> {
    FORMATS.iter().map(|f| (f.name, f.ending)).chain([("transforms", ".json")])
}

/// Whether a format is a folder of files.
pub fn is_folder(format: &str) -> bool {
    format.starts_with("colmap")
}

/// The requested format, or that of the ending of `--out`.
pub fn format(args: &ExportArgs) -> Result<&str> {
    if let Some(format) = &args.format {
        return Ok(format);
    }
    let lower = args.out.to_string_lossy().to_lowercase();
    match endings().find(|(_, ending)| lower.ends_with(ending)) {
        Some((name, _)) => Ok(name),
        None => Err(Error::input(format!(
            "--out {}: its ending states no format; give --format, or one of the endings {}",
            args.out.display(),
            endings().map(|(_, ending)| ending).collect::<Vec<_>>().join(", ")
        ))),
    }
}

/// Refuses an ending of another format, and returns a warning for an ending of none.
fn check_ending(path: &Path, format: &str) -> Result<Option<String>> {
    let Some((_, own)) = endings().find(|(name, _)| *name == format) else { return Ok(None) };
    let (out, file) = (path.display(), path.to_string_lossy());
    let lower = file.to_lowercase();
    match endings().find(|(_, ending)| lower.ends_with(ending)) {
        Some((name, _)) if name == format => Ok(None),
        // Programs recognise a compressed .ply by its content.
        Some(("ply", _)) if format == "compressed-ply" => Ok(None),
        Some((name, ending)) => {
            let stem = file.get(..file.len() - ending.len()).unwrap_or_default();
            Err(Error::input(format!(
                "--out {out}: names that end in {ending} are of --format {name}, not {format}; give --out {stem}{own}, or \
                 --format {name}"
            )))
        }
        None => Ok(Some(format!("--out {out}: programs know --format {format} by names that end in {own}"))),
    }
}

/// Warns if a file with one set of splats gets features that were trained on others.
fn warn_of_models(scene: &Scene) {
    let levels = scene.language.iter().flat_map(|field| &field.levels);
    if levels.into_iter().any(|level| level.splats.is_some()) {
        progress::reporter().warn(
            "every level of this scene has splats of its own, a file has one set: features go with the shared splats, which \
             they were not trained on; the scene directory keeps all",
        );
    }
}

/// Appends the backdrop, without language.
fn add_backdrop(scene: &mut Scene) {
    let (before, more) = (scene.splats.len(), std::mem::take(&mut scene.backdrop));
    if more.is_empty() {
        return;
    }
    scene.language = scene.language.take().map(|field| field.extended(&more, before));
    scene.splats.append_raised(more);
}

/// Drops splats that no photo shows.
fn keep_seen(scene: &mut Scene) {
    // A bare file of Gaussians is exported as it is.
    if scene.seen.pixels.is_empty() {
        return;
    }
    let rows = scene.seen.rows(&scene.splats);
    scene.language = scene.language.take().map(|field| field.picked(&rows, scene.splats.len()));
    scene.splats = scene.splats.picked(&rows);
}

/// Upper bound of base colours in ordinary photos: of 145,000 splats of the breakfast scene one in
/// 50,000 is above 1.1, none above 1.25.
const ORDINARY: f32 = 1.25;
/// Share of the solid splats that may be clipped without a warning.
const UNNOTICED: f64 = 5e-4;

/// Warns of properties that a format cannot hold.
fn warn_of_losses(splats: &Splats, format: &SplatFormat) {
    if let Some(brightest) = format.brightest {
        warn_of_range(splats, brightest);
    }
    if splats.antialiased && !format.states_filter {
        progress::reporter().warn(&format!(
            "the scene is antialiased and {} cannot say so: programs draw its thin splats too heavy; ply, compressed-ply and \
             spz keep it",
            format.name
        ));
    }
}

/// Warns if a format clips base colours of solid splats above `brightest`.
fn warn_of_range(splats: &Splats, brightest: f32) {
    let row = splats.sh.len() / splats.len().max(1);
    let limit = brightest.max(ORDINARY);
    let (mut solid, mut cut) = (0usize, 0usize);
    for (logit, sh) in splats.opacity_logits.iter().zip(splats.sh.chunks_exact(row.max(1))) {
        if *logit > 0.0 {
            solid += 1;
            cut += usize::from(sh.iter().take(3).any(|dc| 0.5 + SH_C0 * dc > limit));
        }
    }
    if cut as f64 > UNNOTICED * solid as f64 {
        progress::reporter().warn(&format!(
            "the format ends at {brightest:.2} of white and {cut} splats are brighter: they are cut off; ply, \
             compressed-ply, glb and gltf keep them"
        ));
    }
}

fn cameras<'a>(scene: &'a Scene, args: &ExportArgs) -> Result<&'a [Camera]> {
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no cameras; give a scene directory",
            args.scene.display()
        )));
    }
    Ok(&scene.cameras)
}
