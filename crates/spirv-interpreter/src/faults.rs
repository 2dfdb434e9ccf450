//! Record of faults, each kind once per instruction.
use crate::memory::AccessFault;
use std::collections::BTreeMap;
use std::fmt;

/// A kind of fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[non_exhaustive]
pub enum Fault {
    /// An index beyond the end of a buffer, an array or a vector.
    Outside,
    /// A read of an unwritten word.
    Unwritten,
    /// Two unordered accesses to a word by different invocations, at least one of them a write.
    Race,
    /// A subgroup operation in which not all invocations of the subgroup take part.
    NonUniform,
    /// A shuffle from an inactive lane.
    AbsentLane,
}

impl From<AccessFault> for Fault {
    fn from(fault: AccessFault) -> Fault {
        match fault {
            AccessFault::Unwritten => Fault::Unwritten,
            AccessFault::Race => Fault::Race,
        }
    }
}

/// A fault and its instruction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Offset of the instruction in the module, words.
    pub at: u32,
    /// Its kind.
    pub fault: Fault,
    /// The first occurrence.
    pub detail: String,
}

/// The failure of a dispatch.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Error {
    /// The dispatch cannot continue: a barrier that some invocations never reach, or a wait without
    /// end.
    Stuck(String),
    /// The dispatch ended, with faults.
    Faulty(Vec<Found>),
}

impl std::error::Error for Error {}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Error::Stuck(message) => f.write_str(message),
            Error::Faulty(found) => {
                let line = |Found { at, fault, detail }: &Found| format!("word {at}: {fault:?}: {detail}");
                f.write_str(&found.iter().take(12).map(line).collect::<Vec<_>>().join("; "))
            }
        }
    }
}

#[derive(Default)]
pub struct Faults {
    found: BTreeMap<(u32, Fault), String>,
}

impl Faults {
    /// Records a fault of the instruction at a word of the module.
    pub fn note(&mut self, at: u32, kind: Fault, detail: impl FnOnce() -> String) {
        self.found.entry((at, kind)).or_insert_with(detail);
    }

    /// All faults, in the order of the module.
    pub fn report(self) -> Result<(), Error> {
        if self.found.is_empty() {
            return Ok(());
        }
        let found = self.found.into_iter().map(|((at, fault), detail)| Found { at, fault, detail });
        Err(Error::Faulty(found.collect()))
    }
}
