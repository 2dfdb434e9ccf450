//! Workloads: splats and a camera.
use crate::format::{cameras, create_folder, picture, ply, scene_dir, write_json};
use crate::gpu::Device;
use crate::pass::renderer::Renderer;
use crate::scene::seeded;
use crate::scene::{Camera, Pose, RgbImage, Splats};
use crate::{Error, Result, files};
use glam::{DMat3, DVec3};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Scene with one camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Workload {
    /// Name in reports.
    pub name: String,
    /// Splats, with the SH degree to measure.
    pub splats: Splats,
    /// Camera to render and train.
    pub camera: Camera,
}

impl Workload {
    /// Seeded scene: `splats` splats spread evenly over a `width × height` image (see
    /// [`seeded::benchmark`]).
    pub fn seeded(splats: usize, width: u32, height: u32, sh_degree: u32, seed: u64) -> Result<Workload> {
        if splats == 0 || width == 0 || height == 0 {
            return Err(Error::input("a benchmark scene needs at least one splat and one pixel"));
        }
        let (splats, camera) = seeded::benchmark(splats, width, height, sh_degree, seed);
        Ok(Workload { name: "seeded scene".into(), splats, camera })
    }

    /// Loads a Gaussian .ply with the camera file beside it, or a scene directory with its first
    /// camera, or either with another camera file. `sh_degree` limits the coefficients.
    pub fn load(scene: &Path, camera: Option<&Path>, sh_degree: Option<u32>) -> Result<Workload> {
        let loaded = scene_dir::load(scene)?;
        let beside: Option<PathBuf> = scene.is_file().then(|| scene.with_extension("json"));
        let camera = match camera.map(Path::to_path_buf).or(beside) {
            Some(file) => read_camera(&file)?,
            None => loaded.cameras.first().cloned().ok_or_else(|| {
                Error::input(format!("{}: the scene has no cameras; give --camera FILE", scene.display()))
            })?,
        };
        let splats = match sh_degree {
            Some(degree) => scene_dir::cut_degree(loaded.splats, degree),
            None => loaded.splats,
        };
        if splats.is_empty() {
            return Err(Error::input(format!("{}: the scene has no splats", scene.display())));
        }
        let name = scene.file_name().unwrap_or(scene.as_os_str()).to_string_lossy().into_owned();
        Ok(Workload { name, splats, camera })
    }

    /// Describes splats, pixels and degree in one line.
    pub fn describe(&self, features: usize) -> String {
        let (n, c) = (self.splats.len(), &self.camera);
        let degree = self.splats.sh_degree;
        format!(
            "{}, {n} splats, {} × {}, SH {degree}, {features} feature channels",
            self.name, c.width, c.height
        )
    }

    /// Renders the scene from its camera, on black.
    pub fn render(&self, device: &Device) -> Result<RgbImage> {
        Ok(Renderer::new(device, &self.splats, &[], 0)?.render(&self.camera)?.rgb)
    }

    /// Photo to fit: a paler render of the scene, so that every pixel has a gradient but the scene
    /// stays similar.
    pub fn target(&self, device: &Device) -> Result<RgbImage> {
        let mut image = self.render(device)?;
        image.data.iter_mut().flatten().for_each(|v| *v = pale(*v));
        Ok(image)
    }

    /// Writes the workload for other programs: `scene.ply` (INRIA fields), `scene.json` (pinhole
    /// camera, world → camera rows) and `render.npy` ([H, W, 3] f32, on black), the expected
    /// render.
    pub fn write(&self, device: &Device, folder: &Path) -> Result<[PathBuf; 3]> {
        create_folder(folder)?;
        let files = ["scene.ply", "scene.json", "render.npy"].map(|name| folder.join(name));
        ply::write_splats(&files[0], &self.splats, ply::PlyOptions::default())?;
        let (c, r) = (&self.camera, &self.camera.pose.rotation);
        let row = |i: usize| [r.row(i).x, r.row(i).y, r.row(i).z, c.pose.translation[i]];
        let camera = json!({
            "N": self.splats.len(), "W": c.width, "H": c.height, "sh_degree": self.splats.sh_degree,
            "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
            "w2c": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            "convention": "OpenCV, world to camera",
        });
        write_json(&files[1], &camera)?;
        let image = self.render(device)?;
        picture::write_npy(&files[2], (image.width, image.height), Some(3), image.data.as_flattened())?;
        Ok(files)
    }
}

/// Colour of the target from the rendered one.
fn pale(v: f32) -> f32 {
    (0.9 * v + 0.05).clamp(0.0, 1.0)
}

