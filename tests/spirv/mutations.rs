//! Whether faults are detected: shipped modules with one defect.
use crate::executor::{Change, Interpreted};
use crate::passes::{self, Scene};
use crate::{interpreted, outcome, runs};
use spirv_interpreter::module::{Instruction, assemble, instructions};
use spirv_interpreter::spirv::Op;
use spirv_interpreter::{Order, words as words_of};
use splatvk::gpu::{Module, shaders};
use std::sync::Arc;

/// Changes the instructions of one family's modules; `change` also gets the first free id.
fn family_change(family: &'static str, change: fn(&mut Vec<Instruction>, u32)) -> Change {
    let modules = shaders::FAMILIES.iter().find(|f| f.name == family).expect("a family").modules;
    Arc::new(move |module: &Module| {
        let known = modules.iter().find(|m| m.name == module.name)?;
        let words = words_of(known.spirv);
        let mut list = instructions(&words);
        change(&mut list, words[3]);
        Some(assemble(&words, &list))
    })
}

fn fault_of(scene: Scene, on: &Interpreted, change: Change) -> String {
    outcome(scene, &Interpreted { change: Some(change), ..on.clone() }).expect_err("the fault is not found")
}

/// Removes every barrier of every module in turn, at each of the subgroup `sizes`.
pub fn without_barriers(sizes: &[usize]) -> usize {
    let mut removed = 0;
    for (size, float_atomics) in sizes.iter().flat_map(|size| [(*size, true), (*size, false)]) {
        let on = interpreted(size, float_atomics);
        for (module, scenes) in runs(size, float_atomics) {
            if float_atomics || module.float_atomics == Some(false) {
                removed += without_each_barrier(module, &scenes, &on);
            }
        }
    }
    removed
}

/// Removes every barrier of a module in turn; one of the scenes finds a race each time.
fn without_each_barrier(module: &'static Module, scenes: &[Scene], on: &Interpreted) -> usize {
    let words = words_of(module.spirv);
    let list = instructions(&words);
    let barriers = list.iter().filter(|i| i.op == Op::ControlBarrier).count();
    for skipped in 0..barriers {
        let mut count = 0..;
        let mut list = list.clone();
        list.retain(|i| i.op != Op::ControlBarrier || count.next() != Some(skipped));
        let (name, changed) = (module.name, assemble(&words, &list));
        let change: Change = Arc::new(move |m: &Module| (m.name == name).then(|| changed.clone()));
        let on = Interpreted { change: Some(change), ..on.clone() };
        // Subgroups that do not agree whether the workgroup has work part at the next barrier.
        let kinds = ["Race", "a barrier that some subgroups do not reach"];
        let is_found = |fault: String| kinds.iter().any(|kind| fault.contains(kind));
        let mut faults = scenes.iter().filter_map(|scene| outcome(*scene, &on).err());
        assert!(faults.any(is_found), "{name}, barrier {skipped}");
    }
    barriers
}

/// First instruction with an opcode.
fn first(list: &mut [Instruction], op: Op) -> &mut Instruction {
    list.iter_mut().find(|i| i.op == op).expect("the instruction")
}

#[test]
fn missing_barrier_is_race() {
    // 2 each of scan_lanes, sort_digits, sort_offsets, ssim_rows_shared, sum and query_peaks, 5 of
    // sort_sweep, 1 of camera_sum, 1 of each degree of project_backward per thread, 3 of each degree with shared
    // memory and of fused_update, and in two variants 4 of bin_sweep and 2 of bin_large.
    let arrays = 12 + 5 + 1 + 4 + 12 + 12 + 12;
    // 1 of each of 5 variants of raster_forward and of count_pairs.
    let batches = 5 + 1;
    // 4 of each of two variants of raster_backward_shared.
    assert_eq!(without_barriers(&[32]), arrays + batches + 8);
}

/// As [`missing_barrier_is_race`], at every subgroup size.
#[test]
#[ignore = "takes long: tools/test-long"]
fn missing_barrier_is_race_everywhere() {
    assert_eq!(without_barriers(&[4, 8, 16, 32, 64]), 5 * (58 + 8) + 2 * 6);
}

