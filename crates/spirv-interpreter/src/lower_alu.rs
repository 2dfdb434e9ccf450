//! Lowering of arithmetic to scalar operations; extracting and composing parts costs nothing.
use crate::code::{Binary, GARBAGE, Inst, Reg, Unary};
use crate::lower::Lowering;
use crate::module::Instruction;
use rspirv::spirv::{GlslStd450Op as GLOp, Op};

impl Lowering {
    pub fn alu(&mut self, i: &Instruction) -> bool {
        if let Some(op) = unary(i.op) {
            self.unary(i, op, i.words[2]);
        } else if let Some((op, swapped)) = binary(i.op) {
            let (a, b) = (i.words[2], i.words[3]);
            let (a, b) = if swapped { (b, a) } else { (a, b) };
            self.binary(i, op, a, b);
        } else {
            return self.composite(i) || self.linear(i) || self.extended(i) || self.other(i);
        }
        true
    }

    fn unary(&mut self, i: &Instruction, op: Unary, a: u32) {
        let a = self.value(a);
        for (to, a) in self.result(i).into_iter().zip(a) {
            self.push(Inst::Unary(op, to, a));
        }
    }

    fn binary(&mut self, i: &Instruction, op: Binary, a: u32, b: u32) {
        let (a, b) = (self.value(a), self.value(b));
        for ((to, a), b) in self.result(i).into_iter().zip(a).zip(b) {
            self.push(Inst::Binary(op, to, a, b));
        }
    }

    fn composite(&mut self, i: &Instruction) -> bool {
        let w = &i.words;
        match i.op {
            Op::CompositeConstruct => {
                let parts = w[2..].iter().flat_map(|id| self.value(*id)).collect();
                self.assign(i, parts);
            }
            Op::CompositeExtract => {
                let (first, count) = self.part(w[2], &w[3..]);
                let regs = self.value(w[2])[first..first + count].to_vec();
                self.assign(i, regs);
            }
            Op::CompositeInsert => {
                let (first, count) = self.part(w[3], &w[4..]);
                let mut regs = self.value(w[3]);
                regs[first..first + count].copy_from_slice(&self.value(w[2]));
                self.assign(i, regs);
            }
            Op::VectorShuffle => {
                let both = [self.value(w[2]), self.value(w[3])].concat();
                let undefined = self.constant(GARBAGE);
                let regs = w[4..].iter().map(|k| both.get(*k as usize).copied().unwrap_or(undefined));
                let regs = regs.collect();
                self.assign(i, regs);
            }
            Op::CopyObject | Op::Bitcast => {
                let regs = self.value(w[2]);
                self.assign(i, regs);
            }
            Op::Undef => {
                let count = self.module.types.scalars(w[0]);
                let regs = (0..count).map(|_| self.constant(GARBAGE)).collect();
                self.assign(i, regs);
            }
            _ => return false,
        }
        true
    }

    /// Number of scalars before a part of a composite, and in it.
    fn part(&self, id: u32, path: &[u32]) -> (usize, usize) {
        let (mut first, mut ty) = (0, self.values[&id].0);
        for &index in path {
            let (before, inner) = self.module.types.part(ty, index);
            (first, ty) = (first + before, inner);
        }
        (first, self.module.types.scalars(ty))
    }

    fn dot(&mut self, to: Reg, a: &[Reg], b: &[Reg]) {
        let mut sum = None;
        for (&a, &b) in a.iter().zip(b) {
            let product = self.registers(1)[0];
            self.push(Inst::Binary(Binary::FMul, product, a, b));
            sum = Some(match sum {
                None => product,
                Some(sum) => {
                    let next = self.registers(1)[0];
                    self.push(Inst::Binary(Binary::FAdd, next, sum, product));
                    next
                }
            });
        }
        let zero = self.constant(0);
        self.push(Inst::Binary(Binary::FAdd, to, sum.expect("a vector has components"), zero));
    }

    /// Lowers operations on vectors and matrices; matrices are stored by columns.
    fn linear(&mut self, i: &Instruction) -> bool {
        let w = &i.words;
        if !matches!(
            i.op,
            Op::VectorTimesScalar
                | Op::MatrixTimesScalar
                | Op::Dot
                | Op::VectorTimesMatrix
                | Op::MatrixTimesVector
                | Op::MatrixTimesMatrix
                | Op::OuterProduct
                | Op::Transpose
        ) {
            return false;
        }
        let a = self.value(w[2]);
        if i.op == Op::Transpose {
            let (rows, columns) = self.module.types.matrix(self.values[&w[2]].0);
            let regs = (0..rows * columns).map(|k| a[k % columns * rows + k / columns]).collect();
            self.assign(i, regs);
            return true;
        }
        let b = self.value(w[3]);
        let to = self.result(i);
        match i.op {
            Op::VectorTimesScalar | Op::MatrixTimesScalar => {
                for (to, a) in to.into_iter().zip(a) {
                    self.push(Inst::Binary(Binary::FMul, to, a, b[0]));
                }
            }
            Op::Dot => self.dot(to[0], &a, &b),
            Op::VectorTimesMatrix => {
                for (to, column) in to.into_iter().zip(b.chunks_exact(a.len())) {
                    self.dot(to, &a, column);
                }
            }
            // The columns of the right factor, one after another; a vector is one column.
            Op::MatrixTimesVector | Op::MatrixTimesMatrix => {
                let inner = match i.op {
                    Op::MatrixTimesVector => b.len(),
                    _ => self.module.types.matrix(self.values[&w[2]].0).1,
                };
                let rows = a.len() / inner;
                for (k, to) in to.into_iter().enumerate() {
                    let row: Vec<Reg> = a.iter().skip(k % rows).step_by(rows).copied().collect();
                    self.dot(to, &row, &b[k / rows * inner..][..inner]);
                }
            }
            _ => {
                for (k, to) in to.into_iter().enumerate() {
                    self.push(Inst::Binary(Binary::FMul, to, a[k % a.len()], b[k / a.len()]));
                }
            }
        }
        true
    }

