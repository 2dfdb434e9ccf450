//! Graph of stages and its schedule.
use super::output::{Inputs, Output, Value};
use super::stage::{Context, Lane, Stage};
use super::store::{Codec, Key, Store};
use crate::checkpoint::Checkpoint;
use crate::gpu::Device;
use crate::infer::Registry;
use crate::progress::{Progress, Recorded};
use crate::sync::lock;
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::marker::PhantomData;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::Scope;
use std::time::Instant;

type Work<'g> = Box<dyn FnOnce(&[Value], &Context) -> Result<Value> + Send + 'g>;
type Load<'g> = Box<dyn Fn(&Store, &Key) -> Option<(Vec<String>, Value)> + Send + Sync + 'g>;
type Save<'g> =
    Box<dyn Fn(&Store, &Key, &[String], &Value, &dyn Fn(&str)) -> Result<bool> + Send + Sync + 'g>;

struct Node<'g> {
    name: &'static str,
    lane: Lane,
    needs: Vec<usize>,
    /// A stage that ends before this one starts, though it gives no input.
    after: Option<usize>,
    settings: String,
    work: Mutex<Option<Work<'g>>>,
    load: Load<'g>,
    save: Save<'g>,
}

/// Stages and their inputs. Stages of one lane start in the order in which they were added, as far
/// as their inputs allow.
#[derive(Default)]
pub struct Graph<'g> {
    nodes: Vec<Node<'g>>,
    after: Option<usize>,
}

/// Outputs of the targets of [`Graph::run`].
pub struct Outputs {
    values: Vec<Option<Value>>,
    seconds: Vec<f64>,
    needs: Vec<Vec<usize>>,
}

impl Outputs {
    /// Output of a target.
    pub fn get<T: Send + Sync + 'static>(&self, output: Output<T>) -> Result<Arc<T>> {
        let value = self.values[output.node].clone().and_then(|v| v.downcast::<T>().ok());
        value.ok_or_else(|| Error::work("pipeline: an output was not asked for"))
    }

    /// Seconds that a stage ran in this process; 0 for outputs read from disk.
    pub fn seconds<T>(&self, output: Output<T>) -> f64 {
        self.seconds[output.node]
    }

    /// Sum of the seconds that a stage and all stages before it ran in this process.
    pub fn seconds_in_all<T>(&self, output: Output<T>) -> f64 {
        let (mut total, mut pending) = (0.0, BTreeSet::from([output.node]));
        while let Some(node) = pending.pop_last() {
            total += self.seconds[node];
            pending.extend(&self.needs[node]);
        }
        total
    }

    /// Takes out the output of a target; an error if a store in memory also holds it.
    pub fn take<T: Send + Sync + 'static>(&mut self, output: Output<T>) -> Result<T> {
        let value = self.get(output);
        self.values[output.node] = None;
        Arc::into_inner(value?).ok_or_else(|| Error::work("pipeline: an output is held elsewhere"))
    }
}

impl<'g> Graph<'g> {
    /// The stages added from here on start when `output` is there, if the run computes it.
    pub fn after<T>(&mut self, output: Output<T>) {
        self.after = Some(output.node);
    }

