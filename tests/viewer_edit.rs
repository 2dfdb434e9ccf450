//! Edits in the interactive view: the page and the command line select and change the same splats,
//! all of it can be undone, and the server refuses the rest.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod browser;
mod fixture;

use browser::Page;
use browser::pictures::keep_screenshot;
use fixture::command::splatvk;
use fixture::view::{Server, breakfast, masks_of};
use serde_json::{Value, json};
use splatvk::format::edits::{Edit, EditList, Operation};
use splatvk::format::scene_dir;
use splatvk::run::Machine;
use splatvk::run::edit::Editor;
use std::path::{Path, PathBuf};

/// Label of the mug in the masks.
const MUG: i32 = 9;
const SELECTED: &str = "document.querySelector('#v-edit').textContent.includes('splats, ')";

/// The edits of a scene directory.
fn edits(scene: &Path) -> EditList {
    EditList::read(scene, &scene_dir::load_unedited(scene).unwrap().splats).unwrap()
}

fn made(folder: &Path, name: &str) -> PathBuf {
    let own = folder.join(name);
    std::fs::create_dir(&own).unwrap();
    breakfast(&own)
}

/// The page at the camera of the first photo, with `scale` pixels per pixel of the photo.
fn open(chromium: &str, server: &Server, scale: f64) -> Page {
    let [width, height] = [640.0, 480.0].map(|side: f64| (scale * side) as u32);
    let mut page = Page::open(chromium, width, height, false);
    page.go(&server.address);
    page.run("splatvk.goTo(0)");
    page
}

/// A pixel of the mug on the page.
fn on_mug(scale: f64) -> [f64; 2] {
    let mask = masks_of("train_00");
    let pixels: Vec<usize> = (0..mask.data.len()).filter(|i| mask.data[*i] == MUG).collect();
    let middle = pixels[pixels.len() / 2];
    [middle % 640, middle / 640].map(|v| scale * (v as f64 + 0.5))
}

fn press_button(page: &mut Page, text: &str) {
    page.run(&format!(
        "[...document.querySelectorAll('#v-edit button')].find((b) => b.textContent === {}).click()",
        json!(text)
    ));
}

/// Waits for a number of edits in the list of the panel.
fn wait_for_edits(page: &mut Page, count: usize) {
    page.wait_for(&format!("document.querySelectorAll('#v-edit li').length === {count}"));
}

fn press_undo(page: &mut Page, shift: bool) {
    page.run(&format!(
        "document.querySelector('.viewer').dispatchEvent(new KeyboardEvent('keydown', \
         {{ key: 'z', ctrlKey: true, shiftKey: {shift}, bubbles: true }}))"
    ));
}

