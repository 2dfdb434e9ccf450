//! The interactive view in a real browser: it draws the pictures of the engine, selects the clicked
//! object, highlights the answer to a query, and connects to no other server.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod browser;
mod fixture;

use browser::Page;
use browser::pictures::{coloured, inner_point, iou, keep_screenshot, object_mask, page_position, to_float};
use fixture::view::{LABELS, Server, breakfast, masks_of};
use fixture::{data, truth};
use serde_json::{Value, json};
use splatvk::format::npy;
use splatvk::format::scene_dir;
use splatvk::gpu;
use splatvk::pass::metrics::psnr;
use splatvk::query::{QueryOptions, instances::splat_codes};
use splatvk::report::viewer::{Layers, Scene3d};
use splatvk::run::ask::QueryScene;
use splatvk::run::metric::{self, Length};
use splatvk::run::sources;
use splatvk::run::view::Viewer;
use splatvk::scene::{LanguageField, Seen};
use std::path::Path;

#[test]
fn served_view_draws_and_answers() {
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let Some(chromium) = browser::installed() else { return };
    let server = Server::start(&scene);
    let mut page = Page::open(&chromium, 720, 540, false);
    page.go(&server.address);
    check_drawing(&mut page, &scene);
    check_selection(&mut page);
    check_query(&mut page);
    check_keyboard(&mut page);
    check_rest(&mut page);
    check_tape(&mut page, &scene);
    assert_eq!(page.complaints, Vec::<String>::new());
    let foreign: Vec<_> = page
        .requests
        .iter()
        .filter(|r| !r.starts_with(&server.address) && !r.starts_with("data:") && !r.starts_with("blob:"))
        .collect();
    assert!(foreign.is_empty(), "{foreign:?}");
    keep_screenshot(&mut page, "desktop.png");
    drop(page);
    let mut phone = Page::open(&chromium, 390, 844, true);
    phone.go(&server.address);
    check_phone_layout(&mut phone);
    check_phone_help(&mut phone);
    let (status, _) = server.stop("-INT");
    assert_eq!(status.code(), Some(0), "Ctrl-C is how it ends");
}

/// Keeps a screenshot for inspection if `SPLATVK_KEEP` names a folder.
fn check_drawing(page: &mut Page, scene: &Path) {
    let loaded = scene_dir::load(scene).unwrap();
    let device = gpu::open(None).unwrap();
    let mut viewer = Viewer::new(&device, &loaded.splats, &LanguageField::default()).unwrap();
    for (i, camera) in loaded.cameras.iter().enumerate() {
        let engine = viewer.view(camera).unwrap().rendered;
        let likeness = psnr(&to_float(&page.picture(i)), &engine.rgb);
        println!("view {i}: {likeness:.1} dB against splatvk render");
        // Loss by bytes and half floats; a wrong blend would be 25 dB.
        assert!(likeness > 38.0, "view {i}: {likeness} dB");
    }
    page.run("splatvk.show('depth')");
    let depth = to_float(&page.picture(0));
    let engine =
        splatvk::report::colour::depth_image(&viewer.view(&loaded.cameras[0]).unwrap().rendered.depth);
    // The page takes the range of depth from the splats, the engine from the pixels: the pictures
    // have the same shapes in other shades.
    assert!(psnr(&depth, &engine) > 15.0, "{}", psnr(&depth, &engine));
    page.run("splatvk.show('colour')");
}

