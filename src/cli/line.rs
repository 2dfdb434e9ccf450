//! Text that is safe for a terminal.
pub(super) use crate::report::one_line;
use crate::report::visible;
use std::borrow::Cow;

/// Text of several lines without control characters.
pub(super) fn lines(text: &str) -> Cow<'_, str> {
    match text.chars().any(|c| !matches!(c, '\n' | '\t') && visible(c) != c) {
        true => text.chars().map(|c| if matches!(c, '\n' | '\t') { c } else { visible(c) }).collect(),
        false => text.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_drop_control_characters() {
        assert_eq!(lines("a\nb"), "a\nb");
        assert_eq!(lines("a\n\u{1b}b"), "a\n\u{fffd}b");
    }
}