#[test]
fn three_clicks_delete_as_one_command_does() {
    let folder = tempfile::tempdir().unwrap();
    let (by_command, by_page) = (made(folder.path(), "a"), made(folder.path(), "b"));
    let mut command = splatvk();
    command.arg("edit").arg(&by_command).args(["--delete", "blue mug", "--force"]);
    assert!(command.output().unwrap().status.success());
    let Some(chromium) = browser::installed() else { return };
    let server = Server::start(&by_page);
    let mut page = open(&chromium, &server, 1.0);
    let whole = page.picture(0);

    let [x, y] = on_mug(1.0);
    page.click(x, y);
    page.wait_for("!document.querySelector('.v-card').hidden");
    page.click_on(".v-edit");
    page.wait_for(SELECTED);
    keep_screenshot(&mut page, "edit-selected.png");
    press_button(&mut page, "Delete");
    wait_for_edits(&mut page, 1);
    page.wait_for(
        "document.querySelector('.v-status').textContent.includes('behind them that no photo shows')",
    );
    let (one, other) = (edits(&by_command), edits(&by_page));
    assert_eq!((one.edits.len(), &one.edits[0].splats), (1, &other.edits[0].splats));
    assert_eq!(other.edits[0].operation, Operation::Delete {});

    // The page draws what the renderer does, hatched behind the mug.
    let deleted = page.picture(0);
    keep_screenshot(&mut page, "edit-deleted.png");
    let out = folder.path().join("views");
    let mut render = splatvk();
    render.arg("render").arg(&by_page).arg("--cameras").arg(by_page.join("cameras/transforms.json"));
    assert!(render.arg("--out").arg(&out).output().unwrap().status.success());
    let rendered = image::open(out.join("train_00.png")).unwrap().to_rgb8();
    let difference = |a: &image::RgbImage, b: &image::RgbImage| {
        let mask = masks_of("train_00");
        let pixels = (0..mask.data.len()).filter(|i| mask.data[*i] == MUG);
        let at = |image: &image::RgbImage, i: usize| image.get_pixel((i % 640) as u32, (i / 640) as u32).0;
        let all: Vec<f64> = pixels
            .map(|i| at(a, i).iter().zip(at(b, i)).map(|(a, b)| f64::from(a.abs_diff(b))).sum::<f64>() / 3.0)
            .collect();
        all.iter().sum::<f64>() / all.len() as f64
    };
    let (same, changed) = (difference(&deleted, &rendered), difference(&deleted, &whole));
    assert!(same < 3.0 && changed > 30.0, "{same} {changed}");

    // Undo brings back the mug, selected, and once more without.
    press_undo(&mut page, false);
    wait_for_edits(&mut page, 0);
    assert_eq!(page.run(SELECTED), true);
    press_undo(&mut page, false);
    page.wait_for(&format!("!({SELECTED})"));
    assert!(difference(&page.picture(0), &whole) < 0.5);
    assert_eq!((edits(&by_page).edits.len(), edits(&by_page).undone.len()), (0, 1));
    press_undo(&mut page, true);
    press_undo(&mut page, true);
    wait_for_edits(&mut page, 1);
    assert_eq!(edits(&by_page), other);
    // Edits of an earlier page can be undone, too.
    let mut page = open(&chromium, &server, 1.0);
    page.click_on("[data-do=edit]");
    wait_for_edits(&mut page, 1);
    press_button(&mut page, "Undo");
    wait_for_edits(&mut page, 0);
    assert_eq!(page.complaints, Vec::<String>::new());
}

/// Marked splats of the page.
fn marked(page: &mut Page, bit: u32) -> u64 {
    let count = format!("splatvk.marks().reduce((n, mark) => n + (mark & {bit} ? 1 : 0), 0)");
    page.run(&count).as_u64().unwrap()
}

#[test]
fn selections_are_combined_hidden_and_changed() {
    // The panel leaves room beside it.
    const WIDE: f64 = 1.5;
    const CHOSEN: u32 = 16;
    const HIDDEN: u32 = 32;
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let Some(chromium) = browser::installed() else { return };
    let server = Server::start(&scene);
    let mut page = open(&chromium, &server, WIDE);
    page.press("x");
    let [x, y] = on_mug(WIDE);
    let corners = |r: f64| [[x - r, y - r], [x + r, y + r]];
    press_button(&mut page, "Rectangle");
    page.draw(&corners(25.0));
    page.wait_for(SELECTED);
    let small = marked(&mut page, CHOSEN);
    // Twice the side, four times the splats of a surface; a new selection takes the old one's place.
    page.draw(&corners(50.0));
    page.wait_for(&format!("splatvk.marks().filter((m) => m & 16).length > {}", 2 * small));
    let large = marked(&mut page, CHOSEN);
    press_button(&mut page, "Remove");
    page.draw(&corners(25.0));
    page.wait_for(&format!("splatvk.marks().filter((m) => m & 16).length < {large}"));
    assert_eq!(marked(&mut page, CHOSEN), large - small);
    press_button(&mut page, "Lasso");
    press_button(&mut page, "Add");
    let round: Vec<[f64; 2]> =
        (0..40).map(|k| 0.16 * f64::from(k)).map(|a| [x + 35.0 * a.cos(), y + 35.0 * a.sin()]).collect();
    page.draw(&round);
    page.wait_for(&format!("splatvk.marks().filter((m) => m & 16).length === {large}"));

    press_button(&mut page, "Hide");
    assert_eq!((marked(&mut page, CHOSEN), marked(&mut page, HIDDEN)), (0, large));
    press_undo(&mut page, false);
    page.wait_for(&format!("splatvk.marks().filter((m) => m & 16).length === {large}"));
    press_button(&mut page, "Recolour");
    wait_for_edits(&mut page, 1);
    page.enter("Words, an id or a range", "id:l9");
    page.wait_for(SELECTED);
    press_button(&mut page, "Isolate");
    wait_for_edits(&mut page, 2);
    // Hidden splats that an edit takes away are no longer hidden.
    page.enter("Words, an id or a range", "opacity>0.5");
    page.wait_for(SELECTED);
    press_button(&mut page, "Hide");
    page.enter("Words, an id or a range", "opacity>0.4");
    page.wait_for(SELECTED);
    press_button(&mut page, "Delete");
    wait_for_edits(&mut page, 3);
    assert_eq!(marked(&mut page, HIDDEN), 0);
    assert_eq!(page.complaints.len(), 1, "the server refuses to select them: {:?}", page.complaints);
    page.complaints.clear();
    let list = edits(&scene);
    assert!(
        matches!(list.edits[0].operation, Operation::Recolour { .. }) && list.edits[0].selection.len() == 3
    );
    assert_eq!(list.edits[1].operation, Operation::Isolate {});
    // The library selects what the page did.
    let mut editor = Editor::open(&scene, &Machine::default()).unwrap();
    while editor.undo().unwrap() {}
    let rows = |edit: &Edit, editor: &mut Editor| editor.select(&edit.selection).unwrap().rows;
    assert_eq!(rows(&list.edits[0], &mut editor), list.edits[0].splats);
    assert_eq!(list.edits[0].splats.count() as u64, large);

    // Another program has undone all: the page says so, and shows it.
    page.enter("Words, an id or a range", "id:l9");
    page.wait_for("document.querySelector('.v-status').textContent.includes('edited elsewhere')");
    wait_for_edits(&mut page, 0);
    page.enter("Words, an id or a range", "unicorn");
    page.wait_for("document.querySelector('.v-status').textContent.includes('unicorn')");
    let refusals = ["409 (Conflict)", "422 (Unprocessable"];
    let all = page.complaints.iter().zip(refusals).all(|(line, part)| line.contains(part));
    assert!(page.complaints.len() == 2 && all, "{:?}", page.complaints);
}

