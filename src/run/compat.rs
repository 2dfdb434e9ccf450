//! `--compat`: choices of the paper, its authors' code and LangSplat that differ from this
//! program's defaults (docs/internals/method.md#differences-from-the-paper). Each switch is a field
//! here and a row of the table there.
use super::method::Recipe;
use crate::fit::FeatureStorage;
use crate::language::Reducer;
use crate::language::align::{AlignOptions, AreaScore};
use crate::query::{MaskRule, QueryOptions};
use crate::{Error, Result, files};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::io::ErrorKind;
use std::path::Path;

/// A set of switches.
#[derive(Debug, PartialEq)]
pub struct Compat {
    /// Name on the command line.
    pub name: &'static str,
    /// Description in one line.
    pub about: &'static str,
    /// Scores, thresholds and conditions of the alignment.
    pub align: AlignOptions,
    /// Paint masks of a network in its output order, not larger ones first.
    pub paint_in_order: bool,
    /// Length of the codes.
    pub feature_dim: usize,
    /// One model per level.
    pub per_level: bool,
    /// Level, mask and location of answers.
    pub mask: MaskRule,
}

impl Serialize for Compat {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

impl<'de> Deserialize<'de> for &'static Compat {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> std::result::Result<Self, D::Error> {
        let name = String::deserialize(from)?;
        let found = Compat::named(&name).map_err(serde::de::Error::custom)?;
        found.ok_or_else(|| serde::de::Error::custom("no compat is null"))
    }
}

/// Choices that the text of the paper states; a condition that it does not state is off.
pub const PAPER: Compat = Compat {
    name: "paper",
    about: "as the paper states it",
    align: AlignOptions {
        tau1: 0.5,
        tau2: 0.5,
        lambda: 0.3,
        area: AreaScore::Paper,
        containment: 0.0,
        fusion_cover: 0.0,
        background_share: 1.0,
        votes: false,
        ranked: false,
        ..AlignOptions::DEFAULT
    },
    paint_in_order: false,
    feature_dim: 3,
    per_level: true,
    mask: MaskRule::Lerf(0.6),
};

/// Choices of the authors' code with its own defaults. Its step 2 requires a score above 2 τ₁ = 1,
/// which no pair reaches.
pub const AUTHORS: Compat = Compat {
    name: "authors",
    about: "as the code that the paper's authors published does it",
    align: AlignOptions { area: AreaScore::SamePlace, fusion: false, mutual: false, ..PAPER.align },
    paint_in_order: true,
    ..PAPER
};

/// Masks, codes and answers of LangSplat. It has no alignment, so this program's stays.
pub const LANGSPLAT: Compat = Compat {
    name: "langsplat",
    about: "masks, codes and answers as in LangSplat",
    align: AlignOptions::DEFAULT,
    paint_in_order: true,
    mask: MaskRule::Lerf(0.4),
    ..PAPER
};

/// Values of `--compat`.
pub static COMPATS: [&Compat; 3] = [&PAPER, &AUTHORS, &LANGSPLAT];

/// Value of `--compat` for this program's own choices in a scene that was made with another one.
pub const NONE: &str = "none";

impl Compat {
    /// Finds a set by name; `None` for [`NONE`].
    pub fn named(name: &str) -> Result<Option<&'static Compat>> {
        if name == NONE {
            return Ok(None);
        }
        COMPATS.iter().find(|c| c.name == name).map(|c| Some(*c)).ok_or_else(|| {
            let names: Vec<&str> = COMPATS.iter().map(|c| c.name).collect();
            Error::input(format!("--compat {name}: unknown; use one of: {}, {NONE}", names.join(", ")))
        })
    }

    /// Reads the set that a scene was made with; `None` also for files without a run record. An
    /// unreadable record is an error: the scene would answer in another way than it was made for.
    pub fn of_scene(scene: &Path) -> Result<Option<&'static Compat>> {
        let file = scene.join("run.json");
        let is_absent =
            |e: std::io::Error| matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory);
        if file.symlink_metadata().is_err_and(is_absent) {
            return Ok(None);
        }
        let remedy = "it says how the scene answers: restore it, or delete it to have answers in this program's own way";
        let damaged = |problem: &str| Error::input(format!("{}: {problem}; {remedy}", file.display()));
        let record: Value = files::read_json(&file, remedy)?;
        match record.get("config").map(|config| &config["plan"]["compat"]) {
            None => Err(damaged("no record of a run")),
            Some(Value::Null) => Ok(None),
            Some(Value::String(name)) => {
                Compat::named(name).map_err(|_| damaged(&format!("made with the unknown --compat {name:?}")))
            }
            Some(_) => Err(damaged("its \"compat\" is no text")),
        }
    }

    /// Query options of `asked`, or of the set that the scene was made with.
    pub fn answers(asked: Option<&str>, scene: &Path) -> Result<QueryOptions> {
        let compat = match asked {
            Some(name) => Compat::named(name)?,
            None => Compat::of_scene(scene)?,
        };
        Ok(query_options(compat))
    }
}

