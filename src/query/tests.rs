use super::*;
use crate::scene::LevelField;

fn unit(v: &[f32]) -> Vec<f32> {
    let n = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    v.iter().map(|x| x / n).collect()
}

/// Three codes in a 4-dimensional space: axes 0, 1 and a near-copy of axis 0; canonical = axis 3.
fn field() -> LanguageField {
    let rows = [unit(&[1.0, 0.0, 0.0, 0.3]), unit(&[0.0, 1.0, 0.0, 0.3]), unit(&[0.95, 0.0, 0.1, 0.3])];
    let codebook = Codebook {
        embedding_dim: 4,
        code_dim: 3,
        embeddings: rows.concat(),
        codes: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        weights: vec![1.0; 3],
        members: vec![Vec::new(); 3],
        min_chord: 1.4,
    };
    let level = LevelField { codebook, ..LevelField::default() };
    LanguageField { levels: vec![LevelField::default(), level.clone(), level], space: "test".into() }
}

fn query(v: &[f32]) -> TextQuery {
    TextQuery {
        text: "q".into(),
        embedding: unit(v),
        canonicals: vec![0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.6, 0.8],
    }
}

/// 60×40: code 1 everywhere, code 0 in a square, code 2 right of it, void in the first column.
fn frame() -> Plane<i32> {
    let mut map = Plane::filled(60, 40, 1);
    for y in 0..40 {
        for x in 0..60 {
            if x == 0 {
                map.data[y * 60 + x] = -1;
            } else if (10..25).contains(&y) && (20..44).contains(&x) {
                map.data[y * 60 + x] = if x < 36 { 0 } else { 2 };
            }
        }
    }
    map
}

#[test]
fn relevancy_is_the_worst_pairwise_softmax() {
    let (field, q) = (field(), query(&[1.0, 0.2, 0.0, 0.1]));
    let got = code_relevancy(&field.levels[1].codebook, &q).unwrap();
    for (k, phi) in field.levels[1].codebook.embeddings.chunks(4).enumerate() {
        let dot = |n: &[f32]| phi.iter().zip(n).map(|(a, b)| (a * b) as f64).sum::<f64>();
        let pos = (10.0 * dot(&q.embedding)).exp();
        let expected =
            q.canonicals.chunks(4).map(|n| pos / (pos + (10.0 * dot(n)).exp())).fold(1.0, f64::min);
        assert!((got[k] as f64 - expected).abs() < 1e-5);
    }
    assert!(code_relevancy(&field.levels[0].codebook, &q).unwrap().is_empty());
    let wrong = TextQuery { embedding: vec![1.0; 3], ..q };
    assert!(code_relevancy(&field.levels[1].codebook, &wrong).unwrap_err().to_string().contains("3 values"));
}

#[test]
fn the_mask_follows_code_borders_exactly() {
    let maps = vec![Plane::filled(60, 40, -1), frame(), frame()];
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap();
    assert_eq!(r.level, 1, "ties go to the finer level, empty levels are skipped");
    for (p, &k) in maps[1].data.iter().enumerate() {
        assert_eq!(r.mask.data[p], k == 0 || k == 2, "pixel {p}");
    }
    assert!(maps[1].at(r.location.0, r.location.1) != 1 && r.found && r.score > 0.95);
    assert_eq!(r.relevancy.data.len(), 2400);
    // raising the bar to the very best code leaves out its near-copy
    let strict = QueryOptions { mask: MaskRule::Codes(1.0), ..QueryOptions::default() };
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &strict).unwrap();
    assert!(maps[1].data.iter().zip(&r.mask.data).all(|(&k, &m)| m == (k == 0)));
}

#[test]
fn what_no_code_means_is_not_found() {
    let maps = vec![Plane::filled(60, 40, -1), frame(), frame()];
    let r = answer(&maps, &field(), &query(&[0.0, 0.0, -1.0, 0.0]), &QueryOptions::default()).unwrap();
    assert!(!r.found && r.score < 0.5);
    let empty = LanguageField::default();
    assert!(answer(&maps, &empty, &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).is_err());
}

#[test]
fn an_all_void_frame_has_an_empty_mask() {
    let maps = vec![Plane::filled(60, 40, -1); 3];
    let r = answer(&maps, &field(), &query(&[1.0, 0.0, 0.0, 0.0]), &QueryOptions::default()).unwrap();
    assert!(!r.found && r.mask.data.iter().all(|m| !m));
}
