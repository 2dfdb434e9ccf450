//! Types of a module: number of scalars of a value, and their layout in memory.
use rspirv::spirv::{Decoration, Op, StorageClass};
use std::collections::HashMap;

/// A type, by the ids of its parts.
#[derive(Clone, Debug)]
pub enum Type {
    Void,
    Bool,
    Int,
    Float,
    Vector { of: u32, count: u32 },
    Matrix { column: u32, count: u32 },
    Array { of: u32, count: u32 },
    RuntimeArray { of: u32 },
    Struct { members: Vec<u32> },
    Pointer { class: StorageClass, to: u32 },
}

/// All types, with the layout that blocks declare. Lengths and offsets count 32-bit words.
#[derive(Default)]
pub struct Types {
    all: HashMap<u32, Type>,
    strides: HashMap<u32, u32>,
    members: HashMap<(u32, u32), u32>,
}

/// Element type of an index, the stride in words, and the number of elements if it is fixed.
pub struct Member {
    pub ty: u32,
    pub stride: u32,
    pub count: Option<u32>,
}

impl Types {
    pub fn get(&self, id: u32) -> &Type {
        self.all.get(&id).unwrap_or_else(|| panic!("%{id} is no type that shaders use"))
    }

    /// Records the layout in `OpDecorate` and `OpMemberDecorate`.
    pub fn decorate(&mut self, op: Op, words: &[u32]) {
        match op {
            Op::Decorate if words[1] == Decoration::ArrayStride as u32 => {
                self.strides.insert(words[0], words[2] / 4);
            }
            Op::MemberDecorate if words[2] == Decoration::Offset as u32 => {
                self.members.insert((words[0], words[1]), words[3] / 4);
            }
            Op::MemberDecorate => {
                assert_ne!(words[2], Decoration::MatrixStride as u32, "a matrix in a buffer is not read yet");
            }
            _ => {}
        }
    }

    /// Records an `OpType…`; `constant` returns the values of array lengths.
    pub fn declare(&mut self, op: Op, words: &[u32], constant: impl Fn(u32) -> u32) {
        let ty = match op {
            Op::TypeVoid | Op::TypeFunction => Type::Void,
            Op::TypeBool => Type::Bool,
            Op::TypeInt | Op::TypeFloat => {
                assert_eq!(words[1], 32, "only 32-bit numbers are read");
                if op == Op::TypeInt { Type::Int } else { Type::Float }
            }
            Op::TypeVector => Type::Vector { of: words[1], count: words[2] },
            Op::TypeMatrix => Type::Matrix { column: words[1], count: words[2] },
            Op::TypeArray => Type::Array { of: words[1], count: constant(words[2]) },
            Op::TypeRuntimeArray => Type::RuntimeArray { of: words[1] },
            Op::TypeStruct => Type::Struct { members: words[1..].to_vec() },
            Op::TypePointer => {
                let class = StorageClass::from_u32(words[1]).expect("a storage class");
                Type::Pointer { class, to: words[2] }
            }
            other => panic!("{other:?} is not read yet"),
        };
        self.all.insert(words[0], ty);
    }

    /// Number of scalars of a value.
    pub fn scalars(&self, id: u32) -> usize {
        match self.get(id) {
            Type::Void => 0,
            Type::Bool | Type::Int | Type::Float | Type::Pointer { .. } => 1,
            Type::Vector { count, .. } => *count as usize,
            Type::Matrix { column: of, count } | Type::Array { of, count } => {
                self.scalars(*of) * *count as usize
            }
            Type::Struct { members } => members.iter().map(|m| self.scalars(*m)).sum(),
            Type::RuntimeArray { .. } => panic!("an array of unknown length is no value"),
        }
    }

    /// Size of a value in memory, words.
    pub fn words(&self, id: u32) -> u32 {
        match self.get(id) {
            Type::RuntimeArray { .. } => 0,
            Type::Array { of, count } => self.stride(id, *of) * count,
            Type::Struct { members } => {
                let end = |(k, m): (usize, &u32)| self.offset(id, k as u32) + self.words(*m);
                members.iter().enumerate().map(end).max().unwrap_or(0)
            }
            _ => self.scalars(id) as u32,
        }
    }

    fn stride(&self, array: u32, of: u32) -> u32 {
        self.strides.get(&array).copied().unwrap_or_else(|| self.words(of))
    }

    fn offset(&self, id: u32, member: u32) -> u32 {
        if let Some(&offset) = self.members.get(&(id, member)) {
            return offset;
        }
        let Type::Struct { members } = self.get(id) else { return 0 };
        members[..member as usize].iter().map(|m| self.words(*m)).sum()
    }

    /// Word offset of each scalar of a value in memory, in order.
    pub fn word_offsets(&self, id: u32, first: u32, out: &mut Vec<u32>) {
        match self.get(id) {
            Type::Array { of, count } => {
                (0..*count).for_each(|k| self.word_offsets(*of, first + k * self.stride(id, *of), out));
            }
            Type::Struct { members } => {
                for (k, member) in members.iter().enumerate() {
                    self.word_offsets(*member, first + self.offset(id, k as u32), out);
                }
            }
            _ => out.extend((0..self.scalars(id) as u32).map(|k| first + k)),
        }
    }

    /// Type and first word of member `index` of a structure.
    pub fn field(&self, id: u32, index: u32) -> Option<(u32, u32)> {
        let Type::Struct { members } = self.get(id) else { return None };
        Some((members[index as usize], self.offset(id, index)))
    }

    /// Element of an index into anything but a structure.
    pub fn element(&self, id: u32) -> Member {
        match self.get(id) {
            Type::Vector { of, count } => Member { ty: *of, stride: 1, count: Some(*count) },
            Type::Matrix { column, count } => {
                Member { ty: *column, stride: self.scalars(*column) as u32, count: Some(*count) }
            }
            Type::Array { of, count } => {
                Member { ty: *of, stride: self.stride(id, *of), count: Some(*count) }
            }
            Type::RuntimeArray { of } => Member { ty: *of, stride: self.stride(id, *of), count: None },
            other => panic!("{other:?} has no elements"),
        }
    }

    /// Number of scalars before part `index` of a value, and the type of that part.
    pub fn part(&self, id: u32, index: u32) -> (usize, u32) {
        match self.get(id) {
            Type::Struct { members } => {
                let before = members[..index as usize].iter().map(|m| self.scalars(*m)).sum();
                (before, members[index as usize])
            }
            _ => {
                let ty = self.element(id).ty;
                (self.scalars(ty) * index as usize, ty)
            }
        }
    }

    /// Rows and columns.
    pub fn matrix(&self, id: u32) -> (usize, usize) {
        let Type::Matrix { column, count } = self.get(id) else { panic!("%{id} is no matrix") };
        (self.scalars(*column), *count as usize)
    }
}
