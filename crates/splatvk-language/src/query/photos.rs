//! Texts answered in single photos, before there is a scene: every region is a code of its own
//! (docs/internals/method.md#ignored-things).
use super::maps::CodeMaps;
use super::presence::{Background, Evidence, Presence, ShownCodes, ShownPixels};
use super::score::margin;
use super::{CanonicalCosines, QueryOptions, TextQuery, answer_all};
use crate::scene::{Codebook, Image, LanguageField, LevelField};
use crate::{Result, ViewMasks};
use std::sync::Arc;

/// Largest p-value, over all photos, of a text that is in them. The caller states that the thing is
/// there, so that the level is above that of found queries. On breakfast, room_a, castle, tower and
/// phone4 (tuning), 18 of 66 texts for things in the photos are at or below it, and 7 of 56 others.
const IN_PHOTOS: f32 = 0.1;

/// Least margin of a photo that shows the thing, as a share of the best margin of all photos. On
/// breakfast (tuning), photos of a lemon, a mug or a loaf reach 0.39 of it; without the regions of
/// the thing 0.17.
const LEAST_MARGIN: f32 = 0.35;

/// The regions of one photo on all levels.
pub struct PhotoRegions {
    field: LanguageField,
    maps: Arc<CodeMaps>,
    shown: ShownPixels,
}

/// A text in a set of photos.
#[derive(Clone, Debug)]
pub struct Named {
    /// Evidence that the photos show it; `None` without enough other things to compare with.
    pub evidence: Option<Evidence>,
    /// [H, W] pixels of its regions, one per photo; none set where a photo does not show it.
    pub masks: Vec<Image<bool>>,
}

impl PhotoRegions {
    /// The regions of a photo with their features.
    ///
    /// # Errors
    /// More regions on a level than a code map can number.
    pub fn new(masks: &ViewMasks, space: &str) -> Result<PhotoRegions> {
        let level = |count: usize, features: &[f32]| {
            let codebook = Codebook {
                embedding_dim: features.len() / count.max(1),
                embeddings: features.to_vec(),
                ..Codebook::default()
            };
            LevelField { codebook, ..LevelField::default() }
        };
        let levels = masks.levels.iter().map(|l| level(l.quality.len(), &l.features)).collect();
        let field = LanguageField { levels, space: space.to_owned() };
        let labels: Vec<Image<i32>> = masks.levels.iter().map(|l| l.labels.clone()).collect();
        let maps = Arc::new(CodeMaps::new(&labels)?);
        Ok(PhotoRegions { shown: ShownPixels::of(&field, [maps.as_ref()]), field, maps })
    }
}

/// A photo compared with a text.
struct Compared<'p> {
    regions: &'p PhotoRegions,
    cosines: CanonicalCosines,
    /// Per level and region.
    relevancy: Vec<Vec<f32>>,
    /// Best margin of a region.
    margin: f32,
}

impl<'p> Compared<'p> {
    fn new(regions: &'p PhotoRegions, query: &TextQuery, options: &QueryOptions) -> Result<Compared<'p>> {
        let cosines = CanonicalCosines::new(&regions.field, &query.canonicals);
        let relevancy = cosines.relevancy(&regions.field, query, options)?;
        let best = relevancy.iter().flatten().copied().fold(0.0, f32::max);
        Ok(Compared { regions, cosines, relevancy, margin: margin(best) })
    }

    fn shown(&self) -> ShownCodes<'_> {
        ShownCodes::new(&self.regions.shown, &self.regions.field, &self.cosines)
    }

    /// Mask of the text by the rule of queries, on the level that it chooses.
    fn mask(&self, options: &QueryOptions) -> Result<Image<bool>> {
        let maps = [self.regions.maps.clone()];
        let answer = answer_all(&maps, &self.relevancy, options, None)?.pop().filter(|a| a.found);
        Ok(answer.map_or_else(|| self.nothing(), |a| a.mask()))
    }

    fn nothing(&self) -> Image<bool> {
        Image::filled(self.regions.maps.width, self.regions.maps.height, false)
    }
}

