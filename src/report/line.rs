//! Sanitised text of files and users for a line of a message, a table or a page.
use std::path::Path;

/// Most characters of an error, warning or message. Longer ones keep their beginning and their end,
/// where the advice is.
const LONGEST: usize = 1000;
/// Characters kept at the end of a longer one.
const END: usize = 300;

/// Text as one line of bounded length without control characters: messages quote names and texts of
/// files, which may have any content.
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
    let byte = |n: usize| line.char_indices().nth(n).map_or(line.len(), |(byte, _)| byte);
    format!("{}…{}", &line[..byte(LONGEST - END - 1)], &line[byte(count - END)..])
}

/// A path in the quotes of a shell, where it needs them.
pub fn shell_quoted(path: &Path) -> String {
    let text = path.display().to_string();
    let plain = |c: char| c.is_alphanumeric() || "/._-+,:@%".contains(c);
    if text.chars().all(plain) { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// Returns the character, or U+FFFD for control characters, which terminals execute, and
/// directional marks, which reverse text.
pub fn visible(c: char) -> char {
    let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    if c.is_control() || turns { '\u{fffd}' } else { c }
}

/// A number in groups of three digits: 80,123.
pub fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let groups: Vec<&[u8]> = digits.as_bytes().rchunks(3).rev().collect();
    String::from_utf8_lossy(&groups.join(&b',')).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thousands_are_grouped() {
        let told = [0, 999, 1000, 80_123, 1_000_001].map(thousands);
        assert_eq!(told, ["0", "999", "1,000", "80,123", "1,000,001"]);
    }

    #[test]
    fn one_line_limits_length_and_characters() {
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
