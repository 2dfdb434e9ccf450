//! The C header is up to date; the C functions handle names and settings. `tools/hosts` tests the
//! rest.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks)] // a panic is how a test fails
mod fixture;

use serde_json::Value;
use splatvk::capi::*;
use splatvk::format::{gaussians, scene_dir};
use std::ffi::{CString, c_char, c_void};
use std::path::Path;
use std::ptr::{null, null_mut};

#[test]
fn header_matches_code() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut builder = cbindgen::Builder::new()
        .with_config(cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap());
    for part in ["context", "train", "scene", "render", "label", "files", "edit", "types", "options"] {
        builder = builder.with_src(root.join(format!("src/capi/{part}.rs")));
    }
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let (made, file) = (String::from_utf8(made).unwrap(), root.join("include/splatvk.h"));
    if std::env::var("SPLATVK_BLESS").is_ok() {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, &made).unwrap();
    }
    let kept = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(kept == made, "include/splatvk.h is out of date: SPLATVK_BLESS=1 cargo test --test capi");
}

fn text(path: &Path) -> CString {
    CString::new(path.to_str().unwrap()).unwrap()
}

/// Text of a failure, from the function that copies it.
fn error_text(copy: impl Fn(*mut c_char, usize) -> usize) -> String {
    let mut bytes = vec![0u8; copy(null_mut(), 0)];
    copy(bytes.as_mut_ptr().cast(), bytes.len());
    bytes.pop();
    String::from_utf8(bytes).unwrap()
}

fn context(provider: Option<&CString>) -> *mut SvkContext {
    // The zero bytes of an options structure are its defaults.
    let mut options: SvkContextOptions = unsafe { std::mem::zeroed() };
    options.size = size_of::<SvkContextOptions>();
    options.provider = provider.map_or(null(), |p| p.as_ptr());
    let mut context = null_mut();
    assert_eq!(unsafe { svk_context_create(&options, &mut context) }, SvkStatus::Ok);
    context
}