impl Compat {
    /// A recipe with the alignment, code length and storage of this set.
    pub fn recipe(&'static self, recipe: Recipe) -> Recipe {
        Recipe {
            feature_dim: feature_dim(Some(self), &recipe),
            align: self.align,
            storage: FeatureStorage::Numbers,
            ..recipe
        }
    }
}

/// Length of the codes. A baseline keeps that of its authors.
pub fn feature_dim(compat: Option<&Compat>, recipe: &Recipe) -> usize {
    let applicable = compat.filter(|_| recipe.reducer == Reducer::Bijection);
    applicable.map_or(recipe.feature_dim, |c| c.feature_dim)
}

/// Query options of a set.
pub fn query_options(compat: Option<&Compat>) -> QueryOptions {
    compat.map_or_else(QueryOptions::default, |c| QueryOptions {
        mask: c.mask,
        // Every text has a mask.
        abs_threshold: 0.0,
        published: true,
        ..QueryOptions::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn compat_refuses_unknown_names_with_choices() {
        for compat in COMPATS {
            assert_eq!(Compat::named(compat.name).unwrap(), Some(compat));
        }
        assert_eq!(Compat::named("none").unwrap(), None);
        let error = Compat::named("lerf").unwrap_err();
        assert!(
            error.exit_code() == 2 && error.to_string().contains("paper, authors, langsplat, none"),
            "{error}"
        );
    }

    #[test]
    fn answers_follow_record_unless_overridden() {
        let folder = tempfile::tempdir().unwrap();
        let mask_rule = |asked: Option<&str>| Compat::answers(asked, folder.path()).unwrap().mask;
        let ours = QueryOptions::default().mask;
        assert_eq!(mask_rule(None), ours, "a folder without run.json");
        let write_record = |compat: &str| {
            let text = format!("{{\"config\": {{\"plan\": {{{compat}}}}}}}");
            std::fs::write(folder.path().join("run.json"), text).unwrap();
        };
        write_record("");
        assert_eq!(mask_rule(None), ours, "a run of before");
        write_record("\"compat\": \"langsplat\"");
        assert_eq!(mask_rule(None), MaskRule::Lerf(0.4));
        assert_eq!((mask_rule(Some("paper")), mask_rule(Some("none"))), (MaskRule::Lerf(0.6), ours));
        for damaged in ["", "{\"config\"", "[]", "{}", "{\"config\":{\"plan\":{\"compat\":3}}}"] {
            std::fs::write(folder.path().join("run.json"), damaged).unwrap();
            let error = Compat::answers(None, folder.path()).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().contains("run.json: "), "{error}");
            assert_eq!(mask_rule(Some("paper")), MaskRule::Lerf(0.6), "it is not asked");
        }
        write_record("\"compat\": \"mine\"");
        let error = Compat::answers(None, folder.path()).unwrap_err().to_string();
        assert!(error.contains("unknown --compat \"mine\"; it says how"), "{error}");
        std::fs::remove_file(folder.path().join("run.json")).unwrap();
        std::fs::create_dir(folder.path().join("run.json")).unwrap();
        assert!(Compat::answers(None, folder.path()).unwrap_err().to_string().contains("is a folder"));
    }
}
