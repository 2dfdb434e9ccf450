"""The driver on a cluster of one node; `cluster.py` has the one that is killed."""

import csv
import importlib.util
import json
import secrets
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from cluster import RAY_PORT, Node, eventually

pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a cluster of one node, since starting one takes longer than the rows."""
    # Ray's sockets need a short path.
    base = Path(tempfile.mkdtemp(prefix="sc-", dir="/tmp"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_MODE", "token")
        patch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(24))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("SPLATVK_PROGRAM", str(Path(__file__).with_name("fake_splatvk")))
        patch.setenv("FAKE_SPLATVK_STATE", str(tmp_path_factory.mktemp("state")))
        node = Node(base, head=True)
        eventually(node.up, 120, "the node is up")
        yield f"127.0.0.1:{RAY_PORT}"
        node.stop()
    shutil.rmtree(base, ignore_errors=True)


@pytest.fixture
def manifest(tmp_path, photos):
    def write(*rows):
        path = tmp_path / "m.jsonl"
        path.write_text("".join(json.dumps({"input": str(photos), **row}) + "\n" for row in rows))
        return str(path)

    return write


def drive(tmp_path, *arguments):
    command = [sys.executable, "-m", "splatvk.batch", *arguments, "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    print(done.stdout, done.stderr)
    return done


def test_rows_are_settled(tmp_path, manifest, cluster):
    path = manifest(
        {"id": "good"},
        {"id": "lost", "options": {"lost": 1}},
        {"id": "large", "options": {"max_size": 640, "out_of_memory": 500}},
        {"id": "bad", "options": {"refuse": 1}},
        {"id": "none", "input": "/nowhere"},
    )
    run = drive(
        tmp_path, path, "--address", cluster, "--cpus-per-row", "1", "--scratch", str(tmp_path / "scratch")
    )
    assert run.returncode == 1, run.stderr
    out = tmp_path / "out"
    with open(out / "summary.csv") as file:
        rows = {row["id"]: row for row in csv.DictReader(file)}
    assert {name: (row["state"], row["attempts"]) for name, row in rows.items()} == {
        "good": ("done", "1"),
        "lost": ("done", "2"),
        "large": ("done", "2"),
        "bad": ("refused", "1"),
        "none": ("refused", "0"),
    }
    assert sorted(p.stem for p in (out / "_failed").iterdir()) == ["bad", "none"]
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert events[0]["event"] == "begin" and events[-1]["event"] == "end"
    assert sum(e["event"] == "retry" for e in events) == 1

    dry = drive(tmp_path, path, "--dry-run")
    states = {line.split()[0]: line.split()[1] for line in dry.stdout.splitlines()[1:] if line[0] != " "}
    assert [states[name] for name in ("good", "lost", "large", "bad", "none")] == ["done"] * 3 + [
        "refused"
    ] * 2
    assert "0 of 5 rows to do" in dry.stdout


def test_node_without_device_stops_run(tmp_path, manifest, cluster):
    rows = ({"id": str(n), "options": {"missing": 1}} for n in range(30))
    run = drive(tmp_path, manifest(*rows), "--address", cluster)
    assert run.returncode == 3, run.stderr
    assert "no node is left that can work: told to missing" in run.stderr
    # Rows that were not tried are no failures.
    assert len(list((tmp_path / "out").glob("_failed/*"))) < 10


def test_many_failures_stop_run(tmp_path, manifest, cluster):
    rows = ({"id": str(n), "options": {"fail": 1}} for n in range(40))
    run = drive(tmp_path, manifest(*rows), "--address", cluster, "--max-failures", "5%")
    assert run.returncode == 1 and "more than --max-failures allows" in run.stderr
    assert len(list((tmp_path / "out" / "_failed").iterdir())) < 15


def test_wrong_arguments_are_refused(tmp_path, manifest):
    path = manifest({"id": "a", "wrong": 1})
    assert drive(tmp_path, path).returncode == 2
    good = manifest({"id": "a"})
    for extra in (["--max-failures", "x"], ["--shard", "2/2"], ["--engin", "ray"], ["--engine", "dask"]):
        assert drive(tmp_path, good, *extra).returncode == 2, extra
    assert not (tmp_path / "out").exists()
