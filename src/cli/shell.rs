//! `splatvk completions`, `splatvk manuals`: files that tools/install puts beside the program.
use super::args::{Cli, CompletionsArgs, ManualsArgs};
use super::print::print;
use super::usage;
use crate::run::outputs::WrittenFiles;
use crate::{Error, Result};

pub fn completions(args: &CompletionsArgs) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut usage::command::<Cli>(), "splatvk", &mut script);
    print(&String::from_utf8_lossy(&script))
}

pub fn manuals(args: &ManualsArgs) -> Result<()> {
    let outputs = WrittenFiles::open(&args.out, args.force, &[])?;
    clap_mangen::generate_to(usage::manual(), outputs.folder()).map_err(Error::unwritable(&args.out))?;
    outputs.keep().map(drop)
}
