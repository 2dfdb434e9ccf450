"""What a driver writes beside the results: events and the summary."""

import csv
import io
import json
import os
import secrets
import socket
import sys
import time
from typing import Any

from ._row import Outcome
from ._store import Store

#: Those of the engine of one machine, and the attempts of this run.
COLUMNS = (
    "id",
    "state",
    "seconds",
    "device",
    "photos",
    "psnr",
    "rotation_sigma_degrees",
    "splats",
    "answers_found",
    "warnings",
    "error",
    "scene",
    "attempts",
)
#: An object is written again with every flush, so it ends at this size and another begins.
_OBJECT_BYTES = 4 << 20
_FLUSH_SECONDS = 30.0


class Events:
    """Lines of `events.jsonl`; on object stores of `events/DRIVER.jsonl`, and once that is large
    of `events/DRIVER-2.jsonl` and so on."""

    def __init__(self, store: Store, shown: str):
        self._store = store
        self._shown = shown
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
        self.driver = f"{stamp}-{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(2)}"
        self._lines: list[bytes] = []
        self._bytes = 0
        self._part = 1
        self._flushed = time.monotonic()

    def write(self, event: str, text: str = "", **values: Any) -> None:
        """Records an event, and shows it on standard error as JSON, or as `text` if there is one."""
        record = {"event": event, "time": round(time.time(), 3), "driver": self.driver, **values}
        line = json.dumps({k: v for k, v in record.items() if v is not None}, ensure_ascii=False)
        if self._shown == "json":
            print(line, file=sys.stderr, flush=True)
        elif text:
            print(text, file=sys.stderr, flush=True)
        data = line.encode() + b"\n"
        if self._store.appends:
            self._store.append("events.jsonl", data)
            return
        self._lines.append(data)
        self._bytes += len(data)
        if time.monotonic() - self._flushed > _FLUSH_SECONDS or self._bytes > _OBJECT_BYTES:
            self.flush()

    def flush(self) -> None:
        if not self._lines:
            return
        part = f"-{self._part}" if self._part > 1 else ""
        self._store.put(f"events/{self.driver}{part}.jsonl", b"".join(self._lines))
        self._flushed = time.monotonic()
        if self._bytes > _OBJECT_BYTES:
            self._lines, self._bytes, self._part = [], 0, self._part + 1


class Summary:
    """The rows of `summary.csv`, by id."""

    def __init__(self, name: str):
        self._name = name
        self._rows: dict[str, tuple[str, ...]] = {}

    def add(self, outcome: Outcome) -> None:
        failed = outcome["state"] == "failed"
        row = {
            **outcome,
            "state": outcome["kind"] if failed else "done",
            "error": outcome.get("message") if failed else None,
        }
        cells = ("" if row.get(c) is None else str(row[c]) for c in COLUMNS)
        self._rows[outcome["id"]] = tuple(cells)

    def write(self, store: Store) -> None:
        if not self._rows:
            return
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(self._rows[name] for name in sorted(self._rows))
        store.put(self._name, text.getvalue().encode())
