//! Interactive 3D view: one page section without a build step and without external requests.
//! `report.html` embeds it with the splats; `splatvk view` serves it and answers its queries.
//!
//! The page consists of plain modules under an import map of `data:` URLs, so that the same text
//! works from a file and from a server.
mod pack;

pub use pack::{Layers, Packed, pack};

use super::chart::escape;
use super::{colour, thousands};
use crate::Result;
use crate::format::picture;
use crate::format::scene_dir::Scene;
use crate::format::views::Views;
use crate::query::highlight::Highlight;
use crate::query::presence::Presence;
use crate::query::things::{self, LEVELS};
use crate::scene::{Camera, LanguageField, RgbImage, World};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};

/// URL path of the packed splats of [`pack`].
pub const SCENE_PATH: &str = "scene.bin";

/// Most splats embedded in a report: about 7 MB of the page.
const REPORT_SPLATS: usize = 300_000;

/// Height of the thumbnails of photos, pixels: twice their size on the page, for dense screens.
const THUMBNAIL: usize = 104;

/// Import name and text of each module.
const MODULES: [(&str, &str); 23] = [
    ("splatvk/address", include_str!("address.js")),
    ("splatvk/camera", include_str!("camera.js")),
    ("splatvk/card", include_str!("card.js")),
    ("splatvk/controls", include_str!("controls.js")),
    ("splatvk/frame", include_str!("frame.js")),
    ("splatvk/measure", include_str!("measure.js")),
    ("splatvk/mesh", include_str!("mesh.js")),
    ("splatvk/motion", include_str!("motion.js")),
    ("splatvk/names", include_str!("names.js")),
    ("splatvk/page", include_str!("page.js")),
    ("splatvk/panel", include_str!("panel.js")),
    ("splatvk/pick", include_str!("pick.js")),
    ("splatvk/preview", include_str!("preview.js")),
    ("splatvk/queries", include_str!("queries.js")),
    ("splatvk/render", include_str!("render.js")),
    ("splatvk/show", include_str!("show.js")),
    ("splatvk/sort", include_str!("sort.js")),
    ("splatvk/splats", include_str!("splats.js")),
    ("splatvk/stage", include_str!("stage.js")),
    ("splatvk/start", include_str!("start.js")),
    ("splatvk/things", include_str!("things.js")),
    ("splatvk/views", include_str!("views.js")),
    ("splatvk/viewer", include_str!("viewer.js")),
];

/// Modules of a page that edits.
const EDITING: [(&str, &str); 3] = [
    ("splatvk/edit", include_str!("edit.js")),
    ("splatvk/outline", include_str!("outline.js")),
    ("splatvk/widgets", include_str!("widgets.js")),
];

const MARKUP: &str = include_str!("viewer.html");

/// Beginning of the upper row of the section.
const TOP: &str = "<div class=\"v-top\">";

/// Style sheet of the section.
pub const STYLE: &str = include_str!("viewer.css");

/// Answered query on the page.
#[derive(Clone, Debug)]
pub struct ShownAnswer<'a> {
    /// Text of the query.
    pub text: &'a str,
    /// Number of views in which it was found.
    pub found: usize,
    /// Number of queried views.
    pub views: usize,
    /// Presence in the scene, where it is known.
    pub presence: Option<Presence>,
    /// Answer in a few words.
    pub verdict: String,
    /// Remarks on parts of the text that were not understood.
    pub notes: Vec<String>,
    /// Highlighted codes.
    pub highlight: &'a Highlight,
}

impl ShownAnswer<'_> {
    /// JSON that the page reads.
    pub fn json(&self) -> Value {
        let h = self.highlight;
        json!({
            "text": self.text, "found": self.found, "views": self.views, "presence": self.presence,
            "verdict": self.verdict, "notes": self.notes,
            "level": h.level, "codes": h.codes, "relevancy": h.relevancy,
        })
    }
}

/// Phrases with their relevancy, best first, per level and code.
pub type CodeNames = Vec<Vec<Vec<(String, f32)>>>;

