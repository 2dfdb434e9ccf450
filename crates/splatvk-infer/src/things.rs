//! Names of everyday things, to which `query::presence` of splatvk compares a text.
use super::colour;

/// One per line.
const THINGS: &str = include_str!("things.txt");

/// Step through the list for a form with colours: each form is a list of its own, which takes a
/// text model seconds.
const FORMED_EVERY: usize = 4;

/// Largest number of colours in a form. Each form has its own list, so this limits work and memory.
const MOST_COLOURS: usize = 3;

/// Form of a text: its first colours, each once. Other things are compared in the same form, since
/// anything red resembles a "red book" a little.
pub fn form(text: &str) -> String {
    let mut words: Vec<String> = Vec::new();
    for word in colour::words_in(text) {
        if words.len() < MOST_COLOURS && !words.contains(&word) {
            words.push(word);
        }
    }
    words.join(" ")
}

/// Whether a form has at most one colour, so that its embeddings are worth caching.
pub fn is_common(form: &str) -> bool {
    forms().any(|known| known == form)
}

/// A text of one colour with each of the other ten instead; empty for other texts.
pub fn recoloured(text: &str) -> Vec<String> {
    let words = colour::words_in(text);
    let [word] = &words[..] else { return Vec::new() };
    let with_colour = |other: &str| {
        let lower = text.to_lowercase();
        let list = lower.split_whitespace().map(|w| if w == word { other } else { w });
        list.collect::<Vec<_>>().join(" ")
    };
    colour::names_besides(word).map(with_colour).collect()
}

/// Every [`form`] of at most one colour.
pub fn forms() -> impl Iterator<Item = &'static str> {
    std::iter::once("").chain(colour::names())
}

/// Things of a form: all for the empty form, else every fourth one behind the colours.
pub fn of_form(form: &str) -> Vec<String> {
    match form {
        "" => THINGS.lines().map(str::to_owned).collect(),
        form => THINGS.lines().step_by(FORMED_EVERY).map(|thing| format!("{form} {thing}")).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn things_are_unique() {
        let all = of_form("");
        let mut sorted = all.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert!(all.len() > 900 && sorted.len() == all.len());
        assert!(all.iter().all(|t| !t.is_empty() && t.trim() == t));
        assert_eq!(of_form("red").len(), all.len().div_ceil(FORMED_EVERY));
        assert_eq!(of_form("red")[0], format!("red {}", all[0]));
    }

    #[test]
    fn form_lists_colour_words() {
        assert_eq!(form("Red soda can"), "red");
        assert_eq!(form("a blue and white mug"), "blue white");
        assert_eq!(form("redwood"), "");
        assert_eq!(form(&"red blue red green grey pink ".repeat(100)), "red blue green");
        assert!(is_common("") && is_common("pink") && !is_common("blue white"));
        assert_eq!(forms().count(), 12);
        let mugs = recoloured("Gray mug");
        assert!(mugs.len() == 10 && mugs.contains(&"red mug".to_owned()), "{mugs:?}");
        assert!(recoloured("mug").is_empty() && recoloured("red and blue mug").is_empty());
    }
}
