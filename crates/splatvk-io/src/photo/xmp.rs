//! Detection of panoramas by the XMP packet of a photo; they do not fit a pinhole camera.
use std::path::Path;

/// Namespace of panoramas (developers.google.com/streetview/spherical-metadata).
const NAMESPACE: &str = "http://ns.google.com/photos/1.0/panorama/";

/// Evidence that the photo is a panorama, as "GPano:ProjectionType=equirectangular"; `None` for
/// photos of a pinhole.
pub(super) fn panorama(packet: &[u8]) -> Option<String> {
    let text = String::from_utf8_lossy(packet);
    let declared = text.find(NAMESPACE)?;
    // xmlns:GPano="http://…": files may choose the prefix.
    let prefix = text[..declared].trim_end_matches(['"', '\'', '=', ' ']).rsplit(':').next()?;
    let value = |name: &str| property(&text, &format!("{prefix}:{name}"));
    let projection = value("ProjectionType");
    match projection.as_deref() {
        Some("rectilinear" | "perspective") => None,
        Some(other) => Some(format!("GPano:ProjectionType={}", other.chars().take(40).collect::<String>())),
        // The type defaults to equirectangular.
        None => value("FullPanoWidthPixels").map(|width| format!("GPano:FullPanoWidthPixels={width}")),
    }
}

/// Value of a property, as attribute or as element.
fn property(text: &str, name: &str) -> Option<String> {
    text.match_indices(name).find_map(|(at, _)| {
        let rest = text[at + name.len()..].trim_start();
        let value = match rest.strip_prefix('>') {
            Some(element) => element.split('<').next()?,
            None => {
                let quoted = rest.strip_prefix('=')?.trim_start();
                let quote = quoted.chars().next().filter(|c| ['"', '\''].contains(c))?;
                quoted[1..].split(quote).next()?
            }
        };
        let value: String = value.split_whitespace().collect();
        (!value.is_empty()).then(|| value.to_lowercase())
    })
}

/// Text of the refusal of a panorama, without the file's name in front.
pub(super) fn refusal(what: &str, path: &Path) -> String {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    // Quotes a word for a shell.
    let quoted = |name: &str| format!("'{}'", name.replace('\'', "'\\''"));
    if !what.contains("equirectangular") && !what.contains("Full") {
        return format!(
            "is a stitched panorama ({what}), which no pinhole camera shows; give single photos instead"
        );
    }
    format!(
        "is a 360° panorama ({what}), which no pinhole camera shows; cut one view out of each panorama, all towards the same things: \
         ffmpeg -i {} -vf v360=e:flat:h_fov=90:v_fov=90:yaw=0:pitch=0:w=1200:h=1200 -frames:v 1 {}",
        quoted(&name),
        quoted(&format!("view_{}.jpg", super::kind::stem(&name)))
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panorama_is_detected_by_xmp() {
        let packet = |prefix: &str, inside: &str| {
            format!("<x:xmpmeta><rdf:Description xmlns:{prefix}=\"{NAMESPACE}\" {inside}</x:xmpmeta>")
                .into_bytes()
        };
        let sphere = "GPano:ProjectionType=equirectangular".to_owned();
        assert_eq!(
            panorama(&packet("GPano", "GPano:ProjectionType=\"equirectangular\"/>")).as_ref(),
            Some(&sphere)
        );
        assert_eq!(panorama(&packet("p", "p:ProjectionType = 'Equirectangular'/>")).as_ref(), Some(&sphere));
        let element = ">\n<GPano:ProjectionType>\n equirectangular </GPano:ProjectionType>";
        assert_eq!(panorama(&packet("GPano", element)).as_ref(), Some(&sphere));
        let wide = panorama(&packet("GPano", "GPano:ProjectionType=\"cylindrical\"/>")).unwrap();
        assert!(
            refusal(&wide, Path::new("a.jpg"))
                .contains("stitched panorama (GPano:ProjectionType=cylindrical)")
        );
        assert!(panorama(&packet("GPano", "GPano:FullPanoWidthPixels=\"4000\"/>")).is_some());
        assert_eq!(panorama(&packet("GPano", "GPano:ProjectionType=\"rectilinear\"/>")), None);
        assert_eq!(panorama(&packet("GPano", "GPano:PoseHeadingDegrees=\"3\"/>")), None);
        assert_eq!(panorama(b"GPano:ProjectionType=\"equirectangular\""), None, "no namespace");
        let whole = packet("GPano", "GPano:ProjectionType=\"equirectangular\"/>");
        for cut in 0..whole.len() {
            panorama(&whole[..cut]);
        }
        assert!(refusal(&sphere, Path::new("x/a b.jpg")).contains("-i 'a b.jpg' -vf"));
    }
}
