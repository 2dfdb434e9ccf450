//! Trade-off of time and quality, for every stage that has one.

/// Length of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Preset {
    /// A few hundred steps: minutes on a CPU device.
    #[serde(alias = "draft")]
    Draft,
    /// The recommended length on a GPU.
    #[serde(alias = "default")]
    Default,
    /// The constants of the reference implementation behind the paper
    /// (docs/internals/method.md#schedules).
    #[serde(alias = "paper")]
    Paper,
}
