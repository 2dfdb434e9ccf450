//! The interactive view of a real scene, by hand: pictures of the documentation and frame times.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod browser;
mod fixture;

use browser::Page;
use browser::pictures::{coloured, inner_point, iou, keep_screenshot, object_mask, page_position, to_float};
use fixture::view::{Server, masks_of};
use splatvk::format::scene_dir;
use splatvk::gpu;
use splatvk::pass::metrics::psnr;
use splatvk::run::view::Viewer;
use splatvk::scene::LanguageField;
use std::path::{Path, PathBuf};

/// The pictures of the README, from a real run: `SPLATVK_SCENE=out/breakfast cargo test --test
/// viewer_scene -- --ignored`.
#[test]
#[ignore = "needs a scene of splatvk run on breakfast in SPLATVK_SCENE"]
fn pictures_of_a_real_scene() {
    let scene = PathBuf::from(std::env::var("SPLATVK_SCENE").unwrap());
    let chromium = browser::installed().unwrap();
    let server = Server::start(&scene);
    let mut page = Page::open(&chromium, 1120, 760, false);
    page.go(&server.address);
    let loaded = scene_dir::load(&scene).unwrap();
    let device = gpu::open(None).unwrap();
    let mut viewer = Viewer::new(&device, &loaded.splats, &LanguageField::default()).unwrap();
    let engine = viewer.view(&loaded.cameras[0]).unwrap().rendered.rgb;
    let likeness = psnr(&to_float(&page.picture(0)), &engine);
    println!("{likeness:.1} dB against splatvk render, {} splats", loaded.splats.len());
    assert!(likeness > 25.0);
    let masks = masks_of("train_00");
    page.run("splatvk.goTo(0)");
    for (object, word) in [(7, "lemon"), (9, "mug"), (4, "cereal"), (8, "loaf")] {
        let (x, y) = page_position(&mut page, inner_point(&masks, object));
        page.click(x, y);
        let names = page.run(
            "[...document.querySelectorAll('.v-names li')].map((l) => l.firstChild.textContent).join(', ') \
             || document.querySelector('.v-doubt').textContent",
        );
        println!("a click on {word}: {} = {names}", page.run("splatvk.state.selected"));
    }
    let (x, y) = page_position(&mut page, inner_point(&masks, 9));
    page.click(x, y);
    let shots = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/images");
    let save_picture = |page: &mut Page, name: &str, width: u32| {
        let shot = image::load_from_memory(&page.screenshot()).unwrap().to_rgb8();
        let height = shot.height() * width / shot.width();
        let small = image::imageops::resize(&shot, width, height, image::imageops::FilterType::Lanczos3);
        let file = std::fs::File::create(shots.join(name)).unwrap();
        image::codecs::jpeg::JpegEncoder::new_with_quality(file, 85).encode_image(&small).unwrap();
    };
    save_picture(&mut page, "view-select.jpg", 840);
    for (text, object) in [("lemon", 7), ("blue mug", 9), ("box of cereal", 4), ("loaf of bread", 8)] {
        page.run(&format!("splatvk.ask('{text}')"));
        let overlap = iou(&coloured(&page.picture(0)), &object_mask(&masks, object));
        println!("{text}: IoU {overlap:.2} in photo 0");
        page.run("splatvk.settled()");
    }
    page.run("splatvk.ask('blue mug')");
    save_picture(&mut page, "view-query.jpg", 840);
    drop(page);
    let mut phone = Page::open(&chromium, 390, 844, true);
    phone.go(&server.address);
    phone.run("splatvk.ask('lemon')");
    save_picture(&mut phone, "view-phone.jpg", 390);
    phone.run("splatvk.show('level', 2)");
    keep_screenshot(&mut phone, "phone-level.png");
}

/// Milliseconds per frame while a pointer drags: a benchmark, which prints and checks nothing but
/// that the picture moves. `SPLATVK_SCENE=out/breakfast cargo test --release --test viewer_scene --
/// --ignored --nocapture frame_time`.
#[test]
#[ignore = "needs a scene in SPLATVK_SCENE"]
fn frame_time_of_a_drag() {
    let scene = PathBuf::from(std::env::var("SPLATVK_SCENE").unwrap());
    let server = Server::start(&scene);
    let mut page = Page::open(&browser::installed().unwrap(), 1280, 720, false);
    page.go(&server.address);
    let before = page.screenshot();
    let times = page.run(DRAG);
    assert!(before != page.screenshot(), "the drag moved nothing");
    let mut times: Vec<f64> = times.as_array().unwrap().iter().map(|t| t.as_f64().unwrap()).collect();
    times.sort_by(f64::total_cmp);
    let at = |share: f64| times[(share * (times.len() - 1) as f64) as usize];
    println!("{:.0} ms per frame ({:.0} to {:.0}), {} frames", at(0.5), at(0.25), at(0.75), times.len());
}

/// Moves a pressed pointer by 12 pixels before each of 10 frames; the times between them.
const DRAG: &str = "new Promise((done) => {
  const canvas = document.querySelector('canvas');
  const send = (type, x) => canvas.dispatchEvent(new PointerEvent(type,
    { pointerId: 1, isPrimary: true, button: 0, buttons: 1, clientX: x, clientY: 360, bubbles: true }));
  canvas.setPointerCapture = () => {};
  const times = [];
  let x = 500, last = null;
  const frame = (now) => {
    if (last !== null) times.push(now - last);
    last = now;
    send('pointermove', x += 12);
    if (times.length < 10) return requestAnimationFrame(frame);
    send('pointerup', x);
    done(times);
  };
  send('pointerdown', x);
  requestAnimationFrame(frame);
})";
