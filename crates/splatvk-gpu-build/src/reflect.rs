//! Reflection of SPIR-V: storage buffers with their access, push constants, workgroup size,
//! capabilities. An unsupported feature is an error that names it.
use rspirv::binary::Assemble;
use rspirv::spirv::{self, Decoration, ExecutionMode, Op, StorageClass};
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

/// Name of the `splatvk_gpu::Capability`; `Some(None)` for those that every Vulkan 1.2 device has.
fn capability(number: u32) -> Option<Option<&'static str>> {
    use spirv::Capability as C;
    Some(Some(match C::from_u32(number)? {
        C::Shader => return Some(None),
        C::Float16 => "Float16",
        C::Float64 => "Float64",
        C::Int64 => "Int64",
        C::Int16 => "Int16",
        C::Int8 => "Int8",
        C::GroupNonUniform => "SubgroupBasic",
        C::GroupNonUniformVote => "SubgroupVote",
        C::GroupNonUniformArithmetic => "SubgroupArithmetic",
        C::GroupNonUniformBallot => "SubgroupBallot",
        C::GroupNonUniformShuffle => "SubgroupShuffle",
        C::GroupNonUniformShuffleRelative => "SubgroupShuffleRelative",
        C::StorageBuffer16BitAccess => "Storage16",
        C::StorageBuffer8BitAccess => "Storage8",
        C::AtomicFloat32AddEXT => "AtomicFloatAdd",
        _ => return None,
    }))
}

/// Whether an atomic instruction reads and writes its pointer, operand 2.
fn is_atomic_update(op: Op) -> bool {
    matches!(
        op,
        Op::AtomicExchange
            | Op::AtomicCompareExchange
            | Op::AtomicCompareExchangeWeak
            | Op::AtomicIIncrement
            | Op::AtomicIDecrement
            | Op::AtomicIAdd
            | Op::AtomicISub
            | Op::AtomicSMin
            | Op::AtomicUMin
            | Op::AtomicSMax
            | Op::AtomicUMax
            | Op::AtomicAnd
            | Op::AtomicOr
            | Op::AtomicXor
            | Op::AtomicFAddEXT
            | Op::AtomicFMinEXT
            | Op::AtomicFMaxEXT
    )
}

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
    decorations: HashMap<(u32, Decoration), u32>,
    member_decorations: HashMap<(u32, u32, Decoration), u32>,
    types: HashMap<u32, Type>,
    constants: HashMap<u32, u32>,
    /// Variable id → (storage class, pointer type).
    variables: BTreeMap<u32, (StorageClass, u32)>,
    /// Pointer id → the variable it leads into.
    roots: HashMap<u32, u32>,
    used: HashMap<u32, Access>,
    out: Reflection,
}

/// Reads one unoptimised module.
pub fn reflect(words: &[u32]) -> Result<Reflection, String> {
    let module = rspirv::dr::load_words(words).map_err(|e| format!("not a SPIR-V module: {e}"))?;
    let mut reader = Reader::default();
    for instruction in module.all_inst_iter() {
        reader.instruction(instruction.class.opcode, &instruction.assemble()[1..])?;
    }
    reader.finish()
}

fn decoration(number: u32) -> Result<Decoration, String> {
    Decoration::from_u32(number).ok_or_else(|| format!("decoration {number} is unknown"))
}

fn storage_class(number: u32) -> Result<StorageClass, String> {
    StorageClass::from_u32(number).ok_or_else(|| format!("storage class {number} is unknown"))
}

fn text(words: &[u32]) -> String {
    let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).take_while(|&b| b != 0).collect();
    String::from_utf8_lossy(&bytes).into_owned()
}

impl Reader {
    fn instruction(&mut self, op: Op, o: &[u32]) -> Result<(), String> {
        match op {
            Op::Name => drop(self.names.insert(o[0], text(&o[1..]))),
            Op::MemberName => drop(self.member_names.insert((o[0], o[1]), text(&o[2..]))),
            Op::ExecutionMode if o[1] == ExecutionMode::LocalSize as u32 => {
                self.out.workgroup = [o[2], o[3], o[4]]
            }
            Op::Capability => self.capability(o[0])?,
            Op::TypeInt if o[1] == 32 => {
                let scalar = if o[2] == 0 { Scalar::U32 } else { Scalar::I32 };
                self.types.insert(o[0], Type::Scalar(scalar));
            }
            Op::TypeFloat if o[1] == 32 => drop(self.types.insert(o[0], Type::Scalar(Scalar::F32))),
            Op::TypeRuntimeArray => drop(self.types.insert(o[0], Type::RuntimeArray(o[1]))),
            Op::TypeInt | Op::TypeFloat => drop(self.types.insert(o[0], Type::Other)),
            Op::TypeVector => drop(self.types.insert(o[0], Type::Vector(o[1], o[2]))),
            Op::TypeMatrix => drop(self.types.insert(o[0], Type::Matrix(o[1], o[2]))),
            Op::TypeArray => drop(self.types.insert(o[0], Type::Array(o[1], o[2]))),
            Op::TypeStruct => drop(self.types.insert(o[0], Type::Struct(o[1..].to_vec()))),
            Op::TypePointer => drop(self.types.insert(o[0], Type::Pointer(o[2]))),
            Op::Constant => drop(self.constants.insert(o[1], o[2])),
            Op::SpecConstantTrue
            | Op::SpecConstantFalse
            | Op::SpecConstant
            | Op::SpecConstantComposite
            | Op::SpecConstantOp => {
                return Err("specialisation constants are not supported: use `// variants:`".into());
            }
            Op::Variable => {
                self.variables.insert(o[1], (storage_class(o[2])?, o[0]));
                self.roots.insert(o[1], o[1]);
            }
            Op::Decorate => {
                let key = (o[0], decoration(o[1])?);
                self.decorations.insert(key, o.get(2).copied().unwrap_or(0));
            }
            Op::MemberDecorate => {
                let key = (o[0], o[1], decoration(o[2])?);
                self.member_decorations.insert(key, o.get(3).copied().unwrap_or(0));
            }
            _ => self.access(op, o),
        }
        Ok(())
    }

