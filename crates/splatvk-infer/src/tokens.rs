//! Texts as tokens of a text tower: padding, case and end mark as it was trained.
use std::path::PathBuf;

use tokenizers::{ModelWrapper, Tokenizer};

use super::adapter::TextSpec;
use super::contract::Part;
use super::graph::GraphFile;
use super::installed::Installed;
use crate::{Error, Result};

/// Size of CLIP's vocabulary, and the ids that CLIP's tokenizer gives for some texts (open_clip
/// 3.3, without start and end marks).
const VOCABULARY: usize = 49408;
const GOLDEN: [(&str, &[i64]); 12] = [
    ("lemon", &[7184]),
    ("a photo of a cat.", &[320, 1125, 539, 320, 2368, 269]),
    ("Blue MUG", &[1746, 9722]),
    ("café!", &[15304, 256]),
    ("it's 3 o'clock", &[585, 568, 274, 334, 262, 6716]),
    ("日本語", &[39121, 44353, 34002, 508]),
    ("naïve — “quoted”", &[1097, 35689, 563, 2005, 257, 27706, 257]),
    ("x²+y²=z²", &[343, 41175, 266, 344, 41175, 284, 345, 41175]),
    ("🙂 smile", &[14860, 3490]),
    ("&amp;amp; more", &[261, 750]),
    ("hello   world\n\tfoo", &[3306, 1002, 23435]),
    ("grandmother's vase, 1950s", &[17469, 568, 20431, 267, 272, 280, 276, 271, 338]),
];

/// The tokenizer beside a text tower, and the form of its texts.
pub(super) struct Tokens {
    tokenizer: Tokenizer,
    spec: TextSpec,
    /// L, the tokens of a text.
    context: usize,
}

impl Tokens {
    /// Loads the tokenizer of the graph `part` of a model, whose input is `tokens`. Refuses one of
    /// no known family, and one that does not give CLIP's ids for CLIP's vocabulary.
    pub(super) fn of(model: &Installed, part: Part) -> Result<Tokens> {
        let tower = model.graph(part)?;
        let tokenizer = tokenizer(model, tower)?;
        let spec = text_spec(&tokenizer, tower)?;
        let context = tower.fixed("tokens", "L").unwrap_or(spec.context).max(2);
        let tokens = Tokens { tokenizer, spec, context };
        tokens.check(tower)?;
        Ok(tokens)
    }

    /// Checks that a tokenizer with CLIP's vocabulary gives CLIP's ids; others are not checked.
    fn check(&self, tower: &GraphFile) -> Result<()> {
        if self.tokenizer.get_vocab_size(true) != VOCABULARY {
            return Ok(());
        }
        for (text, wanted) in GOLDEN {
            let ids = self.ids(text)?;
            if ids.len() < 2 || ids[1..ids.len() - 1] != *wanted {
                return Err(Error::missing_model(
                    tower.path.display(),
                    format!(
                        "{}: the tokenizer beside it does not give CLIP's tokens for {text:?} ({ids:?}); take tokenizer.json from \
                         the model's own page or from tools/export/export_clip.py",
                        tower.path.display()
                    ),
                ));
            }
        }
        Ok(())
    }

    /// Token ids of a text with its start and end marks, cut to the context with the end mark last.
    pub(super) fn ids(&self, text: &str) -> Result<Vec<i64>> {
        let encoded = self
            .tokenizer
            .encode(prepared(text, &self.spec), true)
            .map_err(|e| Error::input(format!("text {text:?}: {e}")))?;
        let mut ids: Vec<i64> = encoded.get_ids().iter().map(|id| i64::from(*id)).collect();
        if ids.len() > self.context {
            let end = ids.last().copied().unwrap_or_default();
            ids.truncate(self.context);
            ids[self.context - 1] = end;
        }
        Ok(ids)
    }

    /// [`Tokens::ids`] filled up to L, and their mask: 1 for tokens of the text, 0 for the rest.
    pub(super) fn padded(&self, text: &str) -> Result<(Vec<i64>, Vec<i64>)> {
        let mut ids = self.ids(text)?;
        let mask = (0..self.context).map(|k| i64::from(k < ids.len())).collect();
        ids.resize(self.context, self.spec.pad);
        Ok((ids, mask))
    }
}

