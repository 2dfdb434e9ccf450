"""The programs that the scripts of this folder run: SPLATVK names splatvk (default target/release/splatvk), SPLATLAB splatlab (default: beside it)."""
import os, subprocess

SPLATVK = os.environ.get("SPLATVK", os.path.join(os.path.dirname(__file__), "../../target/release/splatvk"))
SPLATLAB = os.environ.get("SPLATLAB", os.path.join(os.path.dirname(SPLATVK), "splatlab"))


def splatvk(*arguments):
    """Runs splatvk; returns its standard output, or raises where it fails."""
    return run(SPLATVK, arguments)


def splatlab(*arguments):
    return run(SPLATLAB, arguments)


def run(program, arguments):
    return subprocess.run([program, *arguments], check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True).stdout
