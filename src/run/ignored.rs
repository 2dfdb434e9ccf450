//! Things that a run ignores: the pixels of the texts of `--ignore` become masks of the photos
//! before their cameras are estimated (docs/internals/method.md#ignored-things).
use super::ask;
use super::config::{LanguageConfig, ReconstructionConfig};
use super::sources::{self, FeatureSources, GraphBuilder, MaskSources, PosedPhotos};
use super::stages::{FindByNetwork, FindByWords, GivenGeometry, GivenPhotos};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::infer::installed::{Installed, Task, inventory};
use crate::photo::{Photo, SMALLEST_SIDE};
use crate::pipeline::Store;
use crate::progress::{Progress, Recorded};
use crate::query::{TextQuery, phrasing};
use crate::report::Figure;
use crate::scene::{Coverage, Image, Outside};
use crate::{Error, Result, files};
use serde::Serialize;

/// Width of the rim around a found thing that is ignored as well, as a share of the photo's longer
/// side: edges of regions are off by a few pixels, and a contact shadow moves with its thing.
const RIM: f64 = 1.0 / 128.0;

/// Share of a photo that is left, below which a warning names it.
const LITTLE: f64 = 0.25;

/// Advice where no masks are made.
const WAY_OUT: &str =
    "give masks (--photo-masks DIR) or install a network that finds it (splatvk models fetch sam3)";

/// A text that was ignored.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Ignored {
    /// The text.
    pub text: String,
    /// Source of its masks: the name of a network, or the sources of masks and features.
    pub by: String,
    /// The photos in which it was found.
    pub photos: Vec<IgnoredPart>,
    /// Number of all photos.
    pub of: usize,
}

/// Part of a photo that is ignored.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct IgnoredPart {
    /// Stem of the photo.
    pub photo: String,
    /// Share of the pixels, with the rim, in (0, 1].
    pub share: f64,
}

impl Ignored {
    /// The finding in a line: "ignored in 3 of 4 photos, 2–9 % of the picture".
    pub fn sentence(&self) -> String {
        let shares = || self.photos.iter().map(|p| 100.0 * p.share);
        if self.photos.is_empty() {
            return format!("found in 0 of {} photos; nothing is ignored", self.of);
        }
        let (least, most) = (shares().fold(f64::INFINITY, f64::min), shares().fold(0.0, f64::max));
        let range = match (percent(least), percent(most)) {
            (least, most) if least == most => most,
            (least, most) => format!("{least}–{most}"),
        };
        format!("ignored in {} of {} photos, {range} % of the picture", self.photos.len(), self.of)
    }
}

fn percent(share: f64) -> String {
    if share < 1.0 { format!("{share:.1}") } else { format!("{share:.0}") }
}

/// Line of the report about ignored things.
pub(super) fn figure(ignored: &[Ignored]) -> Option<Figure> {
    let each: Vec<String> = ignored.iter().map(|i| format!("{}: {}", i.text, i.sentence())).collect();
    let meaning =
        "Things that --ignore took out of the photos, as a mask does. The pictures of cameras show where.";
    (!each.is_empty()).then(|| Figure::that_matters("ignored", each.join("; "), meaning))
}

/// Networks that find the ignored things.
///
/// # Errors
/// A network that is not installed.
pub(super) fn networks(config: &ReconstructionConfig, registry: &Registry) -> Result<Vec<Installed>> {
    if config.training.ignore.is_empty() {
        return Ok(Vec::new());
    }
    if let Some(network) = concepts(registry) {
        return Ok(vec![network]);
    }
    let language = language(config, registry)?;
    let masks = sources::installed::<MaskSources>(&language.masks, registry)?;
    let features = sources::installed::<FeatureSources>(&language.features, registry)?;
    Ok([masks, features].into_iter().flatten().collect())
}

/// The best installed concept network.
fn concepts(registry: &Registry) -> Option<Installed> {
    let name = inventory(registry).best(Task::Concepts)?.name.clone();
    registry.installed(Task::Concepts, &name).ok()
}

/// Masks and features of the configuration; without language, the best that are installed.
fn language(config: &ReconstructionConfig, registry: &Registry) -> Result<LanguageConfig> {
    if let Some(language) = &config.language {
        return Ok(language.clone());
    }
    let installed = inventory(registry);
    Ok(LanguageConfig {
        masks: sources::choose::<MaskSources>("auto", &installed)?,
        features: sources::choose::<FeatureSources>("auto", &installed)?,
        ..LanguageConfig::default()
    })
}

