//! Operations between the invocations of a subgroup.
use crate::code::{GARBAGE, Reduction, Reg, Subgroup as Op};
use crate::faults::{Fault, Faults};
use crate::subgroup::Subgroup;

fn combine(op: Reduction, a: u32, b: u32) -> u32 {
    match op {
        Reduction::IAdd => a.wrapping_add(b),
        Reduction::FAdd => (f32::from_bits(a) + f32::from_bits(b)).to_bits(),
        Reduction::UMax => a.max(b),
    }
}

impl Subgroup {
    /// Runs a subgroup operation. A fault if not all invocations take part: Vulkan does not
    /// guarantee that diverged invocations have reconverged.
    pub(crate) fn subgroup_op(&mut self, op: Op, to: Reg, (a, b): (Reg, Reg), at: u32, faults: &mut Faults) {
        let lanes = self.locals.len();
        if self.active.len() != lanes {
            faults
                .note(at, Fault::NonUniform, || format!("{op:?} by {} of {lanes} lanes", self.active.len()));
        }
        let mut here = vec![false; self.size];
        self.active.iter().for_each(|&l| here[l] = true);
        let values: Vec<u32> = (0..lanes).map(|l| self.get(a, l)).collect();
        // Sums run in ascending order of lanes, whatever the order of execution.
        let mut ascending = self.active.clone();
        ascending.sort_unstable();
        let vote = |l: &usize| values[*l] != 0;
        let fill = |s: &mut Subgroup, value: u32| ascending.iter().for_each(|&l| s.set(to, l, value));
        match op {
            Op::All => fill(self, ascending.iter().all(vote).into()),
            Op::Any => fill(self, ascending.iter().any(vote).into()),
            Op::Ballot(word) => {
                let inside = |l: &&usize| **l / 32 == word as usize && vote(l);
                let bits = ascending.iter().filter(inside).map(|l| 1 << (l % 32)).fold(0, |a, b: u32| a | b);
                fill(self, bits);
            }
            Op::Shuffle | Op::ShuffleXor | Op::Broadcast => {
                for &lane in &ascending {
                    let other = self.get(b, lane) as usize;
                    let from = if op == Op::ShuffleXor { lane ^ other } else { other };
                    let value = match here.get(from) {
                        Some(true) => values[from],
                        _ => {
                            faults.note(at, Fault::AbsentLane, || {
                                format!("{op:?} from lane {from} of {lanes}")
                            });
                            GARBAGE
                        }
                    };
                    self.set(to, lane, value);
                }
            }
            Op::Reduce(r) => {
                let sum = ascending.iter().map(|l| values[*l]).reduce(|a, b| combine(r, a, b));
                fill(self, sum.unwrap_or(0));
            }
            // 0 is neutral for sums, also of floats, and for the maximum of unsigned numbers.
            Op::Inclusive(r) | Op::Exclusive(r) => {
                let mut sum = 0;
                for &lane in &ascending {
                    let next = combine(r, sum, values[lane]);
                    self.set(to, lane, if matches!(op, Op::Inclusive(_)) { next } else { sum });
                    sum = next;
                }
            }
        }
    }
}
