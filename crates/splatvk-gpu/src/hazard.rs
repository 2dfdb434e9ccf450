//! Which barriers a list of commands needs, and an independent check that a list with barriers has
//! them all.
//!
//! Everything here is plain data (buffers are numbers), so both halves are tested without a device.
//! They are written from opposite ends: [`derive`] keeps a summary per buffer and inserts what the
//! next command lacks; [`check`] follows every single access through the barriers behind it, by the
//! rules of the Vulkan memory model (execution dependency chains, availability, visibility). The
//! validation layers are not enough: they miss read-modify-write chains between dispatches and
//! float atomics.
use std::collections::BTreeMap;

/// Where in the pipeline a command touches memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum AccessStage {
    Compute = 1,
    Transfer = 2,
    Indirect = 4,
}

/// One command's access to one buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BufferAccess {
    pub buffer: u64,
    pub stage: AccessStage,
    pub read: bool,
    pub write: bool,
}

/// Stages that read and stages that write, as sets of [`AccessStage`] bits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct StageMasks {
    pub reads: u8,
    pub writes: u8,
}

/// A buffer memory barrier: what came before in `from` happens before, and is visible to, `to`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Barrier {
    pub buffer: u64,
    pub from: StageMasks,
    pub to: StageMasks,
}

/// One entry of the final list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    Barriers(Vec<Barrier>),
    /// Index into the command list.
    Command(usize),
}

/// The state of a buffer in [`derive`].
#[derive(Clone, Copy, Default)]
struct BufferState {
    /// AccessStage of the last write.
    writer: u8,
    /// Stages that can already see the last write.
    seen_by: u8,
    /// Stages that have read since the last write.
    readers: u8,
}

/// The commands in order, with the barriers they need in between.
pub(crate) fn derive(commands: &[Vec<BufferAccess>]) -> Vec<Step> {
    let mut state: BTreeMap<u64, BufferState> = BTreeMap::new();
    let mut steps = Vec::new();
    for (index, touches) in commands.iter().enumerate() {
        let mut barriers: Vec<Barrier> = Vec::new();
        for touch in touches {
            let summary = state.entry(touch.buffer).or_default();
            if let Some(barrier) = advance(summary, touch) {
                barriers.push(barrier);
            }
        }
        if !barriers.is_empty() {
            steps.push(Step::Barriers(barriers));
        }
        steps.push(Step::Command(index));
    }
    steps
}

fn advance(summary: &mut BufferState, touch: &BufferAccess) -> Option<Barrier> {
    let stage = touch.stage as u8;
    let barrier = |from: StageMasks, to: StageMasks| Some(Barrier { buffer: touch.buffer, from, to });
    if touch.write {
        let from = StageMasks { reads: summary.readers, writes: summary.writer };
        let to = StageMasks { reads: if touch.read { stage } else { 0 }, writes: stage };
        *summary = BufferState { writer: stage, seen_by: 0, readers: 0 };
        return if from == StageMasks::default() { None } else { barrier(from, to) };
    }
    summary.readers |= stage;
    if summary.writer == 0 || summary.seen_by & stage != 0 {
        return None;
    }
    summary.seen_by |= stage;
    barrier(StageMasks { reads: 0, writes: summary.writer }, StageMasks { reads: stage, writes: 0 })
}

/// One past access and how far barriers have carried it.
struct PastAccess {
    command: usize,
    stage: u8,
    write: bool,
    /// Stages that run after it.
    ordered: u8,
    /// For a write: some barrier made it available, so that later barriers of the chain can make it
    /// visible.
    available: bool,
    /// For a write: stages whose reads / writes see it.
    visible: StageMasks,
}

/// A pair of commands that needs a barrier and has none.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Hazard {
    pub buffer: u64,
    pub earlier: usize,
    pub later: usize,
    pub kind: &'static str,
}