fn tokenizer(model: &Installed, tower: &GraphFile) -> Result<Tokenizer> {
    let beside = tower.path.with_file_name("tokenizer.json");
    let places: [PathBuf; 2] = [beside, model.folder.join("tokenizer.json")];
    let file = places.iter().find(|p| p.is_file()).ok_or_else(|| {
        Error::missing_model(&model.name, format!(
            "{}: missing; tools/export/export_clip.py writes it, and Hugging Face has one beside every CLIP model",
            places[0].display()
        ))
    })?;
    let failed = |e: tokenizers::Error| {
        Error::missing_model(&model.name, format!("{}: not a tokenizer: {e}", file.display()))
    };
    let mut tokenizer = Tokenizer::from_file(file).map_err(failed)?;
    tokenizer.with_padding(None);
    tokenizer.with_truncation(None).map_err(failed)?;
    Ok(tokenizer)
}

/// Preparation of texts for a tokenizer. Padding, case and end mark are part of a text for some
/// towers, so that a tokenizer of no known family is refused.
fn text_spec(tokenizer: &Tokenizer, tower: &GraphFile) -> Result<TextSpec> {
    let vocabulary = tokenizer.get_vocab_size(true);
    // A word per id leaves nothing to get wrong.
    if matches!(tokenizer.get_model(), ModelWrapper::WordLevel(_)) {
        return Ok(TextSpec { vocabulary, context: 77, pad: 0, end: 0, lower: false, punctuation: true });
    }
    let refuse = |reason: String| {
        Err(Error::missing_model(tower.path.display(), format!("{}: {reason}", tower.path.display())))
    };
    let Some(spec) = tower.binding.texts.iter().find(|spec| spec.vocabulary == vocabulary) else {
        let known: Vec<String> = tower.binding.texts.iter().map(|s| s.vocabulary.to_string()).collect();
        return refuse(format!(
            "the tokenizer beside it has {vocabulary} tokens, and a {} text tower one of {}: its padding and case are not \
             known; state them as `texts` in adapter.toml (docs/use/models.md#adapters)",
            tower.binding.family,
            if known.is_empty() { "none that is known".to_owned() } else { known.join(" or ") }
        ));
    };
    let last = tokenizer.encode(prepared("a", spec), true).ok().and_then(|e| e.get_ids().last().copied());
    if last.map(i64::from) != Some(spec.end) {
        return refuse(format!(
            "the tokenizer beside it does not end a text with token {}, as the tower was trained; take tokenizer.json from the \
             model's own page",
            spec.end
        ));
    }
    Ok(*spec)
}

/// A text as the tower was trained on it, for the tokenizer.
fn prepared(text: &str, spec: &TextSpec) -> String {
    let mut text = cleaned(text);
    if spec.lower {
        text = text.to_lowercase();
    }
    if !spec.punctuation {
        text.retain(|c| !c.is_ascii_punctuation());
        text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    }
    text
}

/// Cleans a text as CLIP's tokenizer does before it splits words: straightens typographic quotes
/// (as ftfy) and resolves HTML entities twice. The tokenizer file handles case and white space.
fn cleaned(text: &str) -> String {
    let entities =
        [("&lt;", "<"), ("&gt;", ">"), ("&quot;", "\""), ("&#39;", "'"), ("&nbsp;", " "), ("&amp;", "&")];
    let resolve = |text: String| entities.iter().fold(text, |t, (from, to)| t.replace(from, to));
    resolve(resolve(text.chars().map(straight_quote).collect())).trim().to_string()
}

fn straight_quote(c: char) -> char {
    match c {
        '‘' | '’' | '‚' | '‛' => '\'',
        '“' | '”' | '„' | '‟' => '"',
        c => c,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_prepared_as_trained() {
        let clip = TextSpec { vocabulary: 9, context: 77, pad: 0, end: 1, lower: false, punctuation: true };
        let siglip = TextSpec { lower: true, punctuation: false, ..clip };
        assert_eq!(prepared("It’s a Blue  mug.", &clip), "It's a Blue  mug.");
        assert_eq!(prepared("It’s a Blue  mug.", &siglip), "its a blue mug");
    }

    #[test]
    fn cleaned_text_matches_clip() {
        let given = [" grandmother’s “vase” ", "&amp;amp; more", "a &lt;b&gt; c&#39;s"];
        assert_eq!(given.map(cleaned), ["grandmother's \"vase\"", "& more", "a <b> c's"]);
    }
}
