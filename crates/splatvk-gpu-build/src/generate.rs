//! Writes the Rust bindings. Generated code names everything by absolute paths in `splatvk_gpu`, so
//! that it compiles in any crate that depends on it.
use crate::compile::{FOLDER, Family, Module};
use crate::constants::{self, Constant};
use crate::reflect::{Access, Binding, Element, Layout, Member, Scalar};
use std::collections::BTreeMap;
use std::fmt::Write;

/// A header in `shared/` with its constants.
pub struct Shared {
    pub path: String,
    pub name: String,
    pub constants: Vec<Constant>,
}

/// The content of `OUT_DIR/shaders.rs`.
pub fn shaders(families: &[Family], shared: &[Shared]) -> Result<String, String> {
    let mut out = String::new();
    shared_files(&mut out, shared);
    structures(&mut out, families)?;
    constant_table(&mut out, families, shared);
    for family in families {
        let module = one(family).map_err(|e| format!("{}: error: {e}", family.path.display()))?;
        out.push_str(&module);
    }
    let names: Vec<String> = families.iter().map(|f| format!("&{}::FAMILY", f.name)).collect();
    let _ = writeln!(
        out,
        "/// Every shader file.\n#[allow(dead_code)]\npub static FAMILIES: &[&::splatvk_gpu::Family] = &[{}];",
        names.join(", ")
    );
    Ok(out)
}

/// A module per header that has constants.
fn shared_files(w: &mut String, shared: &[Shared]) {
    let _ = writeln!(w, "/// Constants of the shared headers.\n#[allow(dead_code)]\npub mod shared {{");
    for Shared { path, name, constants } in shared.iter().filter(|s| !s.constants.is_empty()) {
        let _ = writeln!(w, "    /// `{path}`.\n    pub mod {name} {{");
        constants::declarations(w, path, constants, "        ");
        let _ = writeln!(w, "    }}");
    }
    let _ = writeln!(w, "}}");
}

/// The structures that buffers hold; one name has one layout in all shaders.
fn structures(w: &mut String, families: &[Family]) -> Result<(), String> {
    let mut all: BTreeMap<&str, &Layout> = BTreeMap::new();
    for layout in families.iter().flat_map(|f| &f.modules).flat_map(|m| &m.reflection.layouts) {
        if *all.entry(&layout.name).or_insert(layout) != layout {
            return Err(format!("two structures are called `{}`", layout.name));
        }
    }
    let _ = writeln!(
        w,
        "/// Structures of storage buffers, laid out as the shaders read them.\n#[allow(dead_code)]\npub mod structs {{"
    );
    for (name, layout) in all {
        let _ = writeln!(w, "    /// `{name}`, {} bytes.", layout.bytes);
        let _ = writeln!(
            w,
            "    #[repr(C)]\n    #[derive(Clone, Copy, Debug, Default, PartialEq, ::splatvk_gpu::bytemuck::Pod, ::splatvk_gpu::bytemuck::Zeroable)]\n    #[bytemuck(crate = \"::splatvk_gpu::bytemuck\")]"
        );
        let _ = writeln!(w, "    pub struct {name} {{");
        for m in &layout.members {
            let _ = writeln!(w, "        /// Byte {}.\n        pub {}: {},", m.offset, m.name, rust_type(m));
        }
        let _ = writeln!(w, "    }}\n    const _: () = assert!(size_of::<{name}>() == {});", layout.bytes);
    }
    let _ = writeln!(w, "}}");
    Ok(())
}

/// Every constant with its file, for the test that looks for repetitions.
fn constant_table(w: &mut String, families: &[Family], shared: &[Shared]) {
    let _ = writeln!(w, "/// File, name and values of every constant of the shaders.");
    let _ = writeln!(w, "#[allow(dead_code)]\npub static CONSTANTS: &[(&str, &str, &[f64])] = &[");
    let own = families.iter().map(|f| (f.path.display().to_string(), &f.constants));
    let shared = shared.iter().map(|s| (s.path.clone(), &s.constants));
    for (file, constants) in own.chain(shared) {
        for c in constants {
            let _ = writeln!(w, "    ({file:?}, {:?}, &{:?}),", c.name, c.values);
        }
    }
    let _ = writeln!(w, "];");
}

fn one(family: &Family) -> Result<String, String> {
    let bindings = union(family)?;
    let push = &family.modules[0].reflection.push;
    if family.modules.iter().any(|m| &m.reflection.push != push) {
        return Err("all variants must have the same push constants".into());
    }
    let mut out = String::new();
    let w = &mut out;
    let _ = writeln!(w, "/// `{}`.\n#[allow(dead_code)]\npub mod {} {{", family.path.display(), family.name);
    let _ = writeln!(
        w,
        "    #[allow(unused_imports)]\n    use ::splatvk_gpu::{{Access, Binding, Buffer, Call, Capability, Family, Module}};"
    );
    let workgroup = family.modules[0].reflection.workgroup;
    if family.modules.iter().all(|m| m.reflection.workgroup == workgroup) {
        let _ = writeln!(w, "    /// `local_size`.\n    pub const WORKGROUP: [u32; 3] = {workgroup:?};");
    }
    constants::declarations(w, &family.path.display().to_string(), &family.constants, "    ");
    bindings_struct(w, &bindings);
    if !push.is_empty() {
        push_struct(w, push, family.modules[0].reflection.push_bytes);
    }
    variant_struct(w, family);
    call_function(w, family, &bindings, !push.is_empty());
    family_static(w, family, &bindings);
    let _ = writeln!(w, "}}");
    Ok(out)
}

