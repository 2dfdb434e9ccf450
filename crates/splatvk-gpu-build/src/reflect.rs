//! Reflection of SPIR-V: storage buffers with their access, push constants, workgroup size,
//! capabilities. An unsupported feature is an error that names it. Opcodes and enumerants are those
//! of the SPIR-V specification 1.5 and its extension registry.
use std::collections::{BTreeMap, HashMap};

/// How a module touches one storage buffer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Access {
    pub read: bool,
    pub write: bool,
}

/// One storage buffer.
#[derive(Clone, Debug, PartialEq)]
pub struct Binding {
    pub number: u32,
    /// The block name in the GLSL file.
    pub block: String,
    pub access: Access,
    pub element: Element,
}

/// Element type of a block.
#[derive(Clone, Debug, PartialEq)]
pub enum Element {
    /// The scalar of scalars, vectors and arrays of them.
    Scalar(Scalar),
    /// A structure, by its name.
    Structure(String),
}

/// Scalar kinds that members may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    F32,
    I32,
    U32,
}

/// A member of the push constants or of a structure: array of columns of rows of scalars, each
/// level optional.
#[derive(Clone, Debug, PartialEq)]
pub struct Member {
    pub name: String,
    pub offset: u32,
    pub scalar: Scalar,
    /// 1 for a scalar, 2 to 4 for a vector.
    pub rows: u32,
    /// Matrix columns and their stride in bytes.
    pub columns: Option<(u32, u32)>,
    /// Array length and stride in bytes.
    pub array: Option<(u32, u32)>,
}

/// A structure that a storage buffer holds, one or many.
#[derive(Clone, Debug, PartialEq)]
pub struct Layout {
    pub name: String,
    pub members: Vec<Member>,
    /// Size, and distance of two in an array.
    pub bytes: u32,
}

/// The interface of a module.
#[derive(Clone, Debug, Default)]
pub struct Reflection {
    pub bindings: Vec<Binding>,
    pub layouts: Vec<Layout>,
    pub push: Vec<Member>,
    pub push_bytes: u32,
    pub workgroup: [u32; 3],
    /// Names of `splatvk_gpu::Capability` variants.
    pub capabilities: Vec<&'static str>,
}

/// SPIR-V capability number → variant of `splatvk_gpu::Capability`; `None` for those that every
/// Vulkan 1.2 device has.
const CAPABILITIES: &[(u32, Option<&str>)] = &[
    (1, None), // Shader
    (9, Some("Float16")),
    (10, Some("Float64")),
    (11, Some("Int64")),
    (22, Some("Int16")),
    (39, Some("Int8")),
    (61, Some("SubgroupBasic")),
    (62, Some("SubgroupVote")),
    (63, Some("SubgroupArithmetic")),
    (64, Some("SubgroupBallot")),
    (65, Some("SubgroupShuffle")),
    (66, Some("SubgroupShuffleRelative")),
    (4433, Some("Storage16")),
    (4448, Some("Storage8")),
    (6033, Some("AtomicFloatAdd")),
];

enum Type {
    Scalar(Scalar),
    Vector(u32, u32),
    Matrix(u32, u32),
    Array(u32, u32),
    RuntimeArray(u32),
    Struct(Vec<u32>),
    Pointer(u32),
    Other,
}

#[derive(Default)]
struct Reader {
    names: HashMap<u32, String>,
    member_names: HashMap<(u32, u32), String>,
    decorations: HashMap<(u32, u32), u32>,
    member_decorations: HashMap<(u32, u32, u32), u32>,
    types: HashMap<u32, Type>,
    constants: HashMap<u32, u32>,
    /// Variable id → (storage class, pointer type).
    variables: BTreeMap<u32, (u32, u32)>,
    /// Pointer id → the variable it leads into.
    roots: HashMap<u32, u32>,
    used: HashMap<u32, Access>,
    out: Reflection,
}

const BUILT_IN: u32 = 11;
const NON_WRITABLE: u32 = 24;
const NON_READABLE: u32 = 25;
const ARRAY_STRIDE: u32 = 6;
const MATRIX_STRIDE: u32 = 7;
const BINDING: u32 = 33;
const DESCRIPTOR_SET: u32 = 34;
const OFFSET: u32 = 35;
const STORAGE_PUSH_CONSTANT: u32 = 9;
const STORAGE_BUFFER: u32 = 12;

