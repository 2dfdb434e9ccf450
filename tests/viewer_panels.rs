//! Panels of the interactive view: named views and notes are saved in the scene and come back, in
//! the address and in an offline page; every state of the page passes the rules of axe-core.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod browser;
mod fixture;

use browser::Page;
use browser::pictures::keep_screenshot;
use fixture::view::{Server, breakfast};
use serde_json::{Value, json};
use splatvk::format::scene_dir;
use splatvk::format::views::Views;
use std::path::Path;
use std::process::Command;

fn position(page: &mut Page) -> Vec<f64> {
    let eye = page.run("splatvk.camera().position");
    eye.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

#[test]
fn views_and_notes_are_saved_and_shown() {
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let Some(chromium) = browser::installed() else { return };
    let server = Server::start(&scene);
    let mut page = Page::open(&chromium, 720, 540, false);
    page.go(&server.address);
    page.run("splatvk.goTo(0)");
    page.click_on("[data-do=views]");
    page.enter("Name of this view", "Left");
    page.wait_for("document.querySelectorAll('#v-views li').length === 1");
    let left = position(&mut page);
    page.run("splatvk.goTo(1)");
    page.enter("Name of this view", "Right");
    page.wait_for("document.querySelectorAll('#v-views li').length === 2");
    let right = position(&mut page);
    // A name that exists already is refused, in any case of its letters.
    page.enter("Name of this view", "left");
    page.wait_for("document.querySelector('.v-status').textContent.includes('already')");
    page.click_on("[aria-label=\"Start with Right\"]");
    page.wait_for("document.querySelector('[aria-label=\"Start with Right\"]').ariaPressed === 'true'");
    page.enter("Text of a note", "here it is");
    page.click(500.0, 300.0);
    page.wait_for("document.querySelectorAll('.v-pin').length === 1");
    page.click_on("[aria-label=\"Rename Left\"]");
    page.run("document.querySelector('[aria-label=\"New name\"]').value = ''");
    page.enter("New name", "From the left");
    page.wait_for("document.querySelector('[aria-label=\"Rename From the left\"]')");
    keep_screenshot(&mut page, "views.png");
    assert_eq!(page.complaints, Vec::<String>::new());

    let saved = Views::of_scene(&scene).unwrap();
    assert_eq!(saved.start.as_deref(), Some("Right"));
    let names: Vec<&str> = saved.views.iter().map(|v| v.name.as_str()).collect();
    assert_eq!((names, saved.notes.len()), (vec!["From the left", "Right"], 1));
    // The saved view shows a point where the photo does.
    let camera = &scene_dir::load(&scene).unwrap().cameras[0];
    let view = saved.views[0].camera(camera.height);
    assert!(view.pose.centre().distance(camera.pose.centre()) < 1e-6);
    let point = camera.unproject(glam::DVec2::new(f64::from(camera.width) / 3.0, 100.0), 1.0);
    let offset = |c: &splatvk::scene::Camera| {
        (c.project(point).0 - glam::DVec2::new(f64::from(c.width), f64::from(c.height)) / 2.0) / c.fy
    };
    assert!((offset(&view) - offset(camera)).length() < 1e-3, "{:?} {:?}", offset(&view), offset(camera));

    // The page begins at the view, or at that of the address.
    let close = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4);
    page.go(&server.address);
    assert!(close(&position(&mut page), &right), "the view at the start");
    page.go(&format!("{}?view=from%20the%20left&ui=0&query=lemon", server.address));
    assert!(close(&position(&mut page), &left), "the view of the address");
    page.wait_for("splatvk.state.query?.text === 'lemon' && splatvk.state.mode === 'relevancy'");
    assert_eq!(page.run("getComputedStyle(document.querySelector('.v-bottom')).display"), "none");
    keep_screenshot(&mut page, "bare.png");
    page.go(&format!("{}?view=2&show=depth", server.address));
    assert!(close(&position(&mut page), &right), "a photo by its number");
    assert_eq!(page.run("splatvk.state.mode"), "depth");

    // The server refuses what is no list of views, and keeps what is there.
    for body in ["{}", "[]", "{\"format\": \"splatvk-views\"}"] {
        assert_eq!(server.request("POST", "views", "", body).0, 422, "{body}");
    }
    let long = "x".repeat(600 << 10);
    assert_eq!(server.request("POST", "views", "", &long).0, 413);
    assert_eq!(Views::of_scene(&scene).unwrap(), saved);

    check_offline(&chromium, &scene, &right);
    check_rendering(&scene);
}

