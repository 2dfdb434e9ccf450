//! What a module is lowered to: scalar operations on registers, in blocks.
//!
//! A register holds one 32-bit word for every invocation of a subgroup. A vector, a matrix or a
//! structure is a list of registers, so taking it apart and putting it together costs nothing.
//! Booleans are 0 or 1.
use spirv::BuiltIn;

pub type Reg = u32;

/// Stands for a value that the specification leaves undefined: a NaN, and a very large integer.
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
    /// Unequal, or not to be compared.
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

/// What invocations of a subgroup do together.
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

/// The variable that a pointer leads into; logical addressing makes it known beforehand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Root {
    /// Storage buffer by binding number.
    Buffer(u32),
    /// Workgroup memory from a word on.
    Shared(u32),
    /// `Private` or `Function` memory of an invocation from a word on.
    Private(u32),
    Push,
    Input(BuiltIn),
}

/// A root, and the register with the word in it if that is not 0.
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
    /// Number of elements; `Err` for an array up to the end of its buffer, with the word where it
    /// begins.
    pub count: Result<u32, u32>,
}

#[derive(Clone, Debug)]
pub enum Inst {
    Unary(Unary, Reg, Reg),
    Binary(Binary, Reg, Reg, Reg),
    Fma(Reg, Reg, Reg, Reg),
    Select(Reg, Reg, Reg, Reg),
    PackUnorm4(Reg, [Reg; 4]),
    /// The register of a list that an index says.
    Pick(Reg, Reg, Vec<Reg>),
    Address {
        to: Reg,
        place: Place,
        fixed: u32,
        steps: Vec<Step>,
    },
    /// To consecutive registers.
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
    /// `barrier()`; the memory semantics say which memory it orders.
    Barrier {
        semantics: u32,
    },
}

/// The way to another block, with what its phis take.
#[derive(Clone, Debug)]
pub struct Edge {
    pub block: u32,
    /// (phi, source), all at once.
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
    /// Each with the word of the module where it stands.
    pub insts: Vec<(Inst, u32)>,
    pub end: End,
}

/// A module ready to run.
pub struct Code {
    /// In an order in which what a construct merges to follows all of it, the entry first.
    pub blocks: Vec<Block>,
    pub registers: u32,
    pub constants: Vec<(Reg, u32)>,
    pub private_words: u32,
    pub shared_words: u32,
    pub workgroup: [u32; 3],
}
