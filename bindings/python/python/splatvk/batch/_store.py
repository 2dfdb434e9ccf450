"""Where results go: a folder, or an object store by way of fsspec.

A result counts once its `_SUCCESS.json` is there, and that file is put under a condition: of two
workers with the same row one wins, and the other is told.
"""

import errno
import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from ._address import filesystem, is_remote

#: The condition that there is no such file yet.
ABSENT = "absent"


class Store(Protocol):
    """Files below an address; paths are relative, with `/`."""

    address: str
    #: Whether a file can be appended to.
    appends: bool

    def read(self, path: str) -> bytes | None: ...

    def version(self, path: str) -> str:
        """A tag that changes with the content, or ABSENT."""

    def put(self, path: str, data: bytes) -> None: ...

    def put_if(self, path: str, data: bytes, version: str) -> bool:
        """Puts the file if it still has that version; False if it has another."""

    def append(self, path: str, data: bytes) -> None: ...

    def names(self, path: str) -> list[str]:
        """Names of the entries of a folder; none where there is no folder."""

    def upload(self, folder: Path, path: str) -> None: ...

    def delete(self, path: str) -> None:
        """Deletes a file or a folder with what is in it; one that is not there is fine."""


def open_store(address: str) -> Store:
    """The store of a path or an address."""
    if is_remote(address):
        return ObjectStore(address)
    return FolderStore(address.removeprefix("file://"))


class FolderStore:
    """A folder of this machine, or one that machines share."""

    appends = True

    def __init__(self, address: str):
        self.address = os.path.abspath(address)
        self._root = Path(self.address)

    def read(self, path: str) -> bytes | None:
        try:
            return (self._root / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def version(self, path: str) -> str:
        data = self.read(path)
        return ABSENT if data is None else hashlib.sha256(data).hexdigest()

    @contextmanager
    def _written(self, path: str, data: bytes) -> Iterator[str]:
        """A whole file beside the place of `path`, on the disk."""
        place = self._root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=".put-", dir=place.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
            yield name
        finally:
            Path(name).unlink(missing_ok=True)

    def put(self, path: str, data: bytes) -> None:
        with self._written(path, data) as name:
            os.replace(name, self._root / path)

    def put_if(self, path: str, data: bytes, version: str) -> bool:
        with self._written(path, data) as name:
            if version == ABSENT:
                try:
                    # A link, unlike a rename, fails where the name is taken.
                    os.link(name, self._root / path)
                    return True
                except FileExistsError:
                    return False
                except OSError as error:
                    if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK):
                        raise
            with self._locked():
                if self.version(path) != version:
                    return False
                os.replace(name, self._root / path)
                return True

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Holds the lock of replacements, which ends with the process that holds it."""
        handle = os.open(self._root / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)

    def append(self, path: str, data: bytes) -> None:
        self._root.mkdir(parents=True, exist_ok=True)
        # One write at the end of the file, so that lines of two drivers do not mix.
        handle = os.open(self._root / path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(handle, data)
        finally:
            os.close(handle)

    def names(self, path: str) -> list[str]:
        try:
            return sorted(os.listdir(self._root / path))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def upload(self, folder: Path, path: str) -> None:
        place = self._root / path
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(folder, place, copy_function=_copy)

    def delete(self, path: str) -> None:
        place = self._root / path
        try:
            place.unlink()
        except IsADirectoryError:
            shutil.rmtree(place, ignore_errors=True)
        except (FileNotFoundError, NotADirectoryError):
            return
        # Folders that are empty now would look like results.
        for parent in place.parents:
            if parent == self._root:
                break
            try:
                parent.rmdir()
            except OSError:
                break


def _copy(source: str, target: str) -> None:
    """Copies a file onto the disk, since `_SUCCESS.json` promises that it is there."""
    shutil.copyfile(source, target)
    handle = os.open(target, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


class ObjectStore:
    """An object store. Conditions are exact on S3; elsewhere a new file is put under fsspec's
    mode "create", and a replacement is put and read back, so that the last writer wins."""

    appends = False

    def __init__(self, address: str):
        self.address = address.rstrip("/")
        self._fs, root = filesystem(self.address)
        self._root = root.rstrip("/")
        self._s3 = "s3" in self._protocols()

    def _protocols(self) -> tuple[str, ...]:
        protocol: Any = self._fs.protocol
        return (protocol,) if isinstance(protocol, str) else tuple(protocol)

    def _at(self, path: str) -> str:
        return f"{self._root}/{path}"

    def read(self, path: str) -> bytes | None:
        try:
            data: bytes = self._fs.cat_file(self._at(path))
            return data
        except FileNotFoundError:
            return None

    def version(self, path: str) -> str:
        try:
            info = self._fs.info(self._at(path))
        except FileNotFoundError:
            return ABSENT
        return str(info.get("ETag") or "there")

    def put(self, path: str, data: bytes) -> None:
        self._fs.pipe_file(self._at(path), data)

    def put_if(self, path: str, data: bytes, version: str) -> bool:
        try:
            if version == ABSENT:
                self._fs.pipe_file(self._at(path), data, mode="create")
            elif self._s3:
                self._fs.pipe_file(self._at(path), data, IfMatch=version)
            else:
                self.put(path, data)
                return self.read(path) == data
            return True
        except FileExistsError:
            return False
        except OSError as error:
            if _condition_failed(error):
                return False
            raise

    def append(self, path: str, data: bytes) -> None:
        raise NotImplementedError("objects cannot be appended to")

    def names(self, path: str) -> list[str]:
        try:
            entries = self._fs.ls(self._at(path), detail=False)
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted(e.rstrip("/").rpartition("/")[2] for e in entries)

    def upload(self, folder: Path, path: str) -> None:
        files = sorted(p for p in folder.rglob("*") if p.is_file())
        places = [self._at(f"{path}/{p.relative_to(folder).as_posix()}") for p in files]
        self._fs.put([str(p) for p in files], places)

    def delete(self, path: str) -> None:
        try:
            self._fs.rm(self._at(path), recursive=True)
        except FileNotFoundError:
            pass


def _condition_failed(error: BaseException | None) -> bool:
    """Whether S3 refused a put for its condition: 412, or 409 where two puts met, or 404 where
    the replaced object is gone."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            status = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
            if status in (404, 409, 412):
                return True
        error = error.__cause__
    return False