/// An exported page shows views and notes, and changes none.
fn check_offline(chromium: &str, scene: &Path, start: &[f64]) {
    let file = scene.with_file_name("page.html");
    let mut export = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    assert!(export.arg("export").arg(scene).arg(&file).status().unwrap().success());
    let mut page = Page::open(chromium, 720, 540, false);
    page.go(&format!("file://{}?query=unicorn", file.display()));
    assert!(position(&mut page).iter().zip(start).all(|(a, b)| (a - b).abs() < 1e-4));
    let said = page.run("document.querySelector('.v-status').textContent");
    assert!(
        said.as_str().unwrap().contains("unicorn") && said.as_str().unwrap().contains("splatvk view"),
        "{said}"
    );
    page.click_on("[data-do=views]");
    assert_eq!(page.run("document.querySelectorAll('#v-views li').length"), 3);
    assert_eq!(
        page.run("document.querySelectorAll('#v-views form, #v-views [aria-label^=Delete]').length"),
        0
    );
    assert_eq!(page.run("document.querySelector('.v-pin').textContent"), "here it is");
    assert_eq!(page.complaints, Vec::<String>::new());
}

fn check_rendering(scene: &Path) {
    let out = scene.with_file_name("named");
    let mut render = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    render.arg("render").arg(scene).args(["--view", "right", "--height", "96", "--out"]).arg(&out);
    assert!(render.status().unwrap().success());
    let picture = image::open(out.join("Right.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (128, 96));
}

/// axe-core, where tools/viewer-bench/bench or npm has installed it.
fn axe() -> Option<String> {
    let own =
        Path::new(env!("CARGO_MANIFEST_DIR")).join(".deps/viewer-bench/node_modules/axe-core/axe.min.js");
    let found = std::env::var_os("AXE_CORE").map_or(own, Into::into);
    let text = std::fs::read_to_string(&found).ok();
    if text.is_none() {
        println!(
            "SKIPPED: no {}; tools/viewer-bench/bench installs it, or name axe.min.js in AXE_CORE",
            found.display()
        );
    }
    text
}

/// Broken rules in the present state of the page, with their first element.
fn broken(page: &mut Page) -> Value {
    page.run(
        "axe.run(document).then((r) => r.violations.map((v) => `${v.id}: ${v.nodes[0].html.slice(0, 120)}`))",
    )
}

/// Controls that reach out of the screen, rows and panels that scroll excepted.
const OUTSIDE: &str = "[...document.querySelectorAll('.viewer button, .viewer input')].filter((e) => e.offsetParent && \
    !e.closest('dialog, .v-photos, .v-chips, .v-panel > div')).filter((e) => { const r = e.getBoundingClientRect(); \
    return r.left < 0 || r.top < 0 || r.right > innerWidth || r.bottom > innerHeight; }).map((e) => e.outerHTML.slice(0, 80))";

#[test]
fn every_state_is_accessible() {
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let (Some(chromium), Some(axe)) = (browser::installed(), axe()) else { return };
    let server = Server::start(&scene);
    for (width, height, phone) in
        [(1280, 800, false), (360, 640, true), (390, 844, true), (640, 360, true), (844, 390, true)]
    {
        let mut page = Page::open(&chromium, width, height, phone);
        page.go(&server.address);
        page.run(&format!("{axe}; true"));
        let check = |page: &mut Page, state: &str| {
            assert_eq!(broken(page), json!([]), "{state}, {width} x {height}");
            assert_eq!(page.run(OUTSIDE), json!([]), "{state}, {width} x {height}");
        };
        check(&mut page, "start");
        page.click_on("[data-do=views]");
        check(&mut page, "views");
        page.press("Escape");
        page.run("document.querySelector('#v-views .v-close').click(), splatvk.ask('lemon')");
        check(&mut page, "answer");
        keep_screenshot(&mut page, &format!("access-{width}.png"));
        page.click_on(".v-edit");
        page.wait_for("document.querySelector('#v-edit').textContent.includes('splats, ')");
        page.run("(() => { const s = document.querySelector('#v-edit select'); s.value = 'size'; s.onchange({ target: s }); })()");
        page.wait_for("document.querySelector('.v-bars')");
        check(&mut page, "edit");
        keep_screenshot(&mut page, &format!("edit-{width}.png"));
        page.click_on("#v-edit .v-close");
        page.click_on("[data-do=help]");
        check(&mut page, "keys");
        page.click_on(".v-help .v-close");
        check_focus_order(&mut page);
    }
}

/// Tab goes through what is shown, from the top to the bottom, and every stop has a name.
fn check_focus_order(page: &mut Page) {
    page.run("document.querySelector('.viewer').focus()");
    let mut rows = Vec::new();
    for _ in 0..30 {
        page.call(
            "Input.dispatchKeyEvent",
            json!({ "type": "keyDown", "key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9 }),
        );
        page.call("Input.dispatchKeyEvent", json!({ "type": "keyUp", "key": "Tab" }));
        let stop = page.run(
            "(() => { const e = document.activeElement; if (!e.closest('.viewer') || e.matches('.viewer')) return null; \
             const row = e.closest('.v-top, .v-modes, .v-photos, .v-tools'); \
             return [row?.className ?? e.className, e.ariaLabel ?? e.title ?? '', e.textContent.trim()]; })()",
        );
        if stop.is_null() {
            break;
        }
        assert!(stop[1] != "" || stop[2] != "", "a stop without a name: {stop}");
        if rows.last() != Some(&stop[0]) {
            rows.push(stop[0].clone());
        }
    }
    assert_eq!(rows, ["v-top", "v-modes", "v-photos", "v-tools"]);
}
