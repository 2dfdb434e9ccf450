//! The readers, with the valid files to damage.
use super::heap::Heap;
use super::mutate::{Random, damaged};
use super::{HEAP, seeds};
use glam::DVec2;
use splatlab::protocol::{self, ProtocolKind};
use splatvk::checkpoint::Checkpoint;
use splatvk::eval::GroundTruth;
use splatvk::format::{cameras, colmap, gaussians, npy, ply, scene_dir, scene_photos};
use splatvk::infer::adapter::Adapter;
use splatvk::infer::{depth_prior, onnx};
use splatvk::language::dir::{DirMasks, TextEmbeddings};
use splatvk::photo;
use splatvk::run::base::record_of;
use splatvk::scene::{LanguageField, Splats};
use splatvk::{Error, Result};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

/// Limits of a reader.
pub struct Limits;

impl Limits {
    /// Longest time for any damage.
    pub const TIME: Duration = Duration::from_secs(1);
    /// Bytes beside four times the file and the file itself.
    pub const ROOM: usize = 64 << 20;
    /// Bytes for a decoded photo: photos of more than 20 megapixels are not decoded here, and at
    /// most 16 bytes per pixel are needed, and the same again in the decoder.
    const PHOTO_ROOM: usize = 2 * 16 * 20_000_000 + Limits::ROOM;
    /// Decoding 20 megapixels takes a second on a busy machine.
    const PHOTO_TIME: Duration = Duration::from_secs(5);
    /// Bytes for readers of label images: the limit of a decoded image.
    const LABELS_ROOM: usize = (2 << 30) + Limits::ROOM;
}

/// Result of reading one file.
#[derive(Debug)]
pub struct Verdict {
    pub read: bool,
    pub time: Duration,
    pub fault: Option<String>,
    pub error: Option<String>,
}

/// Unpacks the content of a container and repacks it, changed, with correct checksums and lengths.
pub type Container = fn(&[u8], &mut dyn FnMut(&[u8]) -> Vec<u8>) -> Vec<u8>;

/// A file of a reader's folder.
pub struct Seed {
    pub name: String,
    pub bytes: Vec<u8>,
    /// False for files that only others need.
    pub damaged: bool,
    pub container: Option<Container>,
}

/// A reader and its folder.
pub struct Reader {
    pub name: &'static str,
    seeds: Vec<Seed>,
    room: usize,
    pub time: Duration,
    read: fn(&Path) -> Result<()>,
}

impl Reader {
    fn new(name: &'static str, seeds: Vec<Seed>, read: fn(&Path) -> Result<()>) -> Reader {
        Reader { name, seeds, room: Limits::ROOM, time: Limits::TIME, read }
    }

    pub fn lay_out(&self, folder: &Path) {
        for seed in &self.seeds {
            let file = folder.join(&seed.name);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            std::fs::write(file, &seed.bytes).unwrap();
        }
    }

    pub fn whole(&self, name: &str) -> &[u8] {
        &self.seeds.iter().find(|s| s.name == name).unwrap().bytes
    }

    /// One of the files, damaged.
    pub fn damaged(&self, random: &mut Random) -> (&str, Vec<u8>) {
        let open: Vec<&Seed> = self.seeds.iter().filter(|s| s.damaged).collect();
        let seed = *random.pick(&open);
        let others: Vec<&[u8]> = open.iter().map(|s| s.bytes.as_slice()).collect();
        let bytes = match seed.container {
            // The container itself is damaged now and then.
            Some(container) if random.below(4) > 0 => {
                container(&seed.bytes, &mut |inside| damaged(inside, &[inside], random))
            }
            _ => damaged(&seed.bytes, &others, random),
        };
        (&seed.name, bytes)
    }

    pub fn run(&self, folder: &Path) -> Verdict {
        let size: u64 =
            self.seeds.iter().map(|s| std::fs::metadata(folder.join(&s.name)).unwrap().len()).sum();
        within(size as usize, (self.room, self.time), || (self.read)(folder))
    }
}

