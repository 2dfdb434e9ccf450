"""Manifests: one capture a row, from JSON lines, CSV, or a folder of folders."""

import csv
import io
import json
import os
import random
import re
import sys
import tempfile
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypedDict

from ..errors import InputError
from ._address import is_remote, join, listing, open_text

ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
KEYS = ("id", "input", "options", "queries", "exports")


class Row(TypedDict):
    """A capture. `input` holds absolute paths or addresses; wildcards are kept."""

    id: str
    input: list[str]
    options: dict[str, Any]
    queries: list[str]
    exports: list[str]


def _texts(value: object, what: str, where: str) -> list[str]:
    one = [value] if isinstance(value, str) else value
    if not isinstance(one, (list, tuple)) or not all(isinstance(t, str) and t for t in one):
        raise InputError(f"{where}: {what} must be a text or a list of texts")
    return list(one)


def row_of(raw: object, where: str = "row", base: str = "") -> Row:
    """The checked row; relative inputs are below `base`."""
    if not isinstance(raw, dict):
        raise InputError(f"{where}: a row must be a JSON object")
    unknown = [key for key in raw if key not in KEYS]
    if unknown:
        known = ", ".join(KEYS)
        raise InputError(f"{where}: unknown key `{unknown[0]}`; a row has {known}")
    name = raw.get("id")
    if not isinstance(name, str) or not ID.fullmatch(name):
        raise InputError(
            f"{where}: id {json.dumps(name)} must be 1 to 100 of A-Z a-z 0-9 . _ - "
            "and begin with a letter or digit"
        )
    inputs = _texts(raw.get("input", ()), "input", where)
    if not inputs:
        raise InputError(f"{where}: {name} has no input")
    options = raw.get("options") or {}
    if not isinstance(options, dict):
        raise InputError(f"{where}: options of {name} must be a JSON object")
    return {
        "id": name,
        "input": [entry if is_remote(entry) else join(base, entry) for entry in inputs],
        "options": options,
        "queries": _texts(raw.get("queries") or (), "queries", where),
        "exports": _texts(raw.get("exports") or (), "exports", where),
    }


def _json_rows(lines: Iterable[str], name: str) -> Iterator[tuple[str, object]]:
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        where = f"{name}:{number}"
        try:
            yield where, json.loads(line)
        except ValueError as error:
            raise InputError(f"{where}: no JSON object: {error}") from None


def _csv_rows(lines: Iterable[str], name: str) -> Iterator[tuple[str, object]]:
    reader = csv.DictReader(lines)
    columns = reader.fieldnames or []
    if sorted(column.strip() for column in columns) != ["id", "input"]:
        raise InputError(f"{name}: the first line must be `id,input`, not `{','.join(columns)}`")
    for row in reader:
        where = f"{name}:{reader.line_num}"
        if None in row or None in row.values():
            raise InputError(f"{where}: a row has two columns")
        yield where, {column.strip(): value.strip() for column, value in row.items()}


class Manifest:
    """Checked rows in a temporary file, since a million of them need not be in memory.

    Rows come in a random order: two drivers on one output then seldom work on the same row, and
    the time that is left is estimated from a fair sample.
    """

    def __init__(self, rows: Iterable[tuple[str, object]], base: str, shard: tuple[int, int]):
        self._file = tempfile.TemporaryFile(prefix="splatvk-manifest-")
        self._starts = array("Q")
        ids: set[str] = set()
        for index, (where, raw) in enumerate(rows):
            row = row_of(raw, where, base)
            # File systems may not tell the case of letters apart.
            if row["id"].lower() in ids:
                raise InputError(f"{where}: id {row['id']} is there twice, if case is left out")
            ids.add(row["id"].lower())
            if index % shard[1] == shard[0]:
                self._starts.append(self._file.tell())
                self._file.write(json.dumps(row).encode() + b"\n")
        if not ids:
            raise InputError("the manifest has no rows")

    def __len__(self) -> int:
        return len(self._starts)

    def rows(self) -> Iterator[Row]:
        starts = list(self._starts)
        random.shuffle(starts)
        for start in starts:
            self._file.seek(start)
            yield json.loads(self._file.readline())


def read(manifest: str, shard: tuple[int, int] = (0, 1)) -> Manifest:
    """The manifest at a path or an address, or of standard input (`-`); `shard` (I, N) keeps every
    N-th row from I on."""
    if manifest == "-":
        return Manifest(_json_rows(sys.stdin, "standard input"), os.getcwd(), shard)
    if not is_remote(manifest) and os.path.isdir(manifest):
        folders = sorted(p for p in Path(manifest).iterdir() if p.is_dir() and p.name[0] != ".")
        if not folders:
            raise InputError(f"{manifest} has no folders; each is a capture")
        found = [(str(p), {"id": p.name, "input": p.name}) for p in folders]
        return Manifest(found, os.path.abspath(manifest), shard)
    base = manifest.rpartition("/")[0] if is_remote(manifest) else str(Path(manifest).absolute().parent)
    with open_text(manifest) as lines:
        if manifest.lower().endswith(".csv"):
            return Manifest(_csv_rows(lines, manifest), base, shard)
        return Manifest(_json_rows(lines, manifest), base, shard)


#: Index and number of an array job; Kubernetes states no number.
_ARRAYS = (
    ("SLURM_ARRAY_TASK_ID", "SLURM_ARRAY_TASK_COUNT"),
    ("JOB_COMPLETION_INDEX", ""),
    ("AWS_BATCH_JOB_ARRAY_INDEX", "AWS_BATCH_JOB_ARRAY_SIZE"),
    ("BATCH_TASK_INDEX", "BATCH_TASK_COUNT"),
)


def shard_of(text: str) -> tuple[int, int]:
    """`I/N`; `auto` in an array job of Slurm, AWS Batch or Google Batch; `auto/N` in Kubernetes."""
    found = re.fullmatch(r"(\d+|auto)(?:/(\d+))?", text)
    if not found or not (found[2] or found[1] == "auto"):
        raise InputError(f"--shard {text}: give I/N with I from 0, or auto in an array job")
    count = found[2]
    if found[1] != "auto":
        index = int(found[1])
    else:
        env = os.environ
        name, size = next(((name, size) for name, size in _ARRAYS if name in env), ("", ""))
        if not name:
            names = ", ".join(name for name, _ in _ARRAYS)
            raise InputError(f"--shard auto needs an array job; none of {names} is set")
        count = count or env.get(size)
        if not count:
            raise InputError(f"--shard auto: {name} states no number of parts; give auto/N")
        index = int(env[name])
        if name == "SLURM_ARRAY_TASK_ID":
            first, step = env.get("SLURM_ARRAY_TASK_MIN") or 0, env.get("SLURM_ARRAY_TASK_STEP") or 1
            index = (index - int(first)) // int(step)
    if not 0 <= index < int(count):
        raise InputError(f"--shard: part {index} of {count}; parts count from 0")
    return index, int(count)


def source_of(row: Row, version: str) -> dict[str, Any]:
    """What decides whether a finished row is still right, known without reading a photo."""
    files = [[f.address, f.size, f.tag] for entry in row["input"] for f in listing(entry)]
    kept = {key: row[key] for key in ("input", "options", "queries", "exports")}
    return {"files": files, **kept, "splatvk": version}


def dumps(rows: Iterable[Row]) -> str:
    """Rows as JSON lines."""
    out = io.StringIO()
    for row in rows:
        out.write(json.dumps(row) + "\n")
    return out.getvalue()
