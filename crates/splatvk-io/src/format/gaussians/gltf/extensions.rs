//! Other extensions: those that change the Gaussians, and those that do not.
use super::layout::EXTENSION;
use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, Visitor};
use serde_json::Value;

/// Extensions that change neither points nor their attributes, or that the reader supports
/// (quantised numbers).
const HARMLESS: [&str; 12] = [
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_texture_basisu",
    "KHR_lights_punctual",
    "KHR_xmp",
    "KHR_xmp_json_ld",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "MSFT_texture_dds",
    "EXT_lights_image_based",
    "EXT_mesh_features",
    "EXT_structural_metadata",
];
/// Prefixes of the names of further such extensions.
const HARMLESS_KINDS: [&str; 2] = ["KHR_materials_", "EXT_materials_"];

/// Extensions that change the Gaussians, each with advice.
const REFUSED: [(&str, &str); 6] = [
    ("KHR_draco_mesh_compression", "export it without compression"),
    ("EXT_meshopt_compression", "export it without compression (gltf-transform copy does)"),
    ("KHR_meshopt_compression", "export it without compression (gltf-transform copy does)"),
    ("EXT_mesh_gpu_instancing", "write every instance as a node of its own"),
    ("KHR_gaussian_splatting_compression", "export it without compression, or as .spz"),
    ("CESIUM_RTC", "apply its centre to the nodes"),
];

fn is_harmless(name: &str) -> bool {
    name == EXTENSION || HARMLESS.contains(&name) || HARMLESS_KINDS.iter().any(|kind| name.starts_with(kind))
}

fn refusal(name: &str) -> Option<&'static str> {
    REFUSED.iter().find(|(kind, _)| name.starts_with(kind)).map(|(_, advice)| *advice)
}

/// A refused extension of a part, if any; all others are dropped while parsing.
#[derive(Default)]
pub(super) struct Refused(Option<Box<str>>);

impl Refused {
    /// Returns an error for the refused extension, if any.
    pub fn check(&self) -> Result<(), String> {
        self.0.as_deref().map_or(Ok(()), required)
    }
}

impl<'de> Deserialize<'de> for Refused {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Refused, D::Error> {
        struct Names;
        impl<'de> Visitor<'de> for Names {
            type Value = Refused;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("extensions by name")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Refused, A::Error> {
                let mut found = None;
                while let Some((name, _)) = map.next_entry::<String, IgnoredAny>()? {
                    if refusal(&name).is_some() {
                        found = Some(name.into_boxed_str());
                    }
                }
                Ok(Refused(found))
            }
        }
        deserializer.deserialize_map(Names)
    }
}

/// Refuses a required extension that changes the Gaussians.
pub(super) fn required(name: &str) -> Result<(), String> {
    match (is_harmless(name), refusal(name)) {
        (true, _) => Ok(()),
        (_, Some(advice)) => {
            Err(format!("needs the extension {name}, which splatvk does not read; {advice}"))
        }
        (_, None) => {
            Err(format!("needs the extension {name}, which splatvk does not know; export it without"))
        }
    }
}

/// Note on an extension that the file uses but does not require; refused where it applies to
/// Gaussians.
pub(super) fn note(name: &str) -> Option<String> {
    (!is_harmless(name)).then(|| format!("its extension {name} is not read"))
}

/// Refuses unsupported kernels and colour spaces, and notes properties that are rendered
/// differently.
pub(super) fn check(extension: &Value, notes: &mut Vec<String>) -> Result<(), String> {
    for (key, value) in extension.as_object().into_iter().flatten() {
        let text = value.as_str().unwrap_or_default();
        match (key.as_str(), text) {
            ("kernel", "ellipse") | ("colorSpace", "srgb_rec709_display") | ("projection", "perspective") => {
            }
            ("kernel", _) => return Err(unknown(key, value, "ellipse")),
            ("colorSpace", _) => return Err(unknown(key, value, "srgb_rec709_display")),
            ("projection", _) => return Err(unknown(key, value, "perspective")),
            ("sortingMethod", "cameraDistance") | ("extras", _) => {}
            ("sortingMethod", _) => {
                notes.push(format!("its sortingMethod {value} is not applied: splats are sorted by depth"));
            }
            ("extensions", _) => {
                for (name, _) in value.as_object().into_iter().flatten() {
                    match refusal(name) {
                        Some(_) => required(name)?,
                        None => notes.extend(note(name)),
                    }
                }
            }
            _ => notes.push(format!("{key} of {EXTENSION} is not read")),
        }
    }
    Ok(())
}

fn unknown(key: &str, value: &Value, known: &str) -> String {
    let value = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    format!("{key} {value} is not supported, only {known}; export it with that")
}
