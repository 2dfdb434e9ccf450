//! Scheduling of a dispatch: a number of workgroups at a time, in any order, each for a slice of
//! its blocks.
use crate::code::Code;
use crate::counts::Counts;
use crate::faults::Faults;
use crate::memory::Memory;
use crate::subgroup::{Dispatch, Group, Stop, Subgroup};
use rspirv::spirv::MemorySemantics;

/// Order in which workgroups begin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Order {
    /// At random.
    Random,
    /// By number.
    Rising,
    /// By number, descending.
    Falling,
}

/// One possible execution order of a dispatch.
#[derive(Clone, Copy, Debug)]
pub struct Schedule {
    /// Invocations per subgroup.
    pub subgroup_size: usize,
    /// Order in which workgroups begin.
    pub order: Order,
    /// Largest number of workgroups in flight.
    pub in_flight: usize,
    /// Whether invocations are assigned to subgroups at random, which Vulkan permits.
    pub scattered: bool,
    /// Seed of all random choices.
    pub seed: u64,
}

/// A random generator (SplitMix64) with its state.
pub struct Random(pub u64);

impl Random {
    /// A number below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % n.max(1) as u64) as usize
    }

    fn shuffle<T>(&mut self, list: &mut [T]) {
        for k in (1..list.len()).rev() {
            list.swap(k, self.below(k + 1));
        }
    }
}

struct Running {
    group: Group,
    subgroups: Vec<Subgroup>,
    stops: Vec<Stop>,
    /// Whether lanes run in ascending order.
    ascending: bool,
}

/// Runs all workgroups and counts their instructions; `Err` if one cannot continue.
pub(crate) fn run(
    code: &Code,
    buffers: &mut [Option<Memory>],
    push: &[u32],
    groups: [u32; 3],
    schedule: &Schedule,
    faults: &mut Faults,
) -> Result<Counts, String> {
    let threads: u32 = code.workgroup.iter().product();
    buffers.iter_mut().flatten().for_each(|b| b.start(threads));
    let mut random = Random(schedule.seed);
    let mut waiting: Vec<u32> = (0..groups.iter().product()).collect();
    match schedule.order {
        Order::Random => random.shuffle(&mut waiting),
        Order::Rising => waiting.reverse(),
        Order::Falling => {}
    }
    let mut running: Vec<Running> = Vec::new();
    let mut spare: Vec<Subgroup> = Vec::new();
    let mut d = Dispatch { code, buffers, push, groups, faults, counts: Counts::default() };
    loop {
        while running.len() < schedule.in_flight.max(1)
            && let Some(number) = waiting.pop()
        {
            running.push(begin(&d, number, schedule, &mut spare, &mut random));
        }
        if running.is_empty() {
            return Ok(d.counts);
        }
        let k = random.below(running.len());
        if running[k].advance(&mut d, &mut random)? {
            spare.extend(running.swap_remove(k).subgroups);
        }
    }
}

fn begin(
    d: &Dispatch,
    number: u32,
    schedule: &Schedule,
    spare: &mut Vec<Subgroup>,
    random: &mut Random,
) -> Running {
    let threads: u32 = d.code.workgroup.iter().product();
    let mut locals: Vec<u32> = (0..threads).collect();
    if schedule.scattered {
        random.shuffle(&mut locals);
    }
    let count = locals.len().div_ceil(schedule.subgroup_size) as u32;
    let mut subgroups = Vec::new();
    for (k, own) in locals.chunks(schedule.subgroup_size).enumerate() {
        let mut subgroup = spare.pop().unwrap_or_else(|| Subgroup::new(d.code, schedule.subgroup_size));
        subgroup.start(own.to_vec(), k as u32, count);
        subgroups.push(subgroup);
    }
    let [x, y, _] = d.groups;
    let mut shared = Memory::empty(d.code.shared_words as usize);
    // Only this workgroup accesses it.
    shared.start(threads);
    let group = Group {
        id: [number % x, number / x % y, number / (x * y)],
        number,
        shared,
        shared_epoch: 0,
        buffer_epoch: 0,
    };
    let stops = vec![Stop::Slice; subgroups.len()];
    Running { group, subgroups, stops, ascending: random.below(2) == 0 }
}

impl Running {
    /// Runs one subgroup for a slice; returns whether all have ended.
    fn advance(&mut self, d: &mut Dispatch, random: &mut Random) -> Result<bool, String> {
        let ready: Vec<usize> = (0..self.stops.len()).filter(|&k| self.stops[k] == Stop::Slice).collect();
        if ready.is_empty() {
            return self.pass_barrier();
        }
        let k = ready[random.below(ready.len())];
        let blocks = 1 + random.below(200) as u32;
        self.stops[k] = self.subgroups[k].run(d, &mut self.group, blocks, self.ascending)?;
        Ok(self.stops.iter().all(|s| *s == Stop::Done))
    }

    /// Handles a barrier that all subgroups have reached; an error if some have not.
    fn pass_barrier(&mut self) -> Result<bool, String> {
        let Some(Stop::Barrier { at, semantics }) = self.stops.first().copied() else {
            return Err("a barrier that some subgroups never reach".to_owned());
        };
        if self.stops.iter().any(|s| *s != Stop::Barrier { at, semantics }) {
            return Err(format!("word {at}: a barrier that some subgroups do not reach: {:?}", self.stops));
        }
        let semantics = MemorySemantics::from_bits_retain(semantics);
        self.group.shared_epoch += u32::from(semantics.contains(MemorySemantics::WORKGROUP_MEMORY));
        self.group.buffer_epoch += u32::from(semantics.contains(MemorySemantics::UNIFORM_MEMORY));
        self.stops.fill(Stop::Slice);
        Ok(false)
    }
}
