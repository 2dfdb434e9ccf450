//! Required interface of a graph: for every part of a model the roles of its inputs and outputs and
//! their shapes in the program. Names, layouts and ranges of a file are data: see
//! [`super::adapter`].
//!
//! A shape is a row of axis names: "B H W 3" has a free batch, height and width, and three
//! channels. An axis that occurs twice in one contract has one length.
use serde::{Deserialize, Serialize};

/// Part of a model that a graph computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Part {
    /// Image → one embedding (CLIP).
    ImageTower,
    /// Tokens → one embedding (CLIP).
    TextTower,
    /// Image → embedding per pixel (LSeg).
    DenseFeatures,
    /// Image → inputs of the mask decoder (SAM).
    MaskEncoder,
    /// Prompts → masks (SAM).
    MaskDecoder,
    /// Two images → pointmaps in the first camera (DUSt3R, MASt3R as one graph).
    Pair,
    /// Image → tokens (DUSt3R, MASt3R as two graphs).
    PairEncoder,
    /// Tokens of two images → pointmaps in the first camera.
    PairDecoder,
    /// All images → depth and cameras (VGGT and others).
    MultiView,
    /// Two images → dense warp (RoMa).
    Warp,
    /// Image → depth of unknown scale and shift (Depth Anything, MiDaS).
    Depth,
    /// Image → feature maps of a concept network (SAM 3).
    ConceptImage,
    /// Tokens → a feature per token (SAM 3).
    ConceptText,
    /// Feature maps and text → masks of all instances of the text (SAM 3).
    ConceptDecoder,
}

impl Part {
    /// The name that adapters and messages use.
    pub fn name(self) -> &'static str {
        self.contract().name
    }

    /// The required inputs and outputs.
    pub fn contract(self) -> &'static Contract {
        match self {
            Part::ImageTower => &IMAGE_TOWER,
            Part::TextTower => &TEXT_TOWER,
            Part::DenseFeatures => &DENSE_FEATURES,
            Part::MaskEncoder => &MASK_ENCODER,
            Part::MaskDecoder => &MASK_DECODER,
            Part::Pair => &PAIR,
            Part::PairEncoder => &PAIR_ENCODER,
            Part::PairDecoder => &PAIR_DECODER,
            Part::MultiView => &MULTI_VIEW,
            Part::Warp => &WARP,
            Part::Depth => &DEPTH,
            Part::ConceptImage => &CONCEPT_IMAGE,
            Part::ConceptText => &CONCEPT_TEXT,
            Part::ConceptDecoder => &CONCEPT_DECODER,
        }
    }
}

/// One input or output.
#[derive(Debug)]
pub struct Slot {
    /// Its role.
    pub role: &'static str,
    /// Its axes in the program.
    pub shape: &'static str,
    /// Other layouts that graphs use; the program reorders them.
    pub layouts: &'static [&'static str],
    /// Whether a graph may lack it.
    pub optional: bool,
    /// Whether it may be of integers or truth values.
    pub integer: bool,
}

/// The inputs and outputs of a part.
#[derive(Debug)]
pub struct Contract {
    /// The part's name.
    pub name: &'static str,
    /// Its inputs.
    pub inputs: &'static [Slot],
    /// Its outputs.
    pub outputs: &'static [Slot],
}

impl Contract {
    /// The slot of a role.
    pub fn slot(&self, role: &str) -> Option<&'static Slot> {
        self.inputs.iter().chain(self.outputs).find(|s| s.role == role)
    }
}

const fn slot(role: &'static str, shape: &'static str, layouts: &'static [&'static str]) -> Slot {
    Slot { role, shape, layouts, optional: false, integer: false }
}

const fn maybe(role: &'static str, shape: &'static str, layouts: &'static [&'static str]) -> Slot {
    Slot { role, shape, layouts, optional: true, integer: false }
}

const fn integer(s: Slot) -> Slot {
    Slot { integer: true, ..s }
}

