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
    "export",
    "label",
    "load",
    "mesh",
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


def objects(
    scene,
    *,
    vocabulary=None,
    min_share=None,
    out=None,
    level="object",
    format="ply",
    raw=False,
    force=False,
    progress=False,
    device=None,
    models=None,
):
    """The things of a scene, as `splatvk objects`.

    Parameters
    ----------
    scene : path or Scene
        A scene directory with language, whose edits apply, or a scene that is stored.
    vocabulary : sequence of str, optional
        Names to choose from; without it those of the text model.
    min_share : float, optional
        Smallest share of the opacity of the scene that is a thing.
    out : path, optional
        Folder for objects.json, objects.csv, a file and a picture per thing, scene.glb and
        scene.ply. Only with `force=True` are files of the same names replaced.
    level : {"object", "whole", "part", "subpart"}
        Level of the files. No splat is in two objects; wholes may join things with their table.
    format : str
        Format of the file of each thing, as of `splatvk objects --format`.
    raw : bool
        Keep the axes and the unit of the scene in the files; otherwise they are upright and in
        metres, as far as the scene states them.
    progress : bool or callable
        As in `reconstruct`.

    Returns
    -------
    list of dict
        The entries of objects.json: id, level, surface, parent, name, boxes in scene units and in metres.
    """
    options = {
        "vocabulary": vocabulary,
        "min_share": min_share,
        "out": out,
        "level": level,
        "format": format,
        "raw": raw,
        "force": force,
    }
    observer = _progress.observer(progress)
    return _json.loads(_splatvk.objects(scene, options, observer, device, models))


def export(
    scene,
    path,
    *,
    format=None,
    up=None,
    metres=False,
    raw=False,
    guessed=False,
    ply_degree=3,
    spz_version=None,
    with_features=False,
    title=None,
    views=None,
    force=False,
    progress=False,
):
    """Writes a scene for another program, as `splatvk export`: upright and in metres as far as the
    scene states them, without the splats that no photo shows.

    Parameters
    ----------
    scene : path or Scene
        A scene directory, whose edits apply, a file of Gaussians, or a scene. Pages and COLMAP
        models need a scene that is stored.
    path : path
        File or folder. Its ending states the format, unless `format` does.
    up : {"-y", "y", "z"}, optional
        Axis that points up; InputError where the direction up is not known.
    metres : bool
        InputError where metres are not known.
    raw : bool
        Keep the axes and the unit of the scene, as `scene.save` does.
    guessed : bool
        Keep what no photo shows.
    ply_degree, spz_version, with_features, title, views
        As the options of `splatvk export`.
    force : bool
        Replace an ordinary file, or files of the same names in a folder.
    progress : bool or callable
        As in `reconstruct`.

    Returns
    -------
    dict
        `summary`, one line on what was done; `up` and `metres`, None where they are as in the scene;
        `splats` and `guessed`, or `cameras` and `points`; `files`.
    """
    options = {
        "format": format,
        "up": up,
        "metres": metres,
        "raw": raw,
        "guessed": guessed,
        "ply_degree": ply_degree,
        "spz_version": spz_version,
        "with_features": with_features,
        "title": title,
        "views": views,
        "force": force,
    }
    return _json.loads(_splatvk.export(scene, path, options, _progress.observer(progress)))


def mesh(
    scene,
    path,
    *,
    triangles=100_000,
    error=None,
    voxel=None,
    fill_guessed=False,
    collider=None,
    by_object=False,
    vocabulary=None,
    cameras=None,
    raw=False,
    force=False,
    progress=False,
    device=None,
    models=None,
):
    """Writes the surfaces of a scene as triangles, as `splatvk mesh`: upright, in metres and on the
    ground, as far as the scene states them.

    Parameters
    ----------
    scene : path or Scene
        A scene directory, whose edits apply, or a scene. A file of Gaussians needs `cameras`.
    path : path
        A .glb, .ply or .obj.
    triangles : int
        Most triangles.
    error, voxel : str or float, optional
        Length by which 99.9 % of the surface may move, instead of `triangles`; side of a voxel. "2mm"
        or "0.5cm" where the scale is known, or a number in scene units.
    fill_guessed : bool
        Also surfaces that no photo shows; otherwise they are holes.
    collider : {"hull", "decomposition"}, optional
        Shapes for physics beside every part; not in a .ply.
    by_object : bool
        A part with a name for every thing of a stored scene; `vocabulary` has names to choose from.
    cameras : path, optional
        Cameras to look from, instead of those of the scene.
    raw : bool
        Keep the axes, the unit and the origin of the scene.
    force : bool
        Replace an ordinary file.
    progress : bool or callable
        As in `reconstruct`.

    Returns
    -------
    dict
        Figures: `triangles`, `vertices`, `parts`, `unit`, `up`, `size`, `area`, `border_edges`,
        `voxel` and `moved` in the unit of the file, and `from_scene`: file = scale · rotation ·
        scene + translation, rotation row by row.
    """
    options = {
        "triangles": triangles,
        "error": None if error is None else str(error),
        "voxel": None if voxel is None else str(voxel),
        "fill_guessed": fill_guessed,
        "collider": collider,
        "by_object": by_object,
        "vocabulary": vocabulary,
        "cameras": cameras,
        "raw": raw,
        "force": force,
    }
    observer = _progress.observer(progress)
    return _json.loads(_splatvk.mesh(scene, path, options, observer, device, models))