fn check_selection(page: &mut Page) {
    page.run("splatvk.goTo(0)");
    let mask = masks_of("train_00");
    let mut clicked = 0;
    for object in 1..=LABELS as i32 {
        // A carpet behind the table is visible as a few slivers.
        if object_mask(&mask, object).iter().filter(|m| **m).count() < 2000 {
            continue;
        }
        let (x, y) = page_position(page, inner_point(&mask, object));
        // On a narrow window an open card moves the picture.
        page.press("Escape");
        page.run("splatvk.settled()");
        if page.run(&format!("document.elementFromPoint({x}, {y}).tagName")) != "CANVAS" {
            continue;
        }
        page.click(x, y);
        let selected = page.run("splatvk.state.selected");
        assert_eq!(selected, json!({ "level": 3, "codes": [object - 1] }), "at {x}, {y}");
        let name = truth()["labels"][object.to_string()].clone();
        assert_eq!(page.run("document.querySelector('.v-card h3').textContent"), name);
        clicked += 1;
        if object == 9 {
            keep_screenshot(page, "selected.png");
        }
    }
    assert!(clicked >= 6, "only {clicked} objects are free of controls");
    // On the finer level; the numbers of levels count backwards.
    page.run("document.querySelector('.v-levels button').click()");
    let selected = page.run("splatvk.state.selected");
    assert_eq!(selected["level"], 0);
    assert!(selected["codes"][0].as_u64().unwrap() < LABELS as u64);
    page.press("Escape");
    assert_eq!(page.run("splatvk.state.selected"), Value::Null);
}

fn check_query(page: &mut Page) {
    page.press("/");
    page.write("blue mug");
    page.press("Enter");
    let answered = "new Promise((done) => { const look = () => splatvk.state.query ? done(splatvk.state.query.codes) : setTimeout(look, 20); look(); })";
    assert_eq!(page.run(answered), json!([8]));
    assert_eq!(page.run("splatvk.state.mode"), "relevancy");
    for (view, stem) in ["train_00", "train_02"].iter().enumerate() {
        let overlap = iou(&coloured(&page.picture(view)), &object_mask(&masks_of(stem), 9));
        println!("blue mug in {stem}: IoU {overlap:.2}");
        assert!(overlap > 0.7, "{stem}: {overlap}");
    }
    keep_screenshot(page, "query.png");
    // A word without an embedding is reported, and nothing else changes.
    page.run("splatvk.ask('unicorn')");
    assert!(
        page.run("document.querySelector('.v-status').textContent").as_str().unwrap().contains("unicorn")
    );
    assert_eq!(page.run("splatvk.state.query.text"), "blue mug");
    // The browser logs every refused request by itself.
    page.complaints.retain(|c| !c.contains("422"));
    page.run("document.querySelector('.viewer').focus()");
}

fn check_keyboard(page: &mut Page) {
    page.press("Escape");
    assert_eq!(page.run("splatvk.state.mode"), "colour");
    for mode in ["depth", "level", "level", "level", "colour"] {
        page.press("m");
        assert_eq!(page.run("splatvk.state.mode"), mode);
    }
    page.press("m");
    page.press("m");
    page.run("splatvk.settled()");
    keep_screenshot(page, "levels.png");
    page.run("splatvk.show('colour')");
    let eye = |page: &mut Page| page.run("splatvk.camera().position");
    page.run("splatvk.goTo(0)");
    let first = eye(page);
    page.press("ArrowLeft");
    assert_ne!(eye(page), first);
    let height = |eye: &Value| eye[2].as_f64().unwrap();
    assert!((height(&eye(page)) - height(&first)).abs() < 1e-9, "it turns about the scene's up");
    page.press("1");
    page.run("splatvk.settled()");
    let back = eye(page);
    for k in 0..3 {
        assert!((back[k].as_f64().unwrap() - first[k].as_f64().unwrap()).abs() < 1e-9);
    }
    page.press("2");
    page.run("splatvk.settled()");
    assert_ne!(eye(page), first);
    page.press(" ");
    std::thread::sleep(std::time::Duration::from_millis(300));
    page.press(" ");
    assert_ne!(eye(page), first, "it flies");
    page.press("?");
    assert_eq!(page.run("document.querySelector('.v-help').open"), true);
    page.press("Escape");
    assert_eq!(page.run("document.querySelector('.v-help').open"), false);
    page.press("r");
    page.run("splatvk.settled()");
    let start = eye(page);
    page.press("ArrowUp");
    assert!(height(&eye(page)) > height(&start), "the camera rises");
    page.press("Home");
    page.run("splatvk.settled()");
    assert_eq!(eye(page), start);
    page.press("0");
    page.run("splatvk.settled()");
    assert_ne!(eye(page), start, "all of the scene is more than the first view");
    // Arrows in the group of modes choose a mode and leave the camera.
    let before = eye(page);
    page.run("document.querySelector('.v-modes [aria-checked=true]').focus()");
    page.press("ArrowRight");
    assert_eq!(page.run("splatvk.state.mode"), "depth");
    assert_eq!(page.run("document.activeElement.textContent"), "Depth");
    page.press("ArrowLeft");
    assert_eq!(page.run("splatvk.state.mode"), "colour");
    assert_eq!(eye(page), before);
    page.run("document.querySelector('.viewer').focus()");
}

