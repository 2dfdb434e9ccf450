//! Memory that records the accesses to each word, to detect unwritten reads and data races.
//!
//! Two accesses race if at least one writes, not both are atomic, they are by different
//! invocations, and no barrier lies between them. Barriers order the invocations of a workgroup
//! only, and only the memory that they name. Nothing orders two workgroups of one dispatch.
use crate::code::{Atomic, GARBAGE};

/// An invocation: its number in the dispatch, from 1, and the number of barriers that it has
/// passed.
#[derive(Clone, Copy)]
pub(crate) struct Accessor {
    pub invocation: u32,
    pub epoch: u32,
}

/// Summary of the accesses of one kind to one word. It decides exactly whether any of them is
/// unordered with a later access.
#[derive(Clone, Copy, Default)]
struct Seen {
    /// Of the latest access; invocation 0 = none.
    invocation: u32,
    epoch: u32,
    /// Whether several invocations of that workgroup accessed the word in that epoch.
    many: bool,
    /// Whether more than one workgroup accessed the word.
    groups: bool,
}

/// Plain reads, plain writes and atomic accesses of a word since the dispatch began.
#[derive(Clone, Copy, Default)]
struct Shadow {
    read: Seen,
    written: Seen,
    atomic: Seen,
}

/// A fault of an access.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum AccessFault {
    Unwritten,
    Race,
}

const PAGE: usize = 256;

/// Words of a buffer, with their access history in the current dispatch.
pub struct Memory {
    /// The content.
    pub words: Vec<u32>,
    /// Whether each word is written; `None` where all are.
    written: Option<Vec<bool>>,
    shadow: Vec<Option<Box<[Shadow; PAGE]>>>,
    group_size: u32,
}

impl Memory {
    /// Memory in which all words count as written.
    pub fn of(words: Vec<u32>) -> Memory {
        let pages = words.len().div_ceil(PAGE);
        Memory { words, written: None, shadow: vec![None; pages], group_size: 1 }
    }

    /// Memory in which no word counts as written.
    pub fn empty(words: usize) -> Memory {
        let mut memory = Memory::of(vec![GARBAGE; words]);
        memory.forget(0);
        memory
    }

    /// Marks all words from `from` on as unwritten.
    pub fn forget(&mut self, from: usize) {
        let count = self.words.len();
        self.words[from..].fill(GARBAGE);
        self.written.get_or_insert_with(|| vec![true; count])[from..].fill(false);
    }

    /// Writes words outside of a dispatch.
    pub fn set(&mut self, first: usize, words: &[u32]) {
        self.words[first..first + words.len()].copy_from_slice(words);
        if let Some(written) = &mut self.written {
            written[first..first + words.len()].fill(true);
        }
    }

    /// Starts a dispatch, ordered after all earlier ones.
    pub(crate) fn start(&mut self, group_size: u32) {
        self.group_size = group_size;
        self.shadow.fill(None);
    }

    fn shadow(&mut self, word: usize) -> &mut Shadow {
        let page = self.shadow[word / PAGE].get_or_insert_with(|| Box::new([Shadow::default(); PAGE]));
        &mut page[word % PAGE]
    }

    pub(crate) fn load(&mut self, word: usize, accessor: Accessor) -> (u32, Option<AccessFault>) {
        let size = self.group_size;
        let shadow = self.shadow(word);
        let race = shadow.written.unordered(accessor, size) || shadow.atomic.unordered(accessor, size);
        shadow.read.note(accessor, size);
        let unwritten = self.written.as_ref().is_some_and(|w| !w[word]);
        let fault = if race { Some(AccessFault::Race) } else { unwritten.then_some(AccessFault::Unwritten) };
        (self.words[word], fault)
    }

    pub(crate) fn store(&mut self, word: usize, value: u32, accessor: Accessor) -> Option<AccessFault> {
        let size = self.group_size;
        let shadow = self.shadow(word);
        let race = [shadow.read, shadow.written, shadow.atomic].iter().any(|s| s.unordered(accessor, size));
        shadow.written.note(accessor, size);
        self.words[word] = value;
        if let Some(written) = &mut self.written {
            written[word] = true;
        }
        race.then_some(AccessFault::Race)
    }

    pub(crate) fn atomic(
        &mut self,
        op: Atomic,
        word: usize,
        (value, expected): (u32, u32),
        accessor: Accessor,
    ) -> (u32, Option<AccessFault>) {
        let size = self.group_size;
        let shadow = self.shadow(word);
        let race = shadow.read.unordered(accessor, size) && op != Atomic::Load
            || shadow.written.unordered(accessor, size);
        shadow.atomic.note(accessor, size);
        let mut unwritten = false;
        if let Some(written) = &mut self.written {
            unwritten = !written[word] && !matches!(op, Atomic::Store | Atomic::Exchange);
            written[word] = true;
        }
        let before = self.words[word];
        self.words[word] = updated_word(op, before, value, expected);
        let fault = if race { Some(AccessFault::Race) } else { unwritten.then_some(AccessFault::Unwritten) };
        (before, fault)
    }
}

impl Seen {
    fn unordered(&self, accessor: Accessor, group_size: u32) -> bool {
        if self.invocation == 0 {
            return false;
        }
        let other = self.invocation != accessor.invocation;
        let same_group =
            !other || (self.invocation - 1) / group_size == (accessor.invocation - 1) / group_size;
        self.groups || !same_group || self.epoch == accessor.epoch && (other || self.many)
    }

    fn note(&mut self, accessor: Accessor, group_size: u32) {
        let other = self.invocation != 0 && self.invocation != accessor.invocation;
        if other && (self.invocation - 1) / group_size != (accessor.invocation - 1) / group_size {
            self.groups = true;
        } else if self.epoch != accessor.epoch {
            self.many = false;
        } else if other {
            self.many = true;
        }
        (self.invocation, self.epoch) = (accessor.invocation, accessor.epoch);
    }
}

fn updated_word(op: Atomic, before: u32, value: u32, expected: u32) -> u32 {
    match op {
        Atomic::Load => before,
        Atomic::Store | Atomic::Exchange => value,
        Atomic::CompareExchange if before == expected => value,
        Atomic::CompareExchange => before,
        Atomic::IAdd => before.wrapping_add(value),
        Atomic::And => before & value,
        Atomic::Or => before | value,
        Atomic::Xor => before ^ value,
        Atomic::UMin => before.min(value),
        Atomic::UMax => before.max(value),
        Atomic::SMin => (before as i32).min(value as i32) as u32,
        Atomic::SMax => (before as i32).max(value as i32) as u32,
        Atomic::FAdd => (f32::from_bits(before) + f32::from_bits(value)).to_bits(),
    }
}
