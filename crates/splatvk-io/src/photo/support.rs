//! Support of this machine for kinds of files.

/// Support for a kind of files.
#[derive(Clone, Debug)]
pub struct Support {
    /// Description of the available parts.
    pub found: String,
    /// Advice for missing parts.
    pub advice: Option<String>,
}

impl Support {
    /// No support.
    pub(super) fn none(what: &str, advice: String) -> Support {
        Support { found: what.to_owned(), advice: Some(advice) }
    }
}
