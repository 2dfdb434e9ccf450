//! Execution of the invocations of a subgroup in lockstep. Diverged invocations reconverge at the
//! merge block: the block that is first in structured order runs first, with all invocations that
//! are at it.
use crate::alu;
use crate::code::{Code, Edge, End, GARBAGE, Inst, Place, Reg, Root, Step};
use crate::counts::Counts;
use crate::faults::{Fault, Faults};
use crate::memory::{Accessor, Memory};
use rspirv::spirv::BuiltIn;

/// Marks a pointer out of bounds; the other bits are the index.
pub const OUT_OF_BOUNDS: u32 = 1 << 31;

/// Block of an invocation that has returned.
const DONE: u32 = u32::MAX;

/// Limit of blocks, ten times the largest number of any shader in a test: a subgroup beyond it
/// waits for an event that does not occur.
const MOST_BLOCKS: u64 = 1_000_000;

/// Shared state of all workgroups of a dispatch.
pub struct Dispatch<'a> {
    pub code: &'a Code,
    /// By binding number.
    pub buffers: &'a mut [Option<Memory>],
    pub push: &'a [u32],
    pub groups: [u32; 3],
    pub faults: &'a mut Faults,
    pub counts: Counts,
}

/// State of a workgroup: position, memory, and numbers of barriers by the memory that they order.
pub struct Group {
    pub id: [u32; 3],
    pub number: u32,
    pub shared: Memory,
    pub shared_epoch: u32,
    pub buffer_epoch: u32,
}

/// Reason of a stop of a subgroup.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Stop {
    Barrier { at: u32, semantics: u32 },
    Slice,
    Done,
}

pub struct Subgroup {
    /// Local invocation index of every lane.
    pub locals: Vec<u32>,
    pub number: u32,
    pub subgroups: u32,
    /// Lanes per subgroup of this device; the last subgroup of a workgroup may have fewer.
    pub(crate) size: usize,
    pub(crate) regs: Vec<u32>,
    private: Vec<u32>,
    written: Vec<bool>,
    block: Vec<u32>,
    /// Index of the next instruction in the current block; not 0 after a barrier.
    pc: usize,
    pub(crate) active: Vec<usize>,
    blocks: u64,
    moved: Vec<u32>,
}

impl Subgroup {
    pub fn new(code: &Code, size: usize) -> Subgroup {
        let mut regs = vec![GARBAGE; code.registers as usize * size];
        for &(reg, word) in &code.constants {
            regs[reg as usize * size..][..size].fill(word);
        }
        let private = code.private_words as usize * size;
        Subgroup {
            locals: Vec::new(),
            number: 0,
            subgroups: 0,
            size,
            regs,
            private: vec![GARBAGE; private],
            written: vec![false; private],
            block: Vec::new(),
            pc: 0,
            active: Vec::new(),
            blocks: 0,
            moved: Vec::new(),
        }
    }

    /// Resets the subgroup to the entry, for other invocations.
    pub fn start(&mut self, locals: Vec<u32>, number: u32, subgroups: u32) {
        self.block = vec![0; locals.len()];
        (self.locals, self.number, self.subgroups) = (locals, number, subgroups);
        (self.pc, self.blocks) = (0, 0);
        self.private.fill(GARBAGE);
        self.written.fill(false);
    }

