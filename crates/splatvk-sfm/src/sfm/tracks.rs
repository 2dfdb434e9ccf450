//! Matches of all pairs, joined into tracks.
use super::model::Sighting;

/// A verified match between two keypoints; keypoints are numbered per view.
#[derive(Clone, Copy, Debug)]
pub(super) struct KeypointMatch {
    pub(super) first: (usize, usize),
    pub(super) second: (usize, usize),
    pub(super) quality: f64,
}

/// A scene point as the photos show it: at most once per view, at least twice.
pub(super) type Sightings = Vec<Sighting>;

/// Joins links into tracks, best links first; a link that would put two keypoints of one view into
/// a track is left out. `points[view][keypoint]` are all keypoints.
pub(super) fn join(links: &mut [KeypointMatch], points: &[Vec<Sighting>]) -> Vec<Sightings> {
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
        let a = root(&mut parent, starts[link.first.0] + link.first.1);
        let b = root(&mut parent, starts[link.second.0] + link.second.1);
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

fn root(parent: &mut [usize], mut i: usize) -> usize {
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
    fn chains_join_and_conflicts_lose_to_better_links() {
        let keypoint = |view: usize, k: usize| Sighting {
            view,
            pixel: glam::DVec2::new(view as f64, k as f64),
            sigma: 1.0,
            family: 0,
        };
        let points: Vec<Vec<Sighting>> = (0..3).map(|v| (0..2).map(|k| keypoint(v, k)).collect()).collect();
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
