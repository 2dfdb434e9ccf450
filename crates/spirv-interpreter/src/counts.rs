//! Counts of executed instructions.
use crate::code::{Binary, Inst, Root, Unary};

/// Instructions that subgroups have executed, each counted once per subgroup, whatever the number
/// of its active invocations.
///
/// Vectors count by component, but a load or store of a whole vector is one instruction. Moves,
/// addresses, and memory that a compiler keeps in registers are not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Arithmetic, comparisons and selections.
    pub arithmetic: u64,
    /// Of these exponentials, logarithms, roots, divisions and trigonometric functions.
    pub transcendental: u64,
    /// Operations between the invocations of a subgroup.
    pub subgroup: u64,
    /// Loads and stores of workgroup memory.
    pub shared: u64,
    /// Loads and stores of buffers.
    pub buffers: u64,
    /// Atomic operations.
    pub atomics: u64,
    /// Barriers of workgroups.
    pub barriers: u64,
}

impl Counts {
    pub(crate) fn note(&mut self, inst: &Inst) {
        match inst {
            Inst::Unary(op, ..) => {
                self.arithmetic += 1;
                self.transcendental += u64::from(is_transcendental(*op));
            }
            Inst::Binary(op, ..) => {
                self.arithmetic += 1;
                self.transcendental += u64::from(matches!(op, Binary::FDiv | Binary::Pow));
            }
            Inst::Fma(..) | Inst::Select(..) | Inst::PackUnorm4(..) => self.arithmetic += 1,
            Inst::Pick(..) | Inst::Address { .. } => {}
            Inst::Load { place, .. } | Inst::Store { place, .. } => match place.root {
                Root::Shared(_) => self.shared += 1,
                Root::Buffer(_) => self.buffers += 1,
                Root::Private(_) | Root::Push | Root::Input(_) => {}
            },
            Inst::Atomic { .. } => self.atomics += 1,
            Inst::Subgroup(..) => self.subgroup += 1,
            Inst::Barrier { .. } => self.barriers += 1,
        }
    }
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Counts) {
        self.arithmetic += other.arithmetic;
        self.transcendental += other.transcendental;
        self.subgroup += other.subgroup;
        self.shared += other.shared;
        self.buffers += other.buffers;
        self.atomics += other.atomics;
        self.barriers += other.barriers;
    }
}

fn is_transcendental(op: Unary) -> bool {
    use Unary::{Cos, Exp, Exp2, InverseSqrt, Log, Log2, Sin, Sqrt};
    matches!(op, Exp | Exp2 | Log | Log2 | Sqrt | InverseSqrt | Sin | Cos)
}
