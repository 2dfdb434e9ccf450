"""A small process that runs programs for a worker, and ends with it.

Run by path, without the package:  python -I -S _keeper.py FOLDER

Reads a JSON request a line, {"argv", "stdin", "stdout", "stderr", "timeout", "env"} with paths of
files, and answers {"exit_code", "timed_out"}; a signal is a negative exit code. The end of its
input means that the worker is gone, by whatever signal: the running program and its group are
killed and FOLDER is deleted. Should the keeper itself be killed, PR_SET_PDEATHSIG ends the program.
That signal comes with the end of the thread that started the program, which is why not a worker
with its threads starts it, but this process with one.
"""

import ctypes
import json
import os
import select
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from typing import Any

PR_SET_PDEATHSIG = 1
#: The keeper inherits the open file and so holds its lock; its programs do not. A folder whose lock is
#: free is a leftover.
LOCK = ".lock"


def _libc() -> Any:
    try:
        return ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None
    except OSError:
        return None


def remove(folder: str) -> None:
    """Deletes a scratch folder, its lock last: a folder that is half deleted when this process is
    killed can still be told from one that is in use."""
    try:
        entries = os.listdir(folder)
    except OSError:
        return
    for name in entries:
        path = os.path.join(folder, name)
        if os.path.isdir(path):
            shutil.rmtree(path, ignore_errors=True)
        elif name != LOCK:
            try:
                os.unlink(path)
            except OSError:
                pass
    shutil.rmtree(folder, ignore_errors=True)


def _start(request: dict[str, Any], libc: Any) -> int:
    """Starts the program in its own process group."""
    parent = os.getpid()
    pid = os.fork()
    if pid:
        return pid
    try:
        os.setsid()
        if libc is not None:
            libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
            # The keeper ended before the call: no signal will come.
            if os.getppid() != parent:
                os._exit(127)
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        for number, path, mode in (
            (0, request["stdin"], os.O_RDONLY),
            (1, request["stdout"], flags),
            (2, request["stderr"], flags),
        ):
            file = os.open(path, mode, 0o644)
            os.dup2(file, number)
            os.close(file)
        # The lock is the keeper's.
        os.closerange(3, 256)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGPIPE):
            signal.signal(number, signal.SIG_DFL)
        os.execvpe(request["argv"][0], request["argv"], {**os.environ, **request["env"]})
    except OSError as error:
        os.write(2, (json.dumps({"event": "error", "message": str(error), "exit_code": 3}) + "\n").encode())
    finally:
        os._exit(3)


def _kill_group(pid: int) -> None:
    try:
        os.killpg(pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def _wait(pid: int, timeout: float | None) -> tuple[str, int]:
    """Waits for the program: ("ended" | "timeout" | "orphan", status)."""
    end = time.monotonic() + timeout if timeout else None
    pause = 0.005
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return "ended", status
        if end is not None and time.monotonic() >= end:
            return "timeout", 0
        # Input while a program runs is its end: the worker sends no second request.
        if select.select([0], [], [], pause)[0]:
            return "orphan", 0
        pause = min(pause * 2, 0.2)


def _lines() -> Iterator[dict[str, Any]]:
    """Requests; not by sys.stdin, whose buffer select does not see."""
    kept = b""
    while True:
        piece = os.read(0, 1 << 16)
        if not piece:
            return
        kept += piece
        while b"\n" in kept:
            line, kept = kept.split(b"\n", 1)
            yield json.loads(line)


def main(folder: str) -> None:
    # The worker's death is seen at the pipe; Ctrl-C of a terminal goes to the driver alone.
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    os.write(1, b"{}\n")
    libc = _libc()
    for request in _lines():
        pid = _start(request, libc)
        how, status = _wait(pid, request.get("timeout"))
        # Whatever the program started and left goes too.
        _kill_group(pid)
        if how != "ended":
            status = os.waitpid(pid, 0)[1]
        if how == "orphan":
            break
        code = os.waitstatus_to_exitcode(status)
        try:
            os.write(1, (json.dumps({"exit_code": code, "timed_out": how == "timeout"}) + "\n").encode())
        except BrokenPipeError:
            break
    remove(folder)


if __name__ == "__main__":
    main(sys.argv[1])
