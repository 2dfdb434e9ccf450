//! Lowering of a module to [`Code`]: blocks, memory, atomics and subgroup operations. Arithmetic is
//! in `lower_alu.rs`.
use crate::code::{
    Atomic, Block, Code, Edge, End, GARBAGE, Inst, Place, Reduction, Reg, Root, Step, Subgroup,
};
use crate::module::{Instruction, Module};
use crate::types::Type;
use rspirv::spirv::{BuiltIn, GroupOperation, Op, StorageClass};
use std::collections::{HashMap, HashSet};

pub struct Lowering {
    pub module: Module,
    /// Type and registers of every value.
    pub values: HashMap<u32, (u32, Vec<Reg>)>,
    /// Every pointer, with the type of its target.
    places: HashMap<u32, (Place, u32)>,
    registers: Reg,
    constants: Vec<(Reg, u32)>,
    private_words: u32,
    shared_words: u32,
    out: Vec<(Inst, u32)>,
    pub at: u32,
}

/// A block of the module before its phis are resolved.
struct RawBlock {
    label: u32,
    phis: Vec<Instruction>,
    insts: Vec<(Inst, u32)>,
    end: Instruction,
    /// Merge block and continue target, in this order.
    merges: Vec<u32>,
}

pub fn lower(words: &[u32]) -> Code {
    let module = Module::new(words);
    let mut l = Lowering {
        module,
        values: HashMap::new(),
        places: HashMap::new(),
        registers: 0,
        constants: Vec::new(),
        private_words: 0,
        shared_words: 0,
        out: Vec::new(),
        at: 0,
    };
    let body = std::mem::take(&mut l.module.body);
    for i in body.iter().filter(|i| i.op == Op::Variable) {
        l.module.variable(&i.words);
    }
    l.declare();
    let raw = l.blocks(&body);
    let order = structured_order(&raw);
    let number: HashMap<u32, u32> =
        order.iter().enumerate().map(|(k, &b)| (raw[b].label, k as u32)).collect();
    let phis: HashMap<u32, &RawBlock> = raw.iter().map(|b| (b.label, b)).collect();
    let blocks = order.iter().map(|&b| l.finish(&raw[b], &number, &phis)).collect();
    Code {
        blocks,
        registers: l.registers,
        constants: l.constants,
        private_words: l.private_words,
        shared_words: l.shared_words,
        workgroup: l.module.workgroup,
    }
}

/// Blocks in structured order, in which all of a construct precedes its merge block: reverse
/// post-order of a depth-first walk that visits merge blocks first and continue targets next.
fn structured_order(raw: &[RawBlock]) -> Vec<usize> {
    let index: HashMap<u32, usize> = raw.iter().enumerate().map(|(k, b)| (b.label, k)).collect();
    let next = |b: usize| -> Vec<usize> {
        let targets = match raw[b].end.op {
            Op::Branch => raw[b].end.words[..1].to_vec(),
            Op::BranchConditional => raw[b].end.words[1..3].to_vec(),
            Op::Switch => raw[b].end.words[1..].iter().step_by(2).copied().collect(),
            _ => Vec::new(),
        };
        raw[b].merges.iter().chain(&targets).map(|t| index[t]).collect()
    };
    let (mut seen, mut post, mut stack) = (HashSet::from([0]), Vec::new(), vec![(0, next(0))]);
    while let Some((block, rest)) = stack.last_mut() {
        if rest.is_empty() {
            post.push(*block);
            stack.pop();
        } else {
            let b = rest.remove(0);
            if seen.insert(b) {
                stack.push((b, next(b)));
            }
        }
    }
    post.reverse();
    post
}

impl Lowering {
    pub fn registers(&mut self, count: usize) -> Vec<Reg> {
        let first = self.registers;
        self.registers += count as Reg;
        (first..self.registers).collect()
    }

    pub fn constant(&mut self, word: u32) -> Reg {
        let reg = self.registers(1)[0];
        self.constants.push((reg, word));
        reg
    }

    pub fn push(&mut self, inst: Inst) {
        self.out.push((inst, self.at));
    }

    pub fn value(&self, id: u32) -> Vec<Reg> {
        self.values.get(&id).unwrap_or_else(|| panic!("%{id} has no value")).1.clone()
    }

    pub fn scalar(&self, id: u32) -> Reg {
        self.value(id)[0]
    }

    /// Allocates registers for a result.
    pub fn result(&mut self, i: &Instruction) -> Vec<Reg> {
        let count = self.module.types.scalars(i.words[0]);
        let regs = self.registers(count);
        self.assign(i, regs.clone());
        regs
    }

    /// Assigns registers to a result.
    pub fn assign(&mut self, i: &Instruction, regs: Vec<Reg>) {
        self.values.insert(i.words[1], (i.words[0], regs));
    }

