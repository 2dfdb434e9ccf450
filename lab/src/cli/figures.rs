//! `splatlab figures`
use super::args::FiguresArgs;
use super::study;
use crate::ablate::Runner;
use crate::figures::{self, Section};
use crate::{Error, Result};
use splatvk::cli::print::print;
use splatvk::cli::progress;
use splatvk::format::picture;
use splatvk::gpu;
use splatvk::report::file_name;
use splatvk::run::method::Method;
use splatvk::run::outputs::WrittenFiles;

/// The page of a data set.
const PAGE: &str = "figures.html";

pub fn figures(args: &FiguresArgs) -> Result<()> {
    let registry = args.study.device.registry()?;
    let plan = study::plan(&args.study, &registry)?;
    let sets = study::data_sets(&args.study.data, args.study.layout)?;
    let methods = args.methods.iter().map(|name| Method::named(name)).collect::<Result<Vec<_>>>()?;
    let inputs: Vec<_> = args.study.data.iter().map(AsRef::as_ref).collect();
    let mut out = WrittenFiles::open(&args.out, args.force, &inputs)?;
    let device = gpu::open(args.study.device.device.as_deref())?;
    let progress = progress::reporter();
    let several = sets.len() > 1;
    for set in sets {
        let name = set.name.clone();
        let mut lab = Runner::open(&device, &registry, set, progress.as_ref());
        lab.start_seed(args.seed);
        let sections = figures::draw(&plan, &mut lab, &methods)?;
        let below = if several { format!("{}/", file_name(&name)) } else { String::new() };
        write(&mut out, &below, &name, &sections)?;
    }
    out.keep()?;
    print(&format!("figures are in {}\n", args.out.join(if several { "" } else { PAGE }).display()))
}

fn write(out: &mut WrittenFiles, below: &str, title: &str, sections: &[Section]) -> Result<()> {
    for section in sections {
        for (r, row) in section.rows.iter().enumerate() {
            for (c, tile) in row.tiles.iter().enumerate() {
                picture::write_png(&out.file(&format!("{below}{}", section.file(r, c)))?, &tile.image)?;
            }
        }
    }
    let page = out.file(&format!("{below}{PAGE}"))?;
    std::fs::write(&page, figures::page(title, sections)).map_err(Error::unwritable(&page))
}
