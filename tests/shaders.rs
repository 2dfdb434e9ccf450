//! Every shipped shader module, in all variants: naga parses and validates it, and the reflection
//! is consistent.
#![allow(clippy::unwrap_used)] // helpers of tests
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
fn access_follows_from_code() {
    assert_eq!(access("gather", "from"), (true, false));
    assert_eq!(access("gather", "to"), (false, true));
    assert_eq!(access("scan_lanes", "sums"), (true, true));
    assert_eq!(access("raster_backward", "projected_grad"), (true, true));
}

/// Whether the first module of a family reads and writes a binding.
fn access(family: &str, name: &str) -> (bool, bool) {
    let family = shaders::FAMILIES.iter().find(|f| f.name == family).unwrap();
    let binding = family.modules[0].bindings.iter().find(|b| b.name == name).unwrap();
    (binding.access.read, binding.access.write)
}

/// Element type of a block of a module: the name of a scalar, or the size of a structure.
fn element_of(module: &naga::Module, block: naga::Handle<naga::Type>) -> String {
    use naga::{ScalarKind, TypeInner};
    let TypeInner::Struct { members, .. } = &module.types[block].inner else { return "no block".to_owned() };
    assert_eq!(members.len(), 1, "a block has one member");
    let mut kind = members[0].ty;
    loop {
        match &module.types[kind].inner {
            TypeInner::Array { base, .. } => kind = *base,
            TypeInner::Struct { span, .. } => return format!("{span} bytes"),
            TypeInner::Scalar(s) | TypeInner::Atomic(s) | TypeInner::Vector { scalar: s, .. } => {
                let letter = match s.kind {
                    ScalarKind::Float => "f",
                    ScalarKind::Sint => "i",
                    ScalarKind::Uint => "u",
                    _ => "?",
                };
                return format!("{letter}{}", 8 * s.width);
            }
            other => return format!("{other:?}"),
        }
    }
}

/// build.rs writes `Binding::element` and the type of the field in `Bindings` from one value.
#[test]
fn binding_elements_match_modules() {
    let structures = [
        ("CameraView", size_of::<shaders::structs::CameraView>()),
        ("SourceView", size_of::<shaders::structs::SourceView>()),
    ];
    let mut kinds = std::collections::BTreeSet::new();
    for module in modules() {
        let parsed = spv::parse_u8_slice(module.spirv, &spv::Options::default()).unwrap();
        for (_, variable) in parsed.global_variables.iter() {
            let Some(place) = &variable.binding else { continue };
            let binding = module.bindings.iter().find(|b| b.number == place.binding).unwrap();
            let found = element_of(&parsed, variable.ty);
            let structure = structures.iter().find(|s| s.0 == binding.element);
            let expected = structure.map_or(binding.element.to_owned(), |s| format!("{} bytes", s.1));
            // Without native float atomics, a buffer contains the bits of floats.
            let bits =
                module.float_atomics == Some(false) && (binding.element, found.as_str()) == ("f32", "u32");
            assert!(found == expected || bits, "{}: `{}` holds {found}", module.name, binding.name);
            kinds.insert(binding.element);
        }
    }
    assert_eq!(kinds.into_iter().collect::<Vec<_>>(), ["CameraView", "SourceView", "f32", "i32", "u32"]);
}

/// Collects every `const NAME: TYPE = VALUE;` of the Rust sources.
fn rust_constants(folder: &std::path::Path, found: &mut Vec<(String, String, String)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            rust_constants(&path, found);
        } else if path.extension().is_some_and(|x| x == "rs") {
            let text = std::fs::read_to_string(&path).unwrap();
            for part in text.split("const ").skip(1) {
                let Some((declared, value)) = part.split(';').next().and_then(|s| s.split_once('=')) else {
                    continue;
                };
                let name = declared.split(':').next().unwrap_or_default().trim().to_owned();
                found.push((path.display().to_string(), name, value.trim().to_owned()));
            }
        }
    }
}

/// Numbers in a Rust value; empty if it contains names.
fn literals(value: &str) -> Vec<f64> {
    let parts = value.split(['[', ']', ',', ' ']).filter(|p| !p.is_empty());
    parts.map(|p| p.replace('_', "").parse()).collect::<Result<_, _>>().unwrap_or_default()
}

#[test]
fn shader_constants_stand_in_one_place() {
    let (mut rust, mut repeated) = (Vec::new(), Vec::new());
    ["src", "crates"].iter().for_each(|folder| rust_constants(std::path::Path::new(folder), &mut rust));
    assert!(rust.len() > 100 && shaders::CONSTANTS.len() > 20);
    for (file, name, values) in shaders::CONSTANTS {
        let same = |v: &[f64]| {
            v.len() == values.len() && v.iter().zip(*values).all(|(a, b)| (a - b).abs() <= 1e-7 * b.abs())
        };
        let mut hits: Vec<&str> = rust
            .iter()
            .filter(|(_, n, v)| n == name && same(&literals(v)))
            .map(|(f, ..)| f.as_str())
            .collect();
        hits.extend(
            shaders::CONSTANTS.iter().filter(|(f, n, v)| n == name && f != file && same(v)).map(|c| c.0),
        );
        repeated.extend(hits.iter().map(|other| format!("`{name}` of {file} stands in {other} again")));
    }
    assert!(repeated.is_empty(), "{}", repeated.join("\n"));
}

#[test]
fn constants_match_sources() {
    use shaders::shared::{cutoffs, layout, plane_sweep, ssim};
    assert_eq!((layout::TILE, shaders::sort_sweep::TILE, shaders::decode::PIXELS), (8, 2048, 4));
    // A workgroup covers whole strips of a row, each of which has a sum.
    assert_eq!(shaders::ssim_rows_shared::SPAN % ssim::STRIP, 0);
    assert_eq!((layout::BASE_CHANNELS, layout::PROJECTED_FLOATS, layout::CAMERA_GRADIENTS), (4, 12, 10));
    // Moments and base channels fit their vectors, without one to spare.
    assert_eq!((layout::MOMENTS + layout::BASE_CHANNELS + 3) / 4, layout::GRADIENT_VECTORS);
    assert_eq!(plane_sweep::VIEW_SHARES, [0.6, 0.3, 0.1, 0.0]);
    assert_eq!(ssim::WINDOW.len() as i32, 2 * ssim::HALF + 1);
    assert_eq!(cutoffs::ALPHA_MIN, 1.0 / 255.0);
    assert!((cutoffs::ALPHA_MIN.log2() - cutoffs::LOG2_ALPHA_MIN).abs() < 1e-15);
    assert_eq!(size_of::<shaders::structs::CameraView>(), 96);
}