    /// Follows pointers to their variables and records the accesses.
    fn access(&mut self, op: Op, o: &[u32]) {
        const READ: Access = Access { read: true, write: false };
        const WRITE: Access = Access { read: false, write: true };
        const BOTH: Access = Access { read: true, write: true };
        match op {
            Op::Load | Op::AtomicLoad => self.touch(o[2], READ),
            Op::Store | Op::AtomicStore => self.touch(o[0], WRITE),
            Op::CopyMemory => {
                self.touch(o[0], WRITE);
                self.touch(o[1], READ);
            }
            Op::AccessChain | Op::InBoundsAccessChain => {
                if let Some(&root) = self.roots.get(&o[2]) {
                    self.roots.insert(o[1], root);
                }
            }
            Op::ArrayLength => {} // It reads the descriptor, not the memory.
            op if is_atomic_update(op) => self.touch(o[2], BOTH),
            // A pointer that is handed on may be used for anything.
            Op::FunctionCall | Op::CopyObject | Op::Select | Op::Phi => {
                o[2..].iter().for_each(|&id| self.touch(id, BOTH))
            }
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
        let known = capability(number);
        self.out.capabilities.extend(known.flatten());
        let name = || spirv::Capability::from_u32(number).map_or(number.to_string(), |c| format!("{c:?}"));
        known.map(drop).ok_or_else(|| format!("SPIR-V capability {} is not supported", name()))
    }

    fn finish(mut self) -> Result<Reflection, String> {
        let variables: Vec<(u32, (StorageClass, u32))> =
            self.variables.iter().map(|(&i, &v)| (i, v)).collect();
        for (id, (class, pointer)) in variables {
            let Some(&Type::Pointer(pointee)) = self.types.get(&pointer) else { continue };
            match class {
                StorageClass::StorageBuffer => {
                    let binding = self.binding(id, pointee)?;
                    self.out.bindings.push(binding);
                    if let Some(layout) = self.layout(pointee)? {
                        self.out.layouts.push(layout);
                    }
                }
                StorageClass::PushConstant => self.push(pointee)?,
                StorageClass::UniformConstant | StorageClass::Uniform => {
                    let name = self.names.get(&pointee).cloned().unwrap_or_default();
                    return Err(format!("`{name}`: only storage buffers and push constants are supported"));
                }
                // Input (built-ins), Output, Workgroup, Private, Function: invisible from the host.
                _ => debug_assert!(
                    class != StorageClass::Input || self.decorations.contains_key(&(id, Decoration::BuiltIn))
                ),
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
        if self.decorations.get(&(id, Decoration::DescriptorSet)).is_some_and(|&s| s != 0) {
            return Err(format!("`{name}`: only descriptor set 0 is supported"));
        }
        let number = *self
            .decorations
            .get(&(id, Decoration::Binding))
            .ok_or_else(|| format!("`{name}` has no binding number"))?;
        let declared = |promise: Decoration| {
            self.decorations.contains_key(&(id, promise))
                || (0..members.len() as u32)
                    .all(|m| self.member_decorations.contains_key(&(block, m, promise)))
        };
        // `readonly` / `writeonly` are promises the GLSL compiler enforces; what the code does is
        // the finer truth.
        let used = self.used.get(&id).copied().unwrap_or_default();
        let access = Access {
            read: used.read && !declared(Decoration::NonReadable),
            write: used.write && !declared(Decoration::NonWritable),
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
            Some(&Type::RuntimeArray(element)) => {
                (element, self.decorations.get(&(member, Decoration::ArrayStride)))
            }
            _ => (member, None),
        };
        let Some(Type::Struct(members)) = self.types.get(&id) else { return Ok(None) };
        let name = self.names.get(&id).cloned().unwrap_or_default();
        let (mut out, mut end) = (Vec::new(), 0);
        for (index, &kind) in members.iter().enumerate() {
            let index = index as u32;
            let member_name = self.member_names.get(&(id, index)).cloned().unwrap_or_default();
            let offset = self.member_decorations.get(&(id, index, Decoration::Offset)).copied().unwrap_or(0);
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
            let offset =
                self.member_decorations.get(&(block, index, Decoration::Offset)).copied().unwrap_or(0);
            let member = self.member(block, index, kind, name.clone(), offset).ok_or_else(|| {
                format!("push constant `{name}`: use int, uint, float, vectors, matrices or arrays of them")
            })?;
            bytes = bytes.max(member.end());
            push.push(member);
        }
        // Vulkan guarantees 128 bytes, and lavapipe has no more.
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
            array = Some((
                *self.constants.get(length)?,
                *self.decorations.get(&(kind, Decoration::ArrayStride))?,
            ));
            kind = *element;
        }
        let mut columns = None;
        if let Some(Type::Matrix(column, count)) = self.types.get(&kind) {
            columns =
                Some((*count, *self.member_decorations.get(&(block, index, Decoration::MatrixStride))?));
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