    /// Runs to the next barrier, to the end, or for a number of blocks.
    pub fn run(
        &mut self,
        d: &mut Dispatch,
        group: &mut Group,
        blocks: u32,
        ascending: bool,
    ) -> Result<Stop, String> {
        for _ in 0..blocks {
            let block = self.block.iter().copied().min().unwrap_or(DONE);
            if block == DONE {
                return Ok(Stop::Done);
            }
            if self.pc == 0 {
                self.blocks += 1;
                if self.blocks > MOST_BLOCKS {
                    return Err(format!("waits for another workgroup, or never ends: {MOST_BLOCKS} blocks"));
                }
                self.active.clear();
                self.active.extend((0..self.block.len()).filter(|&l| self.block[l] == block));
                if !ascending {
                    self.active.reverse();
                }
            }
            let code = d.code;
            let all = &code.blocks[block as usize];
            while let Some((inst, at)) = all.insts.get(self.pc) {
                self.pc += 1;
                d.counts.note(inst);
                if let Inst::Barrier { semantics } = inst {
                    if self.active.len() != self.locals.len() {
                        let (here, of) = (self.active.len(), self.locals.len());
                        return Err(format!("word {at}: barrier reached by {here} of {of} invocations"));
                    }
                    return Ok(Stop::Barrier { at: *at, semantics: *semantics });
                }
                self.step(inst, *at, d, group);
            }
            self.pc = 0;
            self.branch(&all.end);
        }
        Ok(Stop::Slice)
    }

    fn branch(&mut self, end: &End) {
        let lanes = std::mem::take(&mut self.active);
        match end {
            End::Return => lanes.iter().for_each(|&l| self.block[l] = DONE),
            End::Branch(edge) => self.follow(edge, &lanes),
            End::If(condition, yes, no) => {
                let first = *condition as usize * self.size;
                let (a, b): (Vec<_>, Vec<_>) = lanes.iter().partition(|l| self.regs[first + **l] != 0);
                self.follow(yes, &a);
                self.follow(no, &b);
            }
            End::Switch(selector, cases, default) => {
                for &lane in &lanes {
                    let value = self.regs[*selector as usize * self.size + lane];
                    let edge = cases.iter().find(|c| c.0 == value).map_or(default, |c| &c.1);
                    self.follow(edge, &[lane]);
                }
            }
        }
        self.active = lanes;
    }

    fn follow(&mut self, edge: &Edge, lanes: &[usize]) {
        if lanes.is_empty() {
            return;
        }
        self.moved.clear();
        for &(_, from) in &edge.moves {
            let first = from as usize * self.size;
            self.moved.extend(lanes.iter().map(|l| self.regs[first + l]));
        }
        for (&(to, _), values) in edge.moves.iter().zip(self.moved.chunks_exact(lanes.len())) {
            let first = to as usize * self.size;
            lanes.iter().zip(values).for_each(|(l, v)| self.regs[first + l] = *v);
        }
        lanes.iter().for_each(|&l| self.block[l] = edge.block);
    }

    fn step(&mut self, inst: &Inst, at: u32, d: &mut Dispatch, group: &mut Group) {
        let size = self.size;
        match inst {
            Inst::Unary(op, to, a) => alu::unary(*op, &self.active, size, &mut self.regs, *to, *a),
            Inst::Binary(op, to, a, b) => alu::binary(*op, &self.active, size, &mut self.regs, *to, *a, *b),
            Inst::Fma(to, a, b, c) => {
                alu::each!(&self.active, size, self.regs, *to, |x = (*a), y = (*b), z = (*c)| alu::fused(x, y, z));
            }
            Inst::Select(to, c, a, b) => {
                alu::each!(&self.active, size, self.regs, *to, |x = (*c), y = (*a), z = (*b)| if x != 0 {
                    y
                } else {
                    z
                });
            }
            Inst::PackUnorm4(to, [a, b, c, e]) => {
                alu::each!(&self.active, size, self.regs, *to, |w = (*a), x = (*b), y = (*c), z = (*e)| {
                    alu::unorm8([w, x, y, z])
                });
            }
            Inst::Pick(to, index, from) => {
                for k in 0..self.active.len() {
                    let lane = self.active[k];
                    let index = self.get(*index, lane) as usize;
                    let value = match from.get(index) {
                        Some(&reg) => self.get(reg, lane),
                        None => {
                            d.faults
                                .note(at, Fault::Outside, || format!("component {index} of {}", from.len()));
                            GARBAGE
                        }
                    };
                    self.set(*to, lane, value);
                }
            }
            Inst::Address { to, place, fixed, steps } => self.address(*to, *place, *fixed, steps, d),
            Inst::Load { to, place, words } => self.load(*to, *place, words, at, d, group),
            Inst::Store { from, place, words } => self.store(from, *place, words, at, d, group),
            Inst::Atomic { .. } => self.atomic(inst, at, d, group),
            Inst::Subgroup(op, to, a, b) => self.subgroup_op(*op, *to, (*a, *b), at, d.faults),
            Inst::Barrier { .. } => {}
        }
    }