    fn declare(&mut self) {
        let constants = std::mem::take(&mut self.module.constants);
        for (&id, constant) in &constants {
            let count = self.module.types.scalars(constant.ty);
            let words = constant.words.clone().unwrap_or_else(|| vec![GARBAGE; count]);
            let regs = words.iter().map(|w| self.constant(*w)).collect();
            self.values.insert(id, (constant.ty, regs));
        }
        for variable in std::mem::take(&mut self.module.variables) {
            let words = self.module.types.words(variable.ty);
            let root = match variable.class {
                StorageClass::StorageBuffer => Root::Buffer(self.module.bindings[&variable.id]),
                StorageClass::PushConstant => Root::Push,
                StorageClass::Input => {
                    let built_in = BuiltIn::from_u32(self.module.built_ins[&variable.id]);
                    Root::Input(built_in.expect("a built-in"))
                }
                StorageClass::Workgroup => {
                    self.shared_words += words;
                    Root::Shared(self.shared_words - words)
                }
                StorageClass::Private | StorageClass::Function => {
                    self.private_words += words;
                    Root::Private(self.private_words - words)
                }
                other => panic!("variables in {other:?} are not read yet"),
            };
            let place = Place { root, word: None };
            self.places.insert(variable.id, (place, variable.ty));
            if let Some(value) = variable.initializer {
                self.store(variable.id, value);
            }
        }
    }

    fn blocks(&mut self, body: &[Instruction]) -> Vec<RawBlock> {
        let mut blocks = Vec::new();
        let (mut label, mut phis, mut merges) = (0, Vec::new(), Vec::new());
        for i in body {
            self.at = i.at;
            match i.op {
                Op::Label => label = i.words[0],
                Op::Phi => {
                    self.result(i);
                    phis.push(i.clone());
                }
                Op::SelectionMerge => merges.push(i.words[0]),
                Op::LoopMerge => merges.extend(&i.words[..2]),
                Op::Branch | Op::BranchConditional | Op::Switch | Op::Return | Op::Unreachable => {
                    blocks.push(RawBlock {
                        label,
                        phis: std::mem::take(&mut phis),
                        insts: std::mem::take(&mut self.out),
                        end: i.clone(),
                        merges: std::mem::take(&mut merges),
                    });
                }
                _ => self.instruction(i),
            }
        }
        blocks
    }

    /// Completes a block with its end, once every value has registers.
    fn finish(&self, raw: &RawBlock, number: &HashMap<u32, u32>, all: &HashMap<u32, &RawBlock>) -> Block {
        let edge = |to: u32| {
            let mut moves = Vec::new();
            for phi in &all[&to].phis {
                let sources = phi.words[2..].chunks_exact(2).find(|s| s[1] == raw.label);
                let source = self.value(sources.expect("a source for every edge")[0]);
                moves.extend(self.value(phi.words[1]).into_iter().zip(source));
            }
            Edge { block: number[&to], moves }
        };
        let w = &raw.end.words;
        let end = match raw.end.op {
            Op::Branch => End::Branch(edge(w[0])),
            Op::BranchConditional => End::If(self.scalar(w[0]), edge(w[1]), edge(w[2])),
            Op::Switch => {
                let cases = w[2..].chunks_exact(2).map(|c| (c[0], edge(c[1]))).collect();
                End::Switch(self.scalar(w[0]), cases, edge(w[1]))
            }
            _ => End::Return,
        };
        Block { insts: raw.insts.clone(), end }
    }

    fn instruction(&mut self, i: &Instruction) {
        let w = &i.words;
        match i.op {
            Op::Function | Op::FunctionEnd | Op::Variable | Op::Line | Op::NoLine | Op::Name => {}
            Op::AccessChain | Op::InBoundsAccessChain => self.access_chain(w),
            Op::Load => {
                let (place, ty) = self.places[&w[2]];
                let mut words = Vec::new();
                self.module.types.word_offsets(ty, 0, &mut words);
                let to = self.result(i)[0];
                self.push(Inst::Load { to, place, words });
            }
            Op::Store => self.store(w[0], w[1]),
            // Execution and memory scope are constants, too; shaders have barriers of the whole
            // workgroup only.
            Op::ControlBarrier => {
                let scope = self.constant_value(w[0]);
                assert_eq!(scope, rspirv::spirv::Scope::Workgroup as u32, "a barrier of a workgroup");
                self.push(Inst::Barrier { semantics: self.constant_value(w[2]) });
            }
            _ if self.atomic(i) || self.subgroup(i) || self.alu(i) => {}
            other => panic!("{other:?} is not read yet"),
        }
    }

    /// Value of a constant.
    fn constant_value(&self, id: u32) -> u32 {
        let reg = self.scalar(id);
        self.constants.iter().find(|c| c.0 == reg).expect("a constant").1
    }

    fn store(&mut self, pointer: u32, value: u32) {
        let (place, ty) = self.places[&pointer];
        let mut words = Vec::new();
        self.module.types.word_offsets(ty, 0, &mut words);
        let from = self.value(value);
        self.push(Inst::Store { from, place, words });
    }

