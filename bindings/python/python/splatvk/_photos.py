"""Photos that are arrays."""

import numpy as np

from .errors import InputError


def arrays(photos):
    """Names and float32 pixels in [0, 1] of photos that are arrays; None if they are paths."""
    found = [hasattr(photo, "__array__") for photo in photos]
    if not any(found):
        return None
    if not all(found):
        raise InputError("photos are paths or arrays, not both")
    return [(f"photo_{i:02}.png", _pixels(i, np.asarray(p))) for i, p in enumerate(photos)]


def _pixels(index, array):
    if array.ndim != 3 or array.shape[2] != 3:
        raise InputError(f"photo {index}: (H, W, 3) is needed, not {array.shape}")
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array, np.float32) / np.float32(255)
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"photo {index}: uint8 or float32 is needed, not {array.dtype}")
    pixels = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(pixels).all() or pixels.min() < 0 or pixels.max() > 1:
        raise InputError(f"photo {index}: its values are not all in [0, 1]")
    return pixels