    /// Adds a stage with its inputs.
    pub fn add<S: Stage + 'g>(&mut self, stage: S, inputs: S::Inputs) -> Output<S::Output> {
        let settings = stage.settings();
        let work = move |made: &[Value], context: &Context| {
            let inputs =
                S::Inputs::values(made).ok_or_else(|| Error::work("pipeline: inputs of another type"))?;
            Ok(Arc::new(stage.run(inputs, context)?) as Value)
        };
        let load = |store: &Store, key: &Key| {
            let found = S::codec().and_then(|c: Codec<S::Output>| store.load(S::NAME, key, &c));
            found.map(|(warnings, value)| (warnings, Arc::new(value) as Value))
        };
        let save = |store: &Store, key: &Key, warnings: &[String], value: &Value, warn: &dyn Fn(&str)| match (
            S::codec(),
            value.downcast_ref(),
        ) {
            (Some(codec), Some(value)) => store.save(S::NAME, key, &codec, warnings, value, warn),
            _ => Ok(false),
        };
        self.nodes.push(Node {
            name: S::NAME,
            lane: S::LANE,
            needs: inputs.nodes(),
            after: self.after,
            settings,
            work: Mutex::new(Some(Box::new(work))),
            load: Box::new(load),
            save: Box::new(save),
        });
        Output { node: self.nodes.len() - 1, made: PhantomData }
    }

    /// Computes `targets` ([`Output::target`]); reads outputs from `store` where it has them and
    /// keeps new ones there. The first error stops all stages.
    pub fn run(
        &self,
        targets: &[usize],
        device: &Device,
        registry: &Registry,
        store: &Store,
        progress: &Recorded,
    ) -> Result<Outputs> {
        let keys = self.keys(device, registry);
        let mut state = self.planned(targets, store, &keys);
        targets.iter().for_each(|t| state.users[*t] += 1);
        self.report_kept(&state, progress);
        let shared = Shared { graph: self, keys, store, state: Mutex::new(state), changed: Condvar::new() };
        let processor_progress = progress.second_lane();
        let context = Context { device, registry, progress };
        let shared = &shared;
        let (device_lane, processor_lane) = std::thread::scope(|scope| {
            let processor_progress = processor_progress.as_ref();
            let other = scope.spawn(move || {
                let context = Context { device, registry, progress: processor_progress };
                shared.work(scope, Lane::Processor, &context, progress)
            });
            let device_lane = shared.work(scope, Lane::Device, &context, progress);
            // A panic of the other thread continues in this one.
            (device_lane, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        });
        let mut state = shared.lock();
        let state = &mut *state;
        let unsaved = state.unsaved.take().map_or(Ok(()), Err);
        if let Err(error) = both(device_lane, processor_lane).and(unsaved) {
            let checkpoint_of =
                |n: usize| store.checkpoint(self.nodes[n].name, &shared.keys[n])?.named(self.nodes[n].name);
            let begun = (0..self.nodes.len()).rev().find_map(checkpoint_of);
            let place = |name: &&str| self.nodes.iter().position(|n| n.name == *name);
            state.kept.sort_by_key(place);
            if !state.kept.is_empty() {
                let names = state.kept.join(", ");
                progress.inform(&format!("kept: {names}; the same command with --resume goes on from there"));
            }
            return Err(error.keeping(begun.or(state.kept.last().map(|stage| format!("stage {stage}")))));
        }
        let needs = self.nodes.iter().map(|n| n.needs.clone()).collect();
        let (values, seconds) = (std::mem::take(&mut state.values), std::mem::take(&mut state.seconds));
        Ok(Outputs { values, seconds, needs })
    }

    /// Keys of all stages.
    fn keys(&self, device: &Device, registry: &Registry) -> Vec<Key> {
        let info = device.info();
        // Without ONNX Runtime no stage with networks keeps an output.
        let provider = registry.compute().name().unwrap_or_default();
        let machine = format!("{} {} {} {provider}", info.name, info.driver, info.deterministic);
        let mut keys: Vec<Key> = Vec::with_capacity(self.nodes.len());
        for node in &self.nodes {
            let machine = if node.lane == Lane::Device { machine.as_str() } else { provider };
            let inputs: Vec<&Key> = node.needs.iter().map(|n| &keys[*n]).collect();
            keys.push(Key::of(node.name, &[program(), machine, &node.settings], &inputs));
        }
        keys
    }

    /// Initial state: the stages that must run for the targets, and the outputs that the store has.
    fn planned(&self, targets: &[usize], store: &Store, keys: &[Key]) -> State {
        let n = self.nodes.len();
        let mut state = State {
            waiting: BTreeSet::new(),
            pending: BTreeSet::new(),
            values: vec![None; n],
            seconds: keys.iter().map(|key| store.seconds(key)).collect(),
            warnings: vec![Vec::new(); n],
            users: vec![0; n],
            kept: Vec::new(),
            unsaved: None,
            failed: false,
        };
        let mut pending: BTreeSet<usize> = targets.iter().copied().collect();
        // Inputs precede the stages that need them.
        while let Some(node) = pending.pop_last() {
            if let Some(value) = store.memory_get(&keys[node]) {
                // This process has given its warnings.
                state.values[node] = Some(value);
            } else if let Some((warnings, value)) = (self.nodes[node].load)(store, &keys[node]) {
                (state.warnings[node], state.values[node]) = (warnings, Some(value));
                state.kept.push(self.nodes[node].name);
            } else {
                state.waiting.insert(node);
                state.pending.insert(node);
                for &need in &self.nodes[node].needs {
                    state.users[need] += 1;
                    pending.insert(need);
                }
            }
        }
        state.kept.reverse();
        state
    }

    /// Reports the stages that need not run, and repeats their warnings.
    fn report_kept(&self, state: &State, progress: &dyn Progress) {
        if !state.kept.is_empty() {
            progress.inform(&format!("kept from an earlier run: {}", state.kept.join(", ")));
        }
        let mut repeated = BTreeSet::new();
        let warnings = state.warnings.iter().flatten().filter(|w| repeated.insert(w.as_str()));
        warnings.for_each(|w| progress.warn(w));
    }
}

