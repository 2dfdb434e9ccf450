//! Time against quality, for every stage that can trade them.

/// How much time a run may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Preset {
    /// A few hundred steps: minutes on a CPU device.
    Draft,
    /// The recommended length on a GPU.
    Default,
    /// The constants of the reference implementation behind the paper
    /// (docs/internals/method.md#schedules).
    Paper,
}
