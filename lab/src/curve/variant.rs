//! Variants of a training: the preset with some options changed.
use crate::{Error, Result};
use splatvk::fit::RgbOptions;
use std::str::FromStr;

/// A training that a curve compares: options of a preset, some of them changed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Variant {
    /// Name in tables: the changes as given, or `preset` without any.
    pub name: String,
    changes: Vec<(String, String)>,
}

/// Changes one option.
type Change = fn(&mut RgbOptions, f64);

/// Options that a variant may change.
const OPTIONS: &[(&str, Change)] = &[
    ("steps", |o, v| *o = o.clone().with_iterations(v as usize)),
    ("points", |o, v| o.init.max_points = v as usize),
    ("opacity", |o, v| o.init.opacity = v as f32),
    ("footprint", |o, v| o.init.footprint = v as f32),
    ("neighbours", |o, v| o.init.neighbours = v as f32),
    ("thickness", |o, v| o.init.thickness = v as f32),
    ("virtual-views", |o, v| o.virtual_views = v as usize),
    ("rates", |o, v| scale_rates(o, v)),
    ("means-rate", |o, v| (o.rates.means.start, o.rates.means.end) = (v, v / 10.0)),
    ("scales-rate", |o, v| o.rates.log_scales = v),
    ("colour-rate", |o, v| o.rates.sh_dc = v),
    ("opacity-rate", |o, v| o.rates.opacity = v),
    ("quats-rate", |o, v| o.rates.quats = v),
    ("report-every", |o, v| o.report_every = v as usize),
];

fn scale_rates(options: &mut RgbOptions, factor: f64) {
    let rates = &mut options.rates;
    for rate in [&mut rates.means.start, &mut rates.means.end] {
        *rate *= factor;
    }
    for rate in
        [&mut rates.log_scales, &mut rates.quats, &mut rates.opacity, &mut rates.sh_dc, &mut rates.sh_rest]
    {
        *rate *= factor;
    }
}

impl Variant {
    /// The preset itself.
    pub fn preset() -> Variant {
        Variant { name: "preset".into(), changes: Vec::new() }
    }

    /// Applies the changes in their order.
    pub fn applied(&self, mut options: RgbOptions) -> Result<RgbOptions> {
        for (name, value) in &self.changes {
            let known = OPTIONS.iter().find(|(known, _)| known == name);
            let Some((_, change)) = known else {
                let names: Vec<&str> = OPTIONS.iter().map(|o| o.0).collect();
                return Err(Error::input(format!("--variant {name}: one of {}", names.join(", "))));
            };
            let number = value.parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
            let number = number.ok_or_else(|| {
                Error::input(format!("--variant {name}={value}: the value is a number of at least 0"))
            })?;
            change(&mut options, number);
        }
        Ok(options)
    }
}

impl FromStr for Variant {
    type Err = String;

    fn from_str(text: &str) -> Result<Variant, String> {
        if text == "preset" {
            return Ok(Variant::preset());
        }
        let change = |part: &str| {
            let (name, value) = part.split_once('=').ok_or("write it as NAME=VALUE,NAME=VALUE")?;
            Ok::<_, String>((name.to_owned(), value.to_owned()))
        };
        Ok(Variant { name: text.to_owned(), changes: text.split(',').map(change).collect::<Result<_, _>>()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splatvk::fit::Preset;

    #[test]
    fn changes_apply_in_order_and_unknown_names_fail() {
        let options = || RgbOptions::preset(Preset::Draft);
        let variant: Variant = "steps=50,opacity=0.5,rates=2".parse().unwrap();
        let changed = variant.applied(options()).unwrap();
        assert_eq!((changed.iterations, changed.init.opacity), (50, 0.5));
        assert!((changed.rates.quats / options().rates.quats - 2.0).abs() < 1e-12);
        assert_eq!("preset".parse::<Variant>().unwrap().applied(options()).unwrap(), options());
        assert!("steps".parse::<Variant>().is_err());
        for wrong in ["stops=3", "steps=many", "opacity=-1"] {
            assert!(wrong.parse::<Variant>().unwrap().applied(options()).is_err(), "{wrong}");
        }
    }
}