    fn other(&mut self, i: &Instruction) -> bool {
        let w = &i.words;
        match i.op {
            Op::Select => {
                let (c, a, b) = (self.value(w[2]), self.value(w[3]), self.value(w[4]));
                for (k, to) in self.result(i).into_iter().enumerate() {
                    self.push(Inst::Select(to, c[k % c.len()], a[k], b[k]));
                }
            }
            Op::Any | Op::All => {
                let op = if i.op == Op::Any { Binary::Or } else { Binary::And };
                let mut sum = self.scalar(w[2]);
                for part in self.value(w[2]).into_iter().skip(1) {
                    let next = self.registers(1)[0];
                    self.push(Inst::Binary(op, next, sum, part));
                    sum = next;
                }
                self.assign(i, vec![sum]);
            }
            Op::VectorExtractDynamic => {
                let (from, index) = (self.value(w[2]), self.scalar(w[3]));
                let to = self.result(i)[0];
                self.push(Inst::Pick(to, index, from));
            }
            _ => return false,
        }
        true
    }

    /// Lowers instructions of GLSL.std.450.
    fn extended(&mut self, i: &Instruction) -> bool {
        if i.op != Op::ExtInst {
            return false;
        }
        let op = GLOp::from_u32(i.words[3]).expect("an instruction of GLSL.std.450");
        let args: Vec<Vec<Reg>> = i.words[4..].iter().map(|id| self.value(*id)).collect();
        let to = self.result(i);
        if let Some(op) = extended_unary(op) {
            to.iter().zip(&args[0]).for_each(|(to, a)| self.push(Inst::Unary(op, *to, *a)));
        } else if let Some(op) = extended_binary(op) {
            for (k, to) in to.iter().enumerate() {
                self.push(Inst::Binary(op, *to, args[0][k], args[1][k]));
            }
        } else {
            self.extended_other(op, &to, &args);
        }
        true
    }

    fn extended_other(&mut self, op: GLOp, to: &[Reg], args: &[Vec<Reg>]) {
        match op {
            GLOp::Fma => {
                for (k, to) in to.iter().enumerate() {
                    self.push(Inst::Fma(*to, args[0][k], args[1][k], args[2][k]));
                }
            }
            GLOp::FClamp | GLOp::UClamp | GLOp::SClamp => {
                let (max, min) = match op {
                    GLOp::FClamp => (Binary::FMax, Binary::FMin),
                    GLOp::UClamp => (Binary::UMax, Binary::UMin),
                    _ => (Binary::SMax, Binary::SMin),
                };
                for (k, to) in to.iter().enumerate() {
                    let low = self.registers(1)[0];
                    self.push(Inst::Binary(max, low, args[0][k], args[1][k]));
                    self.push(Inst::Binary(min, *to, low, args[2][k]));
                }
            }
            GLOp::Length | GLOp::Normalize => {
                let (square, length) = (self.registers(1)[0], self.registers(1)[0]);
                self.dot(square, &args[0], &args[0]);
                self.push(Inst::Unary(Unary::Sqrt, length, square));
                if op == GLOp::Length {
                    let zero = self.constant(0);
                    return self.push(Inst::Binary(Binary::FAdd, to[0], length, zero));
                }
                for (to, a) in to.iter().zip(&args[0]) {
                    self.push(Inst::Binary(Binary::FDiv, *to, *a, length));
                }
            }
            GLOp::Cross => {
                for k in 0..3 {
                    let (next, last) = ((k + 1) % 3, (k + 2) % 3);
                    let products = self.registers(2);
                    self.push(Inst::Binary(Binary::FMul, products[0], args[0][next], args[1][last]));
                    self.push(Inst::Binary(Binary::FMul, products[1], args[0][last], args[1][next]));
                    self.push(Inst::Binary(Binary::FSub, to[k], products[0], products[1]));
                }
            }
            GLOp::PackHalf2x16 => self.push(Inst::Binary(Binary::PackHalf, to[0], args[0][0], args[0][1])),
            GLOp::PackUnorm4x8 => {
                let parts = [0, 1, 2, 3].map(|k| args[0][k]);
                self.push(Inst::PackUnorm4(to[0], parts));
            }
            GLOp::UnpackUnorm2x16 => {
                self.push(Inst::Unary(Unary::UnormLow, to[0], args[0][0]));
                self.push(Inst::Unary(Unary::UnormHigh, to[1], args[0][0]));
            }
            other => panic!("{other:?} is not read yet"),
        }
    }
}