/// A moving picture may be coarse; at rest it is as before the motion.
fn check_rest(page: &mut Page) {
    let middle = |page: &mut Page| {
        page.run("splatvk.goTo(0)");
        let shot = image::load_from_memory(&page.screenshot()).unwrap().to_rgb8();
        image::imageops::crop_imm(&shot, 240, 180, 240, 120).to_image()
    };
    let before = middle(page);
    let mut mouse = |kind: &str, x: f64| {
        let params =
            json!({ "type": kind, "x": x, "y": 250.0, "button": "left", "buttons": 1, "clickCount": 1 });
        page.call("Input.dispatchMouseEvent", params);
    };
    mouse("mousePressed", 300.0);
    (1..12).for_each(|k| mouse("mouseMoved", 300.0 + 10.0 * f64::from(k)));
    mouse("mouseReleased", 410.0);
    assert!(middle(page) == before, "the picture at rest has full quality");
}

fn check_tape(page: &mut Page, scene: &Path) {
    page.run("splatvk.show('colour')");
    page.run("splatvk.goTo(0)");
    page.press("l");
    let loaded = scene_dir::load(scene).unwrap();
    let (camera, masks) = (&loaded.cameras[0], masks_of("train_00"));
    let depth = npy::read_npz(data("breakfast/depth/train_00.npz")).unwrap()["depth"].to_f32();
    // The middle of the box of cereal and of the blue mug.
    let ends = [4, 9].map(|object| inner_point(&masks, object));
    let places = ends.map(|(x, y)| {
        let z = f64::from(depth[y as usize * 640 + x as usize]);
        camera.unproject(glam::DVec2::new(x, y), z)
    });
    for end in ends {
        let (x, y) = page_position(page, end);
        page.click(x, y);
    }
    let units = page.run("splatvk.tape.units").as_f64().unwrap();
    let truth = places[0].distance(places[1]);
    println!("box to mug: {units:.4}, truly {truth:.4}");
    // Splats of four pixels about the true surface.
    assert!((units / truth - 1.0).abs() < 0.05, "{units} {truth}");
    assert_eq!(page.run("splatvk.state.selected"), Value::Null, "a click measures, it does not select");
    assert!(tape_text(page).ends_with(" units"), "{}", tape_text(page));
    page.run("splatvk.settled()");
    assert_eq!(page.run("document.querySelectorAll('.v-line line, .v-line circle').length"), 3);
    keep_screenshot(page, "measured.png");
    page.run("document.querySelector('.v-tape input').focus()");
    page.write("half a metre");
    page.press("Enter");
    let said = page.run("document.querySelector('.v-status').textContent");
    assert!(said.as_str().unwrap().contains("half a metre"), "{said}");
    for text in ["0,5", "50 cm", "0.5"] {
        page.run("document.querySelector('.v-tape input').value = ''");
        page.write(text);
        assert_eq!(tape_text(page), "50 cm", "{text}");
    }
    let stated = page.run("splatvk.tape.stated()");
    let stated = stated.as_str().unwrap();
    assert!(stated.starts_with("--scale \"") && stated.ends_with(" = 0.5\""), "{stated}");
    let length: Length = stated["--scale \"".len()..stated.len() - 1].parse().unwrap();
    let measured = &metric::measure(&loaded, std::slice::from_ref(&length), None).unwrap()[0];
    assert!((measured.units / units - 1.0).abs() < 1e-4);
    assert_eq!(length.metres, Some(0.5));
    // From now on the page shows lengths in metres.
    page.run("document.querySelector('.viewer').focus()");
    for end in ends {
        let (x, y) = page_position(page, end);
        page.click(x, y);
    }
    assert_eq!(tape_text(page), "50 cm");
    page.press("Escape");
    assert_eq!(page.run("document.querySelector('.v-tape').hidden"), true);
}

