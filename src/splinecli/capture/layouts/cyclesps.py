"""The layout of CyclesPS (Ikehata, ECCV 2018): folders images_<kind>/ beside the files that all kinds share.

As published, PRPS/<object> contains images_specular and images_metallic, PRPS_Diffuse/<object> images_diffuse,
each with one image for each line of the object's light.txt: 00000.tif and so on. A capture is one such folder.
"""

import re
from pathlib import Path

from splinecli.capture.layouts.capture_files import (
    GROUND_TRUTH,
    LIGHT_DIRECTIONS,
    NOT_PHOTOGRAPHS,
    CaptureFiles,
    Overrides,
    find_named,
    folder_name,
    list_folder,
    list_images,
)
from splinecli.capture.lights.light_files import read_light_directions
from splinecli.errors import InputError
from splinecli.system.files import is_folder, resolve

TREES = ("PRPS", "PRPS_Diffuse")  # folders of objects in the published tree

_PREFIX = "images_"
_LIGHTS = "light.txt"
_BOUNDARIES = ("inboundary.png", "onboundary.png")
_MARKS = frozenset({_LIGHTS, "gt_normal.tif", *_BOUNDARIES})
# Two of the four: an object is recognised if some are missing, and no other folder is mistaken for one.
_ENOUGH_MARKS = 2
_NUMBERED = re.compile(r"\d{5}\.tif")


def find_cyclesps(folder: Path, overrides: Overrides) -> CaptureFiles | None:
    """Return the files of images_<kind> in an object's folder, or of an object's only one; None for another layout.

    Raises InputError where a file is missing, there are several such folders, or the images do not match the lights.
    """
    captures = list_cyclesps(folder)
    if captures is None:
        return None
    if not captures:
        expected = f"{_PREFIX}specular, {_PREFIX}metallic or {_PREFIX}diffuse"
        raise InputError(f"found no folder of images, expected {expected}", path=folder)
    images_folder, *more = captures
    if more:
        names = ", ".join(path.name for path in captures)
        problem = f"found {len(captures)} folders of images ({names}), expected one"
        raise InputError(problem, path=folder, hint=f"Give one of them, such as {images_folder}")
    holder = _parent(images_folder)
    lights = overrides.lights or find_named(holder, [_LIGHTS])
    if lights is None:
        problem = f"found no {_LIGHTS}, expected the light directions of {images_folder.name}"
        raise InputError(problem, path=holder, hint="Pass --lights FILE, with one line x y z for each image")
    return CaptureFiles(
        "CyclesPS",
        _name(images_folder),
        holder,
        _list_numbered(images_folder, len(read_light_directions(lights)), lights),
        lights,
        light_intensities=overrides.intensities,
        mask=overrides.mask,
        boundaries=() if overrides.mask else _find_boundaries(holder),
        ground_truth=overrides.ground_truth or find_named(holder, GROUND_TRUTH),
    )


def cyclesps_name(folder: Path) -> str | None:
    """Return <object>_<kind>, such as "Armadillo_specular"; None for another layout or several captures."""
    try:
        captures = list_cyclesps(folder) if is_folder(folder) else None
    except InputError:  # reading the capture will raise it again
        return None
    return _name(captures[0]) if captures and len(captures) == 1 else None


def list_cyclesps(folder: Path) -> list[Path] | None:
    """Return the folder if it is a folder of images, or the folders of images of an object; None for another layout."""
    is_images_folder = folder_name(folder).startswith(_PREFIX) and _has_marks(_parent(folder))
    if not (is_images_folder or _has_marks(folder)) or find_named(folder, LIGHT_DIRECTIONS) is not None:
        return None  # a light file of its own makes it a plain folder
    if is_images_folder:
        return [folder]
    captures = [entry for entry in list_folder(folder) if entry.name.startswith(_PREFIX) and is_folder(entry)]
    # Images beside light.txt are a plain folder, to be used with --lights light.txt.
    no_photographs = NOT_PHOTOGRAPHS | {Path(name).stem for name in _BOUNDARIES}
    return None if not captures and list_images(folder, leave_out_stems=no_photographs) else captures


def _name(images_folder: Path) -> str:
    return f"{folder_name(_parent(images_folder))}_{folder_name(images_folder).removeprefix(_PREFIX)}"


def _has_marks(folder: Path) -> bool:
    marked = [entry for entry in list_folder(folder) if entry.name.lower() in _MARKS and not is_folder(entry)]
    return len({entry.name.lower() for entry in marked}) >= _ENOUGH_MARKS


def _parent(folder: Path) -> Path:
    # "." and ".." are their own parents to pathlib.
    return folder.parent if folder.name not in ("", "..") else resolve(folder).parent


def _find_boundaries(holder: Path) -> tuple[Path, ...]:
    """Return both masks. The object is their union, so one alone would be wrong."""
    found = {name: find_named(holder, [name]) for name in _BOUNDARIES}
    missing = [name for name, path in found.items() if path is None]
    if missing:
        problem = f"found no {' and no '.join(missing)}, expected the masks whose union is the object"
        raise InputError(problem, path=holder, hint="Pass --mask FILE")
    return tuple(path for path in found.values() if path is not None)


def _list_numbered(folder: Path, n_lights: int, lights: Path) -> tuple[Path, ...]:
    """Return the images 00000.tif and so on, one for each light."""
    there = {entry.name.lower(): entry for entry in list_folder(folder)}
    wanted = [f"{index:05}.tif" for index in range(n_lights)]
    expected = f"{n_lights} ({wanted[0]} to {wanted[-1]}), one for each light in {lights.name}"
    for name in wanted:
        if name not in there:
            raise InputError(f"the image does not exist, expected {expected}", path=folder / name)
    n_images = sum(bool(_NUMBERED.fullmatch(name)) for name in there)
    if n_images != n_lights:
        raise InputError(f"found {n_images} images, expected {expected}", path=folder)
    return tuple(there[name] for name in wanted)
