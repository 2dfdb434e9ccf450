//! `splatvk measure`: lengths in a scene, and its scale.
use super::args::EditUse;
use super::print::{print, print_json};
use super::scene;
use crate::format::scene_dir;
use crate::run::metric::{self, Length, Measured};
use crate::scene::{Scale, World};
use crate::{Error, Result};
use clap::Args;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::PathBuf;

/// `splatvk measure`
#[derive(Debug, Args)]
pub struct MeasureArgs {
    /// Scene directory
    pub scene: PathBuf,
    /// Lengths to measure, "A - B": A and B are x,y,z of the scene, or VIEW:x,y in pixels of
    /// cameras/images; one that begins with a minus goes behind --
    #[arg(value_name = "LENGTH")]
    pub lengths: Vec<Length>,
    /// Give the scene its scale by a length that is known, in metres (or with cm, mm); more than
    /// one may be given
    #[arg(long, value_name = "A-B=0.21", allow_hyphen_values = true)]
    pub scale: Vec<Length>,
    /// Device, for places given in pixels
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Edits
    #[command(flatten)]
    pub edits: EditUse,
    /// Print one JSON object on standard output
    #[arg(long)]
    pub json: bool,
}

pub fn measure(args: &MeasureArgs) -> Result<()> {
    if args.lengths.is_empty() && args.scale.is_empty() {
        return Err(Error::input("measure: give a length, \"A - B\", or --scale \"A - B = METRES\""));
    }
    if let Some(bare) = args.scale.iter().find(|l| l.metres.is_none()) {
        return Err(Error::input(format!("--scale \"{}\": give its length, \"A - B = METRES\"", bare.text)));
    }
    let scene = scene::load(&args.scene, args.edits)?;
    if scene.cameras.is_empty() {
        return Err(Error::input(format!(
            "{}: a file of Gaussians has no place for a scale; give a scene directory",
            args.scene.display()
        )));
    }
    let all: Vec<Length> = args.scale.iter().chain(&args.lengths).cloned().collect();
    let measured = metric::measure(&scene, &all, args.device.as_deref())?;
    let stated = metric::scale(&args.scale, &measured[..args.scale.len()]);
    let world = World { scale: stated.clone().or(scene.world.scale), ..scene.world };
    if stated.is_some() {
        scene_dir::write_world(&args.scene, &world)?;
    }
    let scale = world.scale.as_ref();
    if args.json {
        let lengths: Vec<Value> = all.iter().zip(&measured).map(|(l, m)| to_json(l, m, scale)).collect();
        return print_json(&json!({ "scene": args.scene, "scale": scale, "lengths": lengths }));
    }
    print(&table(&all, &measured, scale))
}

/// Length in metres and its σ, from the σ of the length and of the scale.
fn in_metres(m: &Measured, scale: &Scale) -> (f64, f64) {
    let metres = m.units * scale.metres_per_unit;
    (metres, metres * (m.sigma / m.units).hypot(scale.log_sigma))
}

fn to_json(length: &Length, m: &Measured, scale: Option<&Scale>) -> Value {
    let metres = scale.map(|s| in_metres(m, s));
    json!({
        "length": length.text, "from": m.ends[0].to_array(), "to": m.ends[1].to_array(), "units": m.units,
        "metres": metres.map(|v| v.0), "sigma_metres": metres.map(|v| v.1), "stated_metres": length.metres,
    })
}

fn table(lengths: &[Length], measured: &[Measured], scale: Option<&Scale>) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    for (length, m) in lengths.iter().zip(measured) {
        let _ = match scale.map(|s| in_metres(m, s)) {
            Some((metres, sigma)) => writeln!(text, "{metres:.4} m ± {sigma:.4}  {}", length.text),
            None => writeln!(text, "{:.4} units  {}", m.units, length.text),
        };
    }
    let _ = match scale {
        Some(s) => writeln!(text, "one unit is {:.5} m ± {:.1} %", s.metres_per_unit, 100.0 * s.log_sigma),
        None => writeln!(text, "the scale is not known; state a length with --scale \"A - B = METRES\""),
    };
    text
}
