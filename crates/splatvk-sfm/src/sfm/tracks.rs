//! Tracks from the matches of all pairs.
use super::model::TrackElement;

/// A match between two keypoints, each by view and index.
#[derive(Clone, Copy, Debug)]
pub(super) struct KeypointMatch {
    pub(super) first: (usize, usize),
    pub(super) second: (usize, usize),
    pub(super) quality: f64,
}

/// Observations of one point: at most one per view, at least two.
pub(super) type TrackElements = Vec<TrackElement>;

/// Joins links into tracks, best links first; a link that would put two keypoints of one view into
/// a track is skipped. `points[view][keypoint]` are all keypoints.
pub(super) fn join(links: &mut [KeypointMatch], points: &[Vec<TrackElement>]) -> Vec<TrackElements> {
    links.sort_by(|a, b| {
        b.quality.total_cmp(&a.quality).then(a.first.cmp(&b.first)).then(a.second.cmp(&b.second))
    });
    let starts: Vec<usize> = points
        .iter()
        .scan(0, |sum, p| {
            let start = *sum;
            *sum += p.len();
            Some(start)
        })
        .collect();
    let total = points.iter().map(Vec::len).sum();
    let mut parent: Vec<usize> = (0..total).collect();
    let mut members: Vec<Vec<(usize, usize)>> =
        points.iter().enumerate().flat_map(|(v, p)| (0..p.len()).map(move |k| vec![(v, k)])).collect();
    for link in links.iter() {
        let a = find_root(&mut parent, starts[link.first.0] + link.first.1);
        let b = find_root(&mut parent, starts[link.second.0] + link.second.1);
        if a == b || members[a].iter().any(|m| members[b].iter().any(|n| n.0 == m.0)) {
            continue;
        }
        let moved = std::mem::take(&mut members[b]);
        members[a].extend(moved);
        parent[b] = a;
    }
    members
        .into_iter()
        .filter(|m| m.len() >= 2)
        .map(|mut m| {
            m.sort_unstable();
            m.into_iter().map(|(v, k)| points[v][k]).collect()
        })
        .collect()
}

/// Root of the union–find tree of `i`, with path halving.
fn find_root(parent: &mut [usize], mut i: usize) -> usize {
    while parent[i] != i {
        parent[i] = parent[parent[i]];
        i = parent[i];
    }
    i
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn join_skips_conflicting_links() {
        let keypoint = |view: usize, k: usize| TrackElement {
            view,
            pixel: glam::DVec2::new(view as f64, k as f64),
            sigma: 1.0,
            detector: 0,
        };
        let points: Vec<Vec<TrackElement>> =
            (0..3).map(|v| (0..2).map(|k| keypoint(v, k)).collect()).collect();
        let link = |a, b, quality| KeypointMatch { first: a, second: b, quality };
        let mut links = [
            link((1, 0), (2, 0), 0.5),
            // Would join keypoints 0 and 1 of view 2.
            link((0, 0), (2, 1), 0.1),
            link((0, 0), (1, 0), 0.9),
        ];
        let tracks = join(&mut links, &points);
        assert_eq!(tracks, [vec![points[0][0], points[1][0], points[2][0]]]);
    }
}
