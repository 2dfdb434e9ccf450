//! Every shipped shader module, in all variants: naga parses and validates it, and the reflection agrees with itself.
use naga::front::spv;
use naga::valid::{Capabilities, ValidationFlags, Validator};
use splatvk::gpu::{Module, shaders};

fn modules() -> impl Iterator<Item = &'static Module> {
    shaders::FAMILIES.iter().flat_map(|f| f.modules)
}

#[test]
fn naga_parses_and_validates_every_module() {
    let mut failures = Vec::new();
    for module in modules() {
        let options = spv::Options::default();
        let outcome =
            spv::parse_u8_slice(module.spirv, &options).map_err(|e| format!("{e:?}")).and_then(|parsed| {
                Validator::new(ValidationFlags::all(), Capabilities::all())
                    .validate(&parsed)
                    .map(|_| ())
                    .map_err(|e| format!("{:?}", e.into_inner()))
            });
        if let Err(e) = outcome {
            failures.push(format!("{}: {e}", module.name));
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn reflection_is_complete_and_unambiguous() {
    let mut names: Vec<&str> = modules().map(|m| m.name).collect();
    assert!(!names.is_empty());
    names.sort_unstable();
    names.windows(2).for_each(|w| assert_ne!(w[0], w[1], "two modules of one name"));
    for module in modules() {
        // SPIR-V 1.5 in the header: 1.6 would need maintenance4.
        assert_eq!(&module.spirv[..8], &[3, 2, 35, 7, 0, 5, 1, 0], "{}", module.name);
        assert!(module.workgroup.iter().all(|&n| n > 0), "{}", module.name);
        assert!(module.push_bytes <= 128, "{}", module.name);
        assert!(module.bindings.iter().any(|b| b.access.write), "{} writes nothing", module.name);
        for pair in module.bindings.windows(2) {
            assert!(pair[0].number < pair[1].number, "{}", module.name);
        }
        for binding in module.bindings {
            assert!(!binding.name.is_empty(), "{}: binding {} has no name", module.name, binding.number);
        }
    }
}

#[test]
fn access_follows_from_the_code() {
    let access = |family: &str, name: &str| {
        let family = shaders::FAMILIES.iter().find(|f| f.name == family).unwrap();
        let binding = family.modules[0].bindings.iter().find(|b| b.name == name).unwrap();
        (binding.access.read, binding.access.write)
    };
    assert_eq!(access("relevancy_map", "codes"), (true, false));
    assert_eq!(access("relevancy_map", "relevancy"), (false, true));
    assert_eq!(access("scatter_sum", "sums"), (true, true));
}
