"""Find the files of a capture in a folder, and the captures in a dataset, by trying one layout
after another.

In CyclesPS (Ikehata, ECCV 2018), an object has folders images_<kind>/ and files shared by all
kinds. In the published tree, PRPS/<object> contains images_specular and images_metallic, and
PRPS_Diffuse/<object> contains images_diffuse. Each of these folders is a capture with one image,
00000.tif and so on, for each line of the object's light.txt.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from splinecli.capture import files
from splinecli.capture.channel_lights import CHANNELS
from splinecli.capture.formats.film import is_film
from splinecli.capture.light_files import FORMATS, read_light_directions
from splinecli.capture.light_search import (
    NoLightsError,
    find_light_file,
    has_lights,
    light_names,
    light_option,
    search_lights,
)
from splinecli.capture.roles import choose_mask, copies, pictures_of
from splinecli.errors import InputError
from splinecli.maths.robust import MIN_LIGHTS
from splinecli.records.capture_warnings import CaptureWarning
from splinecli.system.files import StrPath, is_folder, resolve

_PREFIX = "images_"
_BOUNDARIES = ("inboundary.png", "onboundary.png")


def find_cyclesps(folder: Path, overrides: files.Overrides) -> files.CaptureFiles | None:
    """Return the files of a folder images_<kind>, or of an object with only one such folder.

    Return None for any other layout. Raises InputError if a file is missing, if there are several
    such folders, or if the images do not match the lights.
    """
    captures = list_cyclesps(folder)
    if captures is None:
        return None
    if not captures:
        expected = f"{_PREFIX}specular, {_PREFIX}metallic or {_PREFIX}diffuse"
        raise InputError(f"found no folder of images, expected {expected}", folder)
    images_folder, *more = captures
    if more:
        names = ", ".join(path.name for path in captures)
        raise InputError(
            f"found {len(captures)} folders of images ({names}), expected one",
            folder,
            hint=f"Pass one of them, such as {images_folder}",
        )
    holder = _parent(images_folder)
    lights = overrides.lights or files.find_named(holder, ["light.txt"])
    if lights is None:
        raise InputError(
            f"found no light.txt with the light directions of {images_folder.name}",
            holder,
            hint="Pass --lights FILE, with one line x y z for each image",
        )
    images = _list_numbered(images_folder, len(read_light_directions(lights)), lights)
    # The object is the union of both masks, so a single one would be wrong.
    masks = (
        {} if overrides.mask else {name: files.find_named(holder, [name]) for name in _BOUNDARIES}
    )
    if missing := [name for name, path in masks.items() if path is None]:
        raise InputError(
            f"found no {' and no '.join(missing)}, but both masks are needed, because the object is"
            " their union",
            holder,
            hint="Pass --mask FILE",
        )
    return files.CaptureFiles(
        "CyclesPS",
        _name(images_folder),
        holder,
        images,
        lights,
        light_intensities=overrides.intensities,
        mask=overrides.mask,
        boundaries=tuple(path for path in masks.values() if path is not None),
        ground_truth=overrides.ground_truth or files.find_named(holder, files.GROUND_TRUTH),
    )


def list_cyclesps(folder: Path) -> list[Path] | None:
    """Return the folders of images of a CyclesPS object, or the folder itself if it is one of them.

    Return None for any other layout.
    """
    is_images_folder = files.folder_name(folder).startswith(_PREFIX) and _has_marks(_parent(folder))
    usual_lights = [name for each in FORMATS if not each.rank for name in each.found]
    if (
        not (is_images_folder or _has_marks(folder))
        or files.find_named(folder, usual_lights) is not None
    ):
        return None  # a folder with its own light file is a plain folder
    if is_images_folder:
        return [folder]
    captures = [path for path in _subfolders(folder) if path.name.startswith(_PREFIX)]
    # Images beside light.txt are a plain folder, to be used with --lights light.txt.
    no_photographs = files.NOT_PHOTOGRAPHS | {Path(name).stem for name in _BOUNDARIES}
    is_plain = not captures and files.list_images(folder, leave_out_stems=no_photographs)
    return None if is_plain else captures


def _name(images_folder: Path) -> str:
    inner = files.folder_name(images_folder).removeprefix(_PREFIX)
    return f"{files.folder_name(_parent(images_folder))}_{inner}"


def _has_marks(folder: Path) -> bool:
    """Return whether the folder contains at least two of the four files that identify CyclesPS.

    Two are enough, because no other dataset has two of them and some may be missing.
    """
    marks = {"light.txt", "gt_normal.tif", *_BOUNDARIES}
    names = {entry.name.lower() for entry in files.list_folder(folder) if not is_folder(entry)}
    return len(marks & names) >= 2


def _parent(folder: Path) -> Path:
    # pathlib treats "." and ".." as their own parents.
    return folder.parent if folder.name not in ("", "..") else resolve(folder).parent


def _list_numbered(folder: Path, n_lights: int, lights: Path) -> tuple[Path, ...]:
    """Return the images 00000.tif, 00001.tif and so on, one for each light."""
    there = {entry.name.lower(): entry for entry in files.list_folder(folder)}
    wanted = [f"{index:05}.tif" for index in range(n_lights)]
    expected = f"{n_lights} ({wanted[0]} to {wanted[-1]}), one for each light in {lights.name}"
    for name in wanted:
        if name not in there:
            raise InputError(f"the image does not exist, expected {expected}", folder / name)
    n_images = sum(bool(re.fullmatch(r"\d{5}\.tif", name)) for name in there)
    if n_images != n_lights:
        raise InputError(f"found {n_images} images, expected {expected}", folder)
    return tuple(there[name] for name in wanted)


# The light file of PSBox (Y. Xiong), whose images are in the folder Objects
_PSBOX_LIGHTS = ("light_directions.txt",)
# Words in the names of pictures that other programs write next to photographs
_IMAGE_FOLDERS = ("images", "image", "imgs", "img", "photos", "photographs", "pictures", "objects")
_OTHER_WORDS = frozenset({"mask", "normal", "normals", "albedo", "ambient", "all", "depth"})


def _is_other(image: Path, words: frozenset[str] = _OTHER_WORDS) -> bool:
    return not words.isdisjoint(re.findall(r"[a-z]+", image.stem.lower()))


def find_capture_files(
    folder: StrPath, overrides: files.Overrides | None = None
) -> files.CaptureFiles:
    """Return the files of the capture in a folder. Overrides take precedence over them.

    Raises InputError if the folder is missing, is a file or contains no images; if filenames.txt
    lists an image that does not exist; if the light file is missing; or if an override does not
    exist.
    """
    folder, overrides = Path(folder), overrides or files.Overrides()
    files.list_folder(folder)  # raises if it is not a folder
    overrides.named()
    try:
        # The plain layout comes last, because it accepts any folder with images.
        return (
            _find_psbox(folder, overrides)
            or find_cyclesps(folder, overrides)
            or _find_plain(folder, overrides)
        )
    except files.NoImagesError as error:
        captures = [capture for path in _subfolders(folder) for capture in _captures_below(path)]
        if error.path != folder or not captures:
            raise
        raise InputError(
            error.problem,
            folder,
            hint=f"Pass one of the captures inside {folder}, such as {captures[0]}",
        ) from None


def capture_name(folder: StrPath) -> str:
    """Return the capture's name: the name of its folder or video, or <object>_<kind> for CyclesPS.

    Raises InputError.
    """
    folder = Path(folder)
    if is_film(folder):
        return folder.stem
    captures = None
    with suppress(InputError):  # raised again when the capture is read
        captures = list_cyclesps(folder) if is_folder(folder) else None
    return _name(captures[0]) if captures and len(captures) == 1 else _own_name(folder)


def _own_name(folder: Path) -> str:
    """Return a folder's name, or its parent's name for a folder such as `images`. Raises
    InputError.
    """
    name, parent = files.folder_name(folder), _parent(folder)
    inside = name in files.IMAGE_FOLDERS and parent != folder
    return files.folder_name(parent) if inside else name


def _images_folder(folder: Path) -> Path | None:
    """Return the subfolder that contains the images of a capture, or None if they are not in a
    subfolder.
    """
    inside = next((path for name in files.IMAGE_FOLDERS if is_folder(path := folder / name)), None)
    if inside is None and not files.list_images(folder) and has_lights(folder):
        others = [
            path for path in _subfolders(folder) if len(files.list_images(path)) >= MIN_LIGHTS
        ]
        inside = others[0] if len(others) == 1 and not has_lights(others[0]) else None
    if inside is None or not all(map(_is_other, files.list_images(folder))):
        return None
    return inside if files.list_images(inside) else None


def _holder(folder: Path) -> Path:
    """Return the parent of a folder called `images` or similar, unless the folder has its own
    lights.

    Any other folder is returned unchanged.
    """
    around, name = _parent(folder), files.folder_name(folder)
    if name.lower() not in _IMAGE_FOLDERS or has_lights(folder):
        return folder
    with suppress(InputError):  # the parent may be unreadable
        inside = _images_folder(around)
        if inside is not None and inside.name == name:
            return around
    return folder


def find_captures(folder: StrPath) -> list[Path]:
    """Return the captures of a dataset in natural order, or only the folder itself if it is a
    capture.

    A capture is a folder of images with a light file, a folder with a light file and a subfolder
    Objects that contains the images (PSBox), or an images_<kind> folder of a CyclesPS object. A
    CyclesPS object and the published tree are datasets as well. Captures are recognised by the
    names of their files, so reading one may still fail. A subfolder that cannot be listed is
    treated as a capture, so that the error is reported when the caller reads it. Raises InputError
    if the folder is missing, is a file, or contains no capture.
    """
    folder = Path(folder)
    inside = _subfolders(folder)
    captures = _captures_in(folder) or [
        capture for path in inside for capture in _captures_below(path)
    ]
    if captures:
        return captures
    deeper = [path for path in inside if any(_captures_below(sub) for sub in _subfolders(path))]
    raise InputError(
        f"found no capture, expected folders of images with a light file ({light_names()})",
        folder,
        hint=f"Pass {deeper[0]} instead, which contains captures" if deeper else None,
    )


def _subfolders(folder: Path) -> list[Path]:
    return [entry for entry in files.list_folder(folder) if is_folder(entry)]


def _captures_in(folder: Path) -> list[Path]:
    """Return the folder if it is a capture, or the captures of a CyclesPS object."""
    usual = find_light_file(folder)
    if usual is not None:
        objects = folder / files.IMAGE_FOLDERS[0]
        is_psbox = is_folder(objects) and files.find_named(folder, _PSBOX_LIGHTS) is not None
        if (
            files.find_named(folder, [files.FILENAMES]) is not None
            or files.list_images(objects if is_psbox else folder)
            or _images_folder(folder) is not None
        ):
            return [folder]
    captures = list_cyclesps(folder)
    if captures is None and usual is None:
        of_images = _images_folder(folder) or folder
        images = files.list_images(of_images) or files.list_stack(of_images)
        if len(images) >= MIN_LIGHTS and search_lights(folder, images)[0] is not None:
            return [folder]
    return captures or []


def _captures_below(folder: Path) -> list[Path]:
    """Return the captures in a folder, or in the subfolders of a top-level folder of CyclesPS."""
    try:
        if folder.name in ("PRPS", "PRPS_Diffuse"):
            return [capture for path in _subfolders(folder) for capture in _captures_in(path)]
        return _captures_in(folder)
    except InputError:
        return [folder]


def _find_plain(folder: Path, overrides: files.Overrides) -> files.CaptureFiles:
    """Return the files of a plain folder, or of DiLiGenT's layout.

    DiLiGenT (Shi et al.) has filenames.txt and light_directions.txt. Raises InputError if images or
    lights are missing, or if filenames.txt is invalid.
    """
    name = _own_name(folder)
    if overrides.needs_lights and overrides.lights is None:
        folder = _holder(folder)
    listed = files.find_named(folder, [files.FILENAMES]) is not None
    of_images = folder if listed else _images_folder(folder) or folder
    images, _ = files.find_images(of_images, leave_out=overrides.named())
    # Fewer words are excluded if a light file gives the number of photographs.
    words = _OTHER_WORDS if overrides.needs_lights else _OTHER_WORDS | {"demo", "result", "results"}
    others = tuple(image for image in images if _is_other(image, words))
    if listed or len(others) > 0.25 * len(images):  # so many must be photographs
        others = ()
    images = tuple(image for image in images if image not in others)
    lights = overrides.lights or (find_light_file(folder) if overrides.needs_lights else None)
    warnings: tuple[CaptureWarning, ...] = ()
    if lights is None and overrides.needs_lights:
        lights, warnings = search_lights(folder, images)
    if lights is None and overrides.needs_lights:
        raise _no_lights(folder, images)
    layout, ground_truth = "plain folder", files.GROUND_TRUTH
    if listed and files.find_named(folder, ["light_directions.txt"]) is not None:
        # normal.txt comes last, because in harvestPNG it is upside down, unlike the .mat file.
        layout, ground_truth = "DiLiGenT", (*files.GROUND_TRUTH, "normal.txt")
    found = _gather(layout, folder, images, lights, overrides, ground_truth, others)
    of_copies = () if listed else copies(images)
    return replace(found, name=name, warnings=(*warnings, *found.warnings, *of_copies))


def _no_lights(folder: Path, images: Sequence[Path]) -> InputError:
    """Return the error for a capture without a light file, with a hint on how to read it.

    If the lights can be estimated from the images, the error is a NoLightsError. Raises InputError
    if there is a light file that does not fit the images.
    """
    count = "1 image" if len(images) == 1 else f"{len(images)} images"
    problem = f"found {count} ({files.short_list(images)}) but no light file"
    if len(images) < MIN_LIGHTS:
        option = None
        with suppress(InputError):  # its number of lights may belong to other images
            option = light_option(folder, (*images,) * CHANNELS)
        hint = (
            "Normals require at least three photographs under different lights; for a colour"
            f" photograph under three coloured lamps, add --lights-in-channels {option or ''}"
        )
        return InputError(problem, folder, hint=hint.rstrip())
    if option := light_option(folder, images):
        return InputError(problem, folder, hint=f"Add {option}")
    hint = (
        "Pass --lights FILE, with one line x y z for each image. 'splinecli calibrate' creates this"
        " file from images of a mirror ball. Without a light file, --lights estimate estimates the"
        " lights from the images, with lower accuracy. Light files with these names are found"
        f" automatically: {light_names()}"
    )
    return NoLightsError(problem, folder, hint=hint)


def _find_psbox(folder: Path, overrides: files.Overrides) -> files.CaptureFiles | None:
    """Return the files of a PSBox capture, whose images are in a subfolder, or None for any other
    layout.
    """
    lights = overrides.lights or files.find_named(folder, _PSBOX_LIGHTS)
    objects = folder / files.IMAGE_FOLDERS[0]
    if lights is None or not is_folder(objects):
        return None
    images = files.list_images(objects, leave_out=overrides.named())
    files.check_not_empty(images, objects)
    return _gather("PSBox", folder, images, lights, overrides)


def _gather(
    layout: str,
    folder: Path,
    images: tuple[Path, ...],
    lights: Path | None,
    overrides: files.Overrides,
    ground_truth: Sequence[str] = files.GROUND_TRUTH,
    others: tuple[Path, ...] = (),
) -> files.CaptureFiles:
    """Return the capture's images and lights together with the optional files in the folder.

    Files named by the user take precedence over files in the folder.
    """
    beside = [images[0].parent]
    roles = [path for role in files.ROLES for path in pictures_of(role, beside, images)]
    named = {resolve(path) for path in overrides.named()}
    roles = [path for path in roles if resolve(path) not in named]
    others = tuple(sorted({*others, *roles}, key=files.natural_key))

    def beside_or_above(names: Sequence[str]) -> Path | None:
        return files.find_named(folder, names) or files.find_named(images[0].parent, names)

    mask = overrides.mask or beside_or_above(files.MASK)
    warnings: tuple[CaptureWarning, ...] = ()
    if mask is None:
        mask, warnings = choose_mask(folder, images)
        others = tuple(p for p in others if not warnings or not files.has_role(p, "mask"))
        if mask is None and warnings and not overrides.needs_lights:
            raise InputError(str(warnings[0]).removesuffix("."), folder)
    return files.CaptureFiles(
        layout,
        _own_name(folder),
        folder,
        images,
        light_directions=lights if overrides.needs_lights else None,
        light_intensities=overrides.intensities or beside_or_above(["light_intensities.txt"]),
        mask=mask,
        ground_truth=overrides.ground_truth or beside_or_above(ground_truth),
        others=others,
        warnings=warnings,
    )
