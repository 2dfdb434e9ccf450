//! The paper's own figures for the rows of the tables (SparseLGS, its sections "Experiments" and
//! "Ablation studies").

/// Figures of one table on one data set: a value per row and column; NaN where the paper has none.
struct Block {
    table: &'static str,
    /// Data set, or scene of one as `SET/SCENE`.
    data: &'static str,
    columns: &'static [&'static str],
    rows: &'static [(&'static str, &'static [f64])],
}

const NONE: f64 = f64::NAN;

/// Seconds of "40s", "1 min", "6 min" and "8 min".
const TIMES: [f64; 4] = [40.0, 60.0, 360.0, 480.0];

/// mIoU, mACC, training and total time.
const TIMED: &[&str] = &["mIoU", "mAcc", "Tr.T", "T.T"];
const SCORES: &[&str] = &["mIoU", "mAcc"];
const IOU: &[&str] = &["mIoU"];

/// All figures of the paper. Its mean accuracy on LERF is 0.770 in the tables of methods and 0.786
/// in those of ablations; the figures of the four scenes average 0.795.
static BLOCKS: &[Block] = &[
    Block {
        table: "methods",
        data: "lerf",
        columns: TIMED,
        rows: &[
            ("sparselgs", &[0.538, 0.770, TIMES[0], TIMES[2]]),
            ("langsplat", &[0.426, 0.636, TIMES[0], TIMES[2]]),
            ("legaussians", &[0.237, 0.632, NONE, NONE]),
        ],
    },
    Block {
        table: "methods",
        data: "lerf/ramen",
        columns: SCORES,
        rows: &[("sparselgs", &[0.402, 0.692]), ("langsplat", &[0.265, 0.462])],
    },
    Block {
        table: "methods",
        data: "lerf/figurines",
        columns: SCORES,
        rows: &[("sparselgs", &[0.487, 0.732]), ("langsplat", &[0.328, 0.607])],
    },
    Block {
        table: "methods",
        data: "lerf/teatime",
        columns: SCORES,
        rows: &[("sparselgs", &[0.713, 0.868]), ("langsplat", &[0.634, 0.921])],
    },
    Block {
        table: "methods",
        data: "lerf/waldo_kitchen",
        columns: SCORES,
        rows: &[("sparselgs", &[0.551, 0.889]), ("langsplat", &[0.478, 0.556])],
    },
    Block {
        table: "methods",
        data: "3dovs",
        columns: &["mIoU", "Tr.T", "T.T"],
        rows: &[
            ("sparselgs", &[0.844, TIMES[1], TIMES[3]]),
            ("langsplat", &[0.645, TIMES[1], TIMES[3]]),
            ("legaussians", &[0.434, NONE, NONE]),
        ],
    },
    Block {
        table: "methods",
        data: "3dovs/bed",
        columns: IOU,
        rows: &[("sparselgs", &[0.911]), ("langsplat", &[0.628])],
    },
    Block {
        table: "methods",
        data: "3dovs/sofa",
        columns: IOU,
        rows: &[("sparselgs", &[0.831]), ("langsplat", &[0.866])],
    },
    Block {
        table: "methods",
        data: "3dovs/bench",
        columns: IOU,
        rows: &[("sparselgs", &[0.903]), ("langsplat", &[0.841])],
    },
    Block {
        table: "methods",
        data: "3dovs/room",
        columns: IOU,
        rows: &[("sparselgs", &[0.730]), ("langsplat", &[0.004])],
    },
    Block {
        table: "methods",
        data: "3dovs/desk",
        columns: IOU,
        rows: &[("sparselgs", &[0.843]), ("langsplat", &[0.884])],
    },
    // "DC." and "SC.": COLMAP on all photos of LERF, on the three photos of 3D-OVS.
    Block {
        table: "colmap",
        data: "lerf",
        columns: TIMED,
        rows: &[
            ("langsplat, dense COLMAP", &[0.455, 0.616, 1200.0, 4200.0]),
            ("legaussians, dense COLMAP", &[0.253, 0.614, 1500.0, 1800.0]),
        ],
    },
    Block {
        table: "colmap",
        data: "lerf/ramen",
        columns: SCORES,
        rows: &[("langsplat, dense COLMAP", &[0.291, 0.385]), ("legaussians, dense COLMAP", &[0.222, 0.538])],
    },
    Block {
        table: "colmap",
        data: "lerf/figurines",
        columns: SCORES,
        rows: &[("langsplat, dense COLMAP", &[0.347, 0.571]), ("legaussians, dense COLMAP", &[0.249, 0.411])],
    },
    Block {
        table: "colmap",
        data: "lerf/teatime",
        columns: SCORES,
        rows: &[("langsplat, dense COLMAP", &[0.630, 0.842]), ("legaussians, dense COLMAP", &[0.328, 0.842])],
    },
    Block {
        table: "colmap",
        data: "lerf/waldo_kitchen",
        columns: SCORES,
        rows: &[("langsplat, dense COLMAP", &[0.551, 0.667]), ("legaussians, dense COLMAP", &[0.213, 0.667])],
    },
    Block {
        table: "colmap",
        data: "3dovs",
        columns: &["mIoU", "Tr.T", "T.T"],
        rows: &[
            ("langsplat, sparse COLMAP", &[0.601, 1620.0, 6000.0]),
            ("legaussians, sparse COLMAP", &[0.397, 2100.0, 2400.0]),
        ],
    },
    Block {
        table: "colmap",
        data: "3dovs/bed",
        columns: IOU,
        rows: &[("langsplat, sparse COLMAP", &[0.558]), ("legaussians, sparse COLMAP", &[0.418])],
    },
    Block {
        table: "colmap",
        data: "3dovs/sofa",
        columns: IOU,
        rows: &[("langsplat, sparse COLMAP", &[0.789]), ("legaussians, sparse COLMAP", &[0.456])],
    },
    Block {
        table: "colmap",
        data: "3dovs/bench",
        columns: IOU,
        rows: &[("langsplat, sparse COLMAP", &[0.786]), ("legaussians, sparse COLMAP", &[0.328])],
    },
    Block {
        table: "colmap",
        data: "3dovs/room",
        columns: IOU,
        rows: &[("langsplat, sparse COLMAP", &[0.004]), ("legaussians, sparse COLMAP", &[0.386])],
    },
    Block {
        table: "colmap",
        data: "3dovs/desk",
        columns: IOU,
        rows: &[("langsplat, sparse COLMAP", &[0.868]), ("legaussians, sparse COLMAP", &[0.400])],
    },
    Block {
        table: "bijection",
        data: "lerf",
        columns: SCORES,
        rows: &[("bijection", &[0.538, 0.786]), ("autoencoder, 100 epochs", &[0.463, 0.640])],
    },
    Block {
        table: "bijection",
        data: "3dovs",
        columns: IOU,
        rows: &[("bijection", &[0.844]), ("autoencoder, 100 epochs", &[0.655])],
    },
    Block {
        table: "alignment",
        data: "lerf",
        columns: &["mIoU", "mAcc", "SIM", "MSE"],
        rows: &[
            ("none", &[0.496, 0.717, 0.952, 8.59e-3]),
            ("step 1", &[0.511, 0.763, 0.958, 6.05e-3]),
            ("steps 1, 2", &[0.515, 0.763, 0.960, 5.60e-3]),
            ("step 3", &[0.507, 0.746, 0.963, 6.02e-3]),
            ("steps 1, 2, 3", &[0.538, 0.786, 0.969, 4.99e-3]),
        ],
    },
    // The paper counts the points of an initialiser; `splats` are those at the end of training.
    Block {
        table: "initializer",
        data: "lerf/teatime",
        columns: SCORES,
        rows: &[("dust3r", &[0.6977, 0.8684]), ("mast3r", &[0.7125, 0.8684]), ("vggt", &[0.7063, 0.8947])],
    },
    // The row `lsm` is no measurement of LSM, whose network is not part of this program.
    Block {
        table: "feed-forward",
        data: "scannet",
        columns: SCORES,
        rows: &[("features of lseg", &[0.4527, 0.7054]), ("true segmentation", &[0.5977, 0.9055])],
    },
    Block {
        table: "feed-forward",
        data: "lerf/teatime",
        columns: SCORES,
        rows: &[("lseg in 2D", &[0.1447, 0.3144]), ("sparselgs", &[0.7125, 0.8684])],
    },
    Block {
        table: "views",
        data: "lerf/teatime",
        columns: SCORES,
        rows: &[
            ("2 views", &[0.7341, 0.9000]),
            ("4 views", &[0.7264, 0.9000]),
            ("6 views", &[0.7313, 0.8500]),
        ],
    },
    // With six photos, over all labelled frames; the scene is not named.
    Block {
        table: "points",
        data: "lerf",
        columns: IOU,
        rows: &[("cap 50k", &[0.5358]), ("cap 500k", &[0.6020]), ("cap none", &[0.5967])],
    },
];

