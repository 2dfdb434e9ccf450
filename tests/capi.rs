//! The C header is up to date; the C functions handle names and settings. `tools/hosts` tests the
//! rest.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks)] // a panic is how a test fails
mod fixture;

use splatvk::capi::*;
use std::ffi::{CString, c_char, c_void};
use std::path::Path;
use std::ptr::{null, null_mut};

#[test]
fn header_matches_code() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut builder = cbindgen::Builder::new()
        .with_config(cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap());
    for part in ["context", "train", "scene", "render", "types"] {
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
