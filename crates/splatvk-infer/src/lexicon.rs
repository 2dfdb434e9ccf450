//! English nouns and the ImageNet classes of their kind: "chair" has the barber chair, the folding
//! chair, the rocking chair and the throne. `tools/models/lexicon.py` makes the list from WordNet.
use super::stuff;
use std::collections::HashMap;
use std::sync::OnceLock;

/// One noun per line: a tab, then numbers and ranges of classes.
const NOUNS: &str = include_str!("lexicon.txt");

/// Words before a noun that say nothing about its kind.
const ARTICLES: &str = "a|an|the|this|that|these|those|some|my|your|our|his|her|their|any|all|every|each|one|two|three|four|five";

/// Amounts: "a bunch of bananas" means bananas. Of other pairs the first is meant: "box of cereal".
const AMOUNTS: &str =
    "bunch|pile|stack|slice|group|pair|row|lot|lots|couple|heap|handful|kind|sort|type|picture|photo|bit";

/// Irregular plurals.
const PLURALS: &str = "feet foot|teeth tooth|geese goose|mice mouse|people person|children child|men man|women woman|\
    leaves leaf|loaves loaf|knives knife|shelves shelf|halves half|scarves scarf|wolves wolf|calves calf|dice die|\
    bookshelves bookshelf|jeans jeans|stairs stairs|steps stairs|cobblestones cobblestone|dishes dish|clothes clothing";

/// The noun of a text.
#[derive(Clone, Debug, PartialEq)]
pub struct Noun {
    /// In the singular: "chair" of "two wooden chairs".
    pub name: String,
    /// Classes of its kind, ascending: those of ImageNet, then those of [`stuff`].
    pub classes: Vec<usize>,
}

/// Finds the noun that a text is about: its longest end that is a noun of the list. `None` if the
/// list has none.
pub fn noun(text: &str) -> Option<Noun> {
    let lower = text.to_lowercase();
    let letters = |c: char| c.is_alphanumeric() || c == '\'' || c == '-' || c == '.';
    let words: Vec<&str> = lower.split(|c| !letters(c)).filter(|w| !w.is_empty()).collect();
    let start = words.iter().take_while(|w| listed(ARTICLES, w)).count();
    let words = &words[start..];
    if let Some(found) = known(&words.join(" ")) {
        return Some(found);
    }
    if let Some(of) = words.iter().position(|w| *w == "of").filter(|of| *of > 0) {
        let (amount, rest) = (&words[..of], &words[of + 1..]);
        let is_amount =
            amount.last().is_some_and(|w| listed(AMOUNTS, w) || listed(AMOUNTS, w.trim_end_matches('s')));
        // "box of cereal" is a cereal box.
        if let Some(found) = known(&format!("{} {}", rest.join(" "), amount.join(" "))) {
            return Some(found);
        }
        return if is_amount { noun(&rest.join(" ")) } else { ending(amount) };
    }
    ending(words)
}

/// The longest end of `words` that is a noun of the list.
fn ending(words: &[&str]) -> Option<Noun> {
    (0..words.len()).find_map(|from| known(&words[from..].join(" ")))
}

/// Looks up a name in the singular and the plural.
fn known(name: &str) -> Option<Noun> {
    singulars(name).into_iter().find_map(|name| {
        let mut classes = nouns().get(name.as_str()).map(|list| numbers(list)).unwrap_or_default();
        classes.extend(stuff::classes_of(&name));
        (!classes.is_empty()).then_some(Noun { name, classes })
    })
}

/// A name, and its possible singulars.
fn singulars(name: &str) -> Vec<String> {
    let (before, last) = name.rsplit_once(' ').map_or(("", name), |(before, last)| (before, last));
    let irregular =
        PLURALS.split('|').filter_map(|pair| pair.split_once(' ')).find(|(plural, _)| *plural == last);
    let mut ends = vec![last.to_owned()];
    ends.extend(irregular.map(|(_, singular)| singular.to_owned()));
    let regular = [("ies", "y"), ("es", ""), ("s", "")];
    let cut = regular.iter().filter_map(|(end, with)| Some(format!("{}{with}", last.strip_suffix(end)?)));
    ends.extend(cut.filter(|word| word.len() > 2));
    let whole = |end: String| if before.is_empty() { end } else { format!("{before} {end}") };
    ends.into_iter().map(whole).collect()
}

fn nouns() -> &'static HashMap<&'static str, &'static str> {
    static TABLE: OnceLock<HashMap<&'static str, &'static str>> = OnceLock::new();
    TABLE.get_or_init(|| NOUNS.lines().filter_map(|line| line.split_once('\t')).collect())
}

/// The numbers of "3 7-9": 3, 7, 8, 9.
fn numbers(list: &str) -> Vec<usize> {
    let range = |part: &str| {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        Some(first.parse::<usize>().ok()?..=last.parse::<usize>().ok()?)
    };
    list.split(' ').filter_map(range).flatten().collect()
}

fn listed(list: &str, word: &str) -> bool {
    list.split('|').any(|entry| entry == word)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::classify::CLASSES;

    #[test]
    fn nouns_have_classes_of_their_kind() {
        let classes = |text: &str| noun(text).map(|n| n.classes);
        assert_eq!(classes("chair"), Some(vec![423, 559, 765, 857]));
        for text in ["chairs", "two wooden chairs", "the Chair", "a pile of chairs", "office chair"] {
            assert_eq!(classes(text), classes("chair"), "{text}");
        }
        assert_eq!(classes("lemon"), Some(vec![951]));
        assert_eq!(noun("box of lemons").unwrap().name, "box");
        assert_eq!(classes("box of cereal"), classes("cereal box"));
        assert_eq!(noun("loaf of bread").unwrap().name, "loaf of bread");
        assert_eq!(classes("dog").unwrap().len(), 118);
        for unknown in
            ["tree trunk", "Apfel", "moss rose of sharon x", "", "of", "object", "stuff", "inflation"]
        {
            assert_eq!(classes(unknown), None, "{unknown}");
        }
    }

    #[test]
    fn list_names_existing_classes() {
        assert!(nouns().len() > 3000);
        for (name, list) in nouns() {
            let numbers = numbers(list);
            assert!(!numbers.is_empty() && numbers.iter().all(|n| *n < CLASSES), "{name}: {list}");
        }
    }
}
