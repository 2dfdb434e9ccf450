"""One row: inputs to a scratch folder, one program, the result to the store."""

import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from .. import __version__
from ..errors import InputError, MissingError
from ._address import fetch
from ._kinds import EXIT_CODES, RETRIED, Failure, delay, failure_of, smaller
from ._manifest import Row, row_of, source_of
from ._program import Ended, Keeper, KeeperGone, find_program
from ._results import (
    SUCCESS,
    commit,
    delete_failure,
    new_attempt,
    read_success,
    refresh_source,
    write_failure,
)
from ._store import Store, open_store

Outcome = dict[str, Any]
T = TypeVar("T")


def run_row(
    row: Mapping[str, Any],
    out: str,
    *,
    device: str | None = None,
    timeout: float | None = None,
    retries: int = 0,
    lease: float = 3600.0,
    scratch: str | None = None,
    record: bool = True,
) -> Outcome:
    """Makes the result of one row in `out`, unless it is there; never raises for a row that fails.

    For any scheduler: Ray's engine calls it, and so can Dask's `client.map` or Spark's
    `mapInPandas`. Two calls for one row do no harm: one of them wins.

    Parameters
    ----------
    row : mapping
        A row of a manifest: id, input, options, queries, exports.
    out : str
        Folder or address (fsspec) of all results.
    device : str, optional
        The option `--device` of the program.
    timeout : float, optional
        Seconds that the program may take.
    retries : int
        How often a row is tried again whose machine failed, not the row itself. After memory of
        the device ran out it is tried once more in any case, with smaller images.
    lease : float
        Seconds that the upload may take. Later its attempt counts as abandoned.
    scratch : str, optional
        Folder for temporary files of this machine, else the system's.
    record : bool
        Whether a failure is written to `_failed/ID.json`.

    Returns
    -------
    dict
        id, state ("done", "skipped" or "failed"), seconds, attempts; of a finished row device,
        psnr, splats and scene; of a failed one kind, message, exit_code and log.
    """
    checked = row_of(dict(row), base=os.getcwd())
    begin = time.monotonic()
    attempts = 0
    max_size: int | None = None
    while True:
        attempts += 1
        outcome = _attempt(checked, out, device, timeout, lease, scratch, max_size)
        outcome.update(id=checked["id"], attempts=attempts, host=socket.gethostname())
        outcome.setdefault("seconds", round(time.monotonic() - begin, 3))
        if outcome["state"] != "failed":
            break
        if outcome["kind"] == "memory" and max_size is None:
            max_size = smaller(checked["options"])
        elif outcome["kind"] not in RETRIED or attempts - (max_size is not None) > retries:
            break
        else:
            time.sleep(delay(attempts))
    if record and outcome["state"] == "failed":
        try:
            write_failure(open_store(out), outcome)
        except Exception as error:
            outcome["message"] += f"; the failure could not be recorded: {error}"
    return outcome


def _attempt(
    row: Row,
    out: str,
    device: str | None,
    timeout: float | None,
    lease: float,
    scratch: str | None,
    max_size: int | None,
) -> Outcome:
    """One try. Every error becomes an outcome, since a scheduler loses the reason of an exception."""
    source: dict[str, Any] | None = None
    try:
        store = open_store(out)
        source = _readable(lambda: source_of(row, __version__))
        found = read_success(store, row["id"])
        if found and found.get("source") == source:
            return finished(store, row["id"], found, "skipped")
        with Keeper(scratch) as keeper:
            return _work(row, store, source, keeper, device, timeout, lease, max_size)
    except Exception as error:
        return {"state": "failed", **_failure(error).record(), "source": source}


def _failure(error: Exception) -> Failure:
    if isinstance(error, Failure):
        return error
    if isinstance(error, KeeperGone):
        return Failure("transient", "the keeper of the program was killed")
    if isinstance(error, InputError):
        return Failure("refused", str(error), 2)
    if isinstance(error, MissingError):
        return Failure("missing", str(error), 3)
    if isinstance(error, PermissionError):
        return Failure("unwritable", str(error), 4)
    if isinstance(error, OSError):
        return failure_of(error)
    return Failure("failed", f"{type(error).__name__}: {error}", 1)


