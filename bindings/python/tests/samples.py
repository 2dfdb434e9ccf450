"""Data of the tests."""

from pathlib import Path

PHOTOS = Path(__file__).parents[3] / "tests" / "data" / "breakfast" / "images"
