"""What a driver finds before it starts a row: finished, refused, or to be done."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from .. import __version__
from ..errors import InputError
from ._kinds import Failure
from ._manifest import Manifest, Row, source_of
from ._results import SUCCESS, delete_failure, read_failure, read_success, sweep
from ._row import Outcome, finished
from ._store import Store

#: Stores answer in tens of milliseconds; so many questions at once hide that.
_THREADS = 32


@dataclass(frozen=True)
class Look:
    """`outcome` is there for a row that needs no work."""

    row: Row
    outcome: Outcome | None
    source: dict[str, Any] | None
    files: int
    bytes: int
    swept: int


class Looker:
    """Looks at the rows of a manifest, some ahead of the one that is asked for."""

    def __init__(self, store: Store, manifest: Manifest, *, only_failed: bool, grace: float, clean: bool):
        self._store = store
        self._rows = manifest.rows()
        self._only_failed = only_failed
        self._grace = grace
        self._clean = clean
        self._failed = {n.removesuffix(".json") for n in store.names("_failed") if n.endswith(".json")}
        self._pool = ThreadPoolExecutor(_THREADS, "splatvk-look")
        self._ahead: deque[Future[Look]] = deque()

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)

    def __iter__(self) -> Iterator[Look]:
        while (look := self.next()) is not None:
            yield look

    def next(self) -> Look | None:
        """The next row; None after the last."""
        while len(self._ahead) < 4 * _THREADS:
            row = next(self._rows, None)
            if row is None:
                break
            if not self._only_failed or row["id"] in self._failed:
                self._ahead.append(self._pool.submit(self._look, row))
        return self._ahead.popleft().result() if self._ahead else None

    def ready(self) -> bool:
        """Whether `next` returns at once."""
        return not self._ahead or self._ahead[0].done()

    def _look(self, row: Row) -> Look:
        try:
            return self._look_once(row)
        except OSError:
            # The row's task asks the store again, and has retries.
            return Look(row, None, None, 0, 0, 0)

    def _look_once(self, row: Row) -> Look:
        store, name = self._store, row["id"]
        entries = store.names(name)
        swept = sweep(store, name, entries, self._grace) if self._clean else 0
        try:
            source = source_of(row, __version__)
        except InputError as error:
            refused = {
                "id": name,
                "state": "failed",
                "attempts": 0,
                **Failure("refused", str(error), 2).record(),
            }
            return Look(row, refused, None, 0, 0, swept)
        files = source["files"]
        found = read_success(store, name) if SUCCESS in entries else None
        outcome: Outcome | None = None
        if found and found.get("source") == source:
            outcome = {"id": name, "attempts": 0, **finished(store, name, found, "skipped")}
            if name in self._failed and self._clean:
                delete_failure(store, name)
        elif name in self._failed and not self._only_failed:
            outcome = self._refused(name, source)
        return Look(row, outcome, source, len(files), sum(f[1] for f in files), swept)

    def _refused(self, name: str, source: dict[str, Any]) -> Outcome | None:
        """An earlier refusal of the same inputs and options, which stands."""
        record = read_failure(self._store, name)
        if not record or record.get("kind") != "refused" or record.get("source") != source:
            return None
        kept = ("id", "kind", "message", "exit_code", "attempts", "log", "key", "source")
        return {"state": "failed", "known": True, **{key: record.get(key) for key in kept}}
