//! Language for splats of any program.
use super::boundary::{self, CallError, bad_argument, guard};
use super::context::SvkContext;
use super::options::*;
use super::progress::Callback;
use super::scene::SvkScene;
use super::train::source;
use super::types::SvkStatus;
use crate::infer::installed::inventory;
use crate::photo;
use crate::run::config::MASK_POINTS;
use crate::run::live::LiveScene;
use crate::run::sources::{FeatureSources, MaskSources};
use crate::run::{self, Destination, Inputs, LanguageConfig, RunPlan};
use std::ffi::c_char;
use std::path::PathBuf;

/// Most views in free space.
const MOST_SYNTHESIZED: u32 = 200;
/// Most points along a side of a picture.
const MOST_POINTS: u32 = 128;

/// Gives the splats of a file of Gaussians of any trainer, or of a scene directory, language; no
/// number of a splat changes. `options` may be NULL. On failure, and when the callback stops it,
/// `*scene` is NULL, nothing is written, and the context keeps the error text. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_label(
    context: *mut SvkContext,
    path: *const c_char,
    options: *const SvkLabelOptions,
    scene: *mut *mut SvkScene,
) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(context) = (unsafe { boundary::handle(context, "context") }) else { return SvkStatus::Argument };
    guard(&context.error, || {
        // SAFETY: per the header.
        unsafe {
            let slot = boundary::slot(scene)?;
            let Some(path) = boundary::path(path, "path")? else { return bad_argument("the path is null") };
            let options = boundary::read_or_default(options)?;
            let plan = plan(context, path, &options)?;
            let progress = Callback::new(options.progress, options.user);
            let outcome = run::run(&plan, &progress)?;
            *slot = SvkScene::boxed(LiveScene::trained(&context.device, outcome, &context.registry)?);
        }
        Ok(())
    })
}

/// Plan of the options.
unsafe fn plan(context: &SvkContext, splats: PathBuf, o: &SvkLabelOptions) -> Result<RunPlan, CallError> {
    // SAFETY: texts per the header.
    let text = |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkLabelOptions.{field}")) };
    let path = |pointer, field: &str| Ok::<_, CallError>(text(pointer, field)?.map(PathBuf::from));
    let count = |n: u32| (n > 0).then_some(n as usize);
    let (images, cameras) = (path(o.images, "images")?, path(o.cameras, "cameras")?);
    let refuse = |field: &str, why: &str| bad_argument(format!("SvkLabelOptions.{field}: {why}"));
    if cameras.is_none() && images.is_some() {
        return refuse("images", "photos need their cameras; set `cameras`");
    }
    if cameras.is_none() && o.views > 0 {
        return refuse("views", "chooses among photos or cameras; set `cameras`, or `synthesize` instead");
    }
    if cameras.is_some() && o.synthesize > 0 {
        return refuse("synthesize", "places cameras itself; leave it or `cameras` out");
    }
    if o.views == 1 {
        return refuse("views", "is 1; at least 2 are needed");
    }
    if o.synthesize > MOST_SYNTHESIZED {
        return refuse("synthesize", &format!("is {}; at most {MOST_SYNTHESIZED}", o.synthesize));
    }
    if o.mask_points > MOST_POINTS {
        return refuse("mask_points", &format!("is {}; at most {MOST_POINTS}", o.mask_points));
    }
    if o.max_size > 0 && o.max_size < photo::SMALLEST_SIDE as u64 {
        return refuse("max_size", &format!("is {}; at least {}", o.max_size, photo::SMALLEST_SIDE));
    }
    let language = LanguageConfig {
        masks: source::<MaskSources>(text(o.mask_source, "mask_source")?, None)?,
        features: source::<FeatureSources>(text(o.feature_source, "feature_source")?, None)?,
        mask_points: count(o.mask_points).unwrap_or(MASK_POINTS),
        no_mask_crops: o.no_mask_crops != 0,
        ..LanguageConfig::default()
    };
    let max_size = usize::try_from(o.max_size).ok().filter(|n| *n > 0);
    let config = run::label::config(cameras, max_size, language);
    Ok(RunPlan {
        inputs: Inputs {
            photos: images.into_iter().collect(),
            views: count(o.views),
            photo_masks: path(o.photo_masks, "photo_masks")?,
            splats: Some(splats),
            synthesize: count(o.synthesize),
            ..Inputs::default()
        },
        config: config.resolved(&inventory(&context.registry))?,
        machine: context.machine(),
        output: Destination {
            out: path(o.out, "out")?.unwrap_or_default(),
            force: o.replace != 0,
            ..Destination::default()
        },
    })
}
