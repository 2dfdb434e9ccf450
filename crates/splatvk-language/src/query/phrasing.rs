//! Detects words that the embedding of a short text cannot express: negations, places, and choices
//! among several. The answer is for the rest of the text, and a note states the words left out
//! (docs/internals/method.md#phrasing).
use crate::{Error, Result};
use serde::Serialize;

/// Largest number of characters in a question. A few words name a thing; text models read about 77
/// or 128 tokens.
pub const MOST_CHARACTERS: usize = 300;
/// Largest number of words in a question.
pub const MOST_WORDS: usize = 40;

/// Refuses a question that is empty or too long.
pub fn check(text: &str) -> Result<()> {
    if text.trim().is_empty() {
        return Err(Error::input("an empty query; give a few words"));
    }
    let (characters, words) = (text.chars().count(), text.split_whitespace().count());
    if characters <= MOST_CHARACTERS && words <= MOST_WORDS {
        return Ok(());
    }
    let start: String = text.chars().take(30).collect();
    Err(Error::input(format!(
        "“{start}…”: a question of {characters} characters and {words} words is too long; ask in at most \
         {MOST_CHARACTERS} characters and {MOST_WORDS} words"
    )))
}

/// Words that begin a negation.
const NEGATIONS: &str =
    "without|not|no|never|except|excluding|but|neither|nor|isn't|aren't|don't|doesn't|instead of|than";

/// Words that begin a place.
const PLACES: &str = "on|in|inside|outside|at|under|underneath|beneath|below|above|over|behind|beside|besides|near|between|among|\
    around|against|opposite|across|by the|next to|close to|in front of|on top of|left of|right of|to the left|to the right";

/// Words of [`PLACES`] that also begin names of things: "over ear headphones", "in line skates". At
/// the start of a text they begin a place only before an article.
const PARTICLES: &str = "on|in|inside|outside|at|under|above|over|across|around";

/// Words that form a name with the particle behind them: "carry on bag", "plug in", "pull over".
const VERBS: &str = "carry|clip|slip|roll|plug|built|walk|drive|sign|log|pull|all|two|add|stick|drop|push|step|strap|screw|snap|\
    tie|iron|sit|stand|lie|turn|flip|fold|hang|play|sing|bolt|lace|check|cut|fill|head";

/// Words that choose one of several, at the start of a text or behind its articles.
const CHOICES: &str = "first|second|third|fourth|fifth|last|other|another|left|right|middle|leftmost|rightmost|topmost|nearest|\
    closest|farthest|furthest|biggest|largest|smallest|tallest|shortest|longest";

/// Names of one thing that contain words of the lists above.
const NAMES: &str = "first aid|second hand|right angle|left handed|right handed|middle finger|last supper|jack in the box|\
    jack in the pulpit|corn on the cob|soap on a rope|toad in the hole|pig in a blanket|pigs in blankets|pigs in a blanket|\
    hole in the wall|bag in box|forget me not|touch me not|do not disturb|on off|bed in a bag|man in the moon|lily of the valley";

/// Last words of the names of notices, which contain negations: "no smoking sign".
const NOTICES: &str = "sign|signs|symbol|sticker|notice|button";

const ARTICLES: &str = "the|a|an|this|that|these|those|my|your|its|his|her|their|our";

/// Words that the rest of a text cannot end with: "a mug that is" of "a mug that is not blue".
const LOOSE_ENDS: &str =
    "that|which|who|is|are|was|and|or|but|with|the|a|an|to|it|do|does|sitting|standing|lying|placed|of";

/// Split of a text of which only a part is understood.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Phrasing {
    /// The part that the answer is for.
    pub answers_for: String,
    /// The words that the answer leaves out.
    pub not_understood: String,
}

impl Phrasing {
    /// Note for the user.
    pub fn note(&self) -> String {
        format!("answers for “{}”; “{}” is not understood", self.answers_for, self.not_understood)
    }
}

/// Whether a text is in the vocabulary of its model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Vocabulary {
    /// Whether the text is in the vocabulary.
    pub known: bool,
    /// Word of the vocabulary that the text means most; `None` outside of it.
    pub nearest: Option<String>,
    /// Words of an unknown text that are not English.
    pub not_english: Vec<String>,
}

impl Vocabulary {
    /// Note for the user on an unknown text.
    fn note(&self) -> Option<String> {
        let words: Vec<String> = self.not_english.iter().map(|w| format!("“{w}”")).collect();
        (!words.is_empty()).then(|| format!("{} is not among their English words", words.join(", ")))
    }
}

/// Interpretation of a text.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Reading {
    /// Split of the text, if only a part of it is understood.
    pub phrasing: Option<Phrasing>,
    /// Look-up in the vocabulary, for models that have one.
    pub vocabulary: Option<Vocabulary>,
}