/// Finds a text in photos. The presence test of queries decides for all photos together and for
/// each of them; the mask of a photo is that of a query.
///
/// # Errors
/// Embeddings of two spaces.
pub fn named(photos: &[PhotoRegions], query: &TextQuery, options: &QueryOptions) -> Result<Named> {
    let compared: Vec<Compared> =
        photos.iter().map(|p| Compared::new(p, query, options)).collect::<Result<_>>()?;
    let test = |shown: &ShownCodes| {
        let background: Background = shown.background(&query.alternatives.things);
        shown.evidence(&query.embedding, &query.alternatives, &background)
    };
    let all = compared.iter().map(Compared::shown).reduce(ShownCodes::joined).unwrap_or_default();
    let evidence = test(&all);
    let best = compared.iter().map(|c| c.margin).fold(f32::NEG_INFINITY, f32::max);
    let in_set = best > 0.0 && evidence.is_none_or(|e| e.p_value <= IN_PHOTOS);
    let mask = |photo: &Compared| {
        let shows = in_set
            && photo.margin >= LEAST_MARGIN * best
            && test(&photo.shown()).is_none_or(|e| e.presence != Presence::Absent);
        if shows { photo.mask(options) } else { Ok(photo.nothing()) }
    };
    Ok(Named { evidence, masks: compared.iter().map(mask).collect::<Result<_>>()? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LevelMasks;
    use crate::query::presence::{Alternatives, MIN_OTHERS};

    /// Length of the embeddings: the thing, something else, the canonical phrase, and other things.
    const DIM: usize = 3 + MIN_OTHERS;

    fn row(at: usize, cosine: f32) -> Vec<f32> {
        let mut row = vec![0.0; DIM];
        // A part of the rest is the canonical phrase's.
        row[2] = (1.0 - cosine * cosine).sqrt() * 0.2;
        row[at] = cosine;
        row
    }

    /// A photo of 8 × 1 pixels whose finest level has a region of four pixels with `left` and one
    /// with `right`; the next level joins them to one with `whole`.
    fn photo(left: Vec<f32>, right: Vec<f32>, whole: Vec<f32>) -> PhotoRegions {
        let level = |labels: [i32; 8], rows: Vec<Vec<f32>>| LevelMasks {
            labels: Image { width: 8, height: 1, data: labels.to_vec() },
            quality: vec![1.0; rows.len()],
            features: rows.concat(),
            ..LevelMasks::default()
        };
        let levels = vec![level([0, 0, 0, 0, 1, 1, 1, 1], vec![left, right]), level([0; 8], vec![whole])];
        PhotoRegions::new(&ViewMasks { levels }, "test").unwrap()
    }

    fn query(at: usize) -> TextQuery {
        let others: Vec<f32> = (3..DIM).flat_map(|k| row(k, 1.0)).collect();
        TextQuery {
            text: "thing".into(),
            embedding: row(at, 1.0),
            canonicals: row(2, 1.0),
            alternatives: Alternatives { things: Arc::new(others), ..Alternatives::default() },
            ..TextQuery::default()
        }
    }

    fn pixels(named: &Named) -> Vec<usize> {
        named.masks.iter().map(|m| m.data.iter().filter(|m| **m).count()).collect()
    }

    #[test]
    fn things_are_masked_where_photos_show_them() {
        let other = || row(1, 0.8);
        let photos = [
            // The part alone, the whole nearly as well as its part, weakly, and not at all.
            photo(row(0, 0.8), other(), row(0, 0.3)),
            photo(row(0, 0.8), other(), row(0, 0.78)),
            photo(row(0, 0.15), other(), other()),
            photo(other(), other(), other()),
        ];
        let options = QueryOptions::default();
        let found = named(&photos, &query(0), &options).unwrap();
        assert_eq!(pixels(&found), [4, 8, 0, 0]);
        assert!(found.masks[0].data[..4].iter().all(|m| *m), "{:?}", found.masks[0].data);
        assert!(found.evidence.is_some_and(|e| e.p_value < 0.05));
        assert_eq!(pixels(&named(&photos, &query(1), &options).unwrap()), [4, 4, 8, 8]);
    }

    #[test]
    fn absent_things_are_not_masked() {
        // Half of the other things fit the region better than the text.
        let mut rival = row(0, 0.3);
        rival[3..3 + MIN_OTHERS / 2].fill(0.4);
        let photos = [photo(rival.clone(), row(1, 0.8), rival)];
        let found = named(&photos, &query(0), &QueryOptions::default()).unwrap();
        assert_eq!(pixels(&found), [0]);
        assert!(found.evidence.is_some_and(|e| e.p_value > 0.3), "{:?}", found.evidence);
        // Without other things to compare with, the best region answers.
        let alone = TextQuery { alternatives: Alternatives::default(), ..query(0) };
        let found = named(&photos, &alone, &QueryOptions::default()).unwrap();
        assert!(found.evidence.is_none() && pixels(&found)[0] > 0);
    }
}