/// The bindings of all variants together: a variant may leave some out, but a number has one name
/// and a name one number.
fn union(family: &Family) -> Result<Vec<Binding>, String> {
    let mut all: BTreeMap<u32, Binding> = BTreeMap::new();
    // Modules with native float atomics first: their blocks say what the others keep as bits.
    let mut modules: Vec<&Module> = family.modules.iter().collect();
    modules.sort_by_key(|m| m.float_atomics == Some(false));
    for (module, binding) in modules.iter().flat_map(|m| m.reflection.bindings.iter().map(move |b| (m, b))) {
        let entry = all.entry(binding.number).or_insert_with(|| binding.clone());
        let pair = (&entry.element, &binding.element);
        let bits = module.float_atomics == Some(false)
            && matches!(pair, (Element::Scalar(Scalar::F32), Element::Scalar(Scalar::U32)));
        if pair.0 != pair.1 && !bits {
            return Err(format!("`{}` holds different elements in different variants", binding.block));
        }
        if entry.block != binding.block {
            return Err(format!(
                "binding {} is both `{}` and `{}`",
                binding.number, entry.block, binding.block
            ));
        }
        entry.access.read |= binding.access.read;
        entry.access.write |= binding.access.write;
    }
    let all: Vec<Binding> = all.into_values().collect();
    for (i, b) in all.iter().enumerate() {
        if all[..i].iter().any(|a| snake(&a.block) == snake(&b.block)) {
            return Err(format!("two bindings are called `{}`", b.block));
        }
    }
    Ok(all)
}

fn bindings_struct(w: &mut String, bindings: &[Binding]) {
    let _ = writeln!(w, "    /// The buffers.\n    #[derive(Clone, Copy)]\n    pub struct Bindings<'a> {{");
    for b in bindings {
        let _ = writeln!(w, "        /// Binding {}, {}.", b.number, words(b.access));
        let element = match &b.element {
            Element::Scalar(_) => element_name(b),
            Element::Structure(name) => format!("super::structs::{name}"),
        };
        let _ = writeln!(w, "        pub {}: &'a Buffer<{element}>,", snake(&b.block));
    }
    let _ = writeln!(w, "    }}");
}

/// The element as Rust writes it, a structure by its name alone.
fn element_name(b: &Binding) -> String {
    match &b.element {
        Element::Scalar(scalar) => scalar_name(*scalar).to_owned(),
        Element::Structure(name) => name.clone(),
    }
}

fn scalar_name(scalar: Scalar) -> &'static str {
    match scalar {
        Scalar::F32 => "f32",
        Scalar::I32 => "i32",
        Scalar::U32 => "u32",
    }
}

fn words(access: Access) -> &'static str {
    match (access.read, access.write) {
        (true, true) => "read and written",
        (true, false) => "read",
        (false, true) => "written",
        (false, false) => "not used",
    }
}

fn push_struct(w: &mut String, push: &[Member], bytes: u32) {
    let _ = writeln!(w, "    /// The push constants; [`Push::bytes`] puts each at its reflected offset.");
    let _ = writeln!(w, "    #[derive(Clone, Copy, Debug, Default, PartialEq)]\n    pub struct Push {{");
    for m in push {
        let _ = writeln!(w, "        /// Byte {}.\n        pub {}: {},", m.offset, m.name, rust_type(m));
    }
    let _ = writeln!(w, "    }}\n    impl Push {{");
    let _ = writeln!(
        w,
        "        /// The block as the shader reads it.\n        pub fn bytes(&self) -> [u8; {bytes}] {{"
    );
    let _ = writeln!(w, "            let mut out = [0u8; {bytes}];");
    for m in push {
        writer(w, m);
    }
    let _ = writeln!(w, "            out\n        }}\n    }}");
}

fn rust_type(m: &Member) -> String {
    let mut t = scalar_name(m.scalar).to_owned();
    if m.rows > 1 {
        t = format!("[{t}; {}]", m.rows);
    }
    for (n, _) in m.columns.iter().chain(&m.array) {
        t = format!("[{t}; {n}]");
    }
    t
}

/// One `copy_from_slice` per scalar: at most 32 lines, since push constants have 128 bytes.
fn writer(w: &mut String, m: &Member) {
    let (elements, element_stride) = m.array.unwrap_or((1, 0));
    let (columns, column_stride) = m.columns.unwrap_or((1, 0));
    for e in 0..elements {
        for c in 0..columns {
            for r in 0..m.rows {
                let at = m.offset + e * element_stride + c * column_stride + 4 * r;
                let mut path = format!("self.{}", m.name);
                for (used, index) in [(m.array.is_some(), e), (m.columns.is_some(), c), (m.rows > 1, r)] {
                    if used {
                        let _ = write!(path, "[{index}]");
                    }
                }
                let end = at + 4;
                let _ = writeln!(w, "            out[{at}..{end}].copy_from_slice(&{path}.to_le_bytes());");
            }
        }
    }
}

