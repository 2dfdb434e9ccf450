use super::*;
use crate::scene::{LanguageField, LevelField, SH_C0, Seen};

/// A scene of splats in a row, with one feature each.
fn scene(count: usize) -> Scene {
    let splats = Splats {
        means: (0..count).map(|i| [i as f32, 0.0, 1.0]).collect(),
        log_scales: vec![[-3.0; 3]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![2.0; count],
        sh_degree: 1,
        sh: (0..12 * count).map(|i| 0.01 * i as f32).collect(),
        antialiased: false,
    };
    let level = LevelField { features: (0..count).map(|i| i as f32).collect(), ..LevelField::default() };
    Scene {
        backdrop: splats.picked(&[0]),
        seen: Seen { pixels: (0..count).map(|i| i as f32).collect() },
        language: Some(LanguageField { levels: vec![level], space: String::new() }),
        splats,
        ..Scene::default()
    }
}

fn edit(operation: Operation, rows: &[usize]) -> Edit {
    Edit { operation, selection: Vec::new(), splats: Rows::of(rows.iter().copied()) }
}

fn applied(scene: &Scene, edits: &[Edit]) -> Scene {
    let mut list = EditList::new(&scene.splats);
    edits.iter().for_each(|e| list.push(e.clone()));
    list.apply(scene.clone())
}

#[test]
fn rows_are_a_set() {
    let rows = Rows::of([9, 2, 2, 0]);
    let members: Vec<usize> = (0..20).filter(|i| rows.has(*i)).collect();
    assert_eq!((members, rows.count(), rows.end()), (vec![0, 2, 9], 3, 10));
    assert_eq!(serde_json::to_string(&rows).unwrap(), "\"BQI=\"");
    assert_eq!(serde_json::from_str::<Rows>("\"BQI=\"").unwrap(), rows);
    assert_eq!(Rows::default().end(), 0);
}

#[test]
fn deleted_splats_leave_holes() {
    let whole = scene(5);
    let after = applied(&whole, &[edit(Operation::Delete {}, &[1, 3])]);
    assert_eq!(after.splats, whole.splats.picked(&[0, 2, 4]));
    assert_eq!(after.seen.pixels, [0.0, 2.0, 4.0]);
    assert_eq!(after.language.unwrap().levels[0].features, [0.0, 2.0, 4.0]);
    let edits = after.edits.unwrap();
    assert_eq!((edits.count, &edits.rows[..]), (1, &[0, 2, 4][..]));
    assert_eq!(after.holes, whole.splats.picked(&[1, 3]).bare());
    assert!(edits.originals([1, 2]) == Rows::of([2, 4]) && after.backdrop == whole.backdrop);
}

#[test]
fn isolated_splats_stand_before_nothing() {
    let whole = scene(5);
    let edits = [edit(Operation::Delete {}, &[1]), edit(Operation::Isolate {}, &[1, 2])];
    let after = applied(&whole, &edits);
    // A deleted splat does not come back.
    assert_eq!(after.splats, whole.splats.picked(&[2]));
    assert!(after.backdrop.is_empty() && after.holes.is_empty());
}

#[test]
fn moved_splats_leave_holes_at_their_old_place() {
    let whole = scene(3);
    let after = applied(&whole, &[edit(Operation::Move { by: [0.0, 0.5, -1.0] }, &[2])]);
    assert_eq!(after.splats.means, [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.0, 0.5, 0.0]]);
    assert_eq!(after.holes.means, [[2.0, 0.0, 1.0]]);
}

#[test]
fn recoloured_splats_keep_their_shading() {
    let mut whole = scene(2);
    // Two greys of brightness 0.3 and 0.5.
    whole.splats.sh.fill(0.0);
    for (i, grey) in [0.3, 0.5].into_iter().enumerate() {
        whole.splats.sh[12 * i..12 * i + 3].fill((grey - 0.5) / SH_C0);
        whole.splats.sh[12 * i + 3..12 * i + 6].fill(0.05);
    }
    let after = applied(&whole, &[edit(Operation::Recolour { colour: [0.8, 0.2, 0.0] }, &[0, 1])]);
    // Mean 0.4: factors (0.3 + 0.1) / (0.4 + 0.1) and (0.5 + 0.1) / 0.5.
    for (i, factor) in [0.8, 1.2].into_iter().enumerate() {
        let row = &after.splats.sh[12 * i..12 * i + 12];
        for (k, target) in [0.8, 0.2, 0.0].into_iter().enumerate() {
            assert!((0.5 + SH_C0 * row[k] - factor * target).abs() < 1e-5, "{row:?}");
            assert!((row[3 + k] - 0.05 * target / 0.5).abs() < 1e-6, "{row:?}");
        }
    }
    assert!(after.holes.is_empty());
}

#[test]
fn undo_of_every_edit_is_the_reconstruction() {
    let whole = scene(4);
    let mut list = EditList::new(&whole.splats);
    let operations = [
        Operation::Delete {},
        Operation::Move { by: [1.0, 0.0, 0.0] },
        Operation::Recolour { colour: [1.0, 0.0, 0.0] },
        Operation::Isolate {},
    ];
    let mut states = vec![list.apply(whole.clone())];
    for (k, operation) in operations.into_iter().enumerate() {
        list.push(edit(operation, &[k, (k + 1) % 4]));
        states.push(list.apply(whole.clone()));
    }
    let same = |a: &Scene, b: &Scene| a.splats == b.splats && a.edits == b.edits && a.seen == b.seen;
    for state in states.iter().rev().skip(1) {
        assert!(list.undo() && same(&list.apply(whole.clone()), state));
    }
    assert!(!list.undo());
    for state in &states[1..] {
        assert!(list.redo() && same(&list.apply(whole.clone()), state));
    }
    assert!(!list.redo() && list.undo());
    list.push(edit(Operation::Delete {}, &[0]));
    assert!(list.undone.is_empty());
}

#[test]
fn lists_of_other_scenes_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let whole = Scene { path: folder.path().into(), ..scene(4) };
    let splats = whole.splats.clone();
    assert_eq!(EditList::read(folder.path(), &splats).unwrap(), EditList::new(&splats));
    let mut list = EditList::new(&splats);
    let pick = Pick::Word { text: "mug".into(), grow: 0.25 };
    let selection = vec![Term { combine: Combine::Intersect, pick }];
    list.push(Edit { operation: Operation::Delete {}, selection, splats: Rows::of([3]) });
    list.replace(&EditList::new(&splats), &whole).unwrap();
    assert_eq!(EditList::read(folder.path(), &splats).unwrap(), list);
    let error = list.replace(&EditList::new(&splats), &whole).unwrap_err();
    assert!(error.to_string().contains("another program"), "{error}");

    let refusal = |splats: &Splats| EditList::read(folder.path(), splats).unwrap_err();
    assert!(refusal(&scene(3).splats).to_string().contains("another reconstruction"));
    let mut moved = splats.clone();
    moved.means[0][0] += 1.0;
    assert!(refusal(&moved).to_string().contains("another reconstruction"));
    let write = |list: &EditList| write_json(&folder.path().join(FILE), list).unwrap();
    list.edits[0].splats = Rows::of([4]);
    write(&list);
    assert!(refusal(&splats).to_string().contains("selects splat 4, and the scene has 4"));
    write(&EditList { version: VERSION + 1, ..list });
    let error = refusal(&splats);
    assert!(error.exit_code() == 2 && error.to_string().contains("--ignore-edits"), "{error}");
    std::fs::write(folder.path().join(FILE), "{").unwrap();
    assert_eq!(refusal(&splats).exit_code(), 2);
}
