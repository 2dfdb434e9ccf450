//! Things of everyday life: what a text could have said instead. `query::presence` of splatvk
//! weighs a text against them.
use super::colour;

/// One per line.
const THINGS: &str = include_str!("things.txt");

/// With words before them so many fewer are asked for: each form is a list of its own, which takes
/// a text model seconds.
const FORMED_EVERY: usize = 4;

/// Most colours of a form. A list is made for each form that is asked for, so that their number
/// bounds the work and the memory.
const MOST_COLOURS: usize = 3;

/// The words that a text must have in common with what else it could have said: its first colours,
/// each once. Anything red is a little of a "red book".
pub fn form(text: &str) -> String {
    let mut words: Vec<String> = Vec::new();
    for word in colour::words_in(text) {
        if words.len() < MOST_COLOURS && !words.contains(&word) {
            words.push(word);
        }
    }
    words.join(" ")
}

/// Whether many texts have a form, so that it is worth keeping what belongs to it: one colour at
/// most.
pub fn is_common(form: &str) -> bool {
    forms().any(|known| known == form)
}

/// A text that names one colour with each of the other ten; nothing for other texts.
pub fn recoloured(text: &str) -> Vec<String> {
    let words = colour::words_in(text);
    let [word] = &words[..] else { return Vec::new() };
    let renamed = |other: &str| {
        let lower = text.to_lowercase();
        let list = lower.split_whitespace().map(|w| if w == word { other } else { w });
        list.collect::<Vec<_>>().join(" ")
    };
    colour::names_besides(word).map(renamed).collect()
}

/// Every [`form`] of one colour, and none.
pub fn forms() -> impl Iterator<Item = &'static str> {
    std::iter::once("").chain(colour::names())
}

/// The things of a form: without words before them all, otherwise some.
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
    fn things_are_named_once() {
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
    fn the_form_of_a_text_is_its_colours() {
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
