//! Runs the programs of the engine on the interpreter: a device of any subgroup size.
use spirv_interpreter::{Counts, GARBAGE, Memory, Schedule, Shader, words};
use splatvk::gpu::{Buffer, Executor, Groups, Module, NATIVE_FLOAT_ATOMICS, Op, Options, TestDevice};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::{Arc, LazyLock, Mutex};

/// Replacement for a shipped module; `None` keeps the module.
pub type Change = Arc<dyn Fn(&Module) -> Option<Vec<u32>> + Send + Sync>;

/// Interpreted device.
#[derive(Clone)]
pub struct Interpreted {
    pub schedule: Schedule,
    pub float_atomics: bool,
    /// Largest size of a buffer, bytes.
    pub max_binding: Option<u64>,
    /// Names of buffers whose content is undefined when a program begins: the program must write
    /// before it reads.
    pub scratch: &'static [&'static str],
    pub change: Option<Change>,
    /// Modules that have run, and scratch buffers that were used.
    pub ran: Arc<Mutex<BTreeSet<&'static str>>>,
    /// Executed instructions by family.
    pub counts: Arc<Mutex<BTreeMap<&'static str, Counts>>>,
}

impl Interpreted {
    pub fn open(&self) -> TestDevice {
        let size = self.schedule.subgroup_size as u32;
        let options = Options {
            disabled: if self.float_atomics {
                BTreeSet::new()
            } else {
                [NATIVE_FLOAT_ATOMICS.to_owned()].into()
            },
            max_binding: self.max_binding,
            ..splatvk::gpu::options(None)
        };
        TestDevice::executed_by(Box::new(self.clone()), size, &options).expect("a device")
    }

    fn code(&self, module: &Module) -> Arc<Shader> {
        static LOWERED: LazyLock<Mutex<HashMap<&str, Arc<Shader>>>> = LazyLock::new(Mutex::default);
        if let Some(words) = self.change.as_ref().and_then(|change| change(module)) {
            return Arc::new(Shader::new(&words));
        }
        if let Some(code) = LOWERED.lock().unwrap().get(module.name) {
            return code.clone();
        }
        let code = Arc::new(Shader::new(&words(module.spirv)));
        LOWERED.lock().unwrap().insert(module.name, code.clone());
        code
    }
}

/// Buffers of a program, by id.
struct Buffers<'a> {
    on: &'a Interpreted,
    held: HashMap<u64, (Buffer, Memory)>,
}

impl Buffers<'_> {
    /// Memory of a buffer. A binding extends beyond its own bytes to a whole vector of four words,
    /// which may be read with the others but must not affect results.
    fn memory(&mut self, buffer: &Buffer) -> &mut Memory {
        let entry = self.held.entry(buffer.id()).or_insert_with(|| {
            let bytes = buffer.cast::<u8>().read().expect("a mapped buffer");
            let mut words = spirv_interpreter::words(&bytes);
            let own = words.len();
            words.resize(own.next_multiple_of(4).max(4), GARBAGE);
            let mut memory = Memory::of(words);
            if let Some(name) = self.on.scratch.iter().find(|name| **name == buffer.name()) {
                self.on.ran.lock().unwrap().insert(name);
                memory.forget(0);
            }
            (buffer.clone(), memory)
        });
        &mut entry.1
    }

    fn write_back(&self) {
        for (buffer, memory) in self.held.values() {
            let bytes: Vec<u8> = memory.words.iter().flat_map(|w| w.to_le_bytes()).collect();
            let own = &bytes[..buffer.bytes() as usize];
            buffer.cast::<u8>().write(own).expect("a mapped buffer");
        }
    }
}

impl Executor for Interpreted {
    fn run(&self, commands: &[&Op]) -> Result<(), String> {
        let mut buffers = Buffers { on: self, held: HashMap::new() };
        for (k, op) in commands.iter().enumerate() {
            match op {
                Op::Fill { buffer, value } => {
                    let memory = buffers.memory(buffer);
                    let words = vec![*value; memory.words.len()];
                    memory.set(0, &words);
                }
                Op::Copy { from, to, from_byte, to_byte, bytes } => {
                    let (first, count) = ((from_byte / 4) as usize, (bytes / 4) as usize);
                    let words = buffers.memory(from).words[first..first + count].to_vec();
                    buffers.memory(to).set((to_byte / 4) as usize, &words);
                }
                Op::Dispatch { module, call, groups } => {
                    let groups = match groups {
                        Groups::Direct(groups) => *groups,
                        Groups::Indirect { args, byte } => {
                            let words = &buffers.memory(args).words[(byte / 4) as usize..];
                            [words[0], words[1], words[2]]
                        }
                    };
                    let number = k as u64;
                    let counts =
                        self.dispatch(module, call.buffers(), call.push(), groups, number, &mut buffers)?;
                    let family = module.name.split('[').next().unwrap_or_default();
                    *self.counts.lock().unwrap().entry(family).or_default() += counts;
                }
            }
        }
        buffers.write_back();
        Ok(())
    }
}

impl Interpreted {
    fn dispatch(
        &self,
        module: &'static Module,
        bound: &[(u32, Buffer)],
        push: &[u8],
        groups: [u32; 3],
        number: u64,
        buffers: &mut Buffers,
    ) -> Result<Counts, String> {
        self.ran.lock().unwrap().insert(module.name);
        let code = self.code(module);
        let used: Vec<&(u32, Buffer)> =
            bound.iter().filter(|b| module.bindings.iter().any(|m| m.number == b.0)).collect();
        let mut bindings: Vec<Option<Memory>> = Vec::new();
        bindings.resize_with(32, || None);
        let mut first: HashMap<u64, u32> = HashMap::new();
        for (binding, buffer) in &used {
            // Buffers that are only read may be bound twice: the second binding gets a copy.
            let memory = match first.get(&buffer.id()) {
                Some(&other) => Memory::of(bindings[other as usize].as_ref().unwrap().words.clone()),
                None => std::mem::replace(buffers.memory(buffer), Memory::of(Vec::new())),
            };
            first.entry(buffer.id()).or_insert(*binding);
            bindings[*binding as usize] = Some(memory);
        }
        let schedule = Schedule { seed: self.schedule.seed ^ number << 8, ..self.schedule };
        let outcome = code.dispatch(&mut bindings, &words(push), groups, &schedule);
        for (binding, buffer) in &used {
            if first.get(&buffer.id()) == Some(binding)
                && let Some(memory) = bindings[*binding as usize].take()
            {
                *buffers.memory(buffer) = memory;
            }
        }
        outcome.map_err(|e| format!("{}: {e}", module.name))
    }
}
