//! Whether the comparisons with the CPU references notice a wrong operation: modules that are shipped,
//! with one operation in the place of another, as a slip of the hand would have it.
use crate::executor::{Change, Interpreted};
use crate::passes::{self, Scene};
use crate::{interpreted, outcome};
use spirv::Op;
use spirv_interpreter::module::{Instruction, assemble, instructions};
use spirv_interpreter::{Random, words as words_of};
use splatvk::gpu::{Module, shaders};
use std::sync::Arc;

/// An operation and the one that takes its place. Each also stands for its way back.
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
/// The same of GLSL.std.450: smallest and largest of floats, of unsigned and of signed numbers.
const EXTREMES: [(u32, u32); 3] = [(37, 40), (38, 41), (39, 42)];

/// Operations that are exchanged in every module.
const EACH: usize = 8;
/// Percent that must be noticed: 82 are (docs/internals/trust.md#shaders-without-a-device), and a
/// changed shader draws other operations. What is not noticed has no effect in scenes so small, or
/// none at all, such as a bound that the next line tests again.
const LEAST: usize = 77;
/// Subgroups of the size that the device at hand has, so that the modules are those of the other
/// tests.
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

/// A module with one operation exchanged, and what it was.
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

/// The scenes that run a module, and the modules that are run at all.
fn runs() -> Vec<(&'static Module, Vec<Scene>)> {
    let scenes = passes::PLAIN.iter().chain(passes::ADDING).map(|(_, scene)| {
        let on = interpreted(SUBGROUP, true);
        assert_eq!(outcome(*scene, &on), Ok(()));
        (*scene, on.ran.lock().unwrap().clone())
    });
    let scenes: Vec<_> = scenes.collect();
    let modules = shaders::FAMILIES.iter().filter(|f| !f.name.starts_with("bench")).flat_map(|f| f.modules);
    let with = |m: &'static Module| {
        let own = scenes.iter().filter(|(_, ran)| ran.contains(m.name)).map(|(scene, _)| *scene);
        (m, own.collect::<Vec<_>>())
    };
    modules.map(with).filter(|(_, scenes)| !scenes.is_empty()).collect()
}

fn is_noticed(name: &'static str, changed: Vec<u32>, scenes: &[Scene]) -> bool {
    let change: Change = Arc::new(move |m: &Module| (m.name == name).then(|| changed.clone()));
    let on = Interpreted { change: Some(change), ..interpreted(SUBGROUP, true) };
    scenes.iter().any(|scene| outcome(*scene, &on).is_err())
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn a_wrong_operation_is_noticed() {
    let (mut all, mut noticed) = (0, 0);
    for (module, scenes) in runs() {
        let mut missed = Vec::new();
        let mutants = mutants(module);
        all += mutants.len();
        let of = mutants.len();
        for (what, changed) in mutants {
            if !is_noticed(module.name, changed, &scenes) {
                missed.push(what);
            }
        }
        noticed += of - missed.len();
        println!("{}: {} of {of} noticed {}", module.name, of - missed.len(), missed.join(", "));
    }
    println!("{noticed} of {all} noticed");
    assert!(100 * noticed >= LEAST * all, "{noticed} of {all}");
}
