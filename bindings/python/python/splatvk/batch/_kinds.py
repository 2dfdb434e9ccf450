"""Kinds of failure, and which of them another try may mend."""

import errno
import os
from typing import Any

#: By exit code of the program.
EXIT_CODES = {1: "failed", 2: "refused", 3: "missing", 4: "unwritable", 5: "transient", 130: "transient"}
#: The machine failed, not the row. Memory is tried once more too, with smaller images.
RETRIED = ("transient", "missing", "unwritable")


class Failure(Exception):
    """A row that was not made."""

    def __init__(self, kind: str, message: str, exit_code: int | None = None):
        super().__init__(message)
        self.kind = kind
        self.message = message
        self.exit_code = exit_code
        self.log = ""
        self.key: str | None = None

    def record(self) -> dict[str, Any]:
        names = ("kind", "message", "exit_code", "log", "key")
        return {name: getattr(self, name) for name in names}


def failure_of(error: OSError) -> Failure:
    """An error of a disk, a network or a store."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS):
        return Failure("unwritable", str(error), 4)
    return Failure("transient", f"{type(error).__name__}: {error}")


def delay(attempts: int) -> float:
    """Seconds before the next try, doubled each time: 2, 4, 8, ... 60."""
    return min(60.0, 2.0**attempts)


def smaller(options: dict[str, Any]) -> int:
    """0.7 times `max_size`, for half as many pixels, as the engine of one machine takes.

    Without the option the program takes 1600 on a GPU and 800 on a CPU device.
    """
    now = options.get("max_size")
    if not isinstance(now, int):
        now = 1600 if os.environ.get("CUDA_VISIBLE_DEVICES") else 800
    return max(64, int(now * 0.7))
