//! Tests with graphs of small stages: schedule, parallel lanes, reuse of outputs.
use super::*;
use crate::Error;
use crate::Result;
use crate::gpu::Device;
use crate::infer::Registry;
use crate::progress::{Recorded, Silent};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

/// Adds to its input, and counts runs.
struct Add {
    by: u64,
    runs: Arc<AtomicUsize>,
    warning: Option<&'static str>,
}

impl Stage for Add {
    const NAME: &'static str = "add";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<u64>,);
    type Output = u64;
    fn settings(&self) -> String {
        self.by.to_string()
    }
    fn codec() -> Option<Codec<u64>> {
        kept()
    }
    fn run(self, (value,): (&u64,), context: &Context) -> Result<u64> {
        self.runs.fetch_add(1, Ordering::SeqCst);
        self.warning.into_iter().for_each(|w| context.progress.warn(w));
        Ok(value + self.by)
    }
}

/// A number without a codec, on the other lane.
struct Number(u64, Arc<AtomicUsize>);

impl Stage for Number {
    const NAME: &'static str = "number";
    const LANE: Lane = Lane::Device;
    type Inputs = ();
    type Output = u64;
    fn settings(&self) -> String {
        self.0.to_string()
    }
    fn run(self, (): (), context: &Context) -> Result<u64> {
        self.1.fetch_add(1, Ordering::SeqCst);
        context.progress.warn("a number");
        Ok(self.0)
    }
}

struct Machine {
    device: Device,
    registry: Registry,
}

impl Machine {
    fn new() -> Machine {
        Machine { device: crate::gpu::open(None).unwrap(), registry: Registry::open(None).unwrap() }
    }

    fn run(&self, graph: &Graph, targets: &[usize], store: &Store) -> Result<(Outputs, Vec<String>)> {
        let progress = Recorded::new(&Silent);
        let made = graph.run(targets, &self.device, &self.registry, store, &progress)?;
        Ok((made, progress.warnings()))
    }
}

/// Runs number → + 1 → + `last`; the runs of each, the result, and the warnings.
fn chain(machine: &Machine, store: &Store, last: u64) -> ([usize; 3], u64, Vec<String>) {
    let runs: [Arc<AtomicUsize>; 3] = Default::default();
    let mut graph = Graph::default();
    let number = graph.add(Number(5, runs[0].clone()), ());
    let add = |by, k: usize, warning| Add { by, runs: runs[k].clone(), warning };
    let one = graph.add(add(1, 1, Some("one more")), (number,));
    let two = graph.add(add(last, 2, None), (one,));
    let (made, warnings) = machine.run(&graph, &[two.target()], store).unwrap();
    (runs.map(|r| r.load(Ordering::SeqCst)), *made.get(two).unwrap(), warnings)
}

#[test]
fn finished_stages_are_not_run_again() {
    let (machine, folder) = (Machine::new(), tempfile::tempdir().unwrap());
    let kept = |resume| Store::at(folder.path(), resume, TIMEOUT);
    assert_eq!(chain(&machine, &kept(true), 2).0, [1, 1, 1]);
    // Without `resume` all stages run.
    assert_eq!(chain(&machine, &kept(false), 2).0, [1, 1, 1]);
    let (runs, value, warnings) = chain(&machine, &kept(true), 2);
    assert_eq!((runs, value), ([0, 0, 0], 8));
    assert_eq!(warnings, ["a number", "one more"], "of stages that were not even looked at");
    // Another last setting: the stage before comes from the store.
    let (runs, value, warnings) = chain(&machine, &kept(true), 3);
    assert_eq!((runs, value), ([0, 0, 1], 9));
    assert_eq!(warnings, ["a number", "one more"]);
    // Damaged files are not used.
    for (file, _) in Store::list(folder.path()) {
        let mut bytes = std::fs::read(&file).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(&file, bytes).unwrap();
    }
    assert_eq!(chain(&machine, &kept(true), 3).0, [1, 1, 1]);
    let list = Store::list(folder.path());
    assert!(list.len() == 3 && list.iter().all(|(_, bytes)| *bytes > 64), "{list:?}");
    // In a full folder, the least recently used file is removed. 4 GiB of zeros take no disk space.
    let old = folder.path().join("old.stage");
    let file = std::fs::File::create(&old).unwrap();
    file.set_len(4 << 30).unwrap();
    file.set_modified(std::time::SystemTime::UNIX_EPOCH).unwrap();
    assert_eq!(chain(&machine, &kept(false), 2).0, [1, 1, 1]);
    assert!(!old.exists() && Store::list(folder.path()).len() == 3);
}