fn tape_text(page: &mut Page) -> String {
    let text = page.run("document.querySelector('.v-tape output').textContent");
    text.as_str().unwrap().to_owned()
}

fn check_phone_layout(page: &mut Page) {
    page.run("splatvk.ask('lemon')");
    let outside = page.run(
        "[...document.querySelectorAll('.v-ask, .v-card, .v-tools button, .v-modes, .v-photos')].filter((e) => { \
         const r = e.getBoundingClientRect(); return r.left < 0 || r.top < 0 || r.right > innerWidth || r.bottom > innerHeight; \
         }).map((e) => e.className)",
    );
    assert_eq!(outside, json!([]), "reaches out of the screen");
    let small = page.run(
        "[...document.querySelectorAll('.v-tools button, .v-photos button, .v-modes button')].filter((e) => e.offsetParent && \
         e.getBoundingClientRect().height < 38).length",
    );
    assert_eq!(small, 0, "too small for a finger");
    keep_screenshot(page, "phone.png");
    page.press("Escape");
    page.run("splatvk.goTo(0)");
    let (x, y) = page_position(page, inner_point(&masks_of("train_00"), 4));
    let point = json!([{ "x": x, "y": y }]);
    page.call("Input.dispatchTouchEvent", json!({ "type": "touchStart", "touchPoints": point }));
    page.call("Input.dispatchTouchEvent", json!({ "type": "touchEnd", "touchPoints": [] }));
    page.run("splatvk.settled()");
    assert_eq!(page.run("splatvk.state.selected.codes"), json!([3]), "a tap on the box of cereal");
    assert_eq!(page.complaints, Vec::<String>::new());
}

/// The help fits the screen of a phone and closes by its button and by a tap beside it.
fn check_phone_help(page: &mut Page) {
    for (width, height) in [(390, 844), (844, 390)] {
        page.call(
            "Emulation.setDeviceMetricsOverride",
            json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": true }),
        );
        for close in ["document.querySelector('.v-help .v-close').click()", ""] {
            page.run("document.querySelector('[data-do=help]').click()");
            let inside = page.run(
                "(() => { const r = document.querySelector('.v-help').getBoundingClientRect(); \
                 return r.width > 250 && r.left >= 0 && r.top >= 0 && r.right <= innerWidth && r.bottom <= innerHeight; })()",
            );
            assert_eq!(inside, true, "{width} x {height}");
            if close.is_empty() {
                let point = json!([{ "x": 4, "y": 4 }]);
                page.call("Input.dispatchTouchEvent", json!({ "type": "touchStart", "touchPoints": point }));
                page.call("Input.dispatchTouchEvent", json!({ "type": "touchEnd", "touchPoints": [] }));
            } else {
                page.run(close);
            }
            let closed = "new Promise((done) => { const look = () => document.querySelector('.v-help').open ? setTimeout(look, 20) : done(true); look(); })";
            assert_eq!(page.run(closed), true);
        }
    }
}

