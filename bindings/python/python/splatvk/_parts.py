"""Parts beside the module: ONNX Runtime in this wheel, the built-in models in splatvk-models."""

import importlib.util
import os
from pathlib import Path


def _gpu_runtime():
    """ONNX Runtime with GPU providers, if such a build is installed."""
    found = importlib.util.find_spec("onnxruntime")
    if found is None or not found.submodule_search_locations:
        return None
    folder = Path(next(iter(found.submodule_search_locations))) / "capi"
    if not any(folder.glob("libonnxruntime_providers_cuda*")):
        return None
    return next(iter(sorted(folder.glob("libonnxruntime.so*"))), None)


def find():
    """Points the library to the parts, unless the environment does."""
    if not os.environ.get("ORT_DYLIB_PATH"):
        own = Path(__file__).parent / "_lib" / "libonnxruntime.so"
        library = _gpu_runtime() or (own if own.exists() else None)
        if library is not None:
            os.environ["ORT_DYLIB_PATH"] = str(library)
    if not os.environ.get("SPLATVK_MODELS"):
        found = importlib.util.find_spec("splatvk_models")
        if found is not None and found.origin:
            os.environ["SPLATVK_MODELS"] = str(Path(found.origin).parent / "models")