/// Finds the texts of a configuration in the photos and takes their pixels out of use.
///
/// # Errors
/// A text that the words do not know, and a photo of which hardly anything is left.
pub(super) fn apply(
    config: &ReconstructionConfig,
    photos: &mut [Photo],
    device: &Device,
    registry: &Registry,
    store: &Store,
    progress: &Recorded,
) -> Result<Vec<Ignored>> {
    let texts = &config.training.ignore;
    if texts.is_empty() || photos.is_empty() {
        return Ok(Vec::new());
    }
    let (found, by) = find(config, photos, device, registry, store, progress)?;
    let mut all = Vec::with_capacity(texts.len());
    let mut hidden: Vec<Option<Image<bool>>> = vec![None; photos.len()];
    for (text, masks) in texts.iter().zip(found) {
        let mut ignored =
            Ignored { text: text.clone(), by: by.clone(), photos: Vec::new(), of: photos.len() };
        for ((photo, mask), hidden) in photos.iter().zip(masks).zip(&mut hidden) {
            if !mask.data.contains(&true) {
                continue;
            }
            let mask = with_rim(&mask);
            let share = mask.data.iter().filter(|m| **m).count() as f64 / mask.data.len() as f64;
            ignored.photos.push(IgnoredPart { photo: photo.stem.clone(), share });
            join(hidden, mask);
        }
        let line = format!("--ignore {text}: {}", ignored.sentence());
        match ignored.photos.is_empty() {
            true => progress.warn(&format!("{line}. If it is there, {WAY_OUT}")),
            false => progress.inform(&line),
        }
        all.push(ignored);
    }
    hide(photos, hidden, progress)?;
    Ok(all)
}

/// Per text and photo its pixels, and their source.
fn find(
    config: &ReconstructionConfig,
    photos: &[Photo],
    device: &Device,
    registry: &Registry,
    store: &Store,
    progress: &Recorded,
) -> Result<(Vec<Vec<Image<bool>>>, String)> {
    let language = language(config, registry)?;
    let config = ReconstructionConfig { language: Some(language.clone()), ..config.clone() };
    let mut build = GraphBuilder::new(&config, config.preset_on(device), registry);
    let network = concepts(registry);
    let queries = match &network {
        Some(_) => Vec::new(),
        // Before the networks look at the photos.
        None => known(&config, &language, registry)?,
    };
    let placed = build.graph.add(GivenPhotos::unplaced(photos.to_vec()), ());
    let (found, by) = match network {
        Some(network) => {
            let by = network.name.clone();
            (build.graph.add(FindByNetwork::new(network, &config.training.ignore)?, (placed,)), by)
        }
        None => {
            let geometry = build.graph.add(GivenGeometry, (placed,));
            let photos = PosedPhotos { placed, geometry };
            let masks = sources::make::<MaskSources>(&language.masks, registry, (&mut build, photos))?;
            let encoder = sources::make::<FeatureSources>(&language.features, registry, registry)?;
            let regions = super::stages::RegionFeatures { encoder: encoder.clone() };
            let regions = build.graph.add(regions, (placed, masks));
            let by = format!("{} masks, {}", language.masks, language.features);
            (build.graph.add(FindByWords { encoder, queries }, (regions,)), by)
        }
    };
    let mut made = build.graph.run(&[found.target()], device, registry, store, progress)?;
    Ok((made.take(found)?, by))
}

/// The texts as queries.
///
/// # Errors
/// A text that the words do not know.
fn known(
    config: &ReconstructionConfig,
    language: &LanguageConfig,
    registry: &Registry,
) -> Result<Vec<TextQuery>> {
    let texts = &config.training.ignore;
    let mut encoder = sources::encoder(&language.features, registry)?;
    let queries = ask::queries(texts, encoder.as_mut(), false)?;
    let unknown: Vec<&str> =
        queries.iter().filter(|q| q.reading.is_unknown()).map(|q| q.text.as_str()).collect();
    match unknown.is_empty() {
        true => Ok(queries),
        false => Err(Error::input(format!(
            "--ignore {}: the built-in words do not know it; name a common thing, {WAY_OUT}",
            files::listed(&unknown)
        ))),
    }
}

