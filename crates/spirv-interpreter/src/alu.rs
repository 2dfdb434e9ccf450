//! Scalar operations. Results that the specification leaves undefined are [`GARBAGE`].
use crate::code::{Binary, GARBAGE, Unary};

fn f(word: u32) -> f32 {
    f32::from_bits(word)
}

fn sign(x: f32) -> f32 {
    if x > 0.0 {
        1.0
    } else if x < 0.0 {
        -1.0
    } else {
        0.0
    }
}

fn float_to_unsigned(x: f32) -> u32 {
    if x > -1.0 && x < 4_294_967_296.0 { x as u32 } else { GARBAGE }
}

fn float_to_signed(x: f32) -> u32 {
    if (-2_147_483_648.0..2_147_483_648.0).contains(&x) { x as i32 as u32 } else { GARBAGE }
}

fn unorm(half: u32) -> u32 {
    ((half & 0xFFFF) as f32 / 65535.0).to_bits()
}

/// Applies one operation to all active lanes. The operation is chosen outside the loop.
macro_rules! each {
    ($lanes:expr, $size:expr, $regs:expr, $to:expr, |$($x:ident = $reg:tt),+| $value:expr) => {
        for &lane in $lanes {
            $(let $x = $regs[$reg as usize * $size + lane];)+
            $regs[$to as usize * $size + lane] = $value;
        }
    };
}
pub(crate) use each;

pub fn unary(op: Unary, lanes: &[usize], size: usize, regs: &mut [u32], to: u32, a: u32) {
    macro_rules! map {
        (|$x:ident| $value:expr) => {
            each!(lanes, size, regs, to, |$x = a| $value)
        };
    }
    macro_rules! float {
        (|$x:ident| $value:expr) => {
            map!(|word| {
                let $x = f(word);
                ($value).to_bits()
            })
        };
    }
    match op {
        Unary::Not => map!(|x| !x),
        Unary::LogicalNot => map!(|x| 1 - x),
        Unary::BitCount => map!(|x| x.count_ones()),
        Unary::FindLsb => map!(|x| if x == 0 { u32::MAX } else { x.trailing_zeros() }),
        Unary::FindMsb => map!(|x| if x == 0 { u32::MAX } else { 31 - x.leading_zeros() }),
        Unary::SNegate => map!(|x| x.wrapping_neg()),
        Unary::SAbs => map!(|x| (x as i32).wrapping_abs() as u32),
        Unary::FNegate => float!(|x| -x),
        Unary::FAbs => float!(|x| x.abs()),
        Unary::FSign => float!(|x| sign(x)),
        Unary::Floor => float!(|x| x.floor()),
        Unary::Ceil => float!(|x| x.ceil()),
        Unary::Trunc => float!(|x| x.trunc()),
        Unary::RoundEven => float!(|x| x.round_ties_even()),
        Unary::Fract => float!(|x| x - x.floor()),
        Unary::Exp => float!(|x| x.exp()),
        Unary::Exp2 => float!(|x| x.exp2()),
        Unary::Log => float!(|x| x.ln()),
        Unary::Log2 => float!(|x| x.log2()),
        Unary::Sqrt => float!(|x| x.sqrt()),
        Unary::InverseSqrt => float!(|x| 1.0 / x.sqrt()),
        Unary::Sin => float!(|x| x.sin()),
        Unary::Cos => float!(|x| x.cos()),
        Unary::FToU => map!(|x| float_to_unsigned(f(x))),
        Unary::FToS => map!(|x| float_to_signed(f(x))),
        Unary::SToF => map!(|x| (x as i32 as f32).to_bits()),
        Unary::UToF => map!(|x| (x as f32).to_bits()),
        Unary::IsNan => map!(|x| f(x).is_nan().into()),
        Unary::IsInf => map!(|x| f(x).is_infinite().into()),
        Unary::UnormLow => map!(|x| unorm(x)),
        Unary::UnormHigh => map!(|x| unorm(x >> 16)),
    }
}

