//! Lowered form of a module: scalar operations on registers, in blocks.
//!
//! A register holds one 32-bit word for every invocation of a subgroup. A vector, a matrix or a
//! structure is a list of registers, so extracting and composing parts costs nothing. Booleans are
//! 0 or 1.
use rspirv::spirv::BuiltIn;

pub type Reg = u32;

/// Replaces a value that the specification leaves undefined: a NaN, and a very large integer.
pub const GARBAGE: u32 = 0xFFC0_DEAD;

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Unary {
    Not,
    LogicalNot,
    BitCount,
    FindLsb,
    FindMsb,
    SNegate,
    SAbs,
    FNegate,
    FAbs,
    FSign,
    Floor,
    Ceil,
    Trunc,
    RoundEven,
    Fract,
    Exp,
    Exp2,
    Log,
    Log2,
    Sqrt,
    InverseSqrt,
    Sin,
    Cos,
    FToU,
    FToS,
    SToF,
    UToF,
    IsNan,
    IsInf,
    /// One half of `unpackUnorm2x16`.
    UnormLow,
    UnormHigh,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Binary {
    IAdd,
    ISub,
    IMul,
    UDiv,
    SDiv,
    UMod,
    SRem,
    SMod,
    FAdd,
    FSub,
    FMul,
    FDiv,
    And,
    Or,
    Xor,
    ShiftLeft,
    ShiftRight,
    ShiftRightSigned,
    FMin,
    FMax,
    UMin,
    UMax,
    SMin,
    SMax,
    Pow,
    IEqual,
    INotEqual,
    ULess,
    ULessEqual,
    SLess,
    SLessEqual,
    FEqual,
    /// Unequal or unordered.
    FNotEqual,
    FLess,
    FLessEqual,
    PackHalf,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reduction {
    IAdd,
    FAdd,
    UMax,
}

/// Operations between the invocations of a subgroup.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Subgroup {
    All,
    Any,
    /// Word 0 to 3 of the ballot.
    Ballot(u32),
    Shuffle,
    ShuffleXor,
    Broadcast,
    Reduce(Reduction),
    Inclusive(Reduction),
    Exclusive(Reduction),
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Atomic {
    Load,
    Store,
    Exchange,
    CompareExchange,
    IAdd,
    And,
    Or,
    Xor,
    UMin,
    UMax,
    SMin,
    SMax,
    FAdd,
}

/// Variable that a pointer leads into; with logical addressing it is known statically.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Root {
    /// Storage buffer, by binding number.
    Buffer(u32),
    /// Workgroup memory, from a word on.
    Shared(u32),
    /// `Private` or `Function` memory of an invocation, from a word on.
    Private(u32),
    Push,
    Input(BuiltIn),
}

/// A root, and the register with the word offset if that is not 0.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub root: Root,
    pub word: Option<Reg>,
}

/// One index of an access chain.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    pub index: Reg,
    pub stride: u32,
    /// Number of elements; `Err` for a runtime array, with the word at which it begins.
    pub count: Result<u32, u32>,
}

#[derive(Clone, Debug)]
pub enum Inst {
    Unary(Unary, Reg, Reg),
    Binary(Binary, Reg, Reg, Reg),
    Fma(Reg, Reg, Reg, Reg),
    Select(Reg, Reg, Reg, Reg),
    PackUnorm4(Reg, [Reg; 4]),
    /// Register of a list, by index.
    Pick(Reg, Reg, Vec<Reg>),
    Address {
        to: Reg,
        place: Place,
        fixed: u32,
        steps: Vec<Step>,
    },
    /// Loads into consecutive registers.
    Load {
        to: Reg,
        place: Place,
        words: Vec<u32>,
    },
    Store {
        from: Vec<Reg>,
        place: Place,
        words: Vec<u32>,
    },
    Atomic {
        op: Atomic,
        to: Reg,
        place: Place,
        value: Reg,
        expected: Reg,
    },
    Subgroup(Subgroup, Reg, Reg, Reg),
    /// `barrier()`; the memory semantics state which memory it orders.
    Barrier {
        semantics: u32,
    },
}

/// Edge to another block, with the moves of its phis.
#[derive(Clone, Debug)]
pub struct Edge {
    pub block: u32,
    /// (phi, source), all performed at once.
    pub moves: Vec<(Reg, Reg)>,
}

#[derive(Clone, Debug)]
pub enum End {
    Branch(Edge),
    If(Reg, Edge, Edge),
    Switch(Reg, Vec<(u32, Edge)>, Edge),
    Return,
}

#[derive(Clone, Debug)]
pub struct Block {
    /// Instructions, each with its word offset in the module.
    pub insts: Vec<(Inst, u32)>,
    pub end: End,
}

/// An executable module.
pub struct Code {
    /// In structured order: a merge block follows all blocks of its construct; the entry is first.
    pub blocks: Vec<Block>,
    pub registers: u32,
    pub constants: Vec<(Reg, u32)>,
    pub private_words: u32,
    pub shared_words: u32,
    pub workgroup: [u32; 3],
}
