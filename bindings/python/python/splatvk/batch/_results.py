"""The layout of results: `ID/_SUCCESS.json`, attempts, failures.

An attempt is a folder `ID/KEY16-END-RANDOM`; END is the time, in seconds since 1970 as hexadecimal
digits, until which its writer may make it the row's result. A writer that is late gives up, so an
attempt that is past its end and is not named by `_SUCCESS.json` belongs to nobody and is deleted.
"""

import json
import re
import secrets
import time
from dataclasses import dataclass
from typing import Any

from ._kinds import Failure
from ._store import ABSENT, Store

SUCCESS = "_SUCCESS.json"
_ATTEMPT = re.compile(r"[0-9a-zA-Z]{1,16}-([0-9a-f]{8,12})-[0-9a-f]{8}")
#: Between the end of a lease and the deletion: clocks differ, and a put may hang for minutes.
GRACE = 300.0


@dataclass(frozen=True)
class Attempt:
    name: str
    end: float


def new_attempt(key: str, lease: float) -> Attempt:
    end = int(time.time() + lease)
    return Attempt(f"{key[:16]}-{end:08x}-{secrets.token_hex(4)}", float(end))


def read_success(store: Store, name: str) -> dict[str, Any] | None:
    data = store.read(f"{name}/{SUCCESS}")
    return None if data is None else _parsed(data)


def _parsed(data: bytes) -> dict[str, Any] | None:
    """None for a file that is no result, which is then replaced."""
    try:
        success = json.loads(data)
    except ValueError:
        return None
    return success if isinstance(success, dict) else None


def _dumped(value: dict[str, Any]) -> bytes:
    return json.dumps(value, indent=1, ensure_ascii=False).encode() + b"\n"


def commit(store: Store, name: str, attempt: Attempt, success: dict[str, Any]) -> bool:
    """Makes an uploaded attempt the row's result. False if another worker's result stands."""
    path = f"{name}/{SUCCESS}"
    data = _dumped(success)
    while time.time() < attempt.end:
        # The version is read before the content: content newer than it makes the put fail.
        version = store.version(path)
        old = None if version == ABSENT else read_success(store, name)
        if old and old.get("at") == attempt.name:
            # An earlier put arrived although its answer did not.
            return True
        if old and old.get("key") == success["key"]:
            return False
        if store.put_if(path, data, version):
            if version != ABSENT:
                _delete_replaced(store, name, old)
            return True
    raise Failure("transient", "the upload took longer than its lease")


def _delete_replaced(store: Store, name: str, old: dict[str, Any] | None) -> None:
    at = (old or {}).get("at", ".")
    # A result of the one-machine engine lies in the folder itself.
    for folder in ("scene", "exports", "log.jsonl") if at == "." else (at,):
        try:
            store.delete(f"{name}/{folder}")
        except OSError:
            pass


def refresh_source(store: Store, name: str, key: str, source: dict[str, Any]) -> bool:
    """Whether a result with this key stands; its source becomes the present one, so that the next
    run need not read the inputs."""
    path = f"{name}/{SUCCESS}"
    version = store.version(path)
    found = None if version == ABSENT else read_success(store, name)
    if not found or found.get("key") != key:
        return False
    # Losing against another worker is fine: that one saw the same inputs.
    store.put_if(path, _dumped({**found, "source": source}), version)
    return True


def sweep(store: Store, name: str, entries: list[str], grace: float = GRACE) -> int:
    """Deletes attempts that nobody can finish any more; returns how many."""
    now = time.time()
    late = [e for e in entries if (found := _ATTEMPT.fullmatch(e)) and int(found[1], 16) + grace < now]
    if not late:
        return 0
    # Read after the listing: no late attempt can become the result any more.
    named = (read_success(store, name) or {}).get("at")
    gone = [entry for entry in late if entry != named]
    for entry in gone:
        store.delete(f"{name}/{entry}")
    return len(gone)


def failure_path(name: str) -> str:
    return f"_failed/{name}.json"


def write_failure(store: Store, outcome: dict[str, Any]) -> None:
    kept = ("id", "key", "kind", "message", "exit_code", "attempts", "log", "host", "source")
    record = {name: outcome.get(name) for name in kept}
    store.put(failure_path(outcome["id"]), _dumped({**record, "time": round(time.time(), 3)}))


def read_failure(store: Store, name: str) -> dict[str, Any] | None:
    data = store.read(failure_path(name))
    return None if data is None else _parsed(data)


def delete_failure(store: Store, name: str) -> None:
    store.delete(failure_path(name))
    if store.appends:
        # The engine of one machine keeps the log of a failure in a folder, beside it.
        store.delete(f"_failed/{name}.log")