#[test]
fn static_page_answers_stored_queries() {
    let Some(chromium) = browser::installed() else { return };
    let folder = tempfile::tempdir().unwrap();
    let scene = scene_dir::load(&breakfast(folder.path())).unwrap();
    let encoder = sources::dir_encoder(
        &folder.path().join("texts.npz"),
        None,
        &splatvk::infer::Registry::open(None).unwrap(),
    )
    .unwrap();
    let device = gpu::open(None).unwrap();
    let field = scene.language.clone().unwrap();
    let mut ready = QueryScene::open(&device, (&scene.splats, &scene.cameras), field, encoder).unwrap();
    ready.set_views(&scene.cameras).unwrap();
    let answers = ["lemon", "loaf of bread"].map(|t| ready.ask(t, &QueryOptions::default()).unwrap());
    let names = ready.names().unwrap();
    // As if no photo showed the loaf of bread, label 8.
    let things = splat_codes(&scene.language.as_ref().unwrap().levels[2]);
    let seen = Seen { pixels: things.iter().map(|k| f32::from(u8::from(*k != Some(7)))).collect() };
    let view = Scene3d {
        title: "static",
        layers: Layers { seen: &seen, ..Layers::from(&scene) },
        cameras: &scene.cameras,
        world: &scene.world,
        photos: Vec::new(),
        language: scene.language.as_ref(),
        names: &names,
        answers: answers.iter().map(|a| a.shown()).collect(),
        suggested: Vec::new(),
        named: Default::default(),
    };
    let (section, note) = view.embedded().unwrap();
    println!("{note}");
    let file = folder.path().join("page.html");
    let style = splatvk::report::viewer::STYLE;
    std::fs::write(
        &file,
        format!("<!doctype html><title>x</title><style>{style}</style><main>{section}</main>"),
    )
    .unwrap();
    let mut page = Page::open(&chromium, 800, 600, false);
    page.go(&format!("file://{}", file.display()));
    page.run("splatvk.ask('loaf of bread')");
    let overlap = iou(&coloured(&page.picture(0)), &object_mask(&masks_of("train_00"), 8));
    println!("loaf of bread: IoU {overlap:.2}");
    assert!(overlap > 0.7, "{overlap}");
    page.run("splatvk.show('unseen')");
    let overlap = iou(&coloured(&page.picture(0)), &object_mask(&masks_of("train_00"), 8));
    println!("guessed: IoU {overlap:.2}");
    assert!(overlap > 0.7, "what no photo shows is in magenta, the rest grey: {overlap}");
    page.run("splatvk.ask('plate')");
    assert!(
        page.run("document.querySelector('.v-status').textContent")
            .as_str()
            .unwrap()
            .contains("splatvk view")
    );
    assert_eq!(page.complaints, Vec::<String>::new());
    assert!(
        page.requests
            .iter()
            .all(|r| r.starts_with("file:") || r.starts_with("data:") || r.starts_with("blob:")),
        "{:?}",
        page.requests
    );
}

#[test]
fn training_report_shows_scene() {
    let Some(chromium) = browser::installed() else { return };
    let scene = fixture::scene();
    let mut page = Page::open(&chromium, 800, 600, false);
    page.go(&format!("file://{}", scene.join("report.html").display()));
    let render = image::open(scene.join("previews/train_00_render.jpg")).unwrap().to_rgb8();
    let likeness = psnr(&to_float(&page.picture(0)), &to_float(&render));
    println!("report: {likeness:.1} dB against its own preview");
    // JPEG itself costs down to about 35 dB.
    assert!(likeness > 30.0, "{likeness} dB");
    assert_eq!(page.complaints, Vec::<String>::new());
    assert_eq!(
        page.requests.iter().filter(|r| !r.starts_with("file:") && !r.starts_with("data:")).count(),
        0
    );
    keep_screenshot(&mut page, "report.png");
}
