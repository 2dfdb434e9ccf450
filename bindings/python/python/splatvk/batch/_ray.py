"""The driver on a Ray cluster: one task a row, retries here so that reasons are kept."""

import heapq
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from .. import __version__
from ..errors import MissingError
from ._kinds import RETRIED, Failure, delay
from ._look import Looker
from ._manifest import Row
from ._record import Events, Summary
from ._results import read_success, write_failure
from ._row import Outcome, finished, run_row
from ._store import Store

#: A node that lacks something, or cannot write, so often in succession gets no more rows: it would
#: fail the whole manifest, being the fastest.
_NODE_PATIENCE = 2


@dataclass
class Options:
    out: str
    total: int
    address: str | None = None
    gpus: float | None = None
    cpus: float | None = None
    timeout: float | None = None
    retries: int = 2
    max_failures: float | None = None
    lease: float = 3600.0
    scratch: str | None = None
    device: str | None = None


@dataclass
class Job:
    """A row under way. `tries` are those that count against the retries."""

    row: Row
    source: dict[str, Any] | None = None
    attempts: int = 0
    tries: int = 0


@dataclass
class Counts:
    done: int = 0
    skipped: int = 0
    failed: int = 0
    known: int = 0

    @property
    def settled(self) -> int:
        return self.done + self.skipped + self.failed + self.known


def _task(row: Row, out: str, version: str, arguments: Mapping[str, Any]) -> Outcome:
    """The work of one row, on a node of the cluster."""
    node = ray.get_runtime_context().get_node_id()
    if version != __version__:
        text = f"the node has splatvk {__version__}, the driver {version}"
        failure = Failure("missing", text, 3)
        return {"id": row["id"], "state": "failed", "node": node, **failure.record()}
    return {**run_row(row, out, record=False, **arguments), "node": node}


def _nodes() -> list[dict[str, Any]]:
    nodes: Any = ray.nodes
    return [node for node in nodes() if node["Alive"]]