/// A barrier that orders memory of another kind.
#[test]
fn barrier_of_other_memory_is_race() {
    let change = family_change("sum", |list, _| {
        let semantics = first(list, Op::ControlBarrier).words[2];
        // AcquireRelease | UniformMemory instead of AcquireRelease | WorkgroupMemory.
        list.iter_mut()
            .filter(|i| i.op == Op::Constant && i.words[1] == semantics)
            .for_each(|i| i.words[2] = 0x48);
    });
    assert!(fault_of(passes::named("sum"), &interpreted(32, true), change).contains("Race"));
}

#[test]
fn index_beyond_end_is_reported() {
    // Sums one value too many: `i <= count`.
    let change = family_change("sum", |list, _| first(list, Op::ULessThan).op = Op::ULessThanEqual);
    assert!(fault_of(passes::named("sum"), &interpreted(32, true), change).contains("Outside"));
}

#[test]
fn nonatomic_addition_is_race() {
    let change = family_change("sort_digits", |list, free| {
        let at = list.iter().position(|i| i.op == Op::AtomicIAdd).expect("an atomic addition");
        let [ty, result, pointer, _, _, value] = list[at].words[..] else { panic!("six operands") };
        let plain = [
            instruction(Op::Load, &[ty, result, pointer]),
            instruction(Op::IAdd, &[ty, free, result, value]),
            instruction(Op::Store, &[pointer, free]),
        ];
        list.splice(at..=at, plain);
    });
    let fault = fault_of(passes::named("radix sort, sort in one sweep"), &interpreted(32, true), change);
    assert!(fault.contains("sort_digits") && fault.contains("Race"), "{fault}");
}

#[test]
fn divergent_subgroup_operation_is_reported() {
    // Loops end where the counter reaches the lane.
    let change = family_change("raster_forward", |list, _| {
        let built_in = spirv_interpreter::spirv::BuiltIn::SubgroupLocalInvocationId as u32;
        let decorates = |i: &&Instruction| i.op == Op::Decorate && i.words.get(2) == Some(&built_in);
        let variable = list.iter().find(decorates).expect("the lane").words[0];
        let lane =
            list.iter().find(|i| i.op == Op::Load && i.words[2] == variable).expect("its load").words[1];
        list.iter_mut().filter(|i| i.op == Op::ULessThan).for_each(|i| i.words[3] = lane);
    });
    // Smaller subgroups than 32 shuffle; those of 32 would find the barrier before.
    let fault = fault_of(passes::named("colours"), &interpreted(16, true), change);
    assert!(fault.contains("NonUniform"), "{fault}");
}

#[test]
fn unwritten_shared_memory_is_reported() {
    let change = family_change("sort_digits", |list, _| {
        // The first store zeroes the counters.
        let at = list.iter().position(|i| i.op == Op::Store).expect("a store");
        list.remove(at);
    });
    let fault = fault_of(passes::named("radix sort, sort in one sweep"), &interpreted(32, true), change);
    assert!(fault.contains("Unwritten"), "{fault}");
}

/// A program must not read old content of a scratch buffer.
#[test]
fn unwritten_scratch_is_reported() {
    let on = Interpreted { scratch: &["scan values"], ..interpreted(32, true) };
    assert!(outcome(passes::named("prefix sum"), &on).expect_err("a fault").contains("Unwritten"));
}

#[test]
fn wrong_subgroup_variant_is_reported() {
    // Shuffles access lanes that do not exist, and lanes of two tiles share a workgroup.
    let (asked, other) = (raster_module(16).name, words_of(raster_module(32).spirv));
    let change: Change = Arc::new(move |m: &Module| (m.name == asked).then(|| other.clone()));
    let fault = fault_of(passes::named("colours"), &interpreted(16, true), change);
    assert!(fault.contains("AbsentLane") || fault.contains("Race"), "{fault}");
}