    pub(crate) fn get(&self, reg: Reg, lane: usize) -> u32 {
        self.regs[reg as usize * self.size + lane]
    }

    pub(crate) fn set(&mut self, reg: Reg, lane: usize, value: u32) {
        self.regs[reg as usize * self.size + lane] = value;
    }

    fn address(&mut self, to: Reg, place: Place, fixed: u32, steps: &[Step], d: &Dispatch) {
        let whole = match place.root {
            Root::Buffer(binding) => d.buffers[binding as usize].as_ref().map_or(0, |b| b.words.len() as u32),
            _ => 0,
        };
        for k in 0..self.active.len() {
            let lane = self.active[k];
            let mut word = place.word.map_or(0, |reg| self.get(reg, lane));
            if word & OUT_OF_BOUNDS == 0 {
                word += fixed;
                for step in steps {
                    let index = self.get(step.index, lane);
                    let count = step.count.unwrap_or_else(|first| whole.saturating_sub(first) / step.stride);
                    if index >= count {
                        word = OUT_OF_BOUNDS | index.min(OUT_OF_BOUNDS - 1);
                        break;
                    }
                    word += index * step.stride;
                }
            }
            self.set(to, lane, word);
        }
    }

    fn accessor(&self, lane: usize, group: &Group, d: &Dispatch, root: Root) -> Accessor {
        let [x, y, z] = d.code.workgroup;
        let epoch = match root {
            Root::Shared(_) => group.shared_epoch,
            _ => group.buffer_epoch,
        };
        Accessor { invocation: 1 + group.number * x * y * z + self.locals[lane], epoch }
    }

    /// Word offset of a pointer; `None` after a fault.
    fn word(&self, place: Place, lane: usize, at: u32, faults: &mut Faults) -> Option<u32> {
        let word = place.word.map_or(0, |reg| self.get(reg, lane));
        if word & OUT_OF_BOUNDS == 0 {
            return Some(word);
        }
        faults.note(at, Fault::Outside, || format!("{:?}, index {}", place.root, word as i32 & i32::MAX));
        None
    }

    fn load(&mut self, to: Reg, place: Place, words: &[u32], at: u32, d: &mut Dispatch, group: &mut Group) {
        for k in 0..self.active.len() {
            let lane = self.active[k];
            let Some(first) = self.word(place, lane, at, d.faults) else {
                (0..words.len() as u32).for_each(|n| self.set(to + n, lane, GARBAGE));
                continue;
            };
            let accessor = self.accessor(lane, group, d, place.root);
            for (n, &word) in words.iter().enumerate() {
                let word = (first + word) as usize;
                let (value, fault) = match place.root {
                    Root::Push => (d.push[word], None),
                    Root::Input(built_in) => (self.input(built_in, word, lane, group, d), None),
                    Root::Private(base) => {
                        let slot = (base as usize + word) * self.size + lane;
                        let fault = (!self.written[slot]).then_some(Fault::Unwritten);
                        (self.private[slot], fault)
                    }
                    Root::Shared(base) => {
                        let (value, fault) = group.shared.load(base as usize + word, accessor);
                        (value, fault.map(Fault::from))
                    }
                    Root::Buffer(binding) => match buffer(d.buffers, binding, word) {
                        Some(memory) => {
                            let (value, fault) = memory.load(word, accessor);
                            (value, fault.map(Fault::from))
                        }
                        None => (GARBAGE, Some(Fault::Outside)),
                    },
                };
                if let Some(kind) = fault {
                    d.faults.note(at, kind, || describe("load", place.root, word, accessor));
                }
                self.set(to + n as u32, lane, value);
            }
        }
    }

