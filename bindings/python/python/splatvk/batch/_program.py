"""The program `splatvk`, run by a keeper in a scratch folder."""

import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from ..errors import MissingError
from ._keeper import LOCK, remove

_PREFIX = "splatvk-batch-"
_NEW = ".new-" + _PREFIX
#: A folder without a lock is a leftover after this time.
_UNLOCKED_SECONDS = 600.0


class KeeperGone(Exception):
    """The keeper was killed, and the program with it."""


@dataclass(frozen=True)
class Ended:
    """How a program ended. `exit_code` is negative for a signal."""

    exit_code: int
    timed_out: bool
    stdout: str
    stderr: str


def find_program() -> str:
    """`SPLATVK_PROGRAM`, the one beside this Python, or the one on the path."""
    named = os.environ.get("SPLATVK_PROGRAM")
    if named:
        return named
    beside = shutil.which("splatvk", path=str(Path(sys.executable).parent))
    found = beside or shutil.which("splatvk")
    if not found:
        raise MissingError("no program splatvk on this machine; install the package, or set SPLATVK_PROGRAM")
    return found


def clear_scratch(root: Path) -> None:
    """Deletes scratch folders whose keepers are gone."""
    for folder in (*root.glob(_PREFIX + "*"), *root.glob(_NEW + "*")):
        try:
            if folder.name.startswith(_NEW):
                raise FileNotFoundError
            handle = os.open(folder / LOCK, os.O_RDWR)
        except OSError:
            try:
                if time.time() - folder.stat().st_mtime > _UNLOCKED_SECONDS:
                    shutil.rmtree(folder, ignore_errors=True)
            except OSError:
                pass
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            remove(str(folder))
        except OSError:
            pass
        finally:
            os.close(handle)


class Keeper:
    """A scratch folder and a process that runs programs; both are gone afterwards."""

    def __init__(self, root: str | None = None):
        self._root = Path(root or tempfile.gettempdir())

    def __enter__(self) -> "Keeper":
        self._root.mkdir(parents=True, exist_ok=True)
        clear_scratch(self._root)
        made = Path(tempfile.mkdtemp(prefix=_NEW, dir=self._root))
        script = Path(__file__).with_name("_keeper.py")
        lock = os.open(made / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            # Under its name the folder is locked from the beginning: another worker would delete it.
            self.scratch = made.with_name(made.name.removeprefix(_NEW.removesuffix(_PREFIX)))
            made.rename(self.scratch)
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(script), str(self.scratch)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                pass_fds=[lock],
            )
        finally:
            os.close(lock)
        try:
            self._answer()
        except KeeperGone:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process.stdin:
            try:
                self._process.stdin.close()
            except BrokenPipeError:
                pass
        try:
            self._process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        remove(str(self.scratch))

    def _answer(self) -> dict[str, object]:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise KeeperGone
        answer: dict[str, object] = json.loads(line)
        return answer

    def run(
        self, argv: list[str], stdin: str, timeout: float | None = None, env: Mapping[str, str] | None = None
    ) -> Ended:
        """Runs a program to its end."""
        paths = {name: str(self.scratch / f"{name}.txt") for name in ("stdin", "stdout", "stderr")}
        Path(paths["stdin"]).write_text(stdin, encoding="utf-8")
        request = {"argv": argv, "timeout": timeout, "env": dict(env or {}), **paths}
        if self._process.stdin is None:
            raise KeeperGone
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise KeeperGone from None
        answer = self._answer()
        out, log = (
            Path(paths[name]).read_text(encoding="utf-8", errors="replace") for name in ("stdout", "stderr")
        )
        return Ended(int(str(answer["exit_code"])), bool(answer["timed_out"]), out, log)