/// Checksum of the running code: the outputs of another build may differ.
pub(crate) fn program() -> &'static str {
    static PROGRAM: OnceLock<String> = OnceLock::new();
    PROGRAM.get_or_init(|| {
        let bytes = crate::files::own_file().and_then(std::fs::read);
        bytes.map_or_else(|_| env!("CARGO_PKG_VERSION").to_owned(), |b| crate::files::sha256(&b))
    })
}

/// State of a running graph.
struct State {
    /// Stages that have not started.
    waiting: BTreeSet<usize>,
    /// Stages that have not ended.
    pending: BTreeSet<usize>,
    values: Vec<Option<Value>>,
    /// Seconds that each stage ran, here or in an earlier graph of the store.
    seconds: Vec<f64>,
    /// Warnings of each stage and of its inputs.
    warnings: Vec<Vec<String>>,
    /// Number of pending stages and targets that use each output; it is dropped at 0.
    users: Vec<usize>,
    /// Stages whose output is on disk now.
    kept: Vec<&'static str>,
    /// First error of a codec; that output was not written.
    unsaved: Option<Error>,
    failed: bool,
}

struct Shared<'s, 'g> {
    graph: &'s Graph<'g>,
    keys: Vec<Key>,
    store: &'s Store,
    state: Mutex<State>,
    changed: Condvar,
}

