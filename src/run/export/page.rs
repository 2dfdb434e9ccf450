//! `--format html`: the interactive view of a scene as one file.
use super::{Asked, ExportPlan, Exported};
use crate::format::scene_dir::Scene;
use crate::format::views::Views;
use crate::report::thousands;
use crate::report::viewer::{CodeNames, Scene3d};
use crate::run::outputs::WrittenFile;
use crate::run::stored;
use crate::{Error, Result};
use serde_json::json;

/// Refuses options that a page has no use for.
pub(super) fn check(plan: &ExportPlan) -> Result<()> {
    if plan.asked != Asked::default() {
        return Err(Error::input(
            "--format html: a page opens upright and keeps the scene's coordinates; leave --up, --metres and --raw out",
        ));
    }
    Ok(())
}

/// Writes the page. It shows all splats of the scene that fit, and hides at a key those that no
/// photo shows.
pub(super) fn write(plan: &ExportPlan, scene: &Scene, file: WrittenFile) -> Result<Exported> {
    if scene.splats.is_empty() {
        return Err(Error::input(format!("{}: no splats to show", scene.path.display())));
    }
    let images = stored::photos(scene);
    let title = plan.title.clone().unwrap_or_else(|| stored::title(&scene.path));
    let names = CodeNames::new();
    let named = match &plan.views {
        Some(file) => Views::read(file)?,
        None => Views::of_scene(&scene.path)?,
    };
    let view = Scene3d { named, ..Scene3d::of(scene, &title, &images, &names) };
    let page = view.presented()?;
    file.keep(|path| std::fs::write(path, &page.html).map_err(Error::unwritable(path)))?;
    let up = scene.world.up.as_ref();
    let upright = match up {
        Some(up) => format!("opens upright (±{:.1}°)", up.sigma_degrees),
        None if scene.cameras.is_empty() => "opens along the axes of the file, which states no up".to_owned(),
        None => "opens as the photos were held (which way is up is not known)".to_owned(),
    };
    let metres = scene.world.scale.as_ref();
    let lengths = if metres.is_some() { "measures in metres" } else { "measures in the scene's own unit" };
    let (shown, total) = (thousands(page.shown), thousands(page.total));
    let megabytes = page.html.len() as f64 / 1e6;
    let text = format!("{upright}, {lengths}, {shown} of {total} splats, {megabytes:.1} MB");
    let json = json!({
        "up": up.map(|up| json!({ "axis": null, "sigma_degrees": up.sigma_degrees })),
        "metres": metres.map(|s| json!({ "metres_per_unit": s.metres_per_unit, "log_sigma": s.log_sigma })),
        "splats": page.shown, "left_out": page.total - page.shown, "title": title,
    });
    Ok(Exported::new(text, json))
}
