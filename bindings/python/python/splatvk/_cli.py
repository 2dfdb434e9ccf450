"""The command `splatvk`."""

import os
import shutil
import sys
from pathlib import Path

from . import _parts, _splatvk


def _name_programs():
    """Names this interpreter and the command beside it for processes that the program starts: the
    program itself is a library in here."""
    os.environ.setdefault("SPLATVK_PYTHON", sys.executable)
    beside = Path(sys.executable).with_name("splatvk")
    program = str(beside) if beside.exists() else shutil.which("splatvk")
    if program is not None:
        os.environ.setdefault("SPLATVK_PROGRAM", program)


def main():
    _parts.find()
    _name_programs()
    sys.exit(_splatvk.main(["splatvk", *sys.argv[1:]]))