/// Reads files of `size` bytes and checks time and memory against the limits.
pub fn within(size: usize, (room, most): (usize, Duration), read: impl FnOnce() -> Result<()>) -> Verdict {
    let (mark, began, worked) = (Heap::mark(&HEAP), Instant::now(), processor_time());
    let outcome = catch_unwind(AssertUnwindSafe(read));
    let peak = HEAP.peak_above(mark);
    // Other programs prolong the wall time, and waiting uses no processor time: neither alone is
    // the reader's time.
    let time = match processor_time().zip(worked) {
        Some((now, before)) => (now - before).min(began.elapsed()).max(began.elapsed() / 10),
        None => began.elapsed(),
    };
    let allowed = 5 * size + room;
    let fault = match &outcome {
        Err(_) => Some("panic".to_owned()),
        _ if time > most => Some(format!("{} ms", time.as_millis())),
        _ if peak > allowed => Some(format!("{peak} bytes for {size}, {allowed} are allowed")),
        // A damaged model is a missing part (3), other damaged files are refused input.
        Ok(Err(e)) if ![2, 3].contains(&e.exit_code()) => Some(format!("exit code {}: {e}", e.exit_code())),
        _ => None,
    };
    let error = outcome.as_ref().ok().and_then(|o| o.as_ref().err()).map(Error::to_string);
    Verdict { read: matches!(outcome, Ok(Ok(()))), time, fault, error }
}

/// Processor time of all threads of this process; only one reader runs at a time.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn processor_time() -> Option<Duration> {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is a timespec that outlives the call.
    let done = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    (done == 0).then(|| Duration::new(time.tv_sec as u64, time.tv_nsec as u32))
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn processor_time() -> Option<Duration> {
    None
}

/// Reads Gaussians; checks that they are finite and can be written.
fn gaussians_of(folder: &Path, name: &str) -> Result<()> {
    let (splats, _) = gaussians::read(&folder.join(name))?;
    let numbers = splats.means.as_flattened().iter().chain(splats.log_scales.as_flattened());
    let numbers = numbers.chain(splats.quats.as_flattened()).chain(&splats.opacity_logits).chain(&splats.sh);
    assert!(numbers.into_iter().all(|v| v.is_finite()), "not finite");
    for other in ["out.glb", "out.splat", "out.compressed.ply"] {
        let out = folder.join(other);
        gaussians::write(&out, &splats, None).expect("what was read is written");
        let back = gaussians::read_noted(&out).expect("what was written is read");
        assert!(back.0.len() == splats.len(), "{other}: {:?}", back.2);
    }
    Ok(())
}

fn photo_of(folder: &Path, name: &str) -> Result<()> {
    let path = folder.join(name);
    let (w, h) = photo::dimensions(&path)?;
    match u64::from(w) * u64::from(h) <= 20_000_000 {
        true => photo::load_at(&path, 64).map(drop),
        false => Ok(()),
    }
}

