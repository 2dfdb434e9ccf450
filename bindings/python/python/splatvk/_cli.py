"""The command `splatvk`."""

import sys

from . import _parts, _splatvk


def main():
    _parts.find()
    sys.exit(_splatvk.main(["splatvk", *sys.argv[1:]]))
