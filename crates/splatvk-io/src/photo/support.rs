//! Which kinds of files this machine can read.

/// What the machine has for a kind of files.
#[derive(Clone, Debug)]
pub struct Support {
    /// What is there, in words.
    pub found: String,
    /// What to do about what is missing.
    pub advice: Option<String>,
}

impl Support {
    /// Nothing is there.
    pub(super) fn none(what: &str, advice: String) -> Support {
        Support { found: what.to_owned(), advice: Some(advice) }
    }
}
