//! Edits of a scene directory: a list of operations on selected splats in `edits.json`. Readers of
//! the scene apply it ([`super::scene_dir::load`]); the files of the reconstruction never change.
mod apply;

use super::scene_dir::{self, Scene};
use super::{write_json, write_whole_file};
use crate::scene::{Camera, Splats};
use crate::{Error, Result, files};
pub use apply::AppliedEdits;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;
use std::path::Path;

/// The file in the scene directory.
pub const FILE: &str = "edits.json";
/// Version of the layout; readers refuse newer ones.
pub const VERSION: u32 = 1;
/// Format name in the file.
const FORMAT: &str = "splatvk-edits";
/// Advice for a file that cannot be read.
const ADVICE: &str = "restore it, or give --ignore-edits";

/// The edits of a scene, oldest first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditList {
    format: String,
    version: u32,
    /// Number of splats of the reconstruction.
    splats: usize,
    /// SHA-256 of their positions: the rows of a selection mean nothing in another reconstruction.
    positions: String,
    /// Operations that apply, in this order.
    pub edits: Vec<Edit>,
    /// Operations that were undone, the next one to redo last.
    pub undone: Vec<Edit>,
}

/// An operation on selected splats.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edit {
    /// Change of the selected splats.
    pub operation: Operation,
    /// How the splats were selected.
    pub selection: Vec<Term>,
    /// The selected splats.
    pub splats: Rows,
}

/// Change of selected splats.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Operation {
    /// Removes them.
    Delete {},
    /// Removes all others, and the backdrop.
    Isolate {},
    /// Gives them a colour and keeps their shading.
    Recolour {
        /// sRGB, 0 to 1.
        colour: [f32; 3],
    },
    /// Moves them.
    Move {
        /// Scene units along the scene's axes.
        by: [f64; 3],
    },
}

/// A part of a selection, and its combination with the parts before it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Term {
    /// Combination with the selection so far, which begins empty.
    #[serde(default)]
    pub combine: Combine,
    /// Rule of the part.
    pub pick: Pick,
}

/// Combination of two sets of splats.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Combine {
    /// Union.
    #[default]
    Add,
    /// Difference.
    Remove,
    /// Intersection.
    Intersect,
}

/// Rule that selects splats.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Pick {
    /// The answer to a text.
    Word {
        /// Word or phrase.
        text: String,
        /// −1 to 1: 0 is the answer of a query, above it less relevant codes join, below it only
        /// more relevant ones stay.
        #[serde(default)]
        grow: f32,
    },
    /// A thing of `splatvk objects`.
    Thing {
        /// Its id: `l3`, `l3.2`.
        id: String,
    },
    /// Splats by a property.
    Range {
        /// The property.
        property: Property,
        /// Smallest value, included.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        least: Option<f64>,
        /// Largest value, included.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        most: Option<f64>,
    },
    /// The thing that a pixel of a view shows.
    Click {
        /// The view.
        camera: Camera,
        /// Pixel position; the first pixel's centre is (0.5, 0.5).
        pixel: [f64; 2],
        /// Level, index as in [`crate::scene::LEVEL_NAMES`]; `None` = that of a click in the
        /// interactive view.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        level: Option<usize>,
    },
    /// Splats whose centres lie in an outline of a view: rectangle or lasso.
    Outline {
        /// The view.
        camera: Camera,
        /// Corners in pixels, at least three.
        polygon: Vec<[f64; 2]>,
        /// Whether splats behind the visible surface count, too.
        #[serde(default)]
        through: bool,
    },
    /// Splats that float in front of the surfaces ([floaters](docs/use/edit.md#floaters)).
    Floaters {
        /// Whether visible ones go, too.
        #[serde(default)]
        thorough: bool,
    },
}

/// Property of a splat.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Property {
    /// 0 to 1.
    Opacity,
    /// Longest half axis (one standard deviation), scene units.
    Size,
    /// Agreement of the photos on its code, 0 to 1.
    Reliability,
    /// Blending weight in the photos, pixels.
    Seen,
}

impl Property {
    /// Names, for messages and expressions.
    pub const ALL: [(&'static str, Property); 4] = [
        ("opacity", Property::Opacity),
        ("size", Property::Size),
        ("reliability", Property::Reliability),
        ("seen", Property::Seen),
    ];
}

/// A set of splats of the reconstruction; in JSON the base64 text of a bitmap: bit `i % 8` of byte
/// `i / 8` is splat `i`.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Rows(Vec<u8>);

impl fmt::Debug for Rows {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} splats below {}", self.count(), self.end())
    }
}