class Engine:
    """Runs the rows that a looker gives, and settles each."""

    def __init__(self, options: Options, store: Store, looker: Looker, events: Events, summary: Summary):
        self._options = options
        self._store = store
        self._looker = looker
        self._events = events
        self._summary = summary
        self._flying: dict[Any, Job] = {}
        self._later: list[tuple[float, int, Job]] = []
        self._order = 0
        self._rows_left = True
        self._stopped: str | None = None
        self._misses: dict[str, int] = {}
        self._excluded: set[str] = set()
        self._reason = ""
        self._slots = (0, 0.0)
        self.counts = Counts()
        self.missing = False

    def connect(self) -> None:
        """Joins the cluster at the address, or the one of this machine, or starts one."""
        address = self._options.address
        try:
            context: Any = ray.init(address=address, log_to_driver=False, logging_level=logging.WARNING)
        except ConnectionError as error:
            raise MissingError(f"no Ray cluster at {address}: {error}") from None
        options = self._options
        alive = [n["Resources"] for n in _nodes()]
        with_gpu = [n for n in alive if n.get("GPU", 0) >= 1]
        if options.gpus is None:
            options.gpus = 1.0 if with_gpu else 0.0
        if options.cpus is None:
            # A card's share of its node; on processors alone a row uses every core it gets.
            shares = [n.get("CPU", 1) // n["GPU"] for n in with_gpu] if options.gpus else []
            options.cpus = max(1.0, min(shares or [4.0, *(n.get("CPU", 1) for n in alive)]))
        self._work = ray.remote(max_retries=0, scheduling_strategy="SPREAD")(_task)
        self._events.write(
            "cluster",
            f"cluster {context.address_info['gcs_address']}: {len(alive)} nodes, "
            f"{options.gpus:g} GPUs and {options.cpus:g} processors a row",
            address=context.address_info["gcs_address"],
            job=ray.get_runtime_context().get_job_id(),
            nodes=len(alive),
            gpus_per_row=options.gpus,
            cpus_per_row=options.cpus,
        )

    def run(self) -> None:
        """Settles every row, or stops for too many failures."""
        while True:
            self._fill()
            if not self._flying:
                if self._stopped or not (self._rows_left or self._later):
                    return
                time.sleep(0.1)
                continue
            ready, _ = ray.wait(list(self._flying), timeout=0.5)
            for ref in ready:
                self._settle(self._flying.pop(ref), self._result(ref))

    def cancel(self) -> None:
        """Kills the tasks; their programs end with the workers."""
        for ref in self._flying:
            ray.cancel(ref, force=True)

    def _room(self) -> bool:
        """Whether another task may be given to Ray: twice as many as run at once, so that no slot
        waits and a cluster that grows by demand sees some."""
        if time.monotonic() - self._slots[1] > 2.0:
            self._slots = (self._count_slots(), time.monotonic())
        return len(self._flying) < max(2, 2 * self._slots[0])

    def _count_slots(self) -> int:
        options, slots = self._options, 0.0
        for node in _nodes():
            if node["NodeID"] not in self._excluded:
                has = node["Resources"]
                needs = (("GPU", options.gpus), ("CPU", options.cpus))
                fits = [has.get(name, 0) // need for name, need in needs if need]
                slots += min(fits or [1])
        return int(slots)

    def _fill(self) -> None:
        while not self._stopped and self._room():
            if self._later and self._later[0][0] <= time.monotonic():
                self._submit(heapq.heappop(self._later)[2])
            elif self._rows_left and (self._looker.ready() or not self._flying):
                self._next_row()
            else:
                return

    def _next_row(self) -> None:
        look = self._looker.next()
        if look is None:
            self._rows_left = False
            return
        if look.swept:
            self._events.write("swept", id=look.row["id"], folders=look.swept)
        if look.outcome is None:
            self._submit(Job(look.row, look.source))
        else:
            self._close(look.outcome)

    def _submit(self, job: Job) -> None:
        options = self._options
        job.attempts += 1
        job.tries += 1
        arguments = {
            "timeout": options.timeout,
            "lease": options.lease,
            "scratch": options.scratch,
            "device": options.device,
        }
        needs: dict[str, Any] = {"num_gpus": options.gpus, "num_cpus": options.cpus}
        if self._excluded:
            needs["label_selector"] = {"ray.io/node-id": f"!in({','.join(sorted(self._excluded))})"}
        ref = self._work.options(name=f"splatvk {job.row['id']}", **needs).remote(
            job.row, options.out, __version__, arguments
        )
        self._flying[ref] = job
        self._events.write("submitted", id=job.row["id"], attempt=job.attempts)

    def _result(self, ref: Any) -> Outcome:
        """The outcome of a task; a lost worker or node is one too."""
        try:
            outcome: Outcome = ray.get(ref)
            return outcome
        except RayTaskError as error:
            text = str(error).strip().rpartition("\n")[2]
            kind = "missing" if "import" in text or "ModuleNotFoundError" in text else "failed"
            failure = Failure(kind, text, 3 if kind == "missing" else 1)
        except RayError as error:
            first = str(error).strip().partition("\n")[0]
            failure = Failure("transient", f"{type(error).__name__}: {first}")
        return {"state": "failed", **failure.record()}

    def _settle(self, job: Job, outcome: Outcome) -> None:
        # A row whose memory ran out was tried twice by its task.
        job.attempts += outcome.get("attempts", 1) - 1
        outcome.update(id=job.row["id"], attempts=job.attempts)
        # A lost worker has not told it.
        outcome["source"] = outcome.get("source") or job.source
        if outcome["state"] != "failed":
            self._misses.pop(outcome.get("node", ""), None)
            self._close(outcome)
            return
        kind = outcome["kind"]
        if kind in ("missing", "unwritable") and self._miss(outcome):
            # The node's fault alone.
            job.tries -= 1
        if kind in RETRIED and job.tries <= self._options.retries:
            self._again(job, outcome, delay(max(1, job.tries)))
        else:
            self._close(outcome)

    def _miss(self, outcome: Outcome) -> bool:
        """Counts a node that lacks something; True once it gets no more rows."""
        node = outcome.get("node")
        if not node:
            return False
        self._misses[node] = self._misses.get(node, 0) + 1
        if self._misses[node] >= _NODE_PATIENCE and node not in self._excluded:
            self._excluded.add(node)
            self._reason = outcome["message"]
            text = f"node {outcome.get('host', node)} gets no more rows: {outcome['message']}"
            self._events.write(
                "excluded", text, node=node, host=outcome.get("host"), message=outcome["message"]
            )
            if all(n["NodeID"] in self._excluded for n in _nodes()):
                self.missing = True
                self._stop(f"no node is left that can work: {self._reason}")
        return node in self._excluded

    def _again(self, job: Job, outcome: Outcome, seconds: float) -> None:
        self._order += 1
        heapq.heappush(self._later, (time.monotonic() + seconds, self._order, job))
        self._events.write(
            "retry",
            f"{job.row['id']}: {outcome['kind']}: {outcome['message']}; tried again",
            id=job.row["id"],
            kind=outcome["kind"],
            message=outcome["message"],
            attempt=job.attempts,
            node=outcome.get("node"),
        )

    def _close(self, outcome: Outcome) -> None:
        """The last word on a row."""
        counts, name = self.counts, outcome["id"]
        if outcome["state"] == "failed" and not outcome.get("known"):
            # A lost worker may have finished, and so may another driver.
            found = read_success(self._store, name)
            if found and found.get("source") == outcome.get("source"):
                outcome = {
                    "id": name,
                    "attempts": outcome["attempts"],
                    **finished(self._store, name, found, "skipped"),
                }
            else:
                write_failure(self._store, outcome)
        self._summary.add(outcome)
        state = outcome["state"]
        if state == "failed":
            counts.known += bool(outcome.get("known"))
            counts.failed += not outcome.get("known")
        else:
            counts.done += state == "done"
            counts.skipped += state == "skipped"
        self._say(outcome)
        limit = self._options.max_failures
        if limit is not None and counts.failed > limit and not self._stopped:
            self._stop(f"{counts.failed} rows failed, more than --max-failures allows")

    def _say(self, outcome: Outcome) -> None:
        state, name = outcome["state"], outcome["id"]
        place = f"[{self.counts.settled}/{self._options.total}] {name}: "
        if state == "failed":
            text = f"{place}{outcome['kind']}: {outcome['message']}"
        elif state == "done":
            text = f"{place}done in {outcome['seconds']} s on {outcome.get('host') or outcome.get('node')}"
        else:
            text = ""
        kept = ("seconds", "device", "attempts", "host", "node", "kind", "message", "exit_code", "scene")
        self._events.write(state, text, id=name, **{key: outcome.get(key) for key in kept})

    def _stop(self, reason: str) -> None:
        """No more rows begin; those under way end."""
        self._stopped = reason
        self._later.clear()
        self._events.write("stopped", f"stopped: {reason}", message=reason)

    @property
    def stopped(self) -> str | None:
        return self._stopped
