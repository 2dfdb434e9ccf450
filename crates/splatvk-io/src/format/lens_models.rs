//! Camera models of COLMAP and nerfstudio, and the supported ones.
use crate::scene::Lens;

/// A camera model of COLMAP.
pub(super) struct LensModel {
    pub name: &'static str,
    /// Names of its parameters, as COLMAP's `params_info` lists them.
    parameters: &'static str,
    /// Projection of its distortion; `None` = not supported.
    reads: Option<Projection>,
}

#[derive(Clone, Copy, PartialEq)]
enum Projection {
    Rectilinear,
    Fisheye,
}

const fn model(name: &'static str, parameters: &'static str) -> LensModel {
    LensModel { name, parameters, reads: Some(Projection::Rectilinear) }
}

const fn fisheye(name: &'static str, parameters: &'static str) -> LensModel {
    LensModel { name, parameters, reads: Some(Projection::Fisheye) }
}

const fn unread(name: &'static str, parameters: &'static str) -> LensModel {
    LensModel { name, parameters, reads: None }
}

/// All models, in the order of COLMAP's numbers (4.2.1).
const MODELS: [LensModel; 18] = [
    model("SIMPLE_PINHOLE", "f cx cy"),
    model("PINHOLE", "fx fy cx cy"),
    model("SIMPLE_RADIAL", "f cx cy k1"),
    model("RADIAL", "f cx cy k1 k2"),
    model("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    fisheye("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    model("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    unread("FOV", "fx fy cx cy omega"),
    fisheye("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    fisheye("RADIAL_FISHEYE", "f cx cy k1 k2"),
    unread("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    unread("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    unread("SIMPLE_DIVISION", "f cx cy k"),
    unread("DIVISION", "fx fy cx cy k"),
    fisheye("SIMPLE_FISHEYE", "f cx cy"),
    fisheye("FISHEYE", "fx fy cx cy"),
    unread("EUCM", "fx fy cx cy alpha beta"),
    unread("EQUIRECTANGULAR", "w h"),
];

/// Focal lengths, principal point and distortion, pixels.
#[derive(Clone, Copy)]
pub(super) struct Optics {
    pub f: [f64; 2],
    pub c: [f64; 2],
    pub lens: Lens,
}

impl LensModel {
    pub fn named(name: &str) -> Option<&'static LensModel> {
        MODELS.iter().find(|m| m.name.eq_ignore_ascii_case(name))
    }

    pub fn numbered(number: usize) -> Option<&'static LensModel> {
        MODELS.get(number)
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.parameters.split(' ').count()
    }

    /// Whether its distortion is supported.
    pub fn is_read(&self) -> bool {
        self.reads.is_some()
    }

    /// Whether it is a supported fisheye.
    pub fn is_fisheye(&self) -> bool {
        self.reads == Some(Projection::Fisheye)
    }

    /// Intrinsics from a list of its parameters; `None` where its distortion is not supported or
    /// the list has another length.
    pub fn optics(&self, values: &[f64]) -> Option<Optics> {
        if !self.is_read() || values.len() != self.parameters() {
            return None;
        }
        let mut optics =
            Optics { f: [0.0; 2], c: [0.0; 2], lens: Lens { fisheye: self.is_fisheye(), ..Lens::NONE } };
        for (name, value) in self.parameters.split(' ').zip(values) {
            match name {
                "f" => optics.f = [*value; 2],
                "fx" => optics.f[0] = *value,
                "fy" => optics.f[1] = *value,
                "cx" => optics.c[0] = *value,
                "cy" => optics.c[1] = *value,
                "k1" => optics.lens.k1 = *value,
                "k2" => optics.lens.k2 = *value,
                "k3" => optics.lens.k3 = *value,
                "k4" => optics.lens.k4 = *value,
                "k5" => optics.lens.k5 = *value,
                "k6" => optics.lens.k6 = *value,
                "p1" => optics.lens.p1 = *value,
                "p2" => optics.lens.p2 = *value,
                _ => return None,
            }
        }
        Some(optics)
    }
}

/// Name and coefficients of the model with the fewest parameters that represents a distortion, of
/// those that other programs support.
pub(super) fn of_lens(lens: &Lens) -> (&'static str, Vec<f64>) {
    let Lens { k1, k2, k3, k4, k5, k6, p1, p2, fisheye } = *lens;
    if fisheye {
        ("OPENCV_FISHEYE", vec![k1, k2, k3, k4])
    } else if [k3, k4, k5, k6] == [0.0; 4] {
        ("OPENCV", vec![k1, k2, p1, p2])
    } else {
        ("FULL_OPENCV", vec![k1, k2, p1, p2, k3, k4, k5, k6])
    }
}

/// Names of the supported models, for messages.
pub(super) fn read_names() -> String {
    MODELS.iter().filter(|m| m.is_read()).map(|m| m.name).collect::<Vec<_>>().join(", ")
}