fn unary(op: Op) -> Option<Unary> {
    Some(match op {
        Op::Not => Unary::Not,
        Op::LogicalNot => Unary::LogicalNot,
        Op::BitCount => Unary::BitCount,
        Op::SNegate => Unary::SNegate,
        Op::FNegate => Unary::FNegate,
        Op::ConvertFToU => Unary::FToU,
        Op::ConvertFToS => Unary::FToS,
        Op::ConvertSToF => Unary::SToF,
        Op::ConvertUToF => Unary::UToF,
        Op::IsNan => Unary::IsNan,
        Op::IsInf => Unary::IsInf,
        _ => return None,
    })
}

/// The operation, and whether its operands are swapped.
fn binary(op: Op) -> Option<(Binary, bool)> {
    let straight = |op| Some((op, false));
    let swapped = |op| Some((op, true));
    match op {
        Op::IAdd => straight(Binary::IAdd),
        Op::ISub => straight(Binary::ISub),
        Op::IMul => straight(Binary::IMul),
        Op::UDiv => straight(Binary::UDiv),
        Op::SDiv => straight(Binary::SDiv),
        Op::UMod => straight(Binary::UMod),
        Op::SRem => straight(Binary::SRem),
        Op::SMod => straight(Binary::SMod),
        Op::FAdd => straight(Binary::FAdd),
        Op::FSub => straight(Binary::FSub),
        Op::FMul => straight(Binary::FMul),
        Op::FDiv => straight(Binary::FDiv),
        Op::BitwiseAnd | Op::LogicalAnd => straight(Binary::And),
        Op::BitwiseOr | Op::LogicalOr => straight(Binary::Or),
        Op::BitwiseXor => straight(Binary::Xor),
        Op::ShiftLeftLogical => straight(Binary::ShiftLeft),
        Op::ShiftRightLogical => straight(Binary::ShiftRight),
        Op::ShiftRightArithmetic => straight(Binary::ShiftRightSigned),
        Op::IEqual | Op::LogicalEqual => straight(Binary::IEqual),
        Op::INotEqual | Op::LogicalNotEqual => straight(Binary::INotEqual),
        Op::ULessThan => straight(Binary::ULess),
        Op::ULessThanEqual => straight(Binary::ULessEqual),
        Op::UGreaterThan => swapped(Binary::ULess),
        Op::UGreaterThanEqual => swapped(Binary::ULessEqual),
        Op::SLessThan => straight(Binary::SLess),
        Op::SLessThanEqual => straight(Binary::SLessEqual),
        Op::SGreaterThan => swapped(Binary::SLess),
        Op::SGreaterThanEqual => swapped(Binary::SLessEqual),
        Op::FOrdEqual => straight(Binary::FEqual),
        Op::FUnordNotEqual => straight(Binary::FNotEqual),
        Op::FOrdLessThan => straight(Binary::FLess),
        Op::FOrdLessThanEqual => straight(Binary::FLessEqual),
        Op::FOrdGreaterThan => swapped(Binary::FLess),
        Op::FOrdGreaterThanEqual => swapped(Binary::FLessEqual),
        _ => None,
    }
}

fn extended_unary(op: GLOp) -> Option<Unary> {
    Some(match op {
        GLOp::FAbs => Unary::FAbs,
        GLOp::SAbs => Unary::SAbs,
        GLOp::FSign => Unary::FSign,
        GLOp::Floor => Unary::Floor,
        GLOp::Ceil => Unary::Ceil,
        GLOp::Trunc => Unary::Trunc,
        GLOp::Round | GLOp::RoundEven => Unary::RoundEven,
        GLOp::Fract => Unary::Fract,
        GLOp::Exp => Unary::Exp,
        GLOp::Exp2 => Unary::Exp2,
        GLOp::Log => Unary::Log,
        GLOp::Log2 => Unary::Log2,
        GLOp::Sqrt => Unary::Sqrt,
        GLOp::InverseSqrt => Unary::InverseSqrt,
        GLOp::Sin => Unary::Sin,
        GLOp::Cos => Unary::Cos,
        GLOp::FindILsb => Unary::FindLsb,
        GLOp::FindUMsb => Unary::FindMsb,
        _ => return None,
    })
}

fn extended_binary(op: GLOp) -> Option<Binary> {
    Some(match op {
        GLOp::FMin | GLOp::NMin => Binary::FMin,
        GLOp::FMax | GLOp::NMax => Binary::FMax,
        GLOp::UMin => Binary::UMin,
        GLOp::UMax => Binary::UMax,
        GLOp::SMin => Binary::SMin,
        GLOp::SMax => Binary::SMax,
        GLOp::Pow => Binary::Pow,
        _ => return None,
    })
}