/// All hazards of a final list; every command must appear exactly once and in order.
pub(crate) fn check(commands: &[Vec<BufferAccess>], steps: &[Step]) -> Vec<Hazard> {
    let mut past: BTreeMap<u64, Vec<PastAccess>> = BTreeMap::new();
    let mut hazards = Vec::new();
    for step in steps {
        match step {
            Step::Barriers(barriers) => {
                for barrier in barriers {
                    past.entry(barrier.buffer).or_default().iter_mut().for_each(|p| carry(p, barrier));
                }
            }
            Step::Command(index) => {
                // Against what came before the command first, so that its own touches do not meet
                // each other.
                for touch in &commands[*index] {
                    let earlier = past.entry(touch.buffer).or_default();
                    hazards.extend(earlier.iter().filter_map(|p| hazard(p, touch, *index)));
                }
                for touch in &commands[*index] {
                    let earlier = past.entry(touch.buffer).or_default();
                    if touch.write {
                        // What was ordered before this write is ordered before whatever follows it;
                        // what was not has been reported.
                        earlier.clear();
                    }
                    earlier.push(PastAccess {
                        command: *index,
                        stage: touch.stage as u8,
                        write: touch.write,
                        ordered: 0,
                        available: false,
                        visible: StageMasks::default(),
                    });
                }
            }
        }
    }
    hazards
}

fn carry(past: &mut PastAccess, barrier: &Barrier) {
    let from_stages = barrier.from.reads | barrier.from.writes;
    let to_stages = barrier.to.reads | barrier.to.writes;
    let direct = past.stage & from_stages != 0;
    let chained = past.ordered & from_stages != 0;
    if !direct && !chained {
        return;
    }
    past.ordered |= to_stages;
    if past.write {
        past.available |= past.stage & barrier.from.writes != 0;
        if past.available {
            past.visible.reads |= barrier.to.reads;
            past.visible.writes |= barrier.to.writes;
        }
    }
}

fn hazard(past: &PastAccess, touch: &BufferAccess, later: usize) -> Option<Hazard> {
    let stage = touch.stage as u8;
    let found = |kind| Some(Hazard { buffer: touch.buffer, earlier: past.command, later, kind });
    if past.write {
        if touch.read && (past.ordered & stage == 0 || past.visible.reads & stage == 0) {
            return found("read after write");
        }
        if touch.write && (past.ordered & stage == 0 || past.visible.writes & stage == 0) {
            return found("write after write");
        }
    } else if touch.write && past.ordered & stage == 0 {
        return found("write after read");
    }
    None
}