fn variant_struct(w: &mut String, family: &Family) {
    if family.axes.is_empty() {
        return;
    }
    let _ = writeln!(w, "    /// The macros that choose a variant.");
    let _ = writeln!(w, "    #[derive(Clone, Copy, Debug, PartialEq, Eq)]\n    pub struct Variant {{");
    for axis in &family.axes {
        let _ = writeln!(w, "        /// `{axis}`.\n        pub {}: u32,", axis.to_lowercase());
    }
    let _ = writeln!(w, "    }}");
}

fn call_function(w: &mut String, family: &Family, bindings: &[Binding], push: bool) {
    let variant_parameter = if family.axes.is_empty() { "" } else { "variant: Variant, " };
    let push_parameter = if push { ", push: &Push" } else { "" };
    let axes: Vec<String> = family.axes.iter().map(|a| format!("variant.{}", a.to_lowercase())).collect();
    let buffers: Vec<String> =
        bindings.iter().map(|b| format!("({}, bindings.{}.cast())", b.number, snake(&b.block))).collect();
    let push_bytes = if push { "push.bytes().to_vec()" } else { "Vec::new()" };
    let _ = writeln!(w, "    /// One call of the shader, for `Recorder::dispatch`.");
    let _ = writeln!(w, "    pub fn call({variant_parameter}bindings: &Bindings{push_parameter}) -> Call {{");
    let _ = writeln!(
        w,
        "        Call::new(&FAMILY, vec![{}], vec![{}], {push_bytes})\n    }}",
        axes.join(", "),
        buffers.join(", ")
    );
}

fn family_static(w: &mut String, family: &Family, all: &[Binding]) {
    let _ = writeln!(w, "    /// All compiled variants.");
    let _ = writeln!(
        w,
        "    pub static FAMILY: Family = Family {{ name: {:?}, axes: &{:?}, modules: &[",
        family.name, family.axes
    );
    for m in &family.modules {
        let _ = writeln!(w, "        Module {{");
        let _ = writeln!(w, "            name: {:?},", module_name(family, m));
        let _ = writeln!(w, "            variant: &{:?},", m.variant);
        let _ = writeln!(
            w,
            "            subgroup_size: {:?}, float_atomics: {:?},",
            m.subgroup_size, m.float_atomics
        );
        let _ = writeln!(w, "            workgroup: {:?},", m.reflection.workgroup);
        let _ = writeln!(w, "            push_bytes: {},", m.reflection.push_bytes);
        let capabilities: Vec<String> =
            m.reflection.capabilities.iter().map(|c| format!("Capability::{c}")).collect();
        let _ = writeln!(w, "            capabilities: &[{}],", capabilities.join(", "));
        let bindings: Vec<String> = m
            .reflection
            .bindings
            .iter()
            .map(|b| {
                let Access { read, write } = b.access;
                let name = snake(&b.block);
                let element = all.iter().find(|a| a.number == b.number).map(element_name).unwrap_or_default();
                format!("Binding {{ number: {}, name: {name:?}, access: Access {{ read: {read}, write: {write} }}, element: {element:?} }}", b.number)
            })
            .collect();
        let _ = writeln!(w, "            bindings: &[{}],", bindings.join(", "));
        // Relative to the file of bindings, so that both can be packed into a published crate.
        let _ = writeln!(w, "            spirv: include_bytes!(\"{FOLDER}/{}\"),", m.spirv);
        let _ = writeln!(w, "        }},");
    }
    let _ = writeln!(w, "    ] }};");
}

fn module_name(family: &Family, m: &Module) -> String {
    let mut parts: Vec<String> =
        family.axes.iter().zip(&m.variant).map(|(a, v)| format!("{a}={v}")).collect();
    parts.extend(m.subgroup_size.map(|s| format!("SUBGROUP_SIZE={s}")));
    parts.extend(m.float_atomics.map(|f| format!("FLOAT_ATOMICS={}", u32::from(f))));
    if parts.is_empty() { family.name.clone() } else { format!("{}[{}]", family.name, parts.join(",")) }
}

/// `TileRanges` → `tile_ranges`, `SHGrad` → `sh_grad`.
fn snake(name: &str) -> String {
    let chars: Vec<char> = name.chars().collect();
    let mut out = String::new();
    for (i, &c) in chars.iter().enumerate() {
        let after_small = i > 0 && (chars[i - 1].is_lowercase() || chars[i - 1].is_ascii_digit());
        let ends_acronym =
            i > 0 && chars[i - 1].is_uppercase() && chars.get(i + 1).is_some_and(|n| n.is_lowercase());
        if c.is_uppercase() && (after_small || ends_acronym) {
            out.push('_');
        }
        out.extend(c.to_lowercase());
    }
    out
}