/// The paper's figures of a row, by column: those of the first data set that has any.
pub(super) fn figures(table: &str, row: &str, data: &[String]) -> Vec<(&'static str, f64)> {
    let find = |set: &String| {
        let mut blocks = BLOCKS.iter().filter(|b| b.table == table && b.data == set);
        blocks.find_map(|b| Some((b.columns, b.rows.iter().find(|r| r.0 == row)?.1)))
    };
    let Some((columns, values)) = data.iter().find_map(find) else { return Vec::new() };
    columns.iter().copied().zip(values.iter().copied()).filter(|(_, v)| !v.is_nan()).collect()
}

#[cfg(test)]
mod tests {
    use super::super::tables::table;
    use super::*;

    #[test]
    fn figures_prefer_scene_to_data_set() {
        let sparselgs = |data: &[&str]| {
            figures("methods", "sparselgs", &data.iter().map(|d| (*d).to_owned()).collect::<Vec<_>>())
        };
        assert_eq!(sparselgs(&["lerf/teatime", "lerf"]), [("mIoU", 0.713), ("mAcc", 0.868)]);
        assert_eq!(sparselgs(&["lerf/other", "lerf"])[0], ("mIoU", 0.538));
        assert_eq!(sparselgs(&["scannet"]), []);
        // Columns without a figure are left out, not NaN.
        assert_eq!(figures("methods", "legaussians", &["lerf".to_owned()]).len(), 2);
    }

    #[test]
    fn blocks_fit_their_tables() {
        for block in BLOCKS {
            let table = table(block.table).unwrap_or_else(|| panic!("no table {}", block.table));
            let shared = ["mIoU", "mAcc", "Tr.T", "T.T"];
            for column in block.columns {
                let own = table.columns.iter().any(|c| c.0 == *column);
                assert!(own || shared.contains(column), "{}: no column {column}", block.table);
            }
            for (row, values) in block.rows {
                assert_eq!(values.len(), block.columns.len(), "{}: {row}", block.table);
            }
        }
    }
}