/// Reads a pinhole camera of [`Workload::write`], or the first camera of another camera file.
fn read_camera(path: &Path) -> Result<Camera> {
    let fault = |what: String| {
        Error::input(format!("{}: {what}; give the camera with --camera FILE", path.display()))
    };
    if !path.is_file() {
        return Err(fault("there is no such file".into()));
    }
    let value: serde_json::Value = files::read_json(path, "give the camera with --camera FILE")?;
    if value.get("w2c").is_none() {
        return cameras::read(path)?.into_iter().next().ok_or_else(|| fault("no camera in it".into()));
    }
    let number = |v: &serde_json::Value, what: &str| {
        v.as_f64().filter(|x| x.is_finite()).ok_or_else(|| fault(format!("{what} is no number")))
    };
    let field = |name: &str| number(&value[name], name);
    let mut rotation = DMat3::IDENTITY;
    let mut translation = DVec3::ZERO;
    for row in 0..3 {
        for column in 0..3 {
            rotation.col_mut(column)[row] = number(&value["w2c"][row][column], "w2c")?;
        }
        translation[row] = number(&value["w2c"][row][3], "w2c")?;
    }
    let camera = Camera {
        name: "bench".into(),
        width: field("W")? as u32,
        height: field("H")? as u32,
        fx: field("fx")?,
        fy: field("fy")?,
        cx: field("cx")?,
        cy: field("cy")?,
        pose: Pose { rotation, translation },
    };
    camera.checked().map_err(fault)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeded_scene_matches_published_statistics() {
        let w = Workload::seeded(20_000, 480, 360, 1, 0).unwrap();
        let n = w.splats.len() as f64;
        let mean = |f: &dyn Fn(usize) -> f64| (0..w.splats.len()).map(f).sum::<f64>() / n;
        // Standard errors at 20 000 draws stay below 0.01 for every statistic here; five of them
        // are allowed.
        let near = |value: f64, expected: f64, what: &str| {
            assert!((value - expected).abs() < 0.05, "{what}: {value} instead of {expected}");
        };
        near(mean(&|i| f64::from(w.splats.opacity_logits[i])), -1.5, "mean opacity logit");
        near(mean(&|i| (f64::from(w.splats.opacity_logits[i]) + 1.5).powi(2)), 1.0, "its variance");
        near(mean(&|i| f64::from(w.splats.means[i][2])), 4.0, "mean depth");
        // ln σ − ln(2 px · √(50000/N) · z / f) is normal with standard deviation 0.35.
        let footprint = 2.0 * (50_000.0f64 / n).sqrt();
        let log_size = |i: usize| {
            f64::from(w.splats.log_scales[i][0])
                - (footprint * f64::from(w.splats.means[i][2]) / w.camera.fx).ln()
        };
        near(mean(&log_size), 0.0, "mean log size");
        near(mean(&|i| log_size(i).powi(2)), 0.35 * 0.35, "its variance");
        near(mean(&|i| f64::from(w.splats.sh[i * 12]).powi(2)), 0.36, "variance of the DC coefficients");
        near(mean(&|i| f64::from(w.splats.sh[i * 12 + 5]).powi(2)), 0.01, "variance of the others");
        assert_eq!((w.camera.fx, w.camera.cx), (432.0, 240.0));
    }

    #[test]
    fn written_workload_is_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut w = Workload::seeded(50, 64, 48, 1, 3).unwrap();
        w.camera.pose = Pose::exp(DVec3::new(0.1, 0.2, -0.3), DVec3::new(0.3, -0.2, 0.1));
        let device = crate::gpu::test_device();
        let [scene, camera, render] = w.write(&device, folder.path()).unwrap();
        let seen = crate::format::npy::read(&render).unwrap();
        assert_eq!(seen.shape, [48, 64, 3]);
        assert_eq!(seen.to_f32(), w.render(&device).unwrap().data.as_flattened());
        let beside = Workload::load(&scene, None, Some(1)).unwrap();
        let given = Workload::load(&scene, Some(&camera), Some(1)).unwrap();
        assert_eq!(beside, given);
        assert_eq!(given.splats.means, w.splats.means);
        assert_eq!(given.splats.sh, w.splats.sh);
        let off = given.camera.pose.rotation - w.camera.pose.rotation;
        assert!(off.to_cols_array().iter().all(|v| v.abs() < 1e-12));
        assert_eq!(given.camera.fx, w.camera.fx);
        let error = Workload::load(&scene, Some(&folder.path().join("no.json")), None).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("--camera"), "{error}");
    }
}