/// Refuses texts that name nothing.
pub(super) fn check(texts: &[String]) -> Result<()> {
    texts
        .iter()
        .try_for_each(|text| phrasing::check(text).map_err(|e| Error::input(format!("--ignore: {e}"))))
}

fn join(all: &mut Option<Image<bool>>, more: Image<bool>) {
    match all {
        None => *all = Some(more),
        Some(all) => all.data.iter_mut().zip(more.data).for_each(|(a, m)| *a |= m),
    }
}

/// The mask with a rim of [`RIM`].
fn with_rim(mask: &Image<bool>) -> Image<bool> {
    let (w, h) = (mask.width, mask.height);
    let radius = (RIM * w.max(h) as f64).ceil() as isize;
    let mut grown = mask.clone();
    let at = |x: isize, y: isize| {
        (0..w as isize).contains(&x) && (0..h as isize).contains(&y) && mask.data[y as usize * w + x as usize]
    };
    let half = |dy: isize| ((radius * radius - dy * dy) as f64).sqrt() as isize;
    let halves: Vec<(isize, isize)> = (-radius..=radius).map(|dy| (dy, half(dy))).collect();
    for p in (0..mask.data.len()).filter(|p| mask.data[*p]) {
        let (x, y) = ((p % w) as isize, (p / w) as isize);
        if [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(dx, dy)| at(x + dx, y + dy)) {
            continue;
        }
        for (dy, half) in halves.iter().filter(|(dy, _)| (0..h as isize).contains(&(y + dy))) {
            let row = (y + dy) as usize * w;
            let (from, to) = ((x - half).max(0) as usize, ((x + half) as usize).min(w - 1));
            grown.data[row + from..=row + to].fill(true);
        }
    }
    grown
}

/// Takes pixels out of use, beside those that masks of the photos already exclude.
fn hide(photos: &mut [Photo], hidden: Vec<Option<Image<bool>>>, progress: &dyn Progress) -> Result<()> {
    if hidden.iter().all(Option::is_none) {
        return Ok(());
    }
    let is_empty = |p: &Photo| p.coverage.as_ref().is_some_and(|c| c.outside == Outside::Empty);
    if photos.iter().any(is_empty) {
        progress.warn("transparent parts are not used, since --ignore makes masks");
        photos.iter_mut().flat_map(|p| &mut p.coverage).for_each(|c| c.outside = Outside::Unknown);
    }
    for (photo, hidden) in photos.iter_mut().zip(hidden) {
        let Some(hidden) = hidden else { continue };
        hide_in(photo, &hidden);
        let (used, all) = ((0..hidden.data.len()).filter(|i| photo.uses(*i)).count(), hidden.data.len());
        if used < SMALLEST_SIDE * SMALLEST_SIDE / 4 {
            return Err(Error::input(format!(
                "{}: --ignore leaves {used} of {all} pixels; leave the photo out, or give masks instead (--photo-masks DIR)",
                photo.path.display()
            )));
        }
        if (used as f64) < LITTLE * all as f64 {
            progress.warn(&format!(
                "{}: --ignore and masks leave {} % of the picture; its camera may not be found",
                photo.stem,
                percent(100.0 * used as f64 / all as f64)
            ));
        }
    }
    Ok(())
}