    fn store(
        &mut self,
        from: &[Reg],
        place: Place,
        words: &[u32],
        at: u32,
        d: &mut Dispatch,
        group: &mut Group,
    ) {
        for k in 0..self.active.len() {
            let lane = self.active[k];
            let Some(first) = self.word(place, lane, at, d.faults) else { continue };
            let accessor = self.accessor(lane, group, d, place.root);
            for (&reg, &word) in from.iter().zip(words) {
                let (word, value) = ((first + word) as usize, self.get(reg, lane));
                let fault = match place.root {
                    Root::Private(base) => {
                        let slot = (base as usize + word) * self.size + lane;
                        (self.private[slot], self.written[slot]) = (value, true);
                        None
                    }
                    Root::Shared(base) => {
                        group.shared.store(base as usize + word, value, accessor).map(Fault::from)
                    }
                    Root::Buffer(binding) => match buffer(d.buffers, binding, word) {
                        Some(memory) => memory.store(word, value, accessor).map(Fault::from),
                        None => Some(Fault::Outside),
                    },
                    Root::Push | Root::Input(_) => Some(Fault::Outside),
                };
                if let Some(kind) = fault {
                    d.faults.note(at, kind, || describe("store", place.root, word, accessor));
                }
            }
        }
    }

    fn atomic(&mut self, inst: &Inst, at: u32, d: &mut Dispatch, group: &mut Group) {
        let Inst::Atomic { op, to, place, value, expected } = inst else { return };
        for k in 0..self.active.len() {
            let lane = self.active[k];
            let Some(word) = self.word(*place, lane, at, d.faults) else {
                self.set(*to, lane, GARBAGE);
                continue;
            };
            let (word, accessor) = (word as usize, self.accessor(lane, group, d, place.root));
            let operands = (self.get(*value, lane), self.get(*expected, lane));
            let (before, fault) = match place.root {
                Root::Shared(base) => {
                    let (before, fault) = group.shared.atomic(*op, base as usize + word, operands, accessor);
                    (before, fault.map(Fault::from))
                }
                Root::Buffer(binding) => match buffer(d.buffers, binding, word) {
                    Some(memory) => {
                        let (before, fault) = memory.atomic(*op, word, operands, accessor);
                        (before, fault.map(Fault::from))
                    }
                    None => (GARBAGE, Some(Fault::Outside)),
                },
                _ => (GARBAGE, Some(Fault::Outside)),
            };
            if let Some(kind) = fault {
                d.faults.note(at, kind, || describe("atomic", place.root, word, accessor));
            }
            self.set(*to, lane, before);
        }
    }

    fn input(&self, built_in: BuiltIn, word: usize, lane: usize, group: &Group, d: &Dispatch) -> u32 {
        let [x, y, _] = d.code.workgroup;
        let local = self.locals[lane];
        let id = [local % x, local / x % y, local / (x * y)];
        match built_in {
            BuiltIn::NumWorkgroups => d.groups[word],
            BuiltIn::WorkgroupId => group.id[word],
            BuiltIn::LocalInvocationId => id[word],
            BuiltIn::GlobalInvocationId => group.id[word] * d.code.workgroup[word] + id[word],
            BuiltIn::LocalInvocationIndex => local,
            BuiltIn::SubgroupSize => self.size as u32,
            BuiltIn::NumSubgroups => self.subgroups,
            BuiltIn::SubgroupId => self.number,
            BuiltIn::SubgroupLocalInvocationId => lane as u32,
            other => panic!("{other:?} is not read yet"),
        }
    }
}

/// Buffer of a binding if it contains a word.
fn buffer(buffers: &mut [Option<Memory>], binding: u32, word: usize) -> Option<&mut Memory> {
    buffers[binding as usize].as_mut().filter(|b| word < b.words.len())
}

fn describe(what: &str, root: Root, word: usize, accessor: Accessor) -> String {
    format!("{what} of {root:?}, word {word}, by invocation {}", accessor.invocation - 1)
}