impl Rows {
    /// The set of these splats.
    pub fn of(rows: impl IntoIterator<Item = usize>) -> Rows {
        let mut bits = Vec::new();
        for row in rows {
            if bits.len() <= row / 8 {
                bits.resize(row / 8 + 1, 0);
            }
            bits[row / 8] |= 1 << (row % 8);
        }
        Rows(bits)
    }

    /// The set with another one.
    pub fn with(&self, other: &Rows) -> Rows {
        let (long, short) = if self.0.len() >= other.0.len() { (self, other) } else { (other, self) };
        let mut bits = long.0.clone();
        bits.iter_mut().zip(&short.0).for_each(|(byte, more)| *byte |= more);
        Rows(bits)
    }

    /// Whether a splat is in the set.
    pub fn has(&self, row: usize) -> bool {
        self.0.get(row / 8).is_some_and(|byte| byte >> (row % 8) & 1 == 1)
    }

    /// Number of splats.
    pub fn count(&self) -> usize {
        self.0.iter().map(|byte| byte.count_ones() as usize).sum()
    }

    /// One more than the last splat of the set.
    fn end(&self) -> usize {
        self.0
            .iter()
            .rposition(|byte| *byte != 0)
            .map_or(0, |at| 8 * at + 8 - self.0[at].leading_zeros() as usize)
    }
}

impl Serialize for Rows {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&STANDARD.encode(&self.0))
    }
}

impl<'de> Deserialize<'de> for Rows {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Rows, D::Error> {
        let text = String::deserialize(deserializer)?;
        STANDARD.decode(text).map(Rows).map_err(serde::de::Error::custom)
    }
}

impl EditList {
    /// No edits of a reconstruction.
    pub fn new(splats: &Splats) -> EditList {
        let (edits, undone) = (Vec::new(), Vec::new());
        EditList {
            format: FORMAT.into(),
            version: VERSION,
            splats: splats.len(),
            positions: positions(splats),
            edits,
            undone,
        }
    }

    /// The edits of a scene directory with the splats of its reconstruction; none without a file.
    ///
    /// # Errors
    /// A damaged file, one of a newer version, and one of another reconstruction.
    pub fn read(scene: &Path, splats: &Splats) -> Result<EditList> {
        let file = scene.join(FILE);
        if scene_dir::is_missing(&file) {
            return Ok(EditList::new(splats));
        }
        let list: EditList = files::read_json(&file, ADVICE)?;
        let refused = |why: String| Err(Error::input(format!("{}: {why}; {ADVICE}", file.display())));
        if list.format != FORMAT || list.version > VERSION {
            return refused(format!(
                "format {} version {}, and this program reads {FORMAT} up to version {VERSION}",
                list.format, list.version
            ));
        }
        if list.splats != splats.len() || list.positions != positions(splats) {
            return refused("edits another reconstruction than the one beside it".to_owned());
        }
        let all = list.edits.iter().chain(&list.undone);
        match all.map(|edit| edit.splats.end()).max() {
            Some(end) if end > list.splats => {
                refused(format!("selects splat {}, and the scene has {}", end - 1, list.splats))
            }
            _ => Ok(list),
        }
    }

    /// Writes the list into the directory of a scene where it follows `before`, whole or not at all.
    ///
    /// # Errors
    /// A folder that cannot be written, and a list there other than `before`: another program edits
    /// the scene.
    pub fn replace(&self, before: &EditList, scene: &Scene) -> Result<()> {
        write_whole_file(&scene.path.join(FILE), |file| match EditList::read(&scene.path, &scene.splats)? {
            found if found == *before => write_json(file, self),
            _ => Err(Error::input(format!(
                "{}: another program edited the scene meanwhile; nothing is changed, try again",
                scene.path.display()
            ))),
        })
    }

    /// Number of splats of the reconstruction.
    pub fn splats(&self) -> usize {
        self.splats
    }

    /// The scene after its edits; `scene` is the reconstruction.
    pub fn apply(&self, scene: Scene) -> Scene {
        apply::apply(scene, self)
    }

    /// Adds an edit; what was undone before can no longer be redone.
    pub fn push(&mut self, edit: Edit) {
        self.undone.clear();
        self.edits.push(edit);
    }

    /// Undoes the last edit; false without one.
    pub fn undo(&mut self) -> bool {
        let last = self.edits.pop();
        let is_undone = last.is_some();
        self.undone.extend(last);
        is_undone
    }

    /// Applies the edit that was undone last; false without one.
    pub fn redo(&mut self) -> bool {
        let last = self.undone.pop();
        let is_redone = last.is_some();
        self.edits.extend(last);
        is_redone
    }
}

/// SHA-256 of the positions of splats.
fn positions(splats: &Splats) -> String {
    files::sha256(bytemuck::cast_slice(&splats.means))
}

#[cfg(test)]
mod tests;