static IMAGE_TOWER: Contract = Contract {
    name: "image-tower",
    inputs: &[slot("image", "B 3 H W", &["B H W 3"])],
    outputs: &[slot("embedding", "B D", &[])],
};
static TEXT_TOWER: Contract = Contract {
    name: "text-tower",
    inputs: &[integer(slot("tokens", "B L", &[])), integer(maybe("mask", "B L", &[]))],
    outputs: &[slot("embedding", "B D", &[])],
};
static DENSE_FEATURES: Contract = Contract {
    name: "dense-features",
    inputs: &[slot("image", "B 3 H W", &["B H W 3"])],
    outputs: &[slot("features", "B h w D", &["B D h w"])],
};
static MASK_ENCODER: Contract = Contract {
    name: "mask-encoder",
    inputs: &[slot("image", "B 3 H W", &["H W 3", "B H W 3"])],
    outputs: &[
        slot("embedding", "B C h w", &[]),
        maybe("high0", "B C0 h0 w0", &[]),
        maybe("high1", "B C1 h1 w1", &[]),
        maybe("position", "B Cp hp wp", &[]),
    ],
};
static MASK_DECODER: Contract = Contract {
    name: "mask-decoder",
    inputs: &[
        slot("embedding", "B C h w", &[]),
        maybe("high0", "B C0 h0 w0", &[]),
        maybe("high1", "B C1 h1 w1", &[]),
        maybe("position", "B Cp hp wp", &[]),
        slot("points", "P N 2", &["b P N 2"]),
        integer(slot("labels", "P N", &["b P N"])),
        maybe("boxes", "b K 4", &[]),
        maybe("mask", "b 1 m n", &[]),
        maybe("has_mask", "q", &[]),
        maybe("size", "2", &[]),
    ],
    outputs: &[slot("masks", "P M x y", &["b P M x y"]), slot("scores", "P M", &["b P M"])],
};
/// Outputs of a pair network, with optional descriptors.
macro_rules! pair_outputs {
    () => {
        &[
            slot("points1", "B H W 3", &["B 3 H W"]),
            slot("conf1", "B H W", &["B H W 1", "B 1 H W"]),
            slot("points2", "B I J 3", &["B 3 I J"]),
            slot("conf2", "B I J", &["B I J 1", "B 1 I J"]),
            maybe("desc1", "B H W D", &["B D H W"]),
            maybe("desc2", "B I J D", &["B D I J"]),
            maybe("desc_conf1", "B H W", &["B H W 1", "B 1 H W"]),
            maybe("desc_conf2", "B I J", &["B I J 1", "B 1 I J"]),
        ]
    };
}
static PAIR: Contract = Contract {
    name: "pair",
    inputs: &[
        slot("image1", "B 3 H W", &["B H W 3"]),
        slot("image2", "B 3 I J", &["B I J 3"]),
        integer(maybe("shape1", "B 2", &[])),
        integer(maybe("shape2", "B 2", &[])),
    ],
    outputs: pair_outputs!(),
};
static PAIR_ENCODER: Contract = Contract {
    name: "pair-encoder",
    inputs: &[slot("image", "B 3 H W", &["B H W 3"]), integer(maybe("shape", "B 2", &[]))],
    outputs: &[slot("tokens", "B L C", &[]), integer(maybe("position", "B L 2", &[]))],
};
static PAIR_DECODER: Contract = Contract {
    name: "pair-decoder",
    inputs: &[
        slot("tokens1", "B L C", &[]),
        slot("tokens2", "B K C", &[]),
        integer(maybe("position1", "B L 2", &[])),
        integer(maybe("position2", "B K 2", &[])),
    ],
    outputs: pair_outputs!(),
};
static MULTI_VIEW: Contract = Contract {
    name: "multi-view",
    inputs: &[slot("images", "B N 3 H W", &["N 3 H W"])],
    outputs: &[
        slot("depth", "B N H W", &["B N H W 1", "N H W", "N H W 1", "N 1 H W"]),
        slot("confidence", "B N H W", &["B N H W 1", "N H W", "N H W 1", "N 1 H W"]),
        maybe("pose_code", "B N 9", &["N 9"]),
        maybe("extrinsics", "B N R 4", &["N R 4"]),
        maybe("intrinsics", "B N 3 3", &["N 3 3"]),
    ],
};
static WARP: Contract = Contract {
    name: "warp",
    inputs: &[slot("image1", "B 3 H W", &["B H W 3"]), slot("image2", "B 3 H W", &["B H W 3"])],
    outputs: &[
        slot("warp12", "B h w 2", &["B 2 h w"]),
        slot("certainty12", "B h w", &["B 1 h w", "B h w 1"]),
        maybe("warp21", "B h w 2", &["B 2 h w"]),
        maybe("certainty21", "B h w", &["B 1 h w", "B h w 1"]),
    ],
};

// The adapter states which of the two a graph gives: Depth Anything calls both "predicted_depth".
static DEPTH: Contract = Contract {
    name: "depth",
    inputs: &[slot("image", "B 3 H W", &["B H W 3"])],
    outputs: &[
        maybe("inverse_depth", "B h w", &["B 1 h w", "B h w 1"]),
        maybe("depth", "B h w", &["B 1 h w", "B h w 1"]),
    ],
};

/// Feature maps that a concept decoder needs, finest first.
macro_rules! concept_levels {
    ($($more:expr),*) => {
        &[
            slot("level0", "B C0 h0 w0", &[]),
            slot("level1", "B C1 h1 w1", &[]),
            slot("level2", "B C2 h2 w2", &[]),
            slot("position2", "B C2 h2 w2", &[]),
            $($more),*
        ]
    };
}
static CONCEPT_IMAGE: Contract = Contract {
    name: "concept-image",
    inputs: &[slot("image", "B 3 H W", &["B H W 3"])],
    outputs: concept_levels!(),
};
static CONCEPT_TEXT: Contract = Contract {
    name: "concept-text",
    inputs: &[integer(slot("tokens", "B L", &[])), integer(maybe("mask", "B L", &[]))],
    outputs: &[slot("text", "B L E", &[]), integer(maybe("text_mask", "B L", &[]))],
};
static CONCEPT_DECODER: Contract = Contract {
    name: "concept-decoder",
    inputs: concept_levels!(slot("text", "B L E", &[]), integer(slot("text_mask", "B L", &[]))),
    outputs: &[
        slot("masks", "B Q x y", &[]),
        slot("scores", "B Q", &["B Q 1"]),
        maybe("presence", "B", &["B 1"]),
    ],
};

