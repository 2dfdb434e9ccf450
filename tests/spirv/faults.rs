//! What was found, each kind once per instruction.
use super::memory::Fault;
use std::collections::BTreeMap;

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// An index beyond the end of a buffer, an array or a vector.
    Outside,
    /// A word that nobody wrote was read.
    Unwritten,
    /// Two invocations touch a word, one writes, and nothing orders them.
    Race,
    /// A subgroup operation that not all invocations of the subgroup take part in.
    NonUniform,
    /// A shuffle from a lane that does not take part.
    AbsentLane,
}

impl From<Fault> for Kind {
    fn from(fault: Fault) -> Kind {
        match fault {
            Fault::Unwritten => Kind::Unwritten,
            Fault::Race => Kind::Race,
        }
    }
}

#[derive(Default)]
pub struct Faults {
    found: BTreeMap<(u32, Kind), String>,
}

impl Faults {
    /// Notes what is wrong with the instruction at a word of the module.
    pub fn note(&mut self, at: u32, kind: Kind, detail: impl FnOnce() -> String) {
        self.found.entry((at, kind)).or_insert_with(detail);
    }

    /// All of it, for an error.
    pub fn report(&self) -> Result<(), String> {
        if self.found.is_empty() {
            return Ok(());
        }
        let lines = self.found.iter().map(|((at, kind), detail)| format!("word {at}: {kind:?}: {detail}"));
        Err(lines.take(12).collect::<Vec<_>>().join("; "))
    }
}