pub fn binary(op: Binary, lanes: &[usize], size: usize, regs: &mut [u32], to: u32, a: u32, b: u32) {
    macro_rules! map {
        (|$x:ident, $y:ident| $value:expr) => {
            each!(lanes, size, regs, to, |$x = a, $y = b| $value)
        };
    }
    macro_rules! float {
        (|$x:ident, $y:ident| $value:expr) => {
            map!(|x, y| {
                let ($x, $y) = (f(x), f(y));
                ($value).to_bits()
            })
        };
    }
    macro_rules! compare {
        (|$x:ident, $y:ident| $value:expr) => {
            map!(|x, y| {
                let ($x, $y) = (f(x), f(y));
                u32::from($value)
            })
        };
    }
    match op {
        Binary::IAdd => map!(|x, y| x.wrapping_add(y)),
        Binary::ISub => map!(|x, y| x.wrapping_sub(y)),
        Binary::IMul => map!(|x, y| x.wrapping_mul(y)),
        Binary::UDiv => map!(|x, y| x.checked_div(y).unwrap_or(GARBAGE)),
        Binary::SDiv => map!(|x, y| (x as i32).checked_div(y as i32).map_or(GARBAGE, |v| v as u32)),
        Binary::UMod => map!(|x, y| x.checked_rem(y).unwrap_or(GARBAGE)),
        Binary::SRem => map!(|x, y| (x as i32).checked_rem(y as i32).map_or(GARBAGE, |v| v as u32)),
        Binary::SMod => map!(|x, y| signed_modulo(x as i32, y as i32)),
        Binary::FAdd => float!(|x, y| x + y),
        Binary::FSub => float!(|x, y| x - y),
        Binary::FMul => float!(|x, y| x * y),
        Binary::FDiv => float!(|x, y| x / y),
        Binary::And => map!(|x, y| x & y),
        Binary::Or => map!(|x, y| x | y),
        Binary::Xor => map!(|x, y| x ^ y),
        Binary::ShiftLeft => map!(|x, y| x.checked_shl(y).unwrap_or(GARBAGE)),
        Binary::ShiftRight => map!(|x, y| x.checked_shr(y).unwrap_or(GARBAGE)),
        Binary::ShiftRightSigned => map!(|x, y| (x as i32).checked_shr(y).map_or(GARBAGE, |v| v as u32)),
        Binary::FMin => float!(|x, y| x.min(y)),
        Binary::FMax => float!(|x, y| x.max(y)),
        Binary::UMin => map!(|x, y| x.min(y)),
        Binary::UMax => map!(|x, y| x.max(y)),
        Binary::SMin => map!(|x, y| (x as i32).min(y as i32) as u32),
        Binary::SMax => map!(|x, y| (x as i32).max(y as i32) as u32),
        Binary::Pow => float!(|x, y| x.powf(y)),
        Binary::IEqual => map!(|x, y| u32::from(x == y)),
        Binary::INotEqual => map!(|x, y| u32::from(x != y)),
        Binary::ULess => map!(|x, y| u32::from(x < y)),
        Binary::ULessEqual => map!(|x, y| u32::from(x <= y)),
        Binary::SLess => map!(|x, y| u32::from((x as i32) < y as i32)),
        Binary::SLessEqual => map!(|x, y| u32::from(x as i32 <= y as i32)),
        Binary::FEqual => compare!(|x, y| x == y),
        Binary::FNotEqual => compare!(|x, y| x != y),
        Binary::FLess => compare!(|x, y| x < y),
        Binary::FLessEqual => compare!(|x, y| x <= y),
        Binary::PackHalf => map!(|x, y| {
            let half = |w| u32::from(half::f16::from_f32(f(w)).to_bits());
            half(x) | half(y) << 16
        }),
    }
}

/// Remainder with the sign of the divisor.
fn signed_modulo(x: i32, y: i32) -> u32 {
    match x.checked_rem(y) {
        None => GARBAGE,
        Some(rest) if rest != 0 && (rest < 0) != (y < 0) => rest.wrapping_add(y) as u32,
        Some(rest) => rest as u32,
    }
}

pub fn fused(a: u32, b: u32, c: u32) -> u32 {
    f(a).mul_add(f(b), f(c)).to_bits()
}

pub fn unorm8(parts: [u32; 4]) -> u32 {
    let byte = |w: u32| (f(w).clamp(0.0, 1.0) * 255.0).round_ties_even() as u32;
    parts.iter().enumerate().map(|(k, w)| byte(*w) << (8 * k)).sum()
}
