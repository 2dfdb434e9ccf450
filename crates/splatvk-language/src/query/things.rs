//! The things of a scene, without a text: connected groups of the splats of every code on every
//! level, and the objects that their parts make (docs/use/objects.md).
use super::instances::{Instance, Places};
use crate::scene::LEVEL_NAMES;
use std::collections::BTreeMap;

/// Level of objects, beside those of codes. No splat is in two of them.
pub const OBJECTS: usize = LEVEL_NAMES.len();
/// Names of the levels of things, in the order of their index.
pub const LEVELS: [&str; OBJECTS + 1] = ["s", "m", "l", "o"];
/// All levels, coarsest first.
const COARSEST_FIRST: [usize; LEVELS.len()] = [2, OBJECTS, 1, 0];
/// Levels whose things can be objects, best first: masks of parts separate things, those of wholes
/// join them with their table.
const OBJECT_LEVELS: [usize; LEVEL_NAMES.len()] = [1, 2, 0];
/// Index of no thing.
const NONE: u32 = u32::MAX;

/// A thing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Thing {
    /// Level, index of [`LEVELS`].
    pub level: usize,
    /// Its code of the level; for an object that of its largest part.
    pub code: usize,
    /// Index among the groups of the code, heaviest first.
    pub group: usize,
    /// Splats and boxes; `share` is that of the opacity of the whole scene.
    pub instance: Instance,
    /// Index of the thing of a coarser level that contains most of it.
    pub parent: Option<usize>,
    /// Whether it is an object whose parts lie on one large plane, such as a table or a wall.
    pub is_surface: bool,
}

impl Thing {
    /// Number that is unique within the level: `65536 · group + code + 1`. It stays the same while
    /// the codes do, also when photos join the scene; 0 is no thing.
    pub fn number(&self) -> u32 {
        ((self.group as u32) << 16) + self.code as u32 + 1
    }

    /// The number for people: "5", and "5.2" for the second group of a code.
    pub fn label(&self) -> String {
        match self.group {
            0 => (self.code + 1).to_string(),
            group => format!("{}.{}", self.code + 1, group + 1),
        }
    }

    /// Identifier, unique in the scene: level and label, "o3" or "l3.2".
    pub fn id(&self) -> String {
        format!("{}{}", LEVELS[self.level], self.label())
    }
}

impl Places {
    /// Things with at least `least_share` of the opacity of the scene: coarsest level first, on each
    /// level in the order of their codes. No splat is in two things of a level.
    pub fn things(&self, least_share: f64) -> Vec<Thing> {
        let mut lists: Vec<Vec<Thing>> =
            (0..LEVEL_NAMES.len()).map(|level| self.groups_of_codes(level)).collect();
        lists.push(self.objects_of(&lists[self.code_level(OBJECTS)]));
        let mut things: Vec<Thing> = Vec::new();
        // Per coarser level the index of the thing of every splat.
        let mut owners: Vec<Vec<u32>> = Vec::new();
        for level in COARSEST_FIRST {
            let mut owner = vec![NONE; self.weights().len()];
            let list = std::mem::take(&mut lists[level]).into_iter();
            for mut thing in list.filter(|thing| thing.instance.share >= least_share) {
                thing.parent = owners.iter().rev().find_map(|o| self.container(&thing.instance, o));
                thing.instance.splats.iter().for_each(|i| owner[*i] = things.len() as u32);
                things.push(thing);
            }
            owners.push(owner);
        }
        things
    }

    /// The objects, in the order of the codes of their largest parts: every group of a code, with
    /// those on the same surface or inside of it.
    pub fn objects(&self) -> Vec<Thing> {
        self.objects_of(&self.groups_of_codes(self.code_level(OBJECTS)))
    }

    fn objects_of(&self, parts: &[Thing]) -> Vec<Thing> {
        let surfaces = self.surfaces(parts);
        let enclosing = self.enclosing(parts, |part| surfaces[part].is_some());
        let mut members: BTreeMap<(Option<usize>, usize), Vec<usize>> = BTreeMap::new();
        for (part, surface) in surfaces.into_iter().enumerate() {
            let owner = if surface.is_some() { 0 } else { enclosing[part] };
            members.entry((surface, owner)).or_default().push(part);
        }
        let joined = |((surface, _), members): ((Option<usize>, usize), Vec<usize>)| {
            let share = |part: &usize| parts[*part].instance.share;
            let largest = members.iter().copied().rev().max_by(|a, b| share(a).total_cmp(&share(b)))?;
            let mut object =
                Thing { level: OBJECTS, is_surface: surface.is_some(), ..parts[largest].clone() };
            if members.len() > 1 {
                let splats = members.iter().flat_map(|part| &parts[*part].instance.splats);
                let mut splats: Vec<usize> = splats.copied().collect();
                splats.sort_unstable();
                let share = members.iter().map(share).sum();
                object.instance = self.instance(splats, share, self.code_level(OBJECTS));
            }
            Some(object)
        };
        let mut objects: Vec<Thing> = members.into_iter().filter_map(joined).collect();
        objects.sort_by_key(|object| (object.code, object.group));
        objects
    }