/// Every part.
pub const PARTS: [Part; 14] = [
    Part::ImageTower,
    Part::TextTower,
    Part::DenseFeatures,
    Part::MaskEncoder,
    Part::MaskDecoder,
    Part::Pair,
    Part::PairEncoder,
    Part::PairDecoder,
    Part::MultiView,
    Part::Warp,
    Part::Depth,
    Part::ConceptImage,
    Part::ConceptText,
    Part::ConceptDecoder,
];

/// The axes of a shape.
pub fn axes(shape: &str) -> impl Iterator<Item = &str> {
    shape.split_whitespace()
}

/// Whether a tensor of `dims` (`None` = any) can have `shape`, given the axis lengths in `known`;
/// if so, adds the new lengths.
pub fn unify<'s>(shape: &'s str, dims: &[Option<usize>], known: &mut Vec<(&'s str, usize)>) -> bool {
    let start = known.len();
    let fits = axes(shape).count() == dims.len()
        && axes(shape).zip(dims).all(|(axis, length)| {
            let Some(length) = *length else { return true };
            if let Ok(wanted) = axis.parse::<usize>() {
                return wanted == length;
            }
            match known.iter().find(|(a, _)| *a == axis) {
                Some((_, n)) => *n == length,
                None => {
                    known.push((axis, length));
                    true
                }
            }
        });
    if !fits {
        known.truncate(start);
    }
    fits
}

/// Reorders axes. Axes that `to` lacks must have length 1 and are removed; those that `from` lacks
/// are added with length 1. `None` when the values do not have the shape `from`.
pub fn reorder<T: Copy>(
    shape: Vec<usize>,
    data: Vec<T>,
    from: &str,
    to: &str,
) -> Option<(Vec<usize>, Vec<T>)> {
    let (from_axes, to_axes): (Vec<&str>, Vec<&str>) = (axes(from).collect(), axes(to).collect());
    if shape.len() != from_axes.len() {
        return None;
    }
    if from_axes == to_axes {
        return Some((shape, data));
    }
    let mut strides = vec![1usize; from_axes.len()];
    for k in (0..from_axes.len().saturating_sub(1)).rev() {
        strides[k] = strides[k + 1] * shape[k + 1];
    }
    if (0..from_axes.len()).any(|k| !to_axes.contains(&from_axes[k]) && shape[k] != 1) {
        return None;
    }
    let place = |axis: &&str| from_axes.iter().position(|a| a == axis);
    let source: Vec<(usize, usize)> =
        to_axes.iter().map(|a| place(a).map_or((1, 0), |k| (shape[k], strides[k]))).collect();
    let mut out = Vec::with_capacity(data.len());
    gather(&data, &source, 0, &mut out);
    Some((source.iter().map(|s| s.0).collect(), out))
}

fn gather<T: Copy>(data: &[T], axes: &[(usize, usize)], at: usize, out: &mut Vec<T>) {
    match axes {
        [] => out.extend(data.get(at)),
        [(n, 1)] => out.extend(data.get(at..at + n).unwrap_or_default()),
        [(n, stride), rest @ ..] => (0..*n).for_each(|i| gather(data, rest, at + i * stride, out)),
    }
}

#[cfg(test)]
mod tests {
    use super::super::graph::relayout;
    use super::super::runtime::Tensor;
    use super::*;

    #[test]
    fn relayout_reorders_and_changes_unit_axes() {
        let t = Tensor { shape: vec![1, 2, 2, 3], data: (0..12).map(|v| v as f32).collect() };
        let last = relayout(t.clone(), "B C H W", "B H W C").unwrap();
        assert_eq!(last.shape, [1, 2, 3, 2]);
        assert_eq!(last.data, [0.0, 6.0, 1.0, 7.0, 2.0, 8.0, 3.0, 9.0, 4.0, 10.0, 5.0, 11.0]);
        assert_eq!(relayout(last, "B H W C", "B C H W").unwrap().data, t.data);
        assert_eq!(relayout(t.clone(), "B C H W", "C H W").unwrap().shape, [2, 2, 3]);
        assert_eq!(relayout(t.clone(), "B C H W", "B N C H W").unwrap().shape, [1, 1, 2, 2, 3]);
        assert!(relayout(t, "B C H W", "B H W").is_none(), "an axis of length 2 cannot go");
    }

    #[test]
    fn unify_binds_axes_by_name() {
        let mut known = Vec::new();
        assert!(unify("B H W 3", &[Some(1), Some(4), None, Some(3)], &mut known));
        assert!(unify("B H W", &[None, Some(4), Some(5)], &mut known));
        assert!(!unify("B H W", &[Some(1), Some(5), Some(5)], &mut known));
        assert!(!unify("B H W 3", &[Some(1), Some(4), Some(5), Some(2)], &mut known));
        assert!(!unify("B H W", &[Some(1), Some(4)], &mut known));
    }
}