/// All readers of untrusted bytes.
pub fn all() -> Vec<Reader> {
    let mut all = vec![
        Reader::new("ply", seeds::gaussians("a.ply", 1), |f| gaussians_of(f, "a.ply")),
        Reader::new("ply-ascii", vec![seeds::file("a.ply", seeds::ascii_ply())], |f| {
            gaussians_of(f, "a.ply")
        }),
        Reader::new("ply-points", vec![seeds::file("a.ply", seeds::points())], |f| {
            ply::read_points(&f.join("a.ply")).map(drop)
        }),
        Reader::new("compressed-ply", seeds::gaussians("a.compressed.ply", 2), |f| {
            gaussians_of(f, "a.compressed.ply")
        }),
        Reader::new("splat", seeds::gaussians("a.splat", 0), |f| gaussians_of(f, "a.splat")),
        Reader::new("spz", seeds::gaussians("a.spz", 3), |f| gaussians_of(f, "a.spz")),
        Reader::new("spz-gzip", vec![seeds::gzip("a.spz")], |f| gaussians_of(f, "a.spz")),
        Reader::new("sog", seeds::sog("a.sog"), |f| gaussians_of(f, "a.sog")),
        Reader::new("sog-folder", seeds::sog_folder(), |f| gaussians_of(f, "meta.json")),
        Reader::new("glb", seeds::glb("a.glb"), |f| gaussians_of(f, "a.glb")),
        Reader::new("gltf", seeds::gltf(), |f| gaussians_of(f, "a.gltf")),
        Reader::new("language", seeds::language(), |f| gaussians_of(f, "a.splat")),
        Reader::new("colmap-text", seeds::colmap(false), |f| {
            colmap::read(f).and_then(|_| colmap::read_points(f)).map(drop)
        }),
        Reader::new("colmap-binary", seeds::colmap(true), |f| {
            colmap::read(f).and_then(|_| colmap::read_points(f)).map(drop)
        }),
        Reader::new("transforms", vec![seeds::transforms()], |f| cameras::read(&f.join("a.json")).map(drop)),
        Reader::new("cameras-json", vec![seeds::cameras_json()], |f| {
            cameras::read(&f.join("a.json")).map(drop)
        }),
        Reader::new("npy", vec![seeds::npy("a.npy")], |f| npy::read(f.join("a.npy")).map(drop)),
        Reader::new("npz", vec![seeds::npz("a.npz")], |f| npy::read_npz(f.join("a.npz")).map(drop)),
        Reader::new("scene", seeds::scene(), |f| scene_dir::load(f).map(drop)),
        Reader::new("scene-photos", seeds::scene_photos(), |f| scene_photos::load(f).map(drop)),
        Reader::new("run-json", vec![seeds::run_json()], |f| record_of(f).map(drop)),
        Reader::new("checkpoint", vec![seeds::checkpoint("a.state")], |f| {
            let kept = Checkpoint::new(f.join("a.state"), Duration::ZERO, true);
            // A damaged state is ignored: the work restarts.
            match kept.load::<(Splats, LanguageField)>() {
                Some(_) => Ok(()),
                None => Err(Error::input("absent")),
            }
        }),
        Reader::new("adapter", vec![seeds::adapter(), seeds::kept("m.onnx", seeds::onnx())], |f| {
            let model = f.join("m.onnx");
            Adapter::of_file(&model)?.fit(&model, &onnx::read(&model)?).map(drop)
        }),
        Reader::new("onnx", vec![seeds::file("m.onnx", seeds::onnx())], |f| {
            let model = f.join("m.onnx");
            let header = onnx::read(&model)?;
            // Either it fits, or the error describes the graph.
            let _ = Adapter::default().fit(&model, &header);
            Ok(())
        }),
        Reader::new("masks", seeds::masks(), |f| {
            let mut masks = DirMasks::new(f, true);
            masks.read(&seeds::photo("a")).and_then(|_| masks.read(&seeds::photo("b"))).map(drop)
        }),
        Reader::new("texts", vec![seeds::npz("text_embeddings.npz")], |f| {
            TextEmbeddings::read(&f.join("text_embeddings.npz")).map(drop)
        }),
        Reader::new("depth", vec![seeds::depth("a_depth.npy")], |f| {
            depth_prior::of_folder(f, &[seeds::photo("a")]).map(drop)
        }),
        Reader::new("ground-truth", seeds::ground_truth(), |f| {
            let truth = GroundTruth::read(f)?;
            for frame in &truth.frames {
                truth.objects(frame)?;
                truth.depth(frame)?;
                frame.camera.unproject(DVec2::ZERO, 1.0);
            }
            Ok(())
        }),
        Reader::new("lerf", vec![seeds::lerf()], |f| labelled(ProtocolKind::Lerf, f)),
        Reader::new("3dovs", seeds::ovs(), |f| labelled(ProtocolKind::Ovs, f)),
        Reader::new("scannet", seeds::scannet(), |f| labelled(ProtocolKind::ScanNet, f)),
    ];
    let photos: [(&str, Vec<Seed>, fn(&Path) -> Result<()>); 9] = [
        ("png", vec![seeds::picture("a.png")], |f| photo_of(f, "a.png")),
        ("png-indexed", vec![seeds::indexed("a.png")], |f| photo_of(f, "a.png")),
        ("radiance", vec![seeds::picture("a.hdr")], |f| photo_of(f, "a.hdr")),
        ("jpeg", vec![seeds::picture("a.jpg")], |f| photo_of(f, "a.jpg")),
        ("webp", vec![seeds::picture("a.webp")], |f| photo_of(f, "a.webp")),
        ("tiff", vec![seeds::picture("a.tif")], |f| photo_of(f, "a.tif")),
        ("exr", vec![seeds::picture("a.exr")], |f| photo_of(f, "a.exr")),
        ("exif", vec![seeds::exif("a.png")], |f| photo_of(f, "a.png")),
        ("icc", vec![seeds::icc("a.png")], |f| photo_of(f, "a.png")),
    ];
    let labels = ["ground-truth", "lerf", "3dovs", "scannet"];
    all.iter_mut().filter(|r| labels.contains(&r.name)).for_each(|r| r.room = Limits::LABELS_ROOM);
    all.extend(photos.map(|(name, seeds, read)| Reader {
        room: Limits::PHOTO_ROOM,
        time: Limits::PHOTO_TIME,
        ..Reader::new(name, seeds, read)
    }));
    all
}

fn labelled(kind: ProtocolKind, folder: &Path) -> Result<()> {
    let labels = protocol::labels(kind, folder)?;
    labels.stems.iter().try_for_each(|stem| labels.maps.objects(stem).map(drop))
}