/// Contents of the interactive view.
#[derive(Clone, Debug)]
pub struct Scene3d<'a> {
    /// Name of the scene.
    pub title: &'a str,
    /// The Gaussians.
    pub layers: Layers<'a>,
    /// Cameras of the photos.
    pub cameras: &'a [Camera],
    /// World frame of the scene.
    pub world: &'a World,
    /// Photos, for thumbnails; as many as cameras, or none.
    pub photos: Vec<&'a RgbImage>,
    /// Language field, where the scene has one.
    pub language: Option<&'a LanguageField>,
    /// Phrases of the text model for every code; may be empty.
    pub names: &'a CodeNames,
    /// Answered queries.
    pub answers: Vec<ShownAnswer<'a>>,
    /// Queries to choose from.
    pub suggested: Vec<String>,
    /// Named views and notes of a page without a server.
    pub named: Views,
}

impl<'a> Scene3d<'a> {
    /// A loaded scene, without answers and suggestions.
    pub fn of(scene: &'a Scene, title: &'a str, photos: &'a [RgbImage], names: &'a CodeNames) -> Scene3d<'a> {
        Scene3d {
            title,
            layers: scene.into(),
            cameras: &scene.cameras,
            world: &scene.world,
            photos: photos.iter().collect(),
            language: scene.language.as_ref(),
            names,
            answers: Vec::new(),
            suggested: Vec::new(),
            named: Views::default(),
        }
    }
}

/// A page for presentation.
#[derive(Clone, Debug)]
pub struct Presented {
    /// Text of the file.
    pub html: String,
    /// Number of splats in it.
    pub shown: usize,
    /// Number of splats of the scene, those behind it included.
    pub total: usize,
}

/// Data of a served page about its server.
#[derive(Clone, Copy, Debug)]
pub struct Served<'a> {
    /// Reason why questions are not answered, if they are not.
    pub no_questions: Option<&'a str>,
    /// Whether splats or page change while it is open.
    pub lifetime: Lifetime,
    /// Number of splats that it sends.
    pub shown: usize,
    /// Number of splats of the scene, those behind it included.
    pub total: usize,
    /// Whether `GET views` sends the views and notes of the scene and `POST views` saves them.
    pub saves_views: bool,
    /// Whether `POST edit` selects and edits.
    pub edits: bool,
    /// Whether `GET mesh.glb` sends a mesh of the scene.
    pub has_mesh: bool,
}

/// Content of a served page that may change while it is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lifetime {
    /// It stays.
    Final,
    /// A preview: the page follows the state of the server, and takes new splats or another page.
    Preview,
}

