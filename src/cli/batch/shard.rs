//! Part of a batch for one of several machines.
use std::str::FromStr;

/// Part `index` of `count`: the rows whose number leaves this remainder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// From 0.
    pub index: usize,
    /// Number of parts.
    pub count: usize,
}

/// Index and number of an array job: environment variables of Slurm, Kubernetes, AWS Batch and
/// Google Batch. Kubernetes states no number of parts.
const ARRAYS: [(&str, &str); 4] = [
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("JOB_COMPLETION_INDEX", ""),
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE"),
    ("BATCH_TASK_INDEX", "BATCH_TASK_COUNT"),
];

impl Shard {
    /// Whether a row is in the part.
    pub fn has(&self, row: usize) -> bool {
        row % self.count == self.index
    }

    /// `I/N`, `auto`, or `auto/N` where the array job states no number.
    fn read(text: &str, variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard, String> {
        let (index, count) = match text.split_once('/') {
            Some((index, count)) => (index, Some(number(count)?)),
            None => (text, None),
        };
        let shard = if index == "auto" {
            Shard::of_array(count, variable)?
        } else {
            let count = count.ok_or("give I/N, I from 0, or auto in an array job")?;
            Shard { index: number(index)?, count }
        };
        if shard.index >= shard.count {
            return Err(format!("part {} of {}: parts count from 0", shard.index, shard.count));
        }
        Ok(shard)
    }

    fn of_array(count: Option<usize>, variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard, String> {
        let found = ARRAYS.into_iter().find_map(|(index, size)| Some((index, variable(index)?, size)));
        let (name, index, size) = found.ok_or_else(|| {
            let names = ARRAYS.map(|(index, _)| index).join(", ");
            format!("auto needs an array job; none of {names} is set")
        })?;
        // Slurm counts from MIN in steps.
        let of_slurm = |part: &str| match name {
            "SLURM_ARRAY_TASK_ID" => variable(part).map(|text| number(&text)).transpose(),
            _ => Ok(None),
        };
        let first = of_slurm("SLURM_ARRAY_TASK_MIN")?.unwrap_or(0);
        let step = of_slurm("SLURM_ARRAY_TASK_STEP")?.unwrap_or(1).max(1);
        let count = match (count, variable(size)) {
            (Some(count), _) => count,
            (None, Some(count)) => number(&count)?,
            (None, None) => return Err(format!("{name} states no number of parts; give auto/N")),
        };
        let index = number(&index)?.checked_sub(first).ok_or(format!("{name} is below the first"))?;
        Ok(Shard { index: index / step, count })
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Shard, String> {
        Shard::read(text, &|name| std::env::var(name).ok().filter(|v| !v.is_empty()))
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

fn number(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| format!("`{text}` is no whole number"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str, set: &[(&str, &str)]) -> Result<Shard, String> {
        let variable = |name: &str| set.iter().find(|(n, _)| *n == name).map(|(_, v)| (*v).to_owned());
        Shard::read(text, &variable)
    }

    #[test]
    fn every_row_is_in_one_shard() {
        let shards: Vec<Shard> = (0..3).map(|i| read(&format!("{i}/3"), &[]).unwrap()).collect();
        assert!((0..10).all(|row| shards.iter().filter(|s| s.has(row)).count() == 1));
        for wrong in ["3/3", "1", "a/3", "0/0", "auto", "auto/2"] {
            assert!(read(wrong, &[]).is_err(), "{wrong}");
        }
    }

    #[test]
    fn array_jobs_name_their_part() {
        let slurm =
            [("SLURM_ARRAY_TASK_ID", "5"), ("SLURM_ARRAY_TASK_COUNT", "4"), ("SLURM_ARRAY_TASK_MIN", "3")];
        assert_eq!(read("auto", &slurm), Ok(Shard { index: 2, count: 4 }));
        let stepped = [
            &slurm[1..2],
            &[("SLURM_ARRAY_TASK_ID", "9"), ("SLURM_ARRAY_TASK_MIN", "1"), ("SLURM_ARRAY_TASK_STEP", "4")],
        ];
        assert_eq!(read("auto", &stepped.concat()), Ok(Shard { index: 2, count: 4 }));
        let kubernetes = [("JOB_COMPLETION_INDEX", "1")];
        assert!(read("auto", &kubernetes).unwrap_err().contains("auto/N"));
        assert_eq!(read("auto/8", &kubernetes), Ok(Shard { index: 1, count: 8 }));
        let aws = [("AWS_BATCH_JOB_ARRAY_INDEX", "0"), ("AWS_BATCH_JOB_ARRAY_SIZE", "2")];
        assert_eq!(read("auto", &aws), Ok(Shard { index: 0, count: 2 }));
    }
}