    fn access_chain(&mut self, w: &[u32]) {
        let (place, mut ty) = self.places[&w[2]];
        let (mut fixed, mut steps) = (0, Vec::new());
        for &index in &w[3..] {
            if let Type::Struct { .. } = self.module.types.get(ty) {
                let (member, first) =
                    self.module.types.field(ty, self.constant_value(index)).expect("a member");
                (ty, fixed) = (member, fixed + first);
                continue;
            }
            let element = self.module.types.element(ty);
            let index = self.scalar(index);
            steps.push(Step { index, stride: element.stride, count: element.count.ok_or(fixed) });
            ty = element.ty;
        }
        let to = self.registers(1)[0];
        self.push(Inst::Address { to, place, fixed, steps });
        self.places.insert(w[1], (Place { root: place.root, word: Some(to) }, ty));
    }

    fn atomic(&mut self, i: &Instruction) -> bool {
        let w = &i.words;
        // Operands: result type and id, pointer, scope, semantics, then the value; a comparison has
        // one more semantics operand.
        let (op, value, expected) = match i.op {
            Op::AtomicLoad => (Atomic::Load, None, None),
            Op::AtomicStore => {
                let (place, _) = self.places[&w[0]];
                let value = self.scalar(w[3]);
                self.push(Inst::Atomic { op: Atomic::Store, to: value, place, value, expected: value });
                return true;
            }
            Op::AtomicExchange => (Atomic::Exchange, Some(5), None),
            Op::AtomicCompareExchange => (Atomic::CompareExchange, Some(6), Some(7)),
            Op::AtomicIAdd => (Atomic::IAdd, Some(5), None),
            Op::AtomicAnd => (Atomic::And, Some(5), None),
            Op::AtomicOr => (Atomic::Or, Some(5), None),
            Op::AtomicXor => (Atomic::Xor, Some(5), None),
            Op::AtomicUMin => (Atomic::UMin, Some(5), None),
            Op::AtomicUMax => (Atomic::UMax, Some(5), None),
            Op::AtomicSMin => (Atomic::SMin, Some(5), None),
            Op::AtomicSMax => (Atomic::SMax, Some(5), None),
            Op::AtomicFAddEXT => (Atomic::FAdd, Some(5), None),
            _ => return false,
        };
        let (place, _) = self.places[&w[2]];
        let to = self.result(i)[0];
        let value = value.map_or(to, |k: usize| self.scalar(w[k]));
        let expected = expected.map_or(to, |k: usize| self.scalar(w[k]));
        self.push(Inst::Atomic { op, to, place, value, expected });
        true
    }

    /// Lowers a subgroup operation. Operands: result type and id, scope, then the value, or the
    /// operation and the value.
    fn subgroup(&mut self, i: &Instruction) -> bool {
        let w = &i.words;
        let reduction = match i.op {
            Op::GroupNonUniformIAdd => Some(Reduction::IAdd),
            Op::GroupNonUniformFAdd => Some(Reduction::FAdd),
            Op::GroupNonUniformUMax => Some(Reduction::UMax),
            _ => None,
        };
        if let Some(reduction) = reduction {
            let op = match GroupOperation::from_u32(w[3]) {
                Some(GroupOperation::Reduce) => Subgroup::Reduce(reduction),
                Some(GroupOperation::InclusiveScan) => Subgroup::Inclusive(reduction),
                Some(GroupOperation::ExclusiveScan) => Subgroup::Exclusive(reduction),
                other => panic!("{other:?} is not read yet"),
            };
            self.each(i, w[4], None, op);
            return true;
        }
        match i.op {
            Op::GroupNonUniformAll => self.each(i, w[3], None, Subgroup::All),
            Op::GroupNonUniformAny => self.each(i, w[3], None, Subgroup::Any),
            Op::GroupNonUniformShuffle => self.each(i, w[3], Some(w[4]), Subgroup::Shuffle),
            Op::GroupNonUniformShuffleXor => self.each(i, w[3], Some(w[4]), Subgroup::ShuffleXor),
            Op::GroupNonUniformBroadcast => self.each(i, w[3], Some(w[4]), Subgroup::Broadcast),
            Op::GroupNonUniformBallot => {
                let value = self.scalar(w[3]);
                for (k, to) in self.result(i).into_iter().enumerate() {
                    self.push(Inst::Subgroup(Subgroup::Ballot(k as u32), to, value, value));
                }
            }
            _ => return false,
        }
        true
    }

    fn each(&mut self, i: &Instruction, value: u32, other: Option<u32>, op: Subgroup) {
        let values = self.value(value);
        let other = other.map(|id| self.scalar(id));
        for (to, value) in self.result(i).into_iter().zip(values) {
            self.push(Inst::Subgroup(op, to, value, other.unwrap_or(value)));
        }
    }
}
