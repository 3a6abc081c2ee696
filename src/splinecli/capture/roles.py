"""Pictures beside the photographs: masks, ambient images, references without contact, copies."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from splinecli.capture.files import (
    AMBIENT,
    IMAGE_SUFFIXES,
    PICTURE_SUFFIXES,
    ROLES,
    find_named,
    folder_name,
    has_role,
    list_folder,
)
from splinecli.capture.formats.decoders import page_of
from splinecli.capture.formats.facts import read_header
from splinecli.capture.formats.images import cut_out, decode_with_alpha
from splinecli.capture.formats.mat import find_stack
from splinecli.errors import InputError
from splinecli.records.capture_warnings import IMAGES_LEFT_OUT, MASK_CHOICE, CaptureWarning
from splinecli.system.files import is_folder, is_found_file


def copies(images: Sequence[Path]) -> list[CaptureWarning]:
    """Report which images were left out because another file of the same stem shows the same
    photograph.
    """
    stored = {page_of(image)[0] for image in images}
    stems = {image.stem.lower() for image in stored}
    others = [
        entry
        for folder in {image.parent for image in stored}
        for entry in list_folder(folder)
        if entry.suffix.lower() in IMAGE_SUFFIXES
        and entry.stem.lower() in stems
        and entry not in stored
    ]
    if not others:
        return []
    kinds, used = (
        ", ".join(sorted({path.suffix.lower() for path in paths})) for paths in (others, stored)
    )
    text = (
        f"{len(others)} files ({kinds}) have the names of other images ({used}): they show the"
        " same photographs, and"
    )
    return [CaptureWarning(IMAGES_LEFT_OUT, f"{text} were left out.")]


def pictures_of(role: str, folders: Sequence[Path], images: Sequence[Path]) -> list[Path]:
    """Return the pictures in some folders whose names have the word of a role, and which are not
    among the images.
    """
    entries = [path for folder in dict.fromkeys(folders) for path in list_folder(folder)]
    return [p for p in entries if has_role(p, role) and p not in images and is_found_file(p)]


def choose_mask(
    folder: Path, images: Sequence[Path]
) -> tuple[Path | None, tuple[CaptureWarning, ...]]:
    """Return a mask for photographs without one of a usual name, and a warning that names it; None
    if none is found.

    It is the only picture of their size with the word "mask" in its name, in the folder, in a
    folder of masks, or beside the folder with its name; or the mask in the .mat file of the
    photographs; or else the alpha channel of the first photograph. If several pictures match, none
    is chosen.
    """
    named = _masks_by_name(folder, images)
    try:
        size = read_header(images[0]).size[0] if named else ()
        masks = [path for path in named if read_header(path).size[0][:2] == size[:2]]
        if not named and read_header(images[0]).stated_channels in (2, 4):
            masks = [images[0]] if cut_out(decode_with_alpha(images[0])[1]) is not None else []
    except InputError:  # reading the images reports the damage
        return None, ()
    stored, _ = page_of(images[0])
    if not masks and stored.suffix.lower() == ".mat":
        stack = find_stack(stored)
        has_mask = stack is not None and stack.mask is not None
        return stored.with_name(f"{stored.name}[mask]") if has_mask else None, ()
    if not masks:
        return None, ()
    text = f"{masks[0].name} is used as the mask, by its name. Give --mask FILE for another one."
    if masks[0] in images:
        text = (
            f"The alpha channel of {masks[0].name} is used as the mask. Give --mask FILE for"
            " another one."
        )
    if len(masks) > 1:
        text = (
            f"{', '.join(path.name for path in masks)}: none is used as the mask. Choose one with"
            " --mask FILE."
        )
    return masks[0] if len(masks) == 1 else None, (CaptureWarning(MASK_CHOICE, text),)


def _masks_by_name(folder: Path, images: Sequence[Path]) -> list[Path]:
    named = pictures_of("mask", (folder, images[0].parent), images)
    for inside in list_folder(folder):
        if inside.name.lower() in ("mask", "masks") and is_folder(inside):
            named += [p for p in list_folder(inside) if p.suffix.lower() in PICTURE_SUFFIXES]
    name = folder_name(folder).lower()
    with suppress(InputError):  # we may lack permission to read the parent folder
        for path in pictures_of("mask", [folder.absolute().parent], images):
            if ROLES["mask"].sub("", path.stem.lower()).strip("._- ") == name:
                named.append(path)
    return named


def find_ambient(folder: Path, images: Sequence[Path]) -> Path | None:
    """Return the image under none of the lights: the first with the usual name, or else the only
    picture of the photographs' size with the word "ambient" in its name; None if there is none.
    """
    folders = folder, images[0].parent
    usual = find_named(folder, AMBIENT) or find_named(folders[1], AMBIENT)
    named = [] if usual else pictures_of("ambient", folders, images)
    if named:
        size = read_header(images[0]).stated_size
        named = [path for path in named if read_header(path).stated_size == size]
    return usual or (named[0] if len(named) == 1 else None)