    /// Level of the codes of the things of a level.
    pub fn code_level(&self, level: usize) -> usize {
        let counts: Vec<usize> = self.lists().iter().map(|list| list.counts().count()).collect();
        code_level(level, &counts)
    }

    /// Connected groups of the splats of every code of a level.
    fn groups_of_codes(&self, level: usize) -> Vec<Thing> {
        let (Some(lists), all) = (self.lists().get(level), self.weight_of_all()) else { return Vec::new() };
        let of_code = |code: usize| {
            let splats = lists.splats_of(std::iter::once(code));
            let groups = self.instances(&splats, level).into_iter().enumerate();
            groups.map(move |(group, mut instance)| {
                instance.share = self.weight(&instance.splats) / all;
                Thing { level, code, group, instance, ..Thing::default() }
            })
        };
        (0..lists.counts().count()).flat_map(of_code).collect()
    }

    /// Summed opacity of splats.
    fn weight(&self, splats: &[usize]) -> f64 {
        splats.iter().map(|i| self.weights()[*i]).sum()
    }

    fn weight_of_all(&self) -> f64 {
        self.weights().iter().sum()
    }

    /// Thing that contains more than half of the weight of an instance.
    fn container(&self, instance: &Instance, owner: &[u32]) -> Option<usize> {
        let mut shares: BTreeMap<u32, f64> = BTreeMap::new();
        for splat in &instance.splats {
            *shares.entry(owner[*splat]).or_default() += self.weights()[*splat];
        }
        let half = 0.5 * self.weight(&instance.splats);
        let most = shares.into_iter().find(|(thing, share)| *thing != NONE && *share > half);
        most.map(|(thing, _)| thing as usize)
    }
}

/// Level of the codes of the things of a level, by the number of codes of each level.
pub fn code_level(level: usize, codes: &[usize]) -> usize {
    let has_codes = |level: &usize| codes.get(*level).is_some_and(|count| *count > 0);
    match level {
        OBJECTS => OBJECT_LEVELS.into_iter().find(has_codes).unwrap_or(0),
        own => own,
    }
}

/// Number of the thing of every splat on a level, [splats]; 0 for splats of none.
pub fn numbers<'a>(things: impl Iterator<Item = &'a Thing>, level: usize, splats: usize) -> Vec<u32> {
    let mut numbers = vec![0; splats];
    for thing in things.filter(|thing| thing.level == level) {
        thing.instance.splats.iter().for_each(|i| numbers[*i] = thing.number());
    }
    numbers
}

#[cfg(test)]
mod tests {
    use super::super::testing::level_of;
    use super::*;
    use crate::scene::{LanguageField, LevelField, Splats};

    /// 20 splats of a cup at x = 0 and 20 of a second one at x = 5, on a table of 60 at y = 1, and a
    /// speck of two far away.
    fn scene() -> (Splats, LanguageField) {
        let row = |x: f32, y: f32, n: usize| (0..n).map(move |i| [x + 0.01 * i as f32, y, 1.0]);
        let means: Vec<[f32; 3]> = row(0.0, 0.0, 20)
            .chain(row(5.0, 0.0, 20))
            .chain(row(0.0, 1.0, 60))
            .chain(row(50.0, 9.0, 2))
            .collect();
        let count = means.len();
        let splats = Splats {
            means,
            log_scales: vec![[0.01f32.ln(); 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacity_logits: vec![2.0; count],
            ..Splats::default()
        };
        let level = |code_of: fn(usize) -> usize| level_of((0..count).map(code_of), 2);
        // Whole: cups are code 0, the table and the speck code 1. Part: halves of the first cup.
        let (whole, part) = (level(|i| usize::from(i >= 40)), level(|i| usize::from(i >= 10)));
        (splats, LanguageField { levels: vec![LevelField::default(), part, whole], space: String::new() })
    }

    #[test]
    fn things_are_connected_groups_of_codes() {
        let (splats, field) = scene();
        let things = Places::of(&splats, &field).things(0.05);
        let listed: Vec<_> =
            things.iter().map(|t| (t.level, t.number(), t.instance.splats.len(), t.parent)).collect();
        // Of the part level, code 1 is the rest: the second half of the first cup is too small
        // beside the table, of which it is no part. All lie on one plane: they are one object.
        assert_eq!(
            listed,
            [
                (2, 1, 20, None),
                (2, 65537, 20, None),
                (2, 2, 60, None),
                (3, 2, 100, Some(2)),
                (1, 1, 10, Some(3)),
                (1, 2, 60, Some(3)),
                (1, 65538, 20, Some(3)),
                (1, 131074, 10, Some(3))
            ]
        );
        let share = things[2].instance.share;
        assert!((share - 60.0 / 102.0).abs() < 1e-9, "{share}");
    }

    #[test]
    fn every_splat_has_one_number() {
        let (splats, field) = scene();
        let things = Places::of(&splats, &field).things(0.05);
        let numbers = numbers(things.iter(), 2, splats.len());
        assert_eq!((numbers[0], numbers[20], numbers[40], numbers[101]), (1, 65537, 2, 0));
        assert!(Places::of(&splats, &field).things(0.3).iter().all(|t| t.instance.share >= 0.3));
    }
}