/// Path of a file while it is written.
fn partial_path(file: &std::path::Path) -> std::path::PathBuf {
    let name = file.file_name().unwrap().to_string_lossy().into_owned();
    file.with_file_name(format!(".{name}.partial-splatvk"))
}

/// A folder blocks every partial file.
#[test]
fn unwritable_store_keeps_the_result() {
    let (machine, folder) = (Machine::new(), tempfile::tempdir().unwrap());
    let kept = || Store::at(folder.path(), true, TIMEOUT);
    assert_eq!(chain(&machine, &kept(), 2).0, [1, 1, 1]);
    let files: Vec<_> = Store::list(folder.path()).into_iter().map(|f| f.0).collect();
    for file in &files {
        std::fs::remove_file(file).unwrap();
        std::fs::create_dir(partial_path(file)).unwrap();
        std::fs::write(partial_path(file).join("letter"), "precious").unwrap();
    }
    let (runs, value, _) = chain(&machine, &kept(), 2);
    assert_eq!((runs, value), ([1, 1, 1], 8));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), files.len(), "nothing half-written stays");
    // Without the folders the store is written.
    files.iter().for_each(|file| std::fs::remove_dir_all(partial_path(file)).unwrap());
    assert_eq!(chain(&machine, &kept(), 2).0, [1, 1, 1]);
    assert_eq!(chain(&machine, &kept(), 2).0, [0, 0, 0]);
    assert_eq!(Store::list(folder.path()).len(), files.len());
}

/// A stage whose output has no bytes.
struct Unwritable;

impl Stage for Unwritable {
    const NAME: &'static str = "unwritable";
    const LANE: Lane = Lane::Processor;
    type Inputs = ();
    type Output = u64;
    fn settings(&self) -> String {
        String::new()
    }
    fn codec() -> Option<Codec<u64>> {
        Some(Codec { write: |_| Err(Error::work("too large to write")), read: |_| None })
    }
    fn run(self, (): (), _: &Context) -> Result<u64> {
        Ok(1)
    }
}