impl Shared<'_, '_> {
    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Runs the stages of a lane until none is left or a stage of any lane has failed. Outputs are
    /// written to the store in `scope`, while the next stages run.
    fn work<'scope, 'env: 'scope>(
        &'env self,
        scope: &'scope Scope<'scope, 'env>,
        lane: Lane,
        context: &Context,
        progress: &'env Recorded,
    ) -> Result<()> {
        // Stops the other lane also when a stage panics.
        let guard = StopOnDrop { shared: self, progress };
        while let Some((node, inputs)) = self.next(lane) {
            let stage = &self.graph.nodes[node];
            let work = lock(&stage.work).take();
            let work = work.ok_or_else(|| Error::work("pipeline: a graph runs once"))?;
            let checkpoint = self.store.checkpoint(stage.name, &self.keys[node]);
            let recorder =
                WarningRecorder { inner: context.progress, warnings: Mutex::default(), checkpoint };
            let began = Instant::now();
            let kept_state = || recorder.checkpoint.as_ref().and_then(|c| c.named(stage.name));
            let value = work(&inputs, &Context { progress: &recorder, ..*context })
                .map_err(|error| error.keeping(kept_state()))?;
            drop(inputs);
            let mut warnings = lock(&recorder.warnings).clone();
            // With the warnings of its inputs, which a resumed run does not read.
            warnings.splice(0..0, stage.needs.iter().flat_map(|n| self.lock().warnings[*n].clone()));
            let seconds = began.elapsed().as_secs_f64();
            self.store.memory_put(stage.name, &self.keys[node], &value, seconds);
            let (kept_value, kept_warnings) = (value.clone(), warnings.clone());
            let checkpoint = recorder.checkpoint;
            scope.spawn(move || self.save(node, kept_value, &kept_warnings, checkpoint, progress));
            let mut state = self.lock();
            state.pending.remove(&node);
            (state.values[node], state.seconds[node]) = (Some(value), seconds);
            state.warnings[node] = warnings;
            for &need in &stage.needs {
                state.users[need] -= 1;
                if state.users[need] == 0 {
                    state.values[need] = None;
                }
            }
            self.changed.notify_all();
        }
        // The lane is done, or the other lane has failed and set the flag.
        std::mem::forget(guard);
        Ok(())
    }

    /// Writes an output to the store and then removes its checkpoint. An output that was not written
    /// keeps it: a resumed run goes on from there.
    fn save(
        &self,
        node: usize,
        value: Value,
        warnings: &[String],
        checkpoint: Option<Checkpoint>,
        progress: &Recorded,
    ) {
        let stage = &self.graph.nodes[node];
        let warn = |text: &str| progress.warn(text);
        let kept = (stage.save)(self.store, &self.keys[node], warnings, &value, &warn);
        match kept {
            Ok(true) => {
                self.lock().kept.push(stage.name);
                checkpoint.iter().for_each(Checkpoint::remove);
            }
            Ok(false) => {}
            Err(error) => {
                let mut state = self.lock();
                state.unsaved.get_or_insert(error);
                state.failed = true; // no further stage starts
                self.changed.notify_all();
            }
        }
    }

    /// Waits for the first stage of the lane with all inputs; `None` when no more will run.
    fn next(&self, lane: Lane) -> Option<(usize, Vec<Value>)> {
        let mut state = self.lock();
        loop {
            let in_lane = |n: &&usize| self.graph.nodes[**n].lane == lane;
            if state.failed || !state.waiting.iter().any(|n| in_lane(&n)) {
                return None;
            }
            let inputs = |n: &usize| -> Option<Vec<Value>> {
                let node = &self.graph.nodes[*n];
                if node.after.is_some_and(|after| state.pending.contains(&after)) {
                    return None;
                }
                node.needs.iter().map(|need| state.values[*need].clone()).collect()
            };
            let ready = state.waiting.iter().filter(in_lane).find_map(|n| Some((*n, inputs(n)?)));
            if let Some((node, inputs)) = ready {
                state.waiting.remove(&node);
                return Some((node, inputs));
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Progress that forwards all calls and keeps the warnings.
struct WarningRecorder<'a> {
    inner: &'a dyn Progress,
    warnings: Mutex<Vec<String>>,
    checkpoint: Option<Checkpoint>,
}

impl Progress for WarningRecorder<'_> {
    fn begin(&self, stage: &'static str, steps: u64) {
        self.inner.begin(stage, steps);
    }
    fn step(&self, done: u64, note: &str) {
        self.inner.step(done, note);
    }
    fn figures(&self, step: u64, figures: &[(&str, f64)]) {
        self.inner.figures(step, figures);
    }
    fn end(&self) {
        self.inner.end();
    }
    fn warn(&self, message: &str) {
        lock(&self.warnings).push(message.to_owned());
        self.inner.warn(message);
    }
    fn inform(&self, message: &str) {
        self.inner.inform(message);
    }
    fn cancelled(&self) -> bool {
        self.inner.cancelled()
    }
    fn checkpoint(&self) -> Option<&Checkpoint> {
        self.checkpoint.as_ref()
    }
    fn second_lane(&self) -> Box<dyn Progress + '_> {
        self.inner.second_lane()
    }
}

/// Stops the other lane when dropped.
struct StopOnDrop<'s, 'g> {
    shared: &'s Shared<'s, 'g>,
    progress: &'s Recorded<'s>,
}

impl Drop for StopOnDrop<'_, '_> {
    fn drop(&mut self) {
        self.shared.lock().failed = true;
        self.shared.changed.notify_all();
        self.progress.stop();
    }
}

/// Results of two lanes; of two errors the cause, not the cancellation that follows from it.
fn both<A, B>(device: Result<A>, processor: Result<B>) -> Result<(A, B)> {
    match (device, processor) {
        (Ok(a), Ok(b)) => Ok((a, b)),
        (Err(Error::Cancelled), Err(e)) | (Err(e), _) | (_, Err(e)) => Err(e),
    }
}