impl Scene3d<'_> {
    /// Section for a static page with the splats, and a note about it.
    pub fn embedded(&self) -> Result<(String, String)> {
        let packed = pack(self.layers, self.language, REPORT_SPLATS)?;
        let data = STANDARD.encode(&packed.bytes);
        let note = format!(
            "{}, {:.1} MB in this page. splatvk view SCENE answers any question.",
            shown_of(&packed),
            data.len() as f64 / 1e6
        );
        let manifest =
            self.manifest("This page answers the queries of its run; splatvk view SCENE answers any.")?;
        let splats = format!("<script type=\"text/plain\" id=\"v-splats\">{data}</script>");
        Ok((section(&manifest, &splats), note))
    }

    /// Whole page with the splats inside, under its title.
    pub fn presented(&self) -> Result<Presented> {
        let packed = pack(self.layers, self.language, REPORT_SPLATS)?;
        let mut manifest = self.manifest("")?;
        manifest["presented"] = true.into();
        let data = STANDARD.encode(&packed.bytes);
        let splats = format!("<script type=\"text/plain\" id=\"v-splats\">{data}</script>");
        let caption = format!(
            "<header class=\"v-caption\"><h1>{}</h1><p>{}, {:.1} MB</p></header>",
            escape(self.title),
            shown_of(&packed),
            data.len() as f64 / 1e6
        );
        let html = self.whole_page(&manifest, &splats);
        let html = html.replacen(TOP, &format!("{TOP}{caption}"), 1);
        Ok(Presented { html, shown: packed.order.len(), total: packed.total })
    }

    /// Whole page with at most `most` splats inside, for a frame in another page; with `asks` it
    /// sends questions to that page, which answers them.
    pub fn framed(&self, most: usize, asks: bool) -> Result<String> {
        let packed = pack(self.layers, self.language, most)?;
        let mut manifest =
            self.manifest("This view answers no questions; ask in Python: scene.query(text).")?;
        manifest["live"] = asks.into();
        manifest["framed"] = true.into();
        let data = STANDARD.encode(&packed.bytes);
        let splats = format!("<script type=\"text/plain\" id=\"v-splats\">{data}</script>");
        Ok(self.whole_page(&manifest, &splats))
    }

    /// Whole page of a server that answers `POST query` and sends [`SCENE_PATH`]. A preview follows
    /// `GET state`.
    pub fn served(&self, server: &Served) -> Result<String> {
        let mut manifest = self.manifest(server.no_questions.unwrap_or_default())?;
        manifest["live"] = server.no_questions.is_none().into();
        manifest["scene"] = SCENE_PATH.into();
        manifest["renews"] = (server.lifetime == Lifetime::Preview).into();
        manifest["shown"] = server.shown.into();
        manifest["total"] = server.total.into();
        manifest["edits"] = server.edits.into();
        manifest["saves"] = server.saves_views.into();
        manifest["mesh"] = server.has_mesh.into();
        Ok(self.whole_page(&manifest, ""))
    }

    fn whole_page(&self, manifest: &Value, splats: &str) -> String {
        let title = escape(self.title);
        format!(
            "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" \
             content=\"width=device-width, initial-scale=1, viewport-fit=cover\"><title>{title} · splatvk</title>\
             <link rel=\"icon\" href=\"data:,\"><style>* {{ box-sizing: border-box }} body {{ margin: 0; background: #000 }}\
             {STYLE}</style><body>{}</html>\n",
            section(manifest, splats).replacen("class=\"viewer\"", "class=\"viewer full\"", 1)
        )
    }

    fn manifest(&self, ask_note: &str) -> Result<Value> {
        let views = self.cameras.iter().enumerate().map(|(i, c)| view(c, self.photos.get(i).copied()));
        let words = self.language.is_some_and(|l| l.space.starts_with("words"));
        Ok(json!({
            "title": self.title, "live": false, "ask_note": ask_note,
            "names_note": if words { "" } else { "This text model brings no phrases of its own: ask, and they appear here." },
            "views": views.collect::<Result<Vec<_>>>()?,
            "unseen": self.layers.seen.unseen() + self.layers.backdrop.len(),
            "metres": self.world.scale.as_ref().map(|s| s.metres_per_unit),
            "up": self.world.up.as_ref().map(|u| u.direction.to_array()),
            "levels": (0..LEVELS.len()).map(|at| self.level(at)).collect::<Vec<_>>(),
            "suggested": self.suggested, "named": self.named,
            "answers": self.answers.iter().map(ShownAnswer::json).collect::<Vec<_>>(),
        }))
    }

    /// Level of things of the page; `codes` is that of its codes.
    fn level(&self, at: usize) -> Value {
        let sizes = self.language.map_or(Vec::new(), |l| l.levels.iter().map(|l| l.codebook.len()).collect());
        let of_codes = things::code_level(at, &sizes);
        let count = sizes.get(of_codes).copied().unwrap_or(0);
        let colours: Vec<[f32; 3]> = (0..count).map(|k| colour::label(k as i32)).collect();
        let (title, one) =
            [("Subparts", "Subpart"), ("Parts", "Part"), ("Wholes", "Whole"), ("Things", "Thing")][at];
        let phrases = self.names.get(of_codes).filter(|n| n.len() == count).cloned().unwrap_or_default();
        json!({
            "name": LEVELS[at], "title": title, "one": one, "colours": colours, "phrases": phrases,
            "codes": of_codes,
        })
    }
}

