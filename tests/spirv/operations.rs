//! Whether the comparisons with the CPU references detect a wrong operation: shipped modules with
//! one operation replaced, as by a typing error.
use crate::executor::{Change, Interpreted};
use crate::passes::Scene;
use crate::{interpreted, outcome, runs};
use spirv_interpreter::module::{Instruction, assemble, instructions};
use spirv_interpreter::spirv::Op;
use spirv_interpreter::{Random, words as words_of};
use splatvk::gpu::Module;
use std::sync::Arc;

/// Pairs of operations that replace each other.
const SWAPS: [(Op, Op); 9] = [
    (Op::FAdd, Op::FSub),
    (Op::FMul, Op::FDiv),
    (Op::IAdd, Op::ISub),
    (Op::ULessThan, Op::ULessThanEqual),
    (Op::SLessThan, Op::SLessThanEqual),
    (Op::FOrdLessThan, Op::FOrdGreaterThan),
    (Op::LogicalAnd, Op::LogicalOr),
    (Op::BitwiseAnd, Op::BitwiseOr),
    (Op::ShiftLeftLogical, Op::ShiftRightLogical),
];
/// Pairs of GLSL.std.450: minimum and maximum of floats, of unsigned and of signed integers.
const EXTREMES: [(u32, u32); 3] = [(37, 40), (38, 41), (39, 42)];

/// Operations that are replaced in every module.
const EACH: usize = 8;
/// Percent that must be detected: 80 are (docs/internals/trust.md#shaders-without-a-device), and a
/// changed shader draws other operations. The others have no effect in scenes so small, or no
/// effect at all, such as a bound that the next line tests again.
const LEAST: usize = 77;
/// Subgroup size of the available device, so that the modules are those of the other tests.
const SUBGROUP: usize = 8;

fn swapped(i: &Instruction) -> Option<Instruction> {
    if i.op == Op::ExtInst {
        let number = EXTREMES.iter().find_map(|&(a, b)| match i.words[3] {
            n if n == a => Some(b),
            n if n == b => Some(a),
            _ => None,
        })?;
        let mut changed = i.clone();
        changed.words[3] = number;
        return Some(changed);
    }
    let op = SWAPS.iter().find_map(|&(a, b)| match i.op {
        op if op == a => Some(b),
        op if op == b => Some(a),
        _ => None,
    })?;
    Some(Instruction { op, ..i.clone() })
}

/// Modules with one operation replaced, and descriptions of the replacements.
fn mutants(module: &Module) -> Vec<(String, Vec<u32>)> {
    let words = words_of(module.spirv);
    let list = instructions(&words);
    let mut sites: Vec<usize> = (0..list.len()).filter(|&k| swapped(&list[k]).is_some()).collect();
    let mut random = Random(words.len() as u64);
    let mut made = Vec::new();
    while made.len() < EACH && !sites.is_empty() {
        let k = sites.swap_remove(random.below(sites.len()));
        let mut changed = list.clone();
        changed[k] = swapped(&list[k]).expect("a site");
        let name = format!("{:?} at word {} by {:?}", list[k].op, list[k].at, changed[k].op);
        made.push((name, assemble(&words, &changed)));
    }
    made
}

fn is_detected(name: &'static str, changed: Vec<u32>, scenes: &[Scene]) -> bool {
    let change: Change = Arc::new(move |m: &Module| (m.name == name).then(|| changed.clone()));
    let on = Interpreted { change: Some(change), ..interpreted(SUBGROUP, true) };
    scenes.iter().any(|scene| outcome(*scene, &on).is_err())
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn replaced_operation_is_detected() {
    let (mut all, mut noticed) = (0, 0);
    for (module, scenes) in runs(SUBGROUP, true) {
        let mut missed = Vec::new();
        let mutants = mutants(module);
        all += mutants.len();
        let of = mutants.len();
        for (what, changed) in mutants {
            if !is_detected(module.name, changed, &scenes) {
                missed.push(what);
            }
        }
        noticed += of - missed.len();
        println!("{}: {} of {of} noticed {}", module.name, of - missed.len(), missed.join(", "));
    }
    println!("{noticed} of {all} noticed");
    assert!(100 * noticed >= LEAST * all, "{noticed} of {all}");
}
