"""`splatvk batch --engine ray`, which is `python -m splatvk.batch`."""

import argparse
import contextlib
import json
import os
import signal
import statistics
import sys
from types import FrameType

from ..errors import Error, InputError, MissingError, UnwritableError
from ._look import Looker
from ._manifest import Manifest, read, shard_of
from ._record import Events, Summary
from ._results import GRACE
from ._store import Store, open_store


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="splatvk batch --engine ray",
        description="Makes the scene of every row of a manifest, on a Ray cluster.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "manifest",
        help="JSON lines {id, input, options, queries, exports}, CSV id,input, or a folder of folders",
    )
    add("--out", required=True, metavar="ADDRESS", help="folder, or address of fsspec: s3://bucket/scenes")
    add("--engine", choices=["ray"], default="ray", help=argparse.SUPPRESS)
    where = (
        "Ray cluster; `local` starts one here [default: RAY_ADDRESS, else the one that runs here, else local]"
    )
    add("--address", help=where)
    gpus = "may be a fraction [default: 1 where the cluster has GPUs, else 0]"
    add("--gpus-per-row", type=float, metavar="N", help=gpus)
    cpus = "[default: the share of a GPU; without GPUs 4, or what the smallest node has]"
    add("--cpus-per-row", type=float, metavar="N", help=cpus)
    add("--timeout", type=_seconds, metavar="TIME", help="longest time of a row, with s, m or h")
    add(
        "--retries",
        type=int,
        default=2,
        metavar="N",
        help="more tries of a row whose machine failed [default: 2]",
    )
    add("--max-failures", metavar="N|P%", help="start no more rows once more have failed")
    add("--only", choices=["failed"], help="rows whose last attempt failed, refused ones included")
    shard = "every N-th row from I on; auto in an array job, auto/N on Kubernetes"
    add("--shard", default="0/1", metavar="I/N", help=shard)
    add("--dry-run", action="store_true", help="show what would be done")
    add("--device", help="Vulkan device of every node, instead of the one that Ray gives")
    add("--scratch", metavar="DIR", help="folder of temporary files on every node")
    lease = "time for an upload, after which it is abandoned [default: 3600]"
    add("--lease", type=float, default=3600.0, metavar="SECONDS", help=lease)
    add("--json", action="store_true", help="one JSON object on standard output")
    add("--log", choices=["text", "json"], default="text", help="messages on standard error")
    return parser


def _seconds(text: str) -> float:
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    seconds = float(text[:-1]) * units[text[-1]] if text[-1:] in units else float(text)
    if not 0 < seconds < 1e7:
        raise ValueError(text)
    return seconds


def _limit(text: str | None, total: int) -> float | None:
    if text is None:
        return None
    try:
        limit = float(text[:-1]) / 100 * total if text.endswith("%") else float(int(text))
    except ValueError:
        limit = -1.0
    if limit < 0:
        raise InputError(f"--max-failures {text}: give a number of rows, or a percentage as 10%")
    return limit


def _summary_name(shard: tuple[int, int]) -> str:
    return "summary.csv" if shard[1] == 1 else f"summary-{shard[0]}-of-{shard[1]}.csv"


def _dry_run(looker: Looker, total: int) -> None:
    """A line per row, and how long the rest may take."""
    to_do, seconds, bytes_, rows = 0, [], 0, 0
    print(f"{'id':40} {'state':10} {'files':>6} {'MB':>9}")
    for look in looker:
        rows += 1
        outcome = look.outcome
        if outcome is None:
            state = "to do"
            to_do += 1
            bytes_ += look.bytes
        elif outcome["state"] == "failed":
            state = str(outcome["kind"])
        else:
            state = "done"
            if outcome.get("seconds"):
                seconds.append(float(outcome["seconds"]))
        print(f"{look.row['id']:40} {state:10} {look.files:6} {look.bytes / 1e6:9.1f}")
        if outcome and outcome["state"] == "failed":
            print(f"  {outcome['message']}")
    print(f"{to_do} of {rows} rows to do, {bytes_ / 1e6:.1f} MB of inputs")
    if seconds and to_do:
        hours = statistics.median(seconds) * to_do / 3600
        print(f"about {hours:.2f} device hours, by the median of {len(seconds)} finished rows")


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _run(arguments: argparse.Namespace, manifest: Manifest, store: Store, shard: tuple[int, int]) -> int:
    total = len(manifest)
    limit = _limit(arguments.max_failures, total)
    looker = Looker(
        store,
        manifest,
        only_failed=arguments.only == "failed",
        grace=min(GRACE, arguments.lease),
        clean=not arguments.dry_run,
    )
    try:
        if arguments.dry_run:
            _dry_run(looker, total)
            return 0
        return _drive(arguments, store, looker, total, limit, shard)
    finally:
        looker.close()


def _drive(
    arguments: argparse.Namespace,
    store: Store,
    looker: Looker,
    total: int,
    limit: float | None,
    shard: tuple[int, int],
) -> int:
    try:
        from ._ray import Engine, Options
    except ImportError as error:
        raise MissingError(f"the engine needs Ray ({error}): pip install 'splatvk[batch]'") from None
    options = Options(
        out=store.address,
        total=total,
        address=arguments.address,
        gpus=arguments.gpus_per_row,
        cpus=arguments.cpus_per_row,
        timeout=arguments.timeout,
        retries=arguments.retries,
        max_failures=limit,
        lease=arguments.lease,
        scratch=arguments.scratch,
        device=arguments.device,
    )
    events, summary = Events(store, arguments.log), Summary(_summary_name(shard))
    engine = Engine(options, store, looker, events, summary)
    code = 1
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        events.write("begin", rows=total, out=store.address)
        # Ray prints pages about each lost worker there; the events have a line.
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            engine.connect()
            engine.run()
        code = (
            3 if engine.missing else 1 if engine.counts.failed + engine.counts.known or engine.stopped else 0
        )
    except KeyboardInterrupt:
        code = 130
        engine.cancel()
        events.write("stopped", "stopped; the same command goes on", message="interrupted")
    finally:
        counts = engine.counts
        failed = counts.failed + counts.known
        text = f"{counts.done} done, {counts.skipped} were done before, {failed} failed"
        if failed:
            text += f"; reasons in {store.address}/_failed"
        events.write("end", text, done=counts.done, skipped=counts.skipped, failed=failed, exit_code=code)
        events.flush()
        summary.write(store)
    if arguments.json:
        print(json.dumps({"rows": total, "kept": counts.skipped, "done": counts.done, "failed": failed}))
    return code


def main(argv: list[str] | None = None) -> None:
    arguments = _parser().parse_args(argv)
    try:
        shard = shard_of(arguments.shard)
        store = open_store(arguments.out)
        code = _run(arguments, read(arguments.manifest, shard), store, shard)
    except InputError as error:
        code = _refuse(error, 2)
    except MissingError as error:
        code = _refuse(error, 3)
    except (UnwritableError, PermissionError) as error:
        code = _refuse(error, 4)
    except (Error, OSError) as error:
        code = _refuse(error, 1)
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _refuse(error: Exception, code: int) -> int:
    print(f"error: {error}", file=sys.stderr)
    return code
