//! Edits of scene directories.
use super::boundary::{self, CallError, LastError, bad_argument, guard, guard_number};
use super::context::SvkContext;
use super::options::*;
use super::scene::SvkScene;
use super::types::SvkStatus;
use crate::format::edits::{Combine, Operation, Pick, Term};
use crate::run::Machine;
use crate::run::edit::Editor;
use crate::run::edit::expression::{colour, displacement, terms};
use crate::run::live::LiveScene;
use crate::sync::lock;
use std::ffi::c_char;
use std::sync::Mutex;

/// A scene directory that is being edited.
pub struct SvkEditor {
    editor: Mutex<Editor>,
    machine: Machine,
    /// Reasons of the last selection, one a line.
    doubts: LastError,
    error: LastError,
}

/// Opens a scene directory for edits; on failure `*editor` is NULL and the context keeps the error
/// text. Edits are kept in edits.json of the scene; its other files stay as they are, and scenes
/// that are loaded later contain the edits. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_open(
    context: *mut SvkContext,
    path: *const c_char,
    editor: *mut *mut SvkEditor,
) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(context) = (unsafe { boundary::handle(context, "context") }) else { return SvkStatus::Argument };
    guard(&context.error, || {
        // SAFETY: per the header.
        let (slot, path) = unsafe { (boundary::slot(editor)?, boundary::path(path, "path")?) };
        let Some(path) = path else { return bad_argument("the path is null") };
        let machine = context.machine();
        let editor = Mutex::new(Editor::open(&path, &machine)?);
        let (doubts, error) = (LastError::default(), LastError::default());
        *slot = Box::into_raw(Box::new(SvkEditor { editor, machine, doubts, error }));
        Ok(())
    })
}

/// Destroys an editor; the edits stay in the scene. NULL is allowed. No other call with this editor
/// may be running.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_destroy(editor: *mut SvkEditor) {
    if !editor.is_null() {
        // SAFETY: made by Box::into_raw, and not used any more.
        guard_number(|| drop(unsafe { Box::from_raw(editor) }));
    }
}

/// Copies the error text of the last failed call with this editor, in any thread, into `text` as
/// svk_context_device_name does; returns the number of bytes that the whole text needs.
/// Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_error(
    editor: *const SvkEditor,
    text: *mut c_char,
    bytes: usize,
) -> usize {
    // SAFETY: per the header.
    guard_number(|| unsafe { editor.as_ref().map_or(0, |e| e.error.copy(text, bytes)) })
}

/// Selects splats of the edited scene, makes one edit of them and writes edits.json, whole or not
/// at all; fills `edited`, which may be NULL.
///
/// A selection that may be wrong, and that `force` does not allow, is SVK_STATUS_DOUBTFUL: nothing
/// is changed, `edited` is filled, and svk_editor_doubts returns the reasons. A word that the scene
/// does not contain, a selection of nothing and an edit that leaves no splat are SVK_STATUS_INPUT.
/// Thread-safe; calls with one editor are serialised. A list that another program changed
/// meanwhile is refused; a new editor has it.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_edit(
    editor: *mut SvkEditor,
    edit: *const SvkEdit,
    edited: *mut SvkEdited,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(editor, |handle| {
            let mut editor = lock(&handle.editor);
            handle.doubts.set(String::new());
            let edit = boundary::read(edit)?;
            let (operation, terms) = operation(&edit, &editor)?;
            let selected = editor.select(&terms)?;
            let (splats, doubts) = (selected.count as u64, selected.doubts.len() as u64);
            let outcome = SvkEdited { size: 0, splats, share: selected.share, doubts, along: 0 };
            let fill = |outcome: &SvkEdited| {
                if edited.is_null() { Ok(()) } else { boundary::write(edited, outcome) }
            };
            fill(&outcome)?;
            handle.doubts.set(selected.doubts.join("\n"));
            if edit.dry_run != 0 {
                return Ok(());
            }
            if let (Some(doubt), 0) = (selected.doubts.first(), edit.force) {
                return Err(CallError::Doubtful(format!(
                    "{doubt}; nothing is changed: SvkEdit.force edits anyway"
                )));
            }
            let along = editor.push(vec![(operation, selected)])? as u64;
            fill(&SvkEdited { along, ..outcome })
        })
    }
}

/// Copies the reasons why the selection of the last svk_editor_edit may be wrong into `text`, which
/// has `bytes` bytes: one line each, truncated where they do not fit and always ended with a zero
/// byte; empty where it is sure. Returns the number of bytes that the whole text needs.
/// Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_doubts(
    editor: *const SvkEditor,
    text: *mut c_char,
    bytes: usize,
) -> usize {
    // SAFETY: per the header.
    guard_number(|| unsafe { editor.as_ref().map_or(0, |e| e.doubts.copy(text, bytes)) })
}

