"""Many captures: rows of a manifest, by Ray or any other scheduler.

`python -m splatvk.batch MANIFEST --out ADDRESS` is `splatvk batch --engine ray`. `run_row` makes
one row, for Dask, Spark and others.
"""

from ._row import run_row

__all__ = ["run_row"]