/// Unused pixels continue the used ones, so that no edge of the thing is left in the picture.
fn hide_in(photo: &mut Photo, hidden: &Image<bool>) {
    let coverage = Coverage::without(photo.coverage.as_ref(), hidden);
    photo.image.fill_from_used(|i| coverage.uses(i));
    let (w, h) = (hidden.width, hidden.height);
    if let Some(fine) = &photo.fine {
        let (mut filled, luma) = (fine.as_ref().clone(), photo.image.luma());
        let scaled = |v: usize, from: usize, to: usize| (2 * v + 1) * to / (2 * from);
        let width = filled.width;
        for p in 0..filled.data.len() {
            let (x, y) = (scaled(p % width, width, w), scaled(p / width, filled.height, h));
            if hidden.at(x, y) {
                filled.data[p] = luma.at(x, y);
            }
        }
        photo.fine = Some(std::sync::Arc::new(filled));
    }
    photo.coverage = Some(coverage);
    photo.masked = true;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photo::from_used_pixels;
    use crate::progress::Silent;
    use crate::scene::RgbImage;

    fn ignored(shares: &[f64]) -> Ignored {
        let part = |share: &f64| IgnoredPart { photo: "a".into(), share: *share };
        Ignored { text: "car".into(), by: "words".into(), photos: shares.iter().map(part).collect(), of: 4 }
    }

    #[test]
    fn sentence_states_photos_and_shares() {
        for (shares, sentence) in [
            (&[0.021, 0.05, 0.094][..], "ignored in 3 of 4 photos, 2–9 % of the picture"),
            (&[0.02, 0.0204], "ignored in 2 of 4 photos, 2 % of the picture"),
            (&[0.004], "ignored in 1 of 4 photos, 0.4 % of the picture"),
            (&[], "found in 0 of 4 photos; nothing is ignored"),
        ] {
            assert_eq!(ignored(shares).sentence(), sentence);
        }
    }

    fn plane(size: usize, of: impl Fn(usize, usize) -> bool) -> Image<bool> {
        let data = (0..size * size).map(|p| of(p % size, p / size)).collect();
        Image { width: size, height: size, data }
    }

    #[test]
    fn rim_is_a_disc_around_every_pixel() {
        // 256 / 128 = 2 pixels.
        let grown = with_rim(&plane(256, |x, y| (x, y) == (50, 60) || (x, y) == (0, 0)));
        let near =
            |x: usize, y: usize, cx: usize, cy: usize| x.abs_diff(cx).pow(2) + y.abs_diff(cy).pow(2) <= 4;
        assert_eq!(grown, plane(256, |x, y| near(x, y, 50, 60) || near(x, y, 0, 0)));
        let block = plane(256, |x, y| (40..90).contains(&x) && (100..256).contains(&y));
        let (inside, grown) = (block.data.iter().filter(|m| **m).count(), with_rim(&block));
        assert!(grown.at(64, 200) && grown.at(38, 200) && !grown.at(37, 200) && grown.at(64, 98), "{inside}");
    }

    #[test]
    fn hidden_pixels_join_masks_and_lose_their_colour() {
        let image = RgbImage {
            width: 64,
            height: 64,
            data: (0..64 * 64).map(|p| if p % 64 < 32 { [0.2; 3] } else { [0.9, 0.0, 0.0] }).collect(),
        };
        let used = plane(64, |_, y| y >= 8);
        let photo = || from_used_pixels("a.png".as_ref(), &image, &used, None, 64).unwrap();
        let mut photos = [photo(), photo()];
        hide(&mut photos, vec![Some(plane(64, |x, _| x >= 32)), None], &Silent).unwrap();
        assert_eq!(
            [(10, 4), (10, 20), (40, 20)].map(|(x, y)| photos[0].uses(y * 64 + x)),
            [false, true, false]
        );
        assert!(photos[1].uses(20 * 64 + 40) && !photos[1].uses(4 * 64 + 40));
        let left = photos[0].image.at(40, 20);
        assert!(left.iter().all(|v| (v - 0.2).abs() < 0.02), "{left:?}");
        let all = hide(&mut photos, vec![None, Some(plane(64, |x, y| x + y > 2))], &Silent).unwrap_err();
        assert!(all.exit_code() == 2 && all.to_string().contains("leave the photo out"), "{all}");
    }

    #[test]
    fn transparency_becomes_a_mask_beside_ignored_things() {
        let image = RgbImage { width: 64, height: 64, data: vec![[0.4; 3]; 64 * 64] };
        let photo =
            || from_used_pixels("a.png".as_ref(), &image, &plane(64, |x, _| x > 9), None, 64).unwrap();
        let mut photos = [photo(), photo()];
        photos.iter_mut().flat_map(|p| &mut p.coverage).for_each(|c| c.outside = Outside::Empty);
        let progress = Recorded::new(&Silent);
        hide(&mut photos, vec![Some(plane(64, |_, y| y > 40)), None], &progress).unwrap();
        assert!(photos.iter().flat_map(|p| &p.coverage).all(|c| c.outside == Outside::Unknown));
        assert_eq!(progress.warnings().len(), 1);
    }
}