/// Undoes the last `most` edits. `*undone`, which may be NULL, receives how many there were: 0 is no
/// failure. Thread-safe; calls with one editor are serialised.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_undo(
    editor: *mut SvkEditor,
    most: usize,
    undone: *mut usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe { step(editor, most, undone, Editor::undo) }
}

/// Applies the `most` edits that were undone last; a new edit ends what can be redone. `*redone`,
/// which may be NULL, receives how many there were: 0 is no failure. Thread-safe; calls with one
/// editor are serialised.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_redo(
    editor: *mut SvkEditor,
    most: usize,
    redone: *mut usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe { step(editor, most, redone, Editor::redo) }
}

/// Fills `edits` with the number of edits of the scene, and `undone` with the number of those that
/// can be redone; both may be NULL. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_count(
    editor: *const SvkEditor,
    edits: *mut usize,
    undone: *mut usize,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(editor, |handle| {
            let editor = lock(&handle.editor);
            let list = editor.list();
            for (place, count) in [(edits, list.edits.len()), (undone, list.undone.len())] {
                if let Some(place) = place.as_mut() {
                    *place = count;
                }
            }
            Ok(())
        })
    }
}

/// Makes a scene of the present state; later edits do not change it. On failure `*scene` is NULL
/// and the editor keeps the error text. Thread-safe.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_editor_scene(editor: *mut SvkEditor, scene: *mut *mut SvkScene) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(editor, |handle| {
            let slot = boundary::slot(scene)?;
            let edited = lock(&handle.editor).scene().clone();
            let (device, registry) = (handle.machine.gpu()?, handle.machine.registry()?);
            *slot = SvkScene::boxed(LiveScene::loaded(&device, edited, &registry)?);
            Ok(())
        })
    }
}

/// Runs the body of a function with an editor.
unsafe fn with(
    editor: *const SvkEditor,
    body: impl FnOnce(&SvkEditor) -> Result<(), CallError>,
) -> SvkStatus {
    // SAFETY: per the header.
    match unsafe { editor.as_ref() } {
        Some(editor) => guard(&editor.error, || body(editor)),
        None => SvkStatus::Argument,
    }
}

/// Steps through the list at most `most` times.
unsafe fn step(
    editor: *const SvkEditor,
    most: usize,
    done: *mut usize,
    step: fn(&mut Editor) -> crate::Result<bool>,
) -> SvkStatus {
    // SAFETY: per the header.
    unsafe {
        with(editor, |handle| {
            let mut editor = lock(&handle.editor);
            let mut count = 0;
            while count < most && step(&mut editor)? {
                count += 1;
            }
            if let Some(done) = done.as_mut() {
                *done = count;
            }
            Ok(())
        })
    }
}

/// Operation and selection of an edit of the host.
unsafe fn operation(edit: &SvkEdit, editor: &Editor) -> Result<(Operation, Vec<Term>), CallError> {
    let scene = editor.scene();
    // SAFETY: texts per the header.
    let text = |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkEdit.{field}")) };
    let selection = text(edit.selection, "selection")?;
    if edit.operation == SvkOperation::Floaters as u32 {
        if selection.is_some() {
            return bad_argument(
                "SvkEdit.selection: floaters are selected by their own rule; set it to NULL",
            );
        }
        let pick = Pick::Floaters { thorough: edit.thorough != 0 };
        return Ok((Operation::Delete {}, vec![Term { combine: Combine::Add, pick }]));
    }
    let Some(selection) = selection else { return bad_argument("SvkEdit.selection is null") };
    let operation = match edit.operation {
        0 => Operation::Delete {},
        1 => Operation::Isolate {},
        2 => match text(edit.colour, "colour")? {
            Some(value) => Operation::Recolour { colour: colour(&value)? },
            None => return bad_argument("SvkEdit.colour is null"),
        },
        3 => match text(edit.by, "by")? {
            Some(value) => Operation::Move { by: displacement(&value, scene)? },
            None if edit.displacement.iter().all(|v| v.is_finite()) => {
                Operation::Move { by: edit.displacement }
            }
            None => return bad_argument("SvkEdit.displacement is not finite"),
        },
        other => return bad_argument(format!("SvkEdit.operation is {other}")),
    };
    Ok((operation, terms(&selection, scene, edit.grow as f32)?))
}