fn raster_module(subgroup_size: u32) -> &'static Module {
    let family = shaders::FAMILIES.iter().find(|f| f.name == "raster_forward").expect("a family");
    family
        .modules
        .iter()
        .find(|m| m.variant == [4] && m.subgroup_size == Some(subgroup_size))
        .expect("a module")
}

/// A tile of the one-sweep sort looks back at the tiles before it, a chunk of splats at the chunks
/// before it. Each takes its number when it starts, so that these have started, too. With the
/// workgroup's number they may start later, one at a time: it then counts for itself. With an
/// unlimited number of retries it would wait for ever.
#[test]
fn workgroup_order_dependence_is_reported() {
    for (family, scene) in
        [("sort_sweep", "radix sort, sort in one sweep"), ("bin_sweep", "lists by sorting")]
    {
        let scene = passes::named(scene);
        for order in [Order::Falling, Order::Rising] {
            assert_eq!(outcome(scene, &one_at_a_time(order)), Ok(()));
            let change = Some(family_change(family, number_by_workgroup));
            assert_eq!(outcome(scene, &Interpreted { change, ..one_at_a_time(order) }), Ok(()));
        }
        let spinning = family_change(family, |list, free| {
            number_by_workgroup(list, free);
            spin_for_ever(list);
        });
        let fault = fault_of(scene, &one_at_a_time(Order::Falling), spinning);
        assert!(fault.contains(family) && fault.contains("waits for another workgroup"), "{fault}");
    }
}

/// Device that runs one workgroup at a time.
fn one_at_a_time(order: Order) -> Interpreted {
    let mut on = interpreted(32, true);
    (on.schedule.order, on.schedule.in_flight) = (order, 1);
    on
}

/// Sets `MAX_SPINS` to the largest number.
fn spin_for_ever(list: &mut [Instruction]) {
    let max_spins = |i: &&mut Instruction| i.op == Op::Constant && i.words[2..] == [1000];
    let found: Vec<&mut Instruction> = list.iter_mut().filter(max_spins).collect();
    assert_eq!(found.len(), 1, "MAX_SPINS");
    found.into_iter().for_each(|constant| constant.words[2] = u32::MAX);
}

/// The number of the workgroup instead of that of an atomic addition, the first of the shader.
fn number_by_workgroup(list: &mut Vec<Instruction>, free: u32) {
    let [variable, chain] = [free, free + 1];
    let vector =
        list.iter().find(|i| i.op == Op::TypeVector && i.words[2] == 3).expect("uvec3").words.clone();
    let (vector, scalar) = (vector[0], vector[1]);
    let input = spirv_interpreter::spirv::StorageClass::Input as u32;
    let pointer_to = |ty: u32| {
        let fits = |i: &&Instruction| i.op == Op::TypePointer && i.words[1..] == [input, ty];
        list.iter().find(fits).expect("a pointer").words[0]
    };
    let (to_vector, to_scalar) = (pointer_to(vector), pointer_to(scalar));
    let is_zero = |i: &&Instruction| i.op == Op::Constant && i.words[0] == scalar && i.words[2] == 0;
    let zero = list.iter().find(is_zero).expect("0").words[1];
    let at = list.iter().position(|i| i.op == Op::AtomicIAdd).expect("the tile's number");
    let number = [
        instruction(Op::AccessChain, &[to_scalar, chain, variable, zero]),
        instruction(Op::Load, &[scalar, list[at].words[1], chain]),
    ];
    list.splice(at..=at, number);
    let function = list.iter().position(|i| i.op == Op::Function).expect("a function");
    list.insert(function, instruction(Op::Variable, &[to_vector, variable, input]));
    let built_in = [
        variable,
        spirv_interpreter::spirv::Decoration::BuiltIn as u32,
        spirv_interpreter::spirv::BuiltIn::WorkgroupId as u32,
    ];
    list.insert(0, instruction(Op::Decorate, &built_in));
}

fn instruction(op: Op, words: &[u32]) -> Instruction {
    Instruction { op, words: words.to_vec(), at: 0 }
}