#[test]
fn server_refuses_damaged_and_huge_edits() {
    let folder = tempfile::tempdir().unwrap();
    let scene = breakfast(folder.path());
    let server = Server::start(&scene);
    let send = |request: Value| json!({ "request": request }).to_string();
    let select = |pick: Value| send(json!({ "select": [{ "pick": pick }] }));
    let camera = json!({ "name": "v", "width": 4_000_000_000u32, "height": 10, "fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0,
        "pose": { "rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "translation": [0, 0, 0] } });
    for (body, reason) in [
        ("{}".to_owned(), "no edit"),
        (send(json!({ "select": [] })), "selects no splat"),
        (send(json!({ "select": [{}] })), "either a text or a rule"),
        (send(json!({ "drop": {} })), "no edit"),
        (select(json!({ "click": { "camera": camera, "pixel": [1, 1] } })), "too many"),
        (select(json!({ "outline": { "camera": camera, "polygon": [[0, 0], [1, 0], [1, 1]] } })), "too many"),
        (
            send(json!({ "edit": { "operation": { "delete": {} }, "selection": [{ "text": "lemon" }] } })),
            "nothing is changed",
        ),
    ] {
        let (status, said) = server.request("POST", "edit", "", &body);
        assert!(status == 422 && said.contains(reason), "{body}: {status} {said}");
    }
    assert_eq!(server.request("POST", "edit", "", &"x".repeat(600 << 10)).0, 413);
    assert_eq!(server.request("GET", "edit", "", "").0, 404);
    assert_eq!(server.request("POST", "edit", "Origin: http://evil.example\r\n", "{\"undo\": {}}").0, 403);
    assert!(!scene.join("edits.json").exists());
    let outdated = json!({ "scene": 7, "request": { "undo": {} } }).to_string();
    assert_eq!(server.request("POST", "edit", "", &outdated).0, 409);
    let (status, bins) = server.request("POST", "edit", "", &send(json!({ "histogram": "opacity" })));
    let bins: Value = serde_json::from_str(&bins).unwrap();
    let sum: u64 = bins["counts"].as_array().unwrap().iter().map(|n| n.as_u64().unwrap()).sum();
    assert_eq!((status, sum as usize), (200, scene_dir::load(&scene).unwrap().splats.len()));
}