/// A buffer that one command touches twice, at least once writing: the order of the two is
/// undefined.
pub(crate) fn aliased(touches: &[BufferAccess]) -> Option<u64> {
    touches.iter().enumerate().find_map(|(i, a)| {
        touches[..i].iter().find(|b| b.buffer == a.buffer && (a.write || b.write)).map(|b| b.buffer)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const READ: (bool, bool) = (true, false);
    const WRITE: (bool, bool) = (false, true);
    const BOTH: (bool, bool) = (true, true);

    fn touch(buffer: u64, stage: AccessStage, (read, write): (bool, bool)) -> BufferAccess {
        BufferAccess { buffer, stage, read, write }
    }

    /// A step with every kind of dependency: fill, read-modify-write chain, gather, indirect, copy.
    fn program() -> Vec<Vec<BufferAccess>> {
        use AccessStage::*;
        vec![
            vec![touch(1, Transfer, WRITE)],
            vec![touch(0, Compute, READ), touch(1, Compute, BOTH)],
            vec![touch(0, Compute, READ), touch(1, Compute, BOTH)],
            vec![touch(1, Compute, READ), touch(2, Compute, WRITE)],
            vec![touch(2, Indirect, READ), touch(1, Compute, READ), touch(3, Compute, WRITE)],
            vec![touch(3, Transfer, READ), touch(1, Transfer, WRITE)],
            vec![touch(2, Compute, BOTH)],
            vec![touch(1, Compute, WRITE)],
        ]
    }

    #[test]
    fn derived_barriers_pass_the_check() {
        let commands = program();
        assert_eq!(check(&commands, &derive(&commands)), []);
    }

    #[test]
    fn every_single_barrier_is_needed() {
        let commands = program();
        let steps = derive(&commands);
        let mut removed = 0;
        for (i, step) in steps.iter().enumerate() {
            let Step::Barriers(barriers) = step else { continue };
            for b in 0..barriers.len() {
                let mut fewer = barriers.clone();
                let gone = fewer.remove(b);
                let mut broken = steps.clone();
                broken[i] = Step::Barriers(fewer);
                let found = check(&commands, &broken);
                assert!(found.iter().any(|h| h.buffer == gone.buffer), "{gone:?} was not missed");
                removed += 1;
            }
        }
        // By hand: buffer 1 before commands 1, 2, 3, 5, 7; buffer 2 before 4 and 6; buffer 3 before
        // 5.
        assert_eq!(removed, 8);
    }

    #[test]
    fn hazards_are_named() {
        let commands = vec![
            vec![touch(7, AccessStage::Compute, BOTH)],
            vec![touch(7, AccessStage::Compute, BOTH)],
            vec![touch(7, AccessStage::Transfer, READ)],
            vec![touch(7, AccessStage::Compute, WRITE)],
        ];
        let bare: Vec<Step> = (0..4).map(Step::Command).collect();
        let kinds: Vec<_> = check(&commands, &bare).iter().map(|h| (h.earlier, h.later, h.kind)).collect();
        assert_eq!(
            kinds,
            [
                (0, 1, "read after write"),
                (1, 2, "read after write"),
                (1, 3, "write after write"),
                (2, 3, "write after read")
            ]
        );
    }

    #[test]
    fn a_barrier_for_the_wrong_stage_or_access_does_not_count() {
        let commands =
            vec![vec![touch(0, AccessStage::Compute, WRITE)], vec![touch(0, AccessStage::Compute, READ)]];
        let with = |from, to| {
            vec![Step::Command(0), Step::Barriers(vec![Barrier { buffer: 0, from, to }]), Step::Command(1)]
        };
        let compute = AccessStage::Compute as u8;
        let transfer = AccessStage::Transfer as u8;
        let writes = |s| StageMasks { reads: 0, writes: s };
        let reads = |s| StageMasks { reads: s, writes: 0 };
        assert!(check(&commands, &with(writes(compute), reads(compute))).is_empty());
        assert_eq!(check(&commands, &with(writes(transfer), reads(compute))).len(), 1, "wrong source stage");
        assert_eq!(check(&commands, &with(writes(compute), reads(transfer))).len(), 1, "wrong target stage");
        assert_eq!(check(&commands, &with(reads(compute), reads(compute))).len(), 1, "never made available");
        assert_eq!(
            check(&commands, &with(writes(compute), writes(compute))).len(),
            1,
            "not visible to reads"
        );
    }

    #[test]
    fn random_programs_are_covered_and_reads_share_a_barrier() {
        // A small linear congruential generator: the constants are Knuth's MMIX ones.
        let mut seed = 1u64;
        let mut next = |n: u64| {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 33) % n
        };
        for _ in 0..300 {
            let commands: Vec<Vec<BufferAccess>> = (0..12)
                .map(|_| {
                    let first = next(4);
                    (0..=next(3))
                        .map(|i| {
                            let stage = [AccessStage::Compute, AccessStage::Compute, AccessStage::Transfer]
                                [next(3) as usize];
                            touch(first + i, stage, [READ, WRITE, BOTH][next(3) as usize])
                        })
                        .collect()
                })
                .collect();
            assert_eq!(check(&commands, &derive(&commands)), []);
        }
        let shared = vec![
            vec![touch(0, AccessStage::Compute, WRITE)],
            vec![touch(0, AccessStage::Compute, READ)],
            vec![touch(0, AccessStage::Compute, READ)],
        ];
        let barriers = derive(&shared).iter().filter(|s| matches!(s, Step::Barriers(_))).count();
        assert_eq!(barriers, 1);
    }

    #[test]
    fn aliasing_with_a_write_is_found() {
        let read = touch(3, AccessStage::Compute, READ);
        assert_eq!(aliased(&[read, read]), None);
        assert_eq!(aliased(&[read, touch(3, AccessStage::Compute, WRITE)]), Some(3));
    }
}
