//! Text of files and people as it may stand in a line of a message, a table or a page.

/// Most characters of an error, warning or message. Longer ones keep their beginning and their end,
/// where the advice is.
const LONGEST: usize = 1000;
/// Characters that a longer one keeps of its end.
const END: usize = 300;

/// One line of bounded length without control characters: messages quote names and texts of files,
/// which may hold anything.
pub fn one_line(message: &str) -> String {
    let mut line = String::with_capacity(message.len().min(4 * LONGEST));
    let mut count = 0;
    for word in message.split_whitespace() {
        for c in (count > 0).then_some(' ').into_iter().chain(word.chars()) {
            count += 1;
            line.push(visible(c));
        }
    }
    if count <= LONGEST {
        return line;
    }
    let at = |n: usize| line.char_indices().nth(n).map_or(line.len(), |(at, _)| at);
    format!("{}…{}", &line[..at(LONGEST - END - 1)], &line[at(count - END)..])
}

/// The character, or a sign in its place: terminals obey control characters, and marks of direction
/// turn text round.
pub fn visible(c: char) -> char {
    let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    if c.is_control() || turns { '\u{fffd}' } else { c }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_short_and_has_no_control_characters() {
        assert_eq!(one_line("a  b\n c"), "a b c");
        assert_eq!(
            one_line("\u{1b}[31mred\u{7}\u{9b}2J \u{202e}x"),
            "\u{fffd}[31mred\u{fffd}\u{fffd}2J \u{fffd}x"
        );
        let long = one_line(&format!("{}: start {} what to do", "ä".repeat(5_000_000), "x".repeat(9)));
        assert_eq!(long.chars().count(), LONGEST);
        assert!(long.starts_with("ää") && long.contains('…') && long.ends_with("what to do"), "{long}");
        assert_eq!(one_line(&"y".repeat(LONGEST)).len(), LONGEST);
    }
}
