//! `splatlab curve`
use super::args::{CurveArgs, LayoutArg};
use super::study::data_sets;
use crate::Result;
use crate::curve::{self, Curve, Plan, Point, Variant};
use serde_json::json;
use splatvk::cli::print::{print, print_json};
use splatvk::cli::progress;
use splatvk::format::write_json;
use splatvk::gpu;
use splatvk::run::outputs::WrittenFile;

pub fn curve(args: &CurveArgs) -> Result<()> {
    let registry = args.device.registry()?;
    let plan = plan(args);
    let sets = data_sets(&args.data, LayoutArg::Own)?;
    let out = args.out.as_deref().map(|file| WrittenFile::open(file, args.force, &[])).transpose()?;
    let device = gpu::open(args.device.device.as_deref())?;
    let progress = progress::reporter();
    let mut curves: Vec<Curve> = Vec::new();
    for set in sets {
        let mut keep = |curve: Curve| {
            if !args.device.json {
                print(&table(&curve))?;
            }
            curves.push(curve);
            Ok(())
        };
        curve::measure(&plan, set, (&device, &registry), progress.as_ref(), &mut keep)?;
    }
    let report = json!({
        "program": format!("splatvk {}", env!("CARGO_PKG_VERSION")), "device": device.info().name,
        "preset": args.preset, "data": args.data, "seed": plan.seed, "curves": curves,
    });
    if let Some(out) = out {
        out.keep(|file| write_json(file, &report))?;
    }
    if args.device.json {
        return print_json(&report);
    }
    print(&means(&plan.variants, &curves))
}

fn plan(args: &CurveArgs) -> Plan {
    let variants = if args.variant.is_empty() { vec![Variant::preset()] } else { args.variant.clone() };
    Plan {
        views: args.views,
        true_cameras: args.true_cameras,
        preset: args.preset,
        seed: args.seed,
        variants,
        points: args.points,
        words: args.words,
        inputs: args.inputs.clone(),
    }
}

const HEADER: &str = "   step  training/s  in all/s   splats  held out  beside  photos  depth/%   mIoU\n";

fn table(Curve { data, variant, points }: &Curve) -> String {
    let rows: String = points.iter().map(row).collect();
    format!("\n{data}, {variant}\n{HEADER}{rows}")
}

fn row(p: &Point) -> String {
    let figure = |value: Option<f64>, digits: usize| value.map_or("–".into(), |v| format!("{v:.digits$}"));
    format!(
        "{:>7}  {:>10.1}  {:>8.1}  {:>7}  {:>8}  {:>6}  {:>6}  {:>7}  {:>5}\n",
        p.step,
        p.seconds,
        p.whole,
        p.splats,
        figure(p.held_out, 2),
        figure(p.beside, 2),
        figure(p.photos, 2),
        figure(p.depth.map(|d| 100.0 * d), 2),
        figure(p.miou, 3),
    )
}

/// Ends of the curves, averaged over the data sets.
fn means(variants: &[Variant], curves: &[Curve]) -> String {
    let mut text = format!("\nmeans of the ends\n{HEADER}");
    for variant in variants {
        let ends: Vec<&Point> =
            curves.iter().filter(|c| c.variant == variant.name).filter_map(|c| c.points.last()).collect();
        let Some(mean) = curve::mean(&ends) else { continue };
        text += &format!("{}    {}\n", row(&mean).trim_end(), variant.name);
    }
    text
}
