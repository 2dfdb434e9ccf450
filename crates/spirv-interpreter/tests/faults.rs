//! Small shaders with one fault each, compiled from GLSL.
#![allow(clippy::unwrap_used, clippy::panic)] // a panic is how a test fails
use spirv_interpreter::module::{assemble, instructions};
use spirv_interpreter::{Error, Fault, Memory, Order, Schedule, Shader};

const SCHEDULE: Schedule =
    Schedule { subgroup_size: 8, order: Order::Random, in_flight: 3, scattered: false, seed: 1 };

fn compiled(body: &str) -> Vec<u32> {
    let source = format!(
        "#version 450\n#extension GL_KHR_shader_subgroup_arithmetic : require\n\
         #extension GL_KHR_shader_subgroup_shuffle : require\nlayout(local_size_x = 32) in;\n\
         layout(binding = 0) buffer Values {{ uint values[]; }};\nshared uint part[32];\n{body}"
    );
    let compiler = shaderc::Compiler::new().unwrap();
    let mut options = shaderc::CompileOptions::new().unwrap();
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_2 as u32);
    options.set_optimization_level(shaderc::OptimizationLevel::Performance);
    let kind = shaderc::ShaderKind::Compute;
    compiler.compile_into_spirv(&source, kind, "a.comp", "main", Some(&options)).unwrap().as_binary().to_vec()
}

fn run(spirv: &[u32], values: Memory, groups: u32, schedule: &Schedule) -> Result<Vec<u32>, Error> {
    let mut buffers = vec![Some(values)];
    Shader::new(spirv).dispatch(&mut buffers, &[], [groups, 1, 1], schedule)?;
    Ok(buffers.remove(0).unwrap().words)
}

/// Faults of a shader on 64 zeros, in two workgroups.
fn faults(body: &str) -> Vec<Fault> {
    match run(&compiled(body), Memory::of(vec![0; 64]), 2, &SCHEDULE) {
        Ok(_) => Vec::new(),
        Err(Error::Faulty(found)) => found.iter().map(|f| f.fault).collect(),
        Err(e) => panic!("{e}"),
    }
}

const SUM_OF_WORKGROUP: &str = "void main() {
    uint i = gl_LocalInvocationID.x;
    part[i] = values[gl_GlobalInvocationID.x];
    barrier();
    uint sum = 0u;
    for (uint k = 0u; k < 32u; k++) sum += part[k];
    values[gl_GlobalInvocationID.x] = sum;
}";

#[test]
fn results_are_independent_of_schedule() {
    let spirv = compiled(
        "void main() { uint v = values[gl_GlobalInvocationID.x]; values[gl_GlobalInvocationID.x] = 2u * v; }",
    );
    for subgroup_size in [4, 8, 64] {
        for order in [Order::Random, Order::Rising, Order::Falling] {
            for scattered in [false, true] {
                let schedule = Schedule { subgroup_size, order, scattered, ..SCHEDULE };
                let doubled = run(&spirv, Memory::of((0..64).collect()), 2, &schedule).unwrap();
                assert!(doubled.iter().enumerate().all(|(k, v)| *v == 2 * k as u32), "{schedule:?}");
            }
        }
    }
    let sums = run(&compiled(SUM_OF_WORKGROUP), Memory::of((0..64).collect()), 2, &SCHEDULE).unwrap();
    assert_eq!((sums[0], sums[63]), (31 * 16, 31 * 16 + 32 * 32));
}

#[test]
fn removed_barrier_is_race() {
    let spirv = compiled(SUM_OF_WORKGROUP);
    let mut list = instructions(&spirv);
    list.retain(|i| i.op != spirv_interpreter::spirv::Op::ControlBarrier);
    let error = run(&assemble(&spirv, &list), Memory::of(vec![0; 64]), 1, &SCHEDULE).unwrap_err();
    let Error::Faulty(found) = &error else { panic!("{error}") };
    assert!(found.iter().any(|f| f.fault == Fault::Race), "{error}");
}

#[test]
fn faults_have_a_kind() {
    assert_eq!(faults("void main() { values[0] = gl_GlobalInvocationID.x; }"), [Fault::Race]);
    assert_eq!(faults("void main() { atomicAdd(values[0], 1u); }"), []);
    assert_eq!(faults("void main() { values[gl_GlobalInvocationID.x + 1u] = 1u; }"), [Fault::Outside]);
    let unwritten = "void main() { values[gl_GlobalInvocationID.x] = part[gl_LocalInvocationID.x]; }";
    assert_eq!(faults(unwritten), [Fault::Unwritten]);
    let divided =
        "void main() { if (gl_LocalInvocationID.x < 3u) values[gl_GlobalInvocationID.x] = subgroupAdd(1u); }";
    assert_eq!(faults(divided), [Fault::NonUniform]);
}

#[test]
fn reading_unwritten_word_is_fault() {
    let spirv = compiled("void main() { values[gl_GlobalInvocationID.x] += 1u; }");
    let error = run(&spirv, Memory::empty(64), 2, &SCHEDULE).unwrap_err();
    assert!(error.to_string().contains("Unwritten"), "{error}");
}

#[test]
fn wait_for_later_workgroup_is_stuck() {
    let spirv = compiled(
        "void main() {
            if (gl_WorkGroupID.x == 0u && gl_LocalInvocationID.x == 0u) {
                while (atomicAdd(values[1], 0u) == 0u) {}
            } else if (gl_LocalInvocationID.x == 0u) {
                atomicAdd(values[1], 1u);
            }
        }",
    );
    let alone = Schedule { order: Order::Rising, in_flight: 1, ..SCHEDULE };
    let error = run(&spirv, Memory::of(vec![0; 64]), 2, &alone).unwrap_err();
    assert!(matches!(error, Error::Stuck(_)), "{error}");
    assert!(run(&spirv, Memory::of(vec![0; 64]), 2, &Schedule { in_flight: 2, ..alone }).is_ok());
}
