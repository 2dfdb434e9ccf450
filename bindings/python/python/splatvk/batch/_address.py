"""Inputs by path or by address of fsspec: listing, reading, fetching."""

import glob
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from ..errors import InputError, MissingError

_WILD = "*?["


@dataclass(frozen=True)
class Found:
    """A file of an input. `under` is its path below the input."""

    address: str
    size: int
    tag: str
    under: str


def is_remote(address: str) -> bool:
    return "://" in address and not address.startswith("file://")


def join(base: str, path: str) -> str:
    path = path.removeprefix("file://")
    return f"{base}/{path}" if is_remote(base) else os.path.abspath(os.path.join(base, path))


def filesystem(address: str) -> tuple[Any, str]:
    """The file system of an address, and the path there."""
    try:
        import fsspec
    except ImportError:
        raise MissingError(f"{address} needs fsspec: pip install 'splatvk[batch]'") from None
    protocol = address.partition("://")[0]
    try:
        # A listing that is kept would hide what other workers write.
        fs = fsspec.filesystem(protocol, use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise MissingError(f"{address}: {error}") from None
    return fs, fs._strip_protocol(address)


@contextmanager
def open_text(address: str) -> Iterator[TextIO]:
    try:
        if is_remote(address):
            fs, path = filesystem(address)
            with fs.open(path, "r", encoding="utf-8", newline="") as file:
                yield file
        else:
            with open(address, encoding="utf-8", newline="") as file:
                yield file
    except FileNotFoundError:
        raise InputError(f"{address} is not there") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{address} is no text: {error}") from None


def _root(path: str) -> str:
    """The folders before the first wildcard."""
    parts = path.split("/")
    fixed = next(i for i, part in enumerate(parts) if any(c in part for c in _WILD))
    return "/".join(parts[:fixed])


def _tag(info: dict[str, Any]) -> str:
    """An entity tag where the store has one, else the time of the last change."""
    for key in ("ETag", "etag", "generation", "md5Hash", "mtime", "LastModified", "last_modified"):
        if info.get(key):
            return str(info[key]).strip('"')
    return ""


def _remote(entry: str) -> list[Found]:
    fs, path = filesystem(entry)
    protocol = entry.partition("://")[0]
    wild = any(c in path for c in _WILD)
    if wild:
        root, infos = _root(path), fs.glob(path, detail=True)
    else:
        root, infos = path, fs.find(path, detail=True)
    files = [i for i in infos.values() if i["type"] == "file" and not i["name"].endswith("/")]
    if len(files) == 1 and files[0]["name"] == path:
        root = path.rpartition("/")[0]
    return [
        Found(
            f"{protocol}://{i['name'].lstrip('/')}",
            i["size"] or 0,
            _tag(i),
            i["name"][len(root) :].lstrip("/"),
        )
        for i in files
    ]


def _local(entry: str) -> list[Found]:
    if any(c in entry for c in _WILD) and not os.path.exists(entry):
        root, paths = _root(entry), [p for p in glob.glob(entry) if os.path.isfile(p)]
    elif os.path.isdir(entry):
        root = entry
        paths = [str(p) for p in Path(entry).rglob("*") if p.is_file()]
    else:
        root, paths = os.path.dirname(entry), [entry] if os.path.exists(entry) else []
    found = []
    for path in paths:
        stat = os.stat(path)
        found.append(Found(path, stat.st_size, str(stat.st_mtime_ns), os.path.relpath(path, root or "/")))
    return found


def listing(entry: str) -> list[Found]:
    """Files that an input means, by name; hidden ones are left out."""
    found = _remote(entry) if is_remote(entry) else _local(entry)
    shown = [f for f in found if not any(part.startswith(".") for part in f.under.split("/"))]
    if not shown:
        raise InputError(f"{entry} has no files" if found else f"{entry} is not there, or matches nothing")
    return sorted(shown, key=lambda f: f.address)


def fetch(entry: str, folder: Path) -> list[str]:
    """Local paths of an input; remote files are copied below `folder` with their names."""
    if not is_remote(entry):
        return [entry]
    fs, path = filesystem(entry)
    found = listing(entry)
    one = any(c in path for c in _WILD) or [fs._strip_protocol(f.address) for f in found] == [path]
    # A folder keeps its name, since a scene is named after it.
    below = folder if one else folder / path.rstrip("/").rpartition("/")[2]
    places = [below / f.under for f in found]
    for place in places:
        if below.resolve() not in place.resolve().parents:
            raise InputError(f"{entry}: a name leaves the folder: {place}")
        place.parent.mkdir(parents=True, exist_ok=True)
    fs.get([fs._strip_protocol(f.address) for f in found], [str(p) for p in places])
    return [str(p) for p in places] if one else [str(below)]