/// Number of shown splats, and of all where some are left out.
fn shown_of(packed: &Packed) -> String {
    match (packed.order.len(), packed.total) {
        (shown, total) if shown < total => format!("{} of {} splats", thousands(shown), thousands(total)),
        (shown, _) => format!("{} splats", thousands(shown)),
    }
}

fn view(camera: &Camera, photo: Option<&RgbImage>) -> Result<Value> {
    let thumbnail = match photo {
        Some(photo) if photo.height > 0 => {
            let height = THUMBNAIL.min(photo.height);
            let small = photo.resized_by_area((photo.width * height / photo.height).max(1), height);
            Some(format!("data:image/jpeg;base64,{}", STANDARD.encode(picture::jpeg_bytes(&small, 80)?)))
        }
        _ => None,
    };
    // glam is column-major; the page reads rows.
    let rotation = camera.pose.rotation.transpose().to_cols_array();
    Ok(json!({
        "name": crate::photo::stem(&camera.name), "width": camera.width, "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "rotation": rotation, "translation": camera.pose.translation.to_array(), "thumbnail": thumbnail,
    }))
}

/// A module without its comment lines and indentation, a fifth of the compressed page. No string of
/// the modules depends on them.
fn slim(text: &str) -> String {
    let lines = text.lines().map(str::trim_start).filter(|line| !line.is_empty() && !line.starts_with("//"));
    lines.flat_map(|line| [line, "\n"]).collect()
}

