//! A module as a list of instructions that can be modified and reassembled.
use crate::types::{Type, Types};
use rspirv::binary::Assemble;
use rspirv::spirv::{Decoration, ExecutionMode, Op, StorageClass};
use std::collections::HashMap;

/// One instruction.
#[derive(Clone, Debug)]
pub struct Instruction {
    /// Its opcode.
    pub op: Op,
    /// Its operands.
    pub words: Vec<u32>,
    /// Offset of the instruction in the module, words.
    pub at: u32,
}

/// The instructions of a module, without its header.
///
/// # Panics
/// If it is no module of the SPIR-V version that rspirv reads.
pub fn instructions(words: &[u32]) -> Vec<Instruction> {
    let module = rspirv::dr::load_words(words).unwrap_or_else(|e| panic!("a module: {e}"));
    let mut at = 5;
    let list = module.all_inst_iter().map(|i| {
        let words = i.assemble();
        let begin = at;
        at += words.len() as u32;
        Instruction { op: i.class.opcode, words: words[1..].to_vec(), at: begin }
    });
    list.collect()
}

/// Words of a module: the header of another one, and these instructions.
pub fn assemble(header: &[u32], list: &[Instruction]) -> Vec<u32> {
    let mut out = header[..5].to_vec();
    for i in list {
        out.push((i.words.len() as u32 + 1) << 16 | i.op as u32);
        out.extend(&i.words);
    }
    out
}

pub(crate) struct Variable {
    pub id: u32,
    pub class: StorageClass,
    /// Type of its target.
    pub ty: u32,
    pub initializer: Option<u32>,
}

/// A constant: its type and its words, with parts flattened; `None` = undefined.
pub(crate) struct Constant {
    pub ty: u32,
    pub words: Option<Vec<u32>>,
}

#[derive(Default)]
pub(crate) struct Module {
    pub types: Types,
    pub constants: HashMap<u32, Constant>,
    pub variables: Vec<Variable>,
    pub bindings: HashMap<u32, u32>,
    pub built_ins: HashMap<u32, u32>,
    pub workgroup: [u32; 3],
    /// From the entry point's first label to its end.
    pub body: Vec<Instruction>,
}

impl Module {
    pub fn new(words: &[u32]) -> Module {
        let mut module = Module { workgroup: [1; 3], ..Module::default() };
        let mut list = instructions(words).into_iter();
        for i in list.by_ref() {
            if i.op == Op::Function {
                break;
            }
            module.declare(&i);
        }
        // The optimiser leaves one function; a second one would fail at its call.
        module.body = list.take_while(|i| i.op != Op::FunctionEnd).collect();
        module
    }

    fn declare(&mut self, i: &Instruction) {
        let w = &i.words;
        match i.op {
            Op::Decorate | Op::MemberDecorate => {
                self.types.decorate(i.op, w);
                if i.op == Op::Decorate && w[1] == Decoration::Binding as u32 {
                    self.bindings.insert(w[0], w[2]);
                }
                if i.op == Op::Decorate && w[1] == Decoration::BuiltIn as u32 {
                    self.built_ins.insert(w[0], w[2]);
                }
            }
            Op::ExecutionMode if w[1] == ExecutionMode::LocalSize as u32 => {
                self.workgroup = [w[2], w[3], w[4]];
            }
            Op::ConstantTrue => self.constant(w, vec![1]),
            Op::ConstantFalse => self.constant(w, vec![0]),
            Op::Constant => self.constant(w, vec![w[2]]),
            Op::ConstantNull => self.constant(w, vec![0; self.types.scalars(w[0])]),
            Op::ConstantComposite => {
                let parts = w[2..].iter().flat_map(|id| self.constants[id].words.clone().unwrap_or_default());
                let parts = parts.collect();
                self.constant(w, parts);
            }
            Op::Undef => {
                self.constants.insert(w[1], Constant { ty: w[0], words: None });
            }
            Op::Variable => self.variable(w),
            Op::TypeVoid
            | Op::TypeBool
            | Op::TypeInt
            | Op::TypeFloat
            | Op::TypeVector
            | Op::TypeMatrix
            | Op::TypeArray
            | Op::TypeRuntimeArray
            | Op::TypeStruct
            | Op::TypePointer
            | Op::TypeFunction => {
                let constants = &self.constants;
                let value = |id: u32| constants[&id].words.as_ref().expect("a length")[0];
                self.types.declare(i.op, w, value);
            }
            _ => {}
        }
    }

    fn constant(&mut self, w: &[u32], words: Vec<u32>) {
        self.constants.insert(w[1], Constant { ty: w[0], words: Some(words) });
    }

    /// Records an `OpVariable`, at module scope or in the function.
    pub fn variable(&mut self, w: &[u32]) {
        let Type::Pointer { class, to } = *self.types.get(w[0]) else { panic!("a variable is a pointer") };
        self.variables.push(Variable { id: w[1], class, ty: to, initializer: w.get(3).copied() });
    }
}