#[test]
fn export_refuses_unknown_ending() {
    let folder = tempfile::tempdir().unwrap();
    let context = context(None);
    let mut scene = null_mut();
    assert_eq!(
        unsafe { svk_scene_load(context, text(fixture::scene()).as_ptr(), &mut scene) },
        SvkStatus::Ok
    );
    let save = |name: &str, replace: u32| unsafe {
        svk_scene_save(scene, text(&folder.path().join(name)).as_ptr(), replace)
    };
    for name in ["scene.foo", "scene.PLYX", "scene.v2"] {
        assert_eq!(save(name, 1), SvkStatus::Input);
        let error = error_text(|out, bytes| unsafe { svk_scene_error(scene, out, bytes) });
        assert!(error.contains(".compressed.ply, .ply") && error.contains("ends in a slash"), "{error}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    assert_eq!(
        (save("scene.v2/", 0), save("scene.v2", 1), save("scene", 0)),
        (SvkStatus::Ok, SvkStatus::Ok, SvkStatus::Ok)
    );
    assert_eq!(
        (save("a.ply", 0), save("a.ply", 0), save("a.PLY", 0)),
        (SvkStatus::Ok, SvkStatus::Input, SvkStatus::Ok)
    );
    assert!(["scene.v2", "scene"].iter().all(|n| folder.path().join(n).join("scene.json").is_file()));
    #[cfg(unix)]
    {
        let path_of = |name: &str| folder.path().join(name);
        for (link, target) in [("link.ply", "a.ply"), ("nowhere.ply", "nothing"), ("link", "scene")] {
            std::os::unix::fs::symlink(path_of(target), path_of(link)).unwrap();
            assert_eq!((save(link, 0), save(link, 1)), (SvkStatus::Input, SvkStatus::Input), "{link}");
            let error = error_text(|out, bytes| unsafe { svk_scene_error(scene, out, bytes) });
            assert!(error.contains("symbolic link") && path_of(link).is_symlink(), "{error}");
        }
    }
    // No folder is created on the way to another one.
    assert_ne!(save("new/../b.ply", 0), SvkStatus::Ok);
    assert!(!folder.path().join("new").exists() && !folder.path().join("b.ply").exists());
    // Another program's file in a scene, and the scene that was loaded, are kept.
    std::fs::write(folder.path().join("scene/user.txt"), "precious").unwrap();
    assert_eq!(save("scene", 1), SvkStatus::Input);
    assert!(folder.path().join("scene/user.txt").exists());
    let loaded = fixture::scene().join("run.json");
    let own = unsafe { svk_scene_save(scene, text(fixture::scene()).as_ptr(), 1) };
    assert!(own == SvkStatus::Input && loaded.exists());
    unsafe {
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

/// A camera from the scene is accepted unchanged; one camera after the other.
#[test]
fn query_answers_in_given_view() {
    let folder = tempfile::tempdir().unwrap();
    let (context, lemon) = (context(None), CString::new("lemon").unwrap());
    let path = text(&fixture::view::breakfast(folder.path()));
    let mut scene = null_mut();
    assert_eq!(unsafe { svk_scene_load(context, path.as_ptr(), &mut scene) }, SvkStatus::Ok);
    // The lemon has a different place in each; its label is 7.
    for (index, stem) in [(0, "train_00"), (1, "train_02")] {
        let mut camera: SvkCamera = unsafe { std::mem::zeroed() };
        let mut answer: SvkAnswer = unsafe { std::mem::zeroed() };
        (camera.size, answer.size) = (size_of::<SvkCamera>(), size_of::<SvkAnswer>());
        assert_eq!(unsafe { svk_scene_camera(scene, index, &mut camera, null_mut(), 0) }, SvkStatus::Ok);
        let truth = fixture::view::masks_of(stem);
        let mut mask = vec![0u8; truth.data.len()];
        let status = unsafe {
            svk_scene_query(scene, lemon.as_ptr(), &camera, &mut answer, mask.as_mut_ptr(), mask.len())
        };
        let error = error_text(|out, bytes| unsafe { svk_scene_error(scene, out, bytes) });
        assert_eq!((status, answer.found), (SvkStatus::Ok, 1), "{error}");
        let pixels = |counts: fn(bool, bool) -> bool| {
            mask.iter().zip(&truth.data).filter(|(m, t)| counts(**m > 0, **t == 7)).count() as f64
        };
        let overlap = pixels(|a, b| a && b) / pixels(|a, b| a || b);
        assert!(overlap > 0.5, "{stem}: {overlap}");
    }
    unsafe {
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

unsafe extern "C" fn stop(_: *mut c_void, _: *const SvkProgress) -> i32 {
    1
}

#[test]
fn contexts_keep_separate_providers() {
    // No build of ONNX Runtime has both of the absent providers; the first context exists while the
    // others are used.
    let providers = ["cpu", "directml", "coreml"].map(|name| CString::new(name).unwrap());
    let contexts = providers.each_ref().map(|provider| context(Some(provider)));
    let files: Vec<CString> =
        (0..2).map(|k| text(&fixture::data(&format!("breakfast/images/train_0{k}.jpg")))).collect();
    let outcomes = [1, 0, 2].map(|k| {
        let mut photos: [SvkPhoto; 2] = unsafe { std::mem::zeroed() };
        for (photo, file) in photos.iter_mut().zip(&files) {
            (photo.size, photo.path) = (size_of::<SvkPhoto>(), file.as_ptr());
        }
        let mut options: SvkTrainOptions = unsafe { std::mem::zeroed() };
        options.size = size_of::<SvkTrainOptions>();
        if k == 0 {
            options.progress = Some(stop);
        }
        let mut scene = null_mut();
        let status = unsafe { svk_train(contexts[k], photos.as_ptr(), 2, &options, &mut scene) };
        assert!(scene.is_null());
        (status, error_text(|out, bytes| unsafe { svk_context_error(contexts[k], out, bytes) }))
    });
    assert_eq!(outcomes[1].0, SvkStatus::Cancelled, "{}", outcomes[1].1);
    for (k, provider) in [(0, "provider directml"), (2, "provider coreml")] {
        assert!(outcomes[k].0 == SvkStatus::Missing && outcomes[k].1.contains(provider), "{:?}", outcomes[k]);
    }
    contexts.iter().for_each(|c| unsafe { svk_context_destroy(*c) });
}

/// A structure of zeros with its size, the first field.
fn zeros<T>() -> T {
    let mut value = std::mem::MaybeUninit::<T>::zeroed();
    unsafe {
        value.as_mut_ptr().cast::<usize>().write(size_of::<T>());
        value.assume_init()
    }
}

fn loaded(context: *mut SvkContext, path: &Path) -> *mut SvkScene {
    let mut scene = null_mut();
    let status = unsafe { svk_scene_load(context, text(path).as_ptr(), &mut scene) };
    assert_eq!(status, SvkStatus::Ok, "{}", error_text(|o, n| unsafe { svk_context_error(context, o, n) }));
    scene
}

fn scene_error(scene: *mut SvkScene) -> String {
    error_text(|out, bytes| unsafe { svk_scene_error(scene, out, bytes) })
}

fn info(scene: *mut SvkScene) -> SvkSceneInfo {
    let mut info = zeros();
    assert_eq!(unsafe { svk_scene_info(scene, &mut info) }, SvkStatus::Ok);
    info
}

fn means(scene: *mut SvkScene) -> Vec<f32> {
    let mut values = vec![0.0; 3 * info(scene).splats as usize];
    let read = unsafe { svk_scene_read(scene, SvkArray::Means as u32, values.as_mut_ptr(), values.len()) };
    assert_eq!(read, SvkStatus::Ok);
    values
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// The JSON of a .glb.
fn glb(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).unwrap()
}

/// Status, doubts and number of the splats of an edit, those that it took along included.
fn edited(editor: *mut SvkEditor, edit: &SvkEdit) -> (SvkStatus, u64, String) {
    let mut outcome: SvkEdited = zeros();
    let status = unsafe { svk_editor_edit(editor, edit, &mut outcome) };
    let doubts = error_text(|out, bytes| unsafe { svk_editor_doubts(editor, out, bytes) });
    assert_eq!(outcome.doubts as usize, doubts.lines().count());
    (status, outcome.splats + outcome.along, doubts)
}

#[test]
fn edits_are_made_refused_and_undone() {
    let folder = tempfile::tempdir().unwrap();
    let (context, path) = (context(None), fixture::view::breakfast(folder.path()));
    let (splats, list) = (|| scene_dir::load(&path).unwrap().splats, path.join("edits.json"));
    let whole = splats();
    let mut editor = null_mut();
    let file = text(&path.join("point_cloud.ply"));
    assert_eq!(unsafe { svk_editor_open(context, file.as_ptr(), &mut editor) }, SvkStatus::Input);
    assert!(editor.is_null());
    assert_eq!(unsafe { svk_editor_open(context, text(&path).as_ptr(), &mut editor) }, SvkStatus::Ok);
    let said = || error_text(|out, bytes| unsafe { svk_editor_error(editor, out, bytes) });
    let counts = || {
        let mut counts = [9; 2];
        let [edits, undone] = &mut counts;
        assert_eq!(unsafe { svk_editor_count(editor, edits, undone) }, SvkStatus::Ok);
        counts
    };

    // The table of text embeddings has too few words to judge presence.
    let mug = CString::new("blue mug").unwrap();
    let delete = SvkEdit { selection: mug.as_ptr(), ..zeros() };
    let (status, count, doubts) = edited(editor, &delete);
    assert!(status == SvkStatus::Doubtful && count > 0 && doubts.contains("cannot judge"), "{doubts}");
    assert!(said().contains("blue mug") && said().contains("SvkEdit.force"), "{}", said());
    let dry = edited(editor, &SvkEdit { dry_run: 1, ..delete });
    assert_eq!((dry.0, dry.1, list.exists(), counts()), (SvkStatus::Ok, count, false, [0, 0]));
    let (status, all, _) = edited(editor, &SvkEdit { force: 1, ..delete });
    assert_eq!((status, all >= count, counts()), (SvkStatus::Ok, true, [1, 0]));
    let count = all;
    assert_eq!(splats().len(), whole.len() - count as usize);
    let kept = std::fs::read(&list).unwrap();

    // Refusals change nothing, and say why.
    let words = |text: &str| CString::new(text).unwrap();
    let (age, none, red, lemon) = (words("age<3"), words("opacity<0"), words("red"), words("id:l7"));
    let of = |text: &CString| SvkEdit { selection: text.as_ptr(), ..zeros() };
    for (edit, status, reason) in [
        (of(&age), SvkStatus::Input, "age"),
        (of(&none), SvkStatus::Input, "selects no splat"),
        (SvkEdit { operation: 2, colour: red.as_ptr(), ..of(&lemon) }, SvkStatus::Input, "#rrggbb"),
        (SvkEdit { operation: 2, ..of(&lemon) }, SvkStatus::Argument, "SvkEdit.colour"),
        (SvkEdit { operation: 4, ..of(&lemon) }, SvkStatus::Argument, "SvkEdit.selection"),
        (SvkEdit { operation: 5, ..of(&lemon) }, SvkStatus::Argument, "SvkEdit.operation"),
        (zeros(), SvkStatus::Argument, "SvkEdit.selection"),
    ] {
        assert_eq!(edited(editor, &edit).0, status, "{reason}");
        assert!(said().contains(reason), "{}", said());
    }
    assert_eq!((std::fs::read(&list).unwrap(), counts()), (kept, [1, 0]));

    let red = words("#c33");
    let shift = SvkEdit { operation: 3, displacement: [0.0, 0.0, 0.25], ..of(&lemon) };
    assert_eq!(
        edited(editor, &SvkEdit { operation: 2, colour: red.as_ptr(), ..of(&lemon) }).0,
        SvkStatus::Ok
    );
    let moved = edited(editor, &shift).1;
    let mut scene = null_mut();
    assert_eq!(unsafe { svk_editor_scene(editor, &mut scene) }, SvkStatus::Ok);
    let (now, before) = (means(scene), splats());
    assert_eq!(now, before.means.as_flattened());
    let mut steps = 0;
    assert_eq!(unsafe { svk_editor_undo(editor, 1, &mut steps) }, SvkStatus::Ok);
    let raised =
        splats().means.iter().zip(&before.means).filter(|(a, b)| (b[2] - a[2] - 0.25).abs() < 1e-5).count();
    assert_eq!((steps, counts(), raised as u64), (1, [2, 1], moved));
    assert_eq!(unsafe { svk_editor_undo(editor, 9, &mut steps) }, SvkStatus::Ok);
    assert_eq!((steps, counts(), splats() == whole), (2, [0, 3], true));
    assert_eq!(unsafe { svk_editor_redo(editor, 1, &mut steps) }, SvkStatus::Ok);
    assert_eq!((steps, counts(), splats().len()), (1, [1, 2], whole.len() - count as usize));
    unsafe {
        svk_scene_destroy(scene);
        svk_editor_destroy(editor);
        svk_editor_destroy(null_mut());
        svk_context_destroy(context);
    }
}

#[test]
fn exports_are_upright_unless_raw() {
    let folder = tempfile::tempdir().unwrap();
    let context = context(None);
    let scene = loaded(context, &fixture::view::breakfast(folder.path()));
    let export = |name: &str, options: SvkExportOptions| {
        let (file, mut line) = (folder.path().join(name), vec![0u8; 500]);
        let out = line.as_mut_ptr().cast();
        let status = unsafe { svk_scene_export(scene, text(&file).as_ptr(), &options, out, line.len()) };
        let line = String::from_utf8(line).unwrap().trim_end_matches('\0').to_owned();
        (status, line, gaussians::read(&file).map(|(splats, _)| splats))
    };
    let (status, line, upright) = export("a.ply", zeros());
    assert!(status == SvkStatus::Ok && line.starts_with("upright (−y is up"), "{line}");
    let (_, line, raw) = export("b.ply", SvkExportOptions { raw: 1, ..zeros() });
    assert!(line.starts_with("in the scene's own axes"), "{line}");
    let (upright, raw, own) = (upright.unwrap(), raw.unwrap(), means(scene));
    assert_eq!(raw.means.as_flattened(), own);
    // Up is +z in the scene, −y in the file, and the third axis in a file with z up.
    assert!(upright.means.iter().zip(&raw.means).all(|(a, b)| (a[1] + b[2]).abs() < 1e-4));
    let (_, line, turned) = export("c.ply", SvkExportOptions { up: SvkUpAxis::Z as u32, ..zeros() });
    assert!(line.starts_with("upright (+z is up"), "{line}");
    assert!(turned.unwrap().means.iter().zip(&raw.means).all(|(a, b)| (a[2] - b[2]).abs() < 1e-4));

    let (kept, foo) = (std::fs::read(folder.path().join("a.ply")).unwrap(), CString::new("foo").unwrap());
    for (name, options, status, reason) in [
        ("a.ply", zeros(), SvkStatus::Input, "a.ply"),
        ("d.ply", SvkExportOptions { metres: 1, ..zeros() }, SvkStatus::Input, "scale is not known"),
        ("d.spz", SvkExportOptions { up: 3, ..zeros() }, SvkStatus::Input, "y up by definition"),
        ("d.ply", SvkExportOptions { spz_version: 3, ..zeros() }, SvkStatus::Input, "spz"),
        ("d.ply", SvkExportOptions { format: foo.as_ptr(), ..zeros() }, SvkStatus::Input, "foo"),
        ("d.ply", SvkExportOptions { up: 4, ..zeros() }, SvkStatus::Argument, "SvkUpAxis"),
        ("d.ply", SvkExportOptions { ply_degree: 5, ..zeros() }, SvkStatus::Argument, "ply_degree"),
    ] {
        assert_eq!(export(name, options).0, status, "{reason}");
        assert!(scene_error(scene).contains(reason), "{}", scene_error(scene));
    }
    assert!(std::fs::read(folder.path().join("a.ply")).unwrap() == kept);
    assert!(!folder.path().join("d.ply").exists() && !folder.path().join("d.spz").exists());
    assert_eq!(export("cameras.json", zeros()).0, SvkStatus::Ok);
    assert_eq!(json(&folder.path().join("cameras.json"))["frames"].as_array().unwrap().len(), 2);
    unsafe {
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

#[test]
fn meshes_have_parts_and_colliders() {
    let folder = tempfile::tempdir().unwrap();
    let context = context(None);
    let scene = loaded(context, &fixture::view::breakfast(folder.path()));
    let texts = ["0.02", "lemon\nblue mug\n", "wide"].map(|text| CString::new(text).unwrap());
    let [voxel, names, wrong] = texts.each_ref().map(|text| text.as_ptr());
    let mesh = |name: &str, options: SvkMeshOptions| {
        let mut info: SvkMeshInfo = zeros();
        let file = text(&folder.path().join(name));
        let status = unsafe { svk_scene_mesh(scene, file.as_ptr(), &options, &mut info) };
        (status, info)
    };
    let coarse = SvkMeshOptions { voxel, triangles: 5000, ..zeros() };
    let by_object = SvkMeshOptions { by_object: 1, vocabulary: names, collider: 1, ..coarse };
    let (status, info) = mesh("scene.glb", by_object);
    assert_eq!(status, SvkStatus::Ok, "{}", scene_error(scene));
    let figures = (info.triangles > 1000 && info.triangles <= 5000, info.upright, info.metric);
    assert_eq!((figures, info.parts > 3), ((true, 1, 0), true));
    assert!((info.voxel - 0.02).abs() < 1e-6 && info.area > 0.1 && info.moved < 0.1, "{}", info.voxel);
    let root = glb(&folder.path().join("scene.glb"));
    let nodes: Vec<&str> =
        root["nodes"].as_array().unwrap().iter().filter_map(|n| n["name"].as_str()).collect();
    let colliders = nodes.iter().filter(|name| name.ends_with("_collider")).count();
    assert!(colliders as u64 == info.parts && nodes.contains(&"rest"), "{nodes:?}");

    for (name, options, status, reason) in [
        ("scene.glb", coarse, SvkStatus::Input, "scene.glb"),
        ("a.ply", SvkMeshOptions { collider: 1, ..coarse }, SvkStatus::Input, "collider"),
        ("a.stl", coarse, SvkStatus::Input, ".glb, .ply or .obj"),
        ("a.ply", SvkMeshOptions { vocabulary: names, ..coarse }, SvkStatus::Input, "vocabulary"),
        ("a.ply", SvkMeshOptions { voxel: wrong, ..coarse }, SvkStatus::Argument, "SvkMeshOptions.voxel"),
        ("a.ply", SvkMeshOptions { collider: 3, ..coarse }, SvkStatus::Argument, "SvkCollider"),
        ("a.glb", SvkMeshOptions { progress: Some(stop), ..coarse }, SvkStatus::Cancelled, ""),
    ] {
        assert_eq!(mesh(name, options).0, status, "{reason}");
        assert!(scene_error(scene).contains(reason), "{}", scene_error(scene));
    }
    let (status, raw) = mesh("raw.ply", SvkMeshOptions { raw: 1, ..coarse });
    assert_eq!((status, raw.upright, raw.parts), (SvkStatus::Ok, 0, 1));
    assert!(std::fs::read(folder.path().join("raw.ply")).unwrap().starts_with(b"ply\n"));
    assert!(!folder.path().join("a.ply").exists() && !folder.path().join("a.glb").exists());
    unsafe {
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

#[test]
fn things_are_written_with_files() {
    let folder = tempfile::tempdir().unwrap();
    let context = context(None);
    let scene = loaded(context, &fixture::view::breakfast(folder.path()));
    let names = CString::new("lemon\nblue mug").unwrap();
    let twice = CString::new("lemon\nlemon").unwrap();
    let (out, mut count) = (folder.path().join("things"), 0);
    let mut write = |options: SvkObjectsOptions| unsafe {
        svk_scene_objects(scene, text(&out).as_ptr(), &options, &mut count)
    };
    let given = SvkObjectsOptions { vocabulary: names.as_ptr(), ..zeros() };
    assert_eq!(write(given), SvkStatus::Ok, "{}", scene_error(scene));
    for (options, status, reason) in [
        (given, SvkStatus::Input, "things"),
        (SvkObjectsOptions { vocabulary: twice.as_ptr(), ..given }, SvkStatus::Input, "twice"),
        (SvkObjectsOptions { format: twice.as_ptr(), ..given }, SvkStatus::Input, "no format"),
        (SvkObjectsOptions { pieces: 4, ..given }, SvkStatus::Argument, "SvkPieces"),
        (SvkObjectsOptions { min_share: 2.0, ..given }, SvkStatus::Argument, "min_share"),
    ] {
        assert_eq!(write(options), status, "{reason}");
        assert!(scene_error(scene).contains(reason), "{}", scene_error(scene));
    }
    let list = json(&out.join("objects.json"));
    let list = list["objects"].as_array().unwrap();
    assert_eq!(list.len(), count);
    let files: Vec<&Value> = list.iter().filter(|o| !o["file"].is_null()).collect();
    assert!(files.len() > 5, "{}", files.len());
    for thing in &files {
        let splats = gaussians::read(&out.join(thing["file"].as_str().unwrap())).unwrap().0;
        assert_eq!(thing["splats"], splats.len());
    }
    assert!(files.iter().all(|o| o["level"] == "o"));
    assert!(files.iter().any(|o| o["names"][0]["text"] == "lemon"));
    assert!(["objects.csv", "scene.glb", "scene.ply"].iter().all(|name| out.join(name).is_file()));
    unsafe {
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

#[test]
fn label_gives_splats_language() {
    let folder = tempfile::tempdir().unwrap();
    let (images, cameras, _) = fixture::small_views();
    let foreign = folder.path().join("foreign.ply");
    std::fs::copy(fixture::scene().join("point_cloud.ply"), &foreign).unwrap();
    let context = context(None);
    let (out, images, cameras) = (folder.path().join("labelled"), text(&images), text(&cameras));
    let place = text(&out);
    let label = |options: SvkLabelOptions| {
        let mut scene = null_mut();
        let status = unsafe { svk_label(context, text(&foreign).as_ptr(), &options, &mut scene) };
        (status, scene, error_text(|out, bytes| unsafe { svk_context_error(context, out, bytes) }))
    };
    let posed = SvkLabelOptions { images: images.as_ptr(), cameras: cameras.as_ptr(), ..zeros() };
    for (options, status, reason) in [
        (SvkLabelOptions { images: images.as_ptr(), ..zeros() }, SvkStatus::Argument, "images"),
        (SvkLabelOptions { views: 2, ..zeros() }, SvkStatus::Argument, "views"),
        (SvkLabelOptions { synthesize: 4, ..posed }, SvkStatus::Argument, "synthesize"),
        (SvkLabelOptions { synthesize: 201, ..zeros() }, SvkStatus::Argument, "synthesize"),
        (SvkLabelOptions { cameras: images.as_ptr(), ..posed }, SvkStatus::Input, "cameras"),
        (SvkLabelOptions { progress: Some(stop), out: place.as_ptr(), ..posed }, SvkStatus::Cancelled, ""),
    ] {
        let (found, scene, error) = label(options);
        assert!(found == status && scene.is_null() && error.contains(reason), "{found:?} {reason} {error}");
    }
    assert!(!out.exists());
    let (status, scene, error) = label(SvkLabelOptions { out: place.as_ptr(), ..posed });
    assert_eq!(status, SvkStatus::Ok, "{error}");
    let given = gaussians::read(&foreign).unwrap().0;
    assert_eq!(means(scene), given.means.as_flattened());
    assert!(info(scene).codes.iter().any(|codes| *codes > 0) && info(scene).cameras == 2);
    assert!(scene_dir::load(&out).unwrap().language.is_some());
    // Without a place the scene stays in memory, until it is saved; without photos it has renders.
    let (status, kept, error) = label(SvkLabelOptions { synthesize: 2, max_size: 160, ..zeros() });
    assert!(status == SvkStatus::Ok && info(kept).cameras == 2, "{error}");
    let things = text(&folder.path().join("things"));
    let list = || unsafe { svk_scene_objects(kept, things.as_ptr(), null(), null_mut()) };
    assert_eq!(list(), SvkStatus::Input);
    assert!(scene_error(kept).contains("save it first"), "{}", scene_error(kept));
    let (ply, model) = (text(&folder.path().join("kept.ply")), CString::new("colmap").unwrap());
    let export =
        |options: SvkExportOptions| unsafe { svk_scene_export(kept, ply.as_ptr(), &options, null_mut(), 0) };
    assert_eq!(export(SvkExportOptions { format: model.as_ptr(), ..zeros() }), SvkStatus::Input);
    assert!(scene_error(kept).contains("save the scene first"), "{}", scene_error(kept));
    assert_eq!(export(SvkExportOptions { raw: 1, guessed: 1, ..zeros() }), SvkStatus::Ok);
    let written = gaussians::read(&folder.path().join("kept.ply")).unwrap().0;
    assert_eq!(written.means, given.means);
    let saved = text(&folder.path().join("saved"));
    assert_eq!(unsafe { svk_scene_save(kept, saved.as_ptr(), 0) }, SvkStatus::Ok);
    assert_eq!(list(), SvkStatus::Ok, "{}", scene_error(kept));
    unsafe {
        svk_scene_destroy(scene);
        svk_scene_destroy(kept);
        svk_context_destroy(context);
    }
}
