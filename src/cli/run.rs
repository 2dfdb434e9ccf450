//! `splatvk run`
use super::args::RunArgs;
use super::progress;
use super::{plan, print, print_json};
use crate::infer::Registry;
use crate::infer::installed::inventory;
use crate::{Error, Result};

pub fn run(args: &RunArgs) -> Result<()> {
    let installed = inventory(&Registry::open(plan::models(&args.device).as_deref())?);
    let plan = plan::run(args, &installed)?;
    let outcome = crate::run::run(&plan, progress::here().as_ref())?;
    if args.device.json {
        let record = serde_json::to_value(crate::run::run_record(&outcome));
        return print_json(&record.map_err(|e| Error::work(format!("run record: {e}")))?);
    }
    print(&crate::run::closing_table(&outcome))
}
