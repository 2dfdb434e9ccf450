//! Sources of cameras, matches, masks and features: a table per kind, an entry per source. Readers
//! are the options of the command line with their help, the choices in errors, `auto`, `splatvk
//! doctor`, run.json and the C interface.
mod depth;
mod features;
mod geometry;
mod masks;
mod matches;
mod table;
mod texts;

pub use depth::DepthSources;
pub use features::{FeatureSources, check_texts, encoder, text_table};
pub use geometry::GeometrySources;
pub use masks::MaskSources;
pub use matches::MatchSources;
pub use table::{
    Given, GraphBuilder, PosedPhotos, Source, SourceChoice, SourceKind, check, choose, default, help,
    installed, make,
};
pub use texts::{DIR_SPACE, dir_encoder};

use crate::infer::installed::Inventory;
use table::listed;

/// One line per kind of source for `splatvk doctor`.
pub fn list(networks: &Inventory) -> Vec<(String, String)> {
    vec![
        listed::<GeometrySources>(networks),
        listed::<DepthSources>(networks),
        listed::<MatchSources>(networks),
        listed::<MaskSources>(networks),
        listed::<FeatureSources>(networks),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn source_tables_parse_and_serialise() {
        let none = Inventory::default();
        fn of<K: SourceKind>(none: &Inventory) {
            let mut names: Vec<&str> = K::SOURCES.iter().map(|s| s.name).collect();
            assert_eq!(choose::<K>("auto", none).unwrap().name, names[0]);
            for source in K::SOURCES {
                assert!(help::<K>().contains(&source.syntax()));
                let text = source.argument.map_or(source.name.to_owned(), |_| format!("{}:src", source.name));
                let chosen = choose::<K>(&text, none).unwrap();
                assert_eq!(chosen.to_string(), text);
                assert_eq!(serde_json::to_value(&chosen).unwrap(), text);
                // With a superfluous argument, or without a required one.
                let wrong =
                    source.argument.map_or(format!("{}:src", source.name), |_| source.name.to_owned());
                let error = choose::<K>(&wrong, none).unwrap_err().to_string();
                assert!(error.contains("use one of: auto, ") && error.contains(&source.syntax()), "{error}");
            }
            names.sort_unstable();
            names.dedup();
            assert_eq!(names.len(), K::SOURCES.len(), "two sources of one name");
        }
        of::<GeometrySources>(&none);
        of::<DepthSources>(&none);
        of::<MatchSources>(&none);
        of::<MaskSources>(&none);
        of::<FeatureSources>(&none);
    }
}