/// Section of markup, data and modules. `<` is escaped, because it could end the script element.
fn section(manifest: &Value, data: &str) -> String {
    let url = |text: &str| format!("data:text/javascript;base64,{}", STANDARD.encode(slim(text)));
    let editing = EDITING.iter().filter(|_| manifest["edits"] == true);
    let imports: serde_json::Map<String, Value> =
        MODULES.iter().chain(editing).map(|(name, text)| ((*name).to_owned(), url(text).into())).collect();
    let manifest = manifest.to_string().replace('<', "\\u003c");
    format!(
        "{MARKUP}<script type=\"application/json\" id=\"v-manifest\">{manifest}</script>{data}\
         <script type=\"importmap\">{}</script><script type=\"module\">import \"splatvk/viewer\";</script>",
        json!({ "imports": imports })
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Scale, Seen, Splats, seeded};

    /// The worker that sorts imports nothing: it has a copy of the bits of marks, and would draw
    /// hidden splats with another one.
    #[test]
    fn worker_has_the_marks_of_the_page() {
        let number = |text: &str, name: &str| {
            let (_, rest) = text.split_once(name).unwrap();
            rest.chars().take_while(char::is_ascii_digit).collect::<String>().parse::<u8>().unwrap()
        };
        let (page, worker) = (include_str!("splats.js"), include_str!("sort.js"));
        for name in ["hole", "backdrop", "hidden"] {
            let own = number(worker, &format!("{} = ", name.to_uppercase()));
            assert_eq!(own, number(page, &format!("{name}: ")), "{name}");
        }
    }

    /// The page stays small enough to be sent: code, style and markup, compressed.
    #[test]
    fn page_without_data_is_small() {
        use std::io::Write;
        let size = |modules: &[(&str, &str)]| {
            let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
            modules.iter().for_each(|(_, text)| gzip.write_all(slim(text).as_bytes()).unwrap());
            gzip.write_all(STYLE.as_bytes()).unwrap();
            gzip.write_all(MARKUP.as_bytes()).unwrap();
            gzip.finish().unwrap().len()
        };
        let (sent, edits) = (size(&MODULES), size(&[&MODULES[..], &EDITING].concat()));
        println!("{sent} bytes, {edits} with edits");
        assert!(sent < 40_000 && edits < 44_000, "{sent} and {edits} bytes");
        assert_eq!(slim("// a\n  x(); // b\n\n  // c\ny();\n"), "x(); // b\ny();\n");
    }

    #[test]
    fn viewer_section_is_complete_and_escaped() {
        let (splats, camera) = seeded::small(40, 64, 48, 1, 3);
        let photo = RgbImage { width: 64, height: 48, data: vec![[0.3; 3]; 64 * 48] };
        let highlight =
            Highlight { level: 2, codes: vec![1], relevancy: vec![vec![], vec![], vec![0.1, 0.9]] };
        let answer = ShownAnswer {
            text: "</script><b>",
            found: 1,
            views: 1,
            presence: None,
            verdict: "found in 1 of 1 photos".into(),
            notes: Vec::new(),
            highlight: &highlight,
        };
        let scale = Scale { metres_per_unit: 0.25, log_sigma: 0.1, stated: Vec::new() };
        let scene = Scene3d {
            title: "a<b",
            layers: Layers {
                splats: &splats,
                seen: &Seen::default(),
                holes: &Splats::default(),
                backdrop: &Splats::default(),
            },
            cameras: std::slice::from_ref(&camera),
            world: &World { scale: Some(scale), ..World::default() },
            photos: vec![&photo],
            language: None,
            names: &Vec::new(),
            answers: vec![answer],
            suggested: vec!["mug".into()],
            named: Views::default(),
        };
        let (html, note) = scene.embedded().unwrap();
        assert!(note.contains(" splats, "), "{note}");
        assert_eq!(html.matches("</script>").count(), 4, "manifest, splats, import map, start");
        let manifest = html.split("id=\"v-manifest\">").nth(1).unwrap().split("</script>").next().unwrap();
        let manifest: Value = serde_json::from_str(manifest).unwrap();
        assert_eq!(manifest["answers"][0]["text"], "</script><b>");
        assert_eq!(manifest["live"], false);
        assert_eq!(manifest["metres"], 0.25, "what the tape multiplies by");
        // Row 2 of the rotation is the viewing direction.
        let forward = camera.pose.rotation.row(2);
        assert_eq!(manifest["views"][0]["rotation"][8], forward.z);
        assert_eq!(manifest["views"][0]["rotation"][6], forward.x);
        let server = Served {
            no_questions: Some("no model"),
            lifetime: Lifetime::Preview,
            shown: 40,
            total: 50,
            saves_views: false,
            edits: false,
            has_mesh: false,
        };
        let page = scene.served(&server).unwrap();
        assert!(page.contains("viewer full") && page.contains("a&lt;b") && !page.contains("v-splats\""));
        assert!(page.contains("\"ask_note\":\"no model\"") && page.contains("\"live\":false"));
        assert!(page.contains("\"renews\":true") && page.contains("\"suggested\":[\"mug\"]"));
        let framed = scene.framed(10, true).unwrap();
        assert!(framed.contains("id=\"v-splats\"") && framed.contains("\"framed\":true"));
        let shown = scene.presented().unwrap();
        assert!(shown.html.contains("<h1>a&lt;b</h1><p>") && shown.html.contains("\"presented\":true"));
        assert!(shown.shown > 0 && shown.shown <= shown.total && shown.total == splats.len());
        let last = Served { no_questions: None, lifetime: Lifetime::Final, saves_views: true, ..server };
        let last = scene.served(&last).unwrap();
        assert!(last.contains("\"live\":true") && last.contains("\"renews\":false"));
        assert!(last.contains("\"saves\":true") && last.contains("\"total\":50"));
        assert!(!last.contains("splatvk/edit\""));
        let edits = Served { edits: true, ..server };
        assert!(scene.served(&edits).unwrap().contains("splatvk/edit\""));
        // Every imported module exists.
        for (own, text) in MODULES.iter().chain(&EDITING) {
            for line in text.lines().filter(|l| l.starts_with("import ")) {
                let name = line.split('"').nth(1).unwrap();
                let has = |list: &[(&str, &str)], name: &str| list.iter().any(|(n, _)| *n == name);
                assert!(has(&MODULES, name) || has(&EDITING, own) && has(&EDITING, name), "{line}");
            }
        }
    }
}