/// The writer runs beside the next stages; its error still ends the run.
#[test]
fn codec_errors_end_the_run() {
    let (machine, folder) = (Machine::new(), tempfile::tempdir().unwrap());
    let run = |store| {
        let mut graph = Graph::default();
        let one = graph.add(Unwritable, ());
        machine.run(&graph, &[one.target()], &store).map(|(made, _)| *made.get(one).unwrap())
    };
    assert_eq!(run(Store::none()).unwrap(), 1);
    let error = run(Store::at(folder.path(), false, TIMEOUT)).unwrap_err().to_string();
    assert!(error.contains("too large to write"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn graphs_of_one_store_share_outputs() {
    let (machine, store) = (Machine::new(), Store::in_memory());
    let (runs, value, warnings) = chain(&machine, &store, 2);
    assert_eq!((runs, value, warnings.len()), ([1, 1, 1], 8, 2));
    let (runs, value, warnings) = chain(&machine, &store, 2);
    assert_eq!((runs, value), ([0, 0, 0], 8));
    assert!(warnings.is_empty(), "given in this process: {warnings:?}");
    assert_eq!(chain(&machine, &store, 3).0, [0, 0, 1]);
    // Another store does not have it.
    assert_eq!(chain(&machine, &Store::in_memory(), 3).0, [1, 1, 1]);
}

#[test]
fn store_in_memory_forgets_unused_outputs() {
    let (machine, store) = (Machine::new(), Store::in_memory());
    assert_eq!(chain(&machine, &store, 2).0, [1, 1, 1]);
    store.forget_unused();
    // The last stage differs: this round uses the number and its successor, but not 5 + 1 + 2.
    assert_eq!(chain(&machine, &store, 3).0, [0, 0, 1]);
    store.forget_unused();
    assert_eq!(chain(&machine, &store, 3).0, [0, 0, 0]);
    assert_eq!(chain(&machine, &store, 2).0, [0, 0, 1], "made again, from what both rounds have used");
    let passing = Store::in_memory_without(&["number"]);
    assert_eq!(chain(&machine, &passing, 2).0, [1, 1, 1]);
    assert_eq!(chain(&machine, &passing, 2).0, [0, 0, 0]);
    assert_eq!(chain(&machine, &passing, 3).0, [0, 0, 1], "the sum before it was kept");
    // A "number" that the store does not keep runs where it is a target.
    let graph = |by| {
        let runs = Arc::new(AtomicUsize::new(0));
        let mut graph = Graph::default();
        let number = graph.add(Number(5, runs.clone()), ());
        let add = graph.add(Add { by, runs: Arc::default(), warning: None }, (number,));
        let (made, _) = machine.run(&graph, &[number.target(), add.target()], &passing).unwrap();
        assert!(made.seconds_in_all(add) >= made.seconds(add) + made.seconds(number));
        runs.load(Ordering::SeqCst)
    };
    assert_eq!((graph(7), graph(8)), (1, 1));
}

/// Sends a message to the other stage, then waits for its message.
struct Handshake {
    receive: Option<mpsc::Receiver<()>>,
    send: Option<mpsc::Sender<()>>,
    end: fn(&Context) -> Result<()>,
}

/// Long enough for any machine; only a wrong schedule waits for it.
const TIMEOUT: Duration = Duration::from_secs(60);

macro_rules! handshake_stage {
    ($name:ident, $lane:expr) => {
        struct $name(Mutex<Handshake>);
        impl Stage for $name {
            const NAME: &'static str = stringify!($name);
            const LANE: Lane = $lane;
            type Inputs = ();
            type Output = ();
            fn settings(&self) -> String {
                String::new()
            }
            fn run(self, (): (), context: &Context) -> Result<()> {
                let handshake = self.0.into_inner().unwrap();
                if let Some(send) = handshake.send {
                    send.send(()).unwrap();
                }
                if let Some(receive) = handshake.receive {
                    receive.recv_timeout(TIMEOUT).map_err(|_| Error::work("no message"))?;
                }
                (handshake.end)(context)
            }
        }
    };
}

handshake_stage!(OnDevice, Lane::Device);
handshake_stage!(OnProcessor, Lane::Processor);

fn pair(ends: [fn(&Context) -> Result<()>; 2]) -> Result<()> {
    let machine = Machine::new();
    let (there, back) = (mpsc::channel(), mpsc::channel());
    let mut graph = Graph::default();
    let device = Handshake { receive: Some(back.1), send: Some(there.0), end: ends[0] };
    let processor = Handshake { receive: Some(there.1), send: Some(back.0), end: ends[1] };
    let device = graph.add(OnDevice(Mutex::new(device)), ());
    let processor = graph.add(OnProcessor(Mutex::new(processor)), ());
    machine.run(&graph, &[device.target(), processor.target()], &Store::none()).map(|_| ())
}

/// Runs until the progress is cancelled.
fn long(context: &Context) -> Result<()> {
    let started = std::time::Instant::now();
    while started.elapsed() < TIMEOUT {
        context.progress.check()?;
        std::thread::sleep(Duration::from_millis(1));
    }
    Err(Error::work("was not stopped"))
}

#[test]
fn parallel_lanes_report_the_first_error() {
    pair([|_| Ok(()), |_| Ok(())]).unwrap();
    let error = |ends| pair(ends).unwrap_err().to_string();
    assert_eq!(error([long, |_| Err(Error::input("bad mask"))]), "bad mask");
    assert_eq!(error([|_| Err(Error::input("bad photo")), long]), "bad photo");
    let panicked = std::panic::catch_unwind(|| pair([long, |_| std::panic::panic_any("oh")]));
    assert_eq!(panicked.unwrap_err().downcast_ref::<&str>(), Some(&"oh"));
}

/// Reads a flag, or sets it after a while.
struct Flag<const SETS: bool>(Arc<AtomicUsize>);

impl<const SETS: bool> Stage for Flag<SETS> {
    const NAME: &'static str = "flag";
    const LANE: Lane = if SETS { Lane::Device } else { Lane::Processor };
    type Inputs = ();
    type Output = usize;
    fn settings(&self) -> String {
        SETS.to_string()
    }
    fn run(self, (): (), _: &Context) -> Result<usize> {
        if SETS {
            std::thread::sleep(Duration::from_millis(50));
            self.0.store(1, Ordering::SeqCst);
        }
        Ok(self.0.load(Ordering::SeqCst))
    }
}

#[test]
fn after_delays_later_stages() {
    let machine = Machine::new();
    let seen = |waits: bool, both: bool| {
        let (flag, mut graph) = (Arc::new(AtomicUsize::new(0)), Graph::default());
        let first = graph.add(Flag::<true>(flag.clone()), ());
        if waits {
            graph.after(first);
        }
        let second = graph.add(Flag::<false>(flag), ());
        let targets = if both { vec![first.target(), second.target()] } else { vec![second.target()] };
        *machine.run(&graph, &targets, &Store::none()).unwrap().0.get(second).unwrap()
    };
    assert_eq!((seen(true, true), seen(false, true)), (1, 0));
    assert_eq!(seen(true, false), 0, "the first stage is not part of the run");
}