impl Reading {
    /// Whether the answer may be for something else.
    pub fn is_doubtful(&self) -> bool {
        self.phrasing.is_some() || self.is_unknown()
    }

    /// Whether the text is outside of the model's vocabulary. Whether a scene shows it cannot be
    /// told then: a poor fit of unknown words is no evidence of absence.
    pub fn is_unknown(&self) -> bool {
        self.vocabulary.as_ref().is_some_and(|v| !v.known)
    }

    /// Note for the user, one line each.
    pub fn notes(&self) -> Vec<String> {
        let unknown = self.vocabulary.as_ref().and_then(Vocabulary::note);
        self.phrasing.as_ref().map(Phrasing::note).into_iter().chain(unknown).collect()
    }
}

/// Splits a text into the part that is understood and the rest; `None` if all of it is understood.
pub fn read(text: &str) -> Option<Phrasing> {
    let said: Vec<&str> = text.split_whitespace().collect();
    let words: Vec<String> = said.iter().map(|w| without_punctuation(w)).collect();
    let start = words.iter().take_while(|w| contains(ARTICLES, w)).count();
    if let Some(word) = words.get(start).filter(|w| contains(CHOICES, w)) {
        let place =
            matches!(word.as_str(), "left" | "right") && words.get(start + 1).is_some_and(|w| w == "of");
        if !place && !in_name(&words, start) {
            // The rest may contain more to leave out: "the second cup on the table".
            let rest = said[start + 1..].join(" ");
            let inner = read(&rest);
            let answered = inner.as_ref().map_or(rest.as_str(), |p| p.answers_for.as_str());
            let more = inner.as_ref().map(|p| p.not_understood.as_str());
            let left_out: Vec<&str> = std::iter::once(said[start]).chain(more).collect();
            return phrasing(&[answered][..usize::from(!answered.is_empty())], &left_out);
        }
    }
    let (at, length) = (0..words.len()).find_map(|at| Some((at, marker_length(&words, at)?)))?;
    // "bigger than the plate": the word before "than" is left out, too.
    let from = if words[at] == "than" { at.saturating_sub(1) } else { at };
    let end = words[..from].iter().rposition(|w| !contains(LOOSE_ENDS, w)).map_or(0, |last| last + 1);
    match words[..end].iter().any(|w| !contains(ARTICLES, w)) {
        true => phrasing(&said[..end], &said[from..]),
        // "left of the plate", "not the red one": the object behind the words is answered.
        false => {
            let behind =
                words[at + length..].iter().take_while(|w| contains(ARTICLES, w) || *w == "of").count();
            phrasing(&said[at + length + behind..], &said[from..at + length])
        }
    }
}

/// A word in lower case with straight apostrophes, without punctuation around it.
fn without_punctuation(w: &str) -> String {
    w.to_lowercase().replace('’', "'").trim_matches(|c: char| ",.;:!?\"".contains(c)).to_owned()
}

fn phrasing(answered: &[&str], left_out: &[&str]) -> Option<Phrasing> {
    (!answered.is_empty() && !left_out.is_empty())
        .then(|| Phrasing { answers_for: answered.join(" "), not_understood: left_out.join(" ") })
}

/// Number of words from `at` on that begin a part to leave out.
fn marker_length(words: &[String], at: usize) -> Option<usize> {
    if in_name(words, at) {
        return None;
    }
    let notice = words.last().is_some_and(|w| contains(NOTICES, w));
    if let Some(length) = longest_prefix(NEGATIONS, &words[at..]).filter(|_| !notice) {
        return (at + length < words.len()).then_some(length);
    }
    let length = longest_prefix(PLACES, &words[at..]).filter(|length| at + length < words.len())?;
    let particle = length == 1 && contains(PARTICLES, &words[at]);
    let counts = match at.checked_sub(1) {
        _ if !particle => true,
        None => contains(ARTICLES, &words[at + 1]),
        Some(before) => !contains(VERBS, &words[before]),
    };
    counts.then_some(length)
}

/// Number of words in the longest entry of `list` that `words` begin with.
fn longest_prefix(list: &str, words: &[String]) -> Option<usize> {
    list.split('|').filter_map(|entry| prefix_length(entry, words)).max()
}

fn prefix_length(entry: &str, words: &[String]) -> Option<usize> {
    let parts: Vec<&str> = entry.split(' ').collect();
    (parts.len() <= words.len() && parts.iter().zip(words).all(|(p, w)| p == w)).then_some(parts.len())
}