def _work(
    row: Row,
    store: Store,
    source: dict[str, Any],
    keeper: Keeper,
    device: str | None,
    timeout: float | None,
    lease: float,
    max_size: int | None,
) -> Outcome:
    program = find_program()
    inputs = []
    for number, entry in enumerate(row["input"]):
        folder = keeper.scratch / "input" / str(number)
        inputs += _readable(partial(fetch, entry, folder))
    local = {**row, "input": inputs}
    key = _key(keeper, program, local, timeout)
    if refresh_source(store, row["id"], key, source):
        found = read_success(store, row["id"])
        if found:
            return finished(store, row["id"], found, "skipped")

    result = keeper.scratch / "result"
    argv = [program, "batch-row", "--out", str(result), "--log", "json"]
    if device is not None:
        argv += ["--device", device]
    if max_size is not None:
        argv += ["--max-size", str(max_size)]
    ended = keeper.run(argv, json.dumps(local), timeout)
    _check(ended, timeout, key)
    success = _success_of(result)
    success.update(source=source, input=row["input"], host=socket.gethostname())
    (result / "log.jsonl").write_text(ended.stderr, encoding="utf-8")
    return _stored(store, row["id"], result, success, lease)


def _readable(read: Callable[[], T]) -> T:
    """What `read` returns. A store that does not let inputs be read is no place that cannot be
    written."""
    try:
        return read()
    except PermissionError as error:
        raise Failure("failed", f"an input cannot be read: {error}", 1) from None


def _stored(store: Store, name: str, result: Path, success: dict[str, Any], lease: float) -> Outcome:
    """Uploads the result, and makes it the row's unless another worker was first."""
    attempt = new_attempt(success["key"], lease)
    success["at"] = attempt.name
    try:
        (result / SUCCESS).unlink()
        store.upload(result, f"{name}/{attempt.name}")
        won = commit(store, name, attempt, success)
    except BaseException:
        _forget(store, f"{name}/{attempt.name}")
        raise
    if not won:
        store.delete(f"{name}/{attempt.name}")
    found = success if won else read_success(store, name)
    if not found:
        raise Failure("transient", "another worker's result vanished")
    delete_failure(store, name)
    return finished(store, name, found, "done" if won else "skipped")


def _forget(store: Store, path: str) -> None:
    """Deletes what an attempt left. A later driver does it where the store does not answer."""
    try:
        store.delete(path)
    except Exception:
        pass


def _key(keeper: Keeper, program: str, row: dict[str, Any], timeout: float | None) -> str:
    ended = keeper.run([program, "batch-row", "--key", "--log", "json"], json.dumps(row), timeout)
    _check(ended, timeout, None)
    try:
        return str(json.loads(ended.stdout)["key"])
    except (ValueError, KeyError, TypeError):
        raise Failure("failed", f"{program} batch-row --key printed no key: {ended.stdout[:200]!r}") from None


def _check(ended: Ended, timeout: float | None, key: str | None) -> None:
    """Raises for a program that did not succeed."""
    if ended.timed_out:
        failure = Failure("timeout", f"no result after {timeout:g} s", None)
    elif ended.exit_code:
        failure = Failure(*_reason(ended))
    else:
        return
    failure.log = ended.stderr[-8192:]
    failure.key = key
    raise failure


def _reason(ended: Ended) -> tuple[str, str, int]:
    message, kind = "", ""
    for line in reversed(ended.stderr.splitlines()):
        try:
            event = json.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict) and event.get("event") == "error":
            message, kind = str(event.get("message")), str(event.get("kind"))
            break
    code = ended.exit_code
    if code < 0:
        return "transient", message or f"killed by signal {-code}", code
    if code == 5:
        return ("memory" if kind == "memory" else "transient"), message, code
    last = ended.stderr.strip().rpartition("\n")[2]
    return EXIT_CODES.get(code, "failed"), message or last or f"exit code {code}", code


def _success_of(result: Path) -> dict[str, Any]:
    try:
        success: dict[str, Any] = json.loads((result / SUCCESS).read_bytes())
        files = success["files"]
        for file in files:
            if (result / file["path"]).stat().st_size != file["bytes"]:
                raise Failure("failed", f"{file['path']} has another size than {SUCCESS} says")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Failure("failed", f"the program ended well without a whole {SUCCESS}: {error}") from None
    return success


def finished(store: Store, name: str, success: dict[str, Any], state: str) -> Outcome:
    place = "" if success.get("at", ".") == "." else f"/{success['at']}"
    shown = {
        key: success.get(key)
        for key in ("seconds", "photos", "psnr", "rotation_sigma_degrees", "splats", "key")
    }
    device = success.get("device")
    shown["device"] = device.get("name") if isinstance(device, dict) else device
    shown["answers_found"] = sum(a.get("found") is True for a in success.get("answers") or ())
    shown["warnings"] = len(success.get("warnings") or ())
    return {"state": state, **shown, "scene": f"{store.address}/{name}{place}/scene"}
