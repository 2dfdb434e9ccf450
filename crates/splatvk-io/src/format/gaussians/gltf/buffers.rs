//! Buffers of a glTF file: data URIs, or files in its own folder and below.
use crate::files;
use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use percent_encoding::percent_decode_str;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

#[derive(Deserialize)]
pub(super) struct Buffer {
    pub uri: Option<String>,
}

/// Decoder of base64 with or without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// Content of every URI, each loaded once.
pub(super) fn contents<'a>(
    buffers: &'a [Buffer],
    folder: &Path,
) -> Result<BTreeMap<&'a str, Vec<u8>>, String> {
    let mut all = BTreeMap::new();
    for uri in buffers.iter().filter_map(|b| b.uri.as_deref()) {
        if !all.contains_key(uri) {
            all.insert(uri, content(uri, folder)?);
        }
    }
    Ok(all)
}

/// URIs are percent-encoded (RFC 3986); some programs write plain names.
fn content(uri: &str, folder: &Path) -> Result<Vec<u8>, String> {
    if uri.get(..5).is_some_and(|start| start.eq_ignore_ascii_case("data:")) {
        let (kind, body) = uri[5..].split_once(',').ok_or("a buffer inside of the file has no comma")?;
        let bytes: Vec<u8> = percent_decode_str(body).collect();
        let base64 = kind.rsplit(';').next().is_some_and(|word| word.trim().eq_ignore_ascii_case("base64"));
        return match base64 {
            true => BASE64.decode(bytes).map_err(|e| format!("damaged base64 ({e}); copy the file again")),
            false => Ok(bytes),
        };
    }
    if uri.contains("://") {
        return Err(format!("its buffer {uri} is not a local file; download it and give its name"));
    }
    let decoded = percent_decode_str(uri).decode_utf8_lossy();
    let paths = [decoded.as_ref(), uri].map(|name| files::within(folder, name));
    let [Some(decoded), Some(plain)] = paths else {
        return Err(format!("its buffer {uri} is outside of the file's folder; put it beside the file"));
    };
    let path = if !decoded.is_file() && plain.is_file() { plain } else { decoded };
    files::read(&path).map_err(|e| format!("its buffer {e}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_decoded() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("ä b")).unwrap();
        for name in ["my scene.bin", "ä b/1#.bin", "100%.bin", "as%20it is.bin"] {
            std::fs::write(folder.path().join(name), name).unwrap();
        }
        for (uri, name) in [
            ("my%20scene.bin", "my scene.bin"),
            ("my scene.bin", "my scene.bin"),
            ("./%C3%A4%20b/1%23.bin", "ä b/1#.bin"),
            ("100%.bin", "100%.bin"),
            ("as%20it is.bin", "as%20it is.bin"),
        ] {
            assert_eq!(content(uri, folder.path()), Ok(name.as_bytes().to_vec()), "{uri}");
        }
        for uri in ["%2e%2e/a.bin", "..%2Fa.bin", "%2Fetc%2Fpasswd", "a%5Cb.bin", "../a.bin", "a/../../b"] {
            assert!(content(uri, folder.path()).unwrap_err().contains("outside"), "{uri}");
        }
        assert!(content("a%00.bin", folder.path()).is_err());
    }

    #[test]
    fn data_uri_is_decoded() {
        for uri in [
            "data:application/octet-stream;base64,AQL/",
            "DATA:application/gltf-buffer;Base64,AQL%2F",
            "data:,%01%02%FF",
            "data:application/octet-stream,%01%02%ff",
        ] {
            assert_eq!(content(uri, Path::new(".")), Ok(vec![1, 2, 255]), "{uri}");
        }
        assert_eq!(content("data:;base64,AQI", Path::new(".")), Ok(vec![1, 2]));
        for uri in ["data:AQL", "data:;base64,!"] {
            assert!(content(uri, Path::new(".")).is_err(), "{uri}");
        }
    }
}
