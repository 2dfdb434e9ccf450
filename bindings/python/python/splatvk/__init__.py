"""A few photos without camera poses to a Gaussian-splat scene that answers texts.

>>> import splatvk
>>> scene = splatvk.reconstruct("my-photos", out="kitchen", progress=True)  # doctest: +SKIP
>>> scene.query("blue mug").presence                                        # doctest: +SKIP
'found'

Conventions: scene coordinates and cameras have OpenCV axes (x right, y down, z forward); `w2c`
maps scene coordinates to those of a camera. `quats` are (w, x, y, z). Scales, opacities and
quaternions are activated values, as gsplat's `rasterization` takes them. Arrays of a scene are
read-only views of its memory; `numpy.array(...)` copies, `torch.from_dlpack(array.copy())` too.
"""

import json as _json
import os as _os

from . import _parts

_parts.find()

from . import _photos, _progress, _splatvk  # noqa: E402  the module loads what _parts has found
from ._splatvk import (  # noqa: E402
    Answer,
    Camera,
    Editor,
    Event,
    Scene,
    Selection,
    Thing,
    __version__,
    close_device,
    device_name,
    load,
)
from .errors import (  # noqa: E402
    Cancelled,
    DeviceLostError,
    Error,
    FileError,
    ForkError,
    GpuError,
    InputError,
    MissingError,
    MissingModelError,
    NoDeviceError,
    OutOfDeviceMemoryError,
    UnwritableError,
    WorkError,
)

__all__ = [
    "Answer",
    "Camera",
    "Cancelled",
    "DeviceLostError",
    "Editor",
    "Error",
    "Event",
    "FileError",
    "ForkError",
    "GpuError",
    "InputError",
    "MissingError",
    "MissingModelError",
    "NoDeviceError",
    "OutOfDeviceMemoryError",
    "Scene",
    "Selection",
    "Thing",
    "UnwritableError",
    "WorkError",
    "__version__",
    "close_device",
    "device_name",
    "label",
    "load",
    "objects",
    "reconstruct",
    "train",
]


# The best installed network, else what is built in.
_SOURCES = ("init", "depth_prior", "matcher", "masks", "features")


def reconstruct(photos, *, out=None, views=None, queries=(), language=True, progress=False, **options):
    """Makes a scene from photos, and stores it in the folder `out`.

    Parameters
    ----------
    photos : path, sequence of paths, or sequence of arrays
        Photos, folders of photos, or a video; or at least two arrays (H, W, 3) of sRGB pixels, uint8, or
        float32 in [0, 1].
    out : path
        The scene directory. It is written whole or not at all; `force=True` replaces a scene. Only
        a scene from arrays may go without; `scene.save` stores it.
    views : int, optional
        How many of the photos are used; without it all, at most 4.
    queries : sequence of str
        Texts that the report answers.
    language : bool
        False makes a scene of colours alone, which answers no texts and is done sooner.
    progress : bool or callable
        True draws bars (tqdm, where it is installed); a callable gets every `Event`, and its
        exceptions stop the work. Warnings go to the logger `splatvk` unless a callable takes them.
    **options
        Options of `splatvk run` with underscores: `preset`, `max_size`, `iterations`, `seed`,
        `device`, `models`, `force`, `resume`, `init`, `photo_masks`, `ignore`, `sh_degree`, ...

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        Photos or options that cannot be used.
    KeyboardInterrupt
        After Ctrl-C. Finished stages and the state of training are kept; the same call with
        `resume=True` continues.
    """
    paths = [photos] if isinstance(photos, (str, _os.PathLike)) else list(photos)
    arrays = _photos.arrays(paths)
    if out is None and arrays is None:
        raise InputError("photos from files need a place for the scene: out=")
    plan = {
        "inputs": [] if arrays is not None else [_os.fspath(path) for path in paths],
        "out": "" if out is None else _os.fspath(out),
        "queries": list(queries),
        "views": views,
        **dict.fromkeys(_SOURCES, "auto"),
        **options,
    }
    if not language:
        plan["method"] = "none"
    for key, value in plan.items():
        if isinstance(value, _os.PathLike):
            plan[key] = _os.fspath(value)
    if arrays is None:
        return _splatvk.reconstruct(_json.dumps(plan), _progress.observer(progress))
    refused = [key for key in ("views", "photo_masks", "points", "resume", "add") if plan.get(key)]
    if refused:
        raise InputError(f"{refused[0]} needs photos from files")
    return _splatvk.reconstruct_pixels(_json.dumps(plan), arrays, _progress.observer(progress))


def train(images, cameras, *, out, views=None, progress=False, **options):
    """Makes a scene of colours from photos with known cameras, as `splatvk train`.

    Parameters
    ----------
    images : path
        Folder of the photos.
    cameras : path
        transforms.json, cameras.json, a COLMAP model, or a data set with one of them.
    out, views, progress, **options
        As in `reconstruct`.

    Returns
    -------
    Scene
    """
    init = f"cameras:{_os.fspath(cameras)}"
    return reconstruct(
        images, out=out, views=views, language=False, progress=progress, init=init, **options
    )


def label(
    splats,
    *,
    out,
    images=None,
    cameras=None,
    synthesize=None,
    views=None,
    queries=(),
    progress=False,
    **options,
):
    """Gives splats of any program language, as `splatvk label`. Their numbers do not change.

    Parameters
    ----------
    splats : path
        A file of Gaussians, or a scene directory.
    images, cameras : path, optional
        Photos of the training with their cameras, or cameras alone to render from. Without both,
        views are placed in free space.
    synthesize : int, optional
        How many views are rendered.
    out, views, queries, progress, **options
        As in `reconstruct`.

    Returns
    -------
    Scene
    """
    plan = {
        "inputs": [] if images is None else [_os.fspath(images)],
        "out": _os.fspath(out),
        "splats": _os.fspath(splats),
        "synthesize": synthesize,
        "queries": list(queries),
        "views": views,
        **dict.fromkeys(_SOURCES, "auto"),
        "init": "sfm" if cameras is None else f"cameras:{_os.fspath(cameras)}",
        "depth_prior": "none",
        **options,
    }
    return _splatvk.reconstruct(_json.dumps(plan), _progress.observer(progress))


def objects(scene, *, vocabulary=None, min_share=None, device=None, models=None):
    """The things of a scene, as `splatvk objects`.

    Parameters
    ----------
    scene : path
        A scene directory with language; its edits apply.
    vocabulary : sequence of str, optional
        Names to choose from; without it those of the text model.
    min_share : float, optional
        Smallest share of the opacity of the scene that is a thing.

    Returns
    -------
    list of dict
        The entries of objects.json: id, level, parent, name, boxes in scene units and in metres.
    """
    return _json.loads(_splatvk.objects(_os.fspath(scene), vocabulary, min_share, device, models))