/// Reads one unoptimised module.
pub fn reflect(words: &[u32]) -> Result<Reflection, String> {
    if words.first() != Some(&0x0723_0203) {
        return Err("not a SPIR-V module".into());
    }
    let mut reader = Reader::default();
    let mut at = 5;
    while at < words.len() {
        let (length, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        let operands = words.get(at + 1..at + length).filter(|_| length > 0).ok_or("truncated SPIR-V")?;
        reader.instruction(opcode, operands)?;
        at += length;
    }
    reader.finish()
}

fn text(words: &[u32]) -> String {
    let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).take_while(|&b| b != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}

impl Reader {
    fn instruction(&mut self, opcode: u32, o: &[u32]) -> Result<(), String> {
        match opcode {
            5 => drop(self.names.insert(o[0], text(&o[1..]))),
            6 => drop(self.member_names.insert((o[0], o[1]), text(&o[2..]))),
            16 if o[1] == 17 => self.out.workgroup = [o[2], o[3], o[4]],
            17 => self.capability(o[0])?,
            21 if o[1] == 32 => {
                let scalar = if o[2] == 0 { Scalar::U32 } else { Scalar::I32 };
                self.types.insert(o[0], Type::Scalar(scalar));
            }
            22 if o[1] == 32 => drop(self.types.insert(o[0], Type::Scalar(Scalar::F32))),
            29 => drop(self.types.insert(o[0], Type::RuntimeArray(o[1]))),
            21 | 22 => drop(self.types.insert(o[0], Type::Other)),
            23 => drop(self.types.insert(o[0], Type::Vector(o[1], o[2]))),
            24 => drop(self.types.insert(o[0], Type::Matrix(o[1], o[2]))),
            28 => drop(self.types.insert(o[0], Type::Array(o[1], o[2]))),
            30 => drop(self.types.insert(o[0], Type::Struct(o[1..].to_vec()))),
            32 => drop(self.types.insert(o[0], Type::Pointer(o[2]))),
            43 => drop(self.constants.insert(o[1], o[2])),
            48..=52 => return Err("specialisation constants are not supported: use `// variants:`".into()),
            59 => {
                self.variables.insert(o[1], (o[2], o[0]));
                self.roots.insert(o[1], o[1]);
            }
            71 => drop(self.decorations.insert((o[0], o[1]), o.get(2).copied().unwrap_or(0))),
            72 => drop(self.member_decorations.insert((o[0], o[1], o[2]), o.get(3).copied().unwrap_or(0))),
            _ => self.access(opcode, o),
        }
        Ok(())
    }

    /// Follows pointers to their variables and records the accesses.
    fn access(&mut self, opcode: u32, o: &[u32]) {
        const READ: Access = Access { read: true, write: false };
        const WRITE: Access = Access { read: false, write: true };
        const BOTH: Access = Access { read: true, write: true };
        match opcode {
            61 | 227 => self.touch(o[2], READ),  // OpLoad, OpAtomicLoad
            62 | 228 => self.touch(o[0], WRITE), // OpStore, OpAtomicStore
            63 => {
                self.touch(o[0], WRITE);
                self.touch(o[1], READ);
            }
            65 | 66 => {
                if let Some(&root) = self.roots.get(&o[2]) {
                    self.roots.insert(o[1], root);
                }
            }
            68 => {} // OpArrayLength reads the descriptor, not the memory.
            229..=242 | 6035 | 5614 | 5615 => self.touch(o[2], BOTH),
            // OpFunctionCall, OpCopyObject, OpSelect, OpPhi: a pointer handed on may be used for
            // anything.
            57 | 83 | 169 | 245 => o[2..].iter().for_each(|&id| self.touch(id, BOTH)),
            _ => {}
        }
    }

    fn touch(&mut self, pointer: u32, access: Access) {
        if let Some(&root) = self.roots.get(&pointer) {
            let entry = self.used.entry(root).or_default();
            entry.read |= access.read;
            entry.write |= access.write;
        }
    }

    fn capability(&mut self, number: u32) -> Result<(), String> {
        match CAPABILITIES.iter().find(|(n, _)| *n == number) {
            Some((_, Some(name))) => self.out.capabilities.push(name),
            Some((_, None)) => {}
            None => {
                return Err(format!("SPIR-V capability {number} is not supported"));
            }
        }
        Ok(())
    }

    fn finish(mut self) -> Result<Reflection, String> {
        let variables: Vec<(u32, (u32, u32))> = self.variables.iter().map(|(&i, &v)| (i, v)).collect();
        for (id, (class, pointer)) in variables {
            let Some(&Type::Pointer(pointee)) = self.types.get(&pointer) else { continue };
            match class {
                STORAGE_BUFFER => {
                    let binding = self.binding(id, pointee)?;
                    self.out.bindings.push(binding);
                    if let Some(layout) = self.layout(pointee)? {
                        self.out.layouts.push(layout);
                    }
                }
                STORAGE_PUSH_CONSTANT => self.push(pointee)?,
                0 | 2 => {
                    let name = self.names.get(&pointee).cloned().unwrap_or_default();
                    return Err(format!("`{name}`: only storage buffers and push constants are supported"));
                }
                // Input (built-ins), Output, Workgroup, Private, Function: invisible from the host.
                _ => debug_assert!(class != 1 || self.decorations.contains_key(&(id, BUILT_IN))),
            }
        }
        self.out.bindings.sort_by_key(|b| b.number);
        if let Some(pair) = self.out.bindings.windows(2).find(|p| p[0].number == p[1].number) {
            return Err(format!(
                "`{}` and `{}` share binding {}",
                pair[0].block, pair[1].block, pair[0].number
            ));
        }
        if self.out.workgroup == [0; 3] {
            return Err("the workgroup size must be literal (local_size_x = ...)".into());
        }
        Ok(self.out)
    }

    fn binding(&self, id: u32, block: u32) -> Result<Binding, String> {
        let name = self.names.get(&block).cloned().unwrap_or_default();
        let Some(Type::Struct(members)) = self.types.get(&block) else {
            return Err(format!("`{name}`: arrays of buffers are not supported"));
        };
        if self.decorations.get(&(id, DESCRIPTOR_SET)).is_some_and(|&s| s != 0) {
            return Err(format!("`{name}`: only descriptor set 0 is supported"));
        }
        let number =
            *self.decorations.get(&(id, BINDING)).ok_or_else(|| format!("`{name}` has no binding number"))?;
        let declared = |what: u32| {
            self.decorations.contains_key(&(id, what))
                || (0..members.len() as u32).all(|m| self.member_decorations.contains_key(&(block, m, what)))
        };
        // `readonly` / `writeonly` are promises the GLSL compiler enforces; what the code does is
        // the finer truth.
        let used = self.used.get(&id).copied().unwrap_or_default();
        let access = Access {
            read: used.read && !declared(NON_READABLE),
            write: used.write && !declared(NON_WRITABLE),
        };
        let &[member] = members.as_slice() else {
            return Err(format!(
                "`{name}` has several members: give each its own block, or make them a structure"
            ));
        };
        let element = self
            .element(member)
            .ok_or_else(|| format!("`{name}` holds neither 32-bit scalars nor a structure"))?;
        Ok(Binding { number, block: name, access, element })
    }

    /// The scalar or structure under arrays and vectors.
    fn element(&self, kind: u32) -> Option<Element> {
        match self.types.get(&kind)? {
            Type::Scalar(scalar) => Some(Element::Scalar(*scalar)),
            Type::Vector(inner, _)
            | Type::Matrix(inner, _)
            | Type::Array(inner, _)
            | Type::RuntimeArray(inner) => self.element(*inner),
            Type::Struct(_) => Some(Element::Structure(self.names.get(&kind)?.clone())),
            Type::Pointer(_) | Type::Other => None,
        }
    }

    /// The structure in a block whose one member is a structure or an array of them.
    fn layout(&self, block: u32) -> Result<Option<Layout>, String> {
        let Some(Type::Struct(block_members)) = self.types.get(&block) else { return Ok(None) };
        let &[member] = block_members.as_slice() else { return Ok(None) };
        let (id, stride) = match self.types.get(&member) {
            Some(&Type::RuntimeArray(element)) => (element, self.decorations.get(&(member, ARRAY_STRIDE))),
            _ => (member, None),
        };
        let Some(Type::Struct(members)) = self.types.get(&id) else { return Ok(None) };
        let name = self.names.get(&id).cloned().unwrap_or_default();
        let (mut out, mut end) = (Vec::new(), 0);
        for (index, &kind) in members.iter().enumerate() {
            let index = index as u32;
            let member_name = self.member_names.get(&(id, index)).cloned().unwrap_or_default();
            let offset = self.member_decorations.get(&(id, index, OFFSET)).copied().unwrap_or(0);
            let member = self.member(id, index, kind, member_name.clone(), offset).ok_or_else(|| {
                format!("`{name}.{member_name}`: a structure holds scalars, vectors and arrays of them")
            })?;
            if offset != end || !member.is_packed() {
                return Err(format!("`{name}.{member_name}` has a gap before or in it: name the padding"));
            }
            end = member.end();
            out.push(member);
        }
        let bytes = stride.copied().unwrap_or(end);
        if bytes != end {
            return Err(format!(
                "`{name}` has {} bytes behind its last member: name the padding",
                bytes - end
            ));
        }
        Ok(Some(Layout { name, members: out, bytes }))
    }

    fn push(&mut self, block: u32) -> Result<(), String> {
        let Some(Type::Struct(members)) = self.types.get(&block) else {
            return Err("push constants must be a block".into());
        };
        let mut push = Vec::new();
        let mut bytes = 0;
        for (index, &kind) in members.iter().enumerate() {
            let index = index as u32;
            let name = self.member_names.get(&(block, index)).cloned().unwrap_or_default();
            let offset = self.member_decorations.get(&(block, index, OFFSET)).copied().unwrap_or(0);
            let member = self.member(block, index, kind, name.clone(), offset).ok_or_else(|| {
                format!("push constant `{name}`: use int, uint, float, vectors, matrices or arrays of them")
            })?;
            bytes = bytes.max(member.end());
            push.push(member);
        }
        // 128 bytes is what Vulkan guarantees and what lavapipe has.
        if bytes > 128 {
            return Err(format!("push constants take {bytes} bytes, more than the 128 every device has"));
        }
        self.out.push = push;
        self.out.push_bytes = bytes;
        Ok(())
    }

    fn member(&self, block: u32, index: u32, kind: u32, name: String, offset: u32) -> Option<Member> {
        let mut kind = kind;
        let mut array = None;
        if let Some(Type::Array(element, length)) = self.types.get(&kind) {
            array = Some((*self.constants.get(length)?, *self.decorations.get(&(kind, ARRAY_STRIDE))?));
            kind = *element;
        }
        let mut columns = None;
        if let Some(Type::Matrix(column, count)) = self.types.get(&kind) {
            columns = Some((*count, *self.member_decorations.get(&(block, index, MATRIX_STRIDE))?));
            kind = *column;
        }
        let mut rows = 1;
        if let Some(Type::Vector(component, count)) = self.types.get(&kind) {
            rows = *count;
            kind = *component;
        }
        match self.types.get(&kind) {
            Some(&Type::Scalar(scalar)) => Some(Member { name, offset, scalar, rows, columns, array }),
            _ => None,
        }
    }
}

impl Member {
    /// Whether its elements follow each other as they do in Rust.
    fn is_packed(&self) -> bool {
        let column = 4 * self.rows;
        let element = column * self.columns.map_or(1, |(n, _)| n);
        self.columns.is_none_or(|(_, stride)| stride == column)
            && self.array.is_none_or(|(_, stride)| stride == element)
    }

    /// First byte behind the member.
    fn end(&self) -> u32 {
        let last_element = self.array.map_or(0, |(n, stride)| (n - 1) * stride);
        let last_column = self.columns.map_or(0, |(n, stride)| (n - 1) * stride);
        self.offset + last_element + last_column + self.rows * 4
    }
}