/// Whether the word at `at` is part of one of the [`NAMES`].
fn in_name(words: &[String], at: usize) -> bool {
    (0..=at).any(|from| longest_prefix(NAMES, &words[from..]).is_some_and(|length| from + length > at))
}

fn contains(list: &str, word: &str) -> bool {
    list.split('|').any(|entry| entry == word)
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk_infer::{PackFileKind, Registry, things};
    use splatvk_test_support::breakfast;

    #[test]
    fn read_leaves_out_unsupported_words() {
        for (text, answered, left_out) in [
            ("mug without handle", "mug", "without handle"),
            ("a Mug without a handle", "a Mug", "without a handle"),
            ("bottle without label", "bottle", "without label"),
            ("a mug that is not blue", "a mug", "not blue"),
            ("the mug that isn’t blue", "the mug", "isn’t blue"),
            ("not the red one", "red one", "not"),
            ("no lemon", "lemon", "no"),
            ("anything but the mug", "anything", "but the mug"),
            ("fruit other than a lemon", "fruit", "other than a lemon"),
            ("a cup bigger than the plate", "a cup", "bigger than the plate"),
            ("left of the plate", "plate", "left of"),
            ("to the left of the plate", "plate", "to the left"),
            ("the cup to the right of the plate", "the cup", "to the right of the plate"),
            ("book on the table", "book", "on the table"),
            ("book on table", "book", "on table"),
            ("under the table", "table", "under"),
            ("the mug next to the lemon", "the mug", "next to the lemon"),
            ("behind the box", "box", "behind"),
            ("lamp standing by the window", "lamp", "by the window"),
            ("lemon in front of the box", "lemon", "in front of the box"),
            ("the second cup", "cup", "second"),
            ("second cup", "cup", "second"),
            ("the second cup on the table", "cup", "second on the table"),
            ("the left mug", "mug", "left"),
            ("largest book", "book", "largest"),
            ("the second, blue cup", "blue cup", "second,"),
            ("\"first\" mug", "mug", "\"first\""),
        ] {
            let read = read(text).unwrap_or_else(|| panic!("{text}: taken as understood"));
            assert_eq!(
                (read.answers_for.as_str(), read.not_understood.as_str()),
                (answered, left_out),
                "{text}"
            );
        }
    }

    #[test]
    fn check_refuses_long_questions() {
        for text in ["lemon", &"ab ".repeat(MOST_WORDS), &"ä".repeat(MOST_CHARACTERS)] {
            check(text).unwrap();
        }
        for text in ["", " \n", &"a ".repeat(MOST_WORDS + 1), &"ä".repeat(MOST_CHARACTERS + 1)] {
            let error = check(text).unwrap_err();
            assert!(error.exit_code() == 2 && error.to_string().len() < 300, "{error}");
        }
        let error = check(&"red ".repeat(2_500_000)).unwrap_err().to_string();
        assert!(error.contains("2500000 words") && error.contains("at most 300 characters"), "{error}");
    }

    #[test]
    fn read_keeps_names_of_things() {
        for text in [
            "remote control",
            "cup of tea",
            "book end",
            "carton of milk",
            "loaf of bread",
            "mug with handle",
            "first aid kit",
            "second hand watch",
            "jack-in-the-box",
            "jack in the box",
            "corn on the cob",
            "forget me not",
            "no smoking sign",
            "carry on bag",
            "plug in hybrid",
            "slip on shoe",
            "roll on deodorant",
            "over ear headphones",
            "above ground pool",
            "in line skates",
            "built in oven",
            "walk in closet",
            "non-stick pan",
            "overcoat",
            "underwear",
            "notebook",
            "button",
            "nobody",
            "inbox",
            "left handed scissors",
            "right angle ruler",
            "pull over sweater",
            "toad in the hole",
            "no entry sign",
            "do not disturb sign",
            "glass of water",
            "picture of a dog",
            "blue and white mug",
            "top hat",
            "bottom drawer",
            "on",
            "not",
            "without",
            "second",
            "the other",
            "",
            "  ",
            "lily of the valley",
            "on off switch",
        ] {
            assert_eq!(read(text), None, "{text}");
        }
    }

    #[test]
    fn read_keeps_all_listed_phrases() {
        let classes = Registry::open(None).unwrap().path(PackFileKind::Classes).unwrap();
        let classes = std::fs::read_to_string(classes).unwrap();
        let first = classes.lines().filter_map(|l| l.split(['\t', ',']).next().map(str::to_owned));
        let all =
            things::of_form("").into_iter().chain(first).chain(breakfast::phrases().into_iter().map(|p| p.1));
        let cut: Vec<_> = all.filter(|text| read(text).is_some()).collect();
        assert!(cut.is_empty(), "{cut:?}");
    }
}
