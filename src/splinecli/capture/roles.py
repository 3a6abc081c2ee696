"""Pictures next to the photographs: masks, ambient images and copies."""

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
    """Return a warning about images left out because another file shows the same photograph."""
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
        f"{len(others)} files ({kinds}) were left out, because images with the same names ({used})"
        " show the same photographs."
    )
    return [CaptureWarning(IMAGES_LEFT_OUT, text)]


def pictures_of(role: str, folders: Sequence[Path], images: Sequence[Path]) -> list[Path]:
    """Return the pictures in these folders whose names contain a role's word and that are not
    images.
    """
    entries = [path for folder in dict.fromkeys(folders) for path in list_folder(folder)]
    return [p for p in entries if has_role(p, role) and p not in images and is_found_file(p)]


def choose_mask(
    folder: Path, images: Sequence[Path]
) -> tuple[Path | None, tuple[CaptureWarning, ...]]:
    """Return a mask for photographs without a usual mask file, and a warning that names it.

    Candidates have the size of the photographs. They are pictures in the folder with the word
    "mask" in their names, pictures in a folder of masks, and pictures next to the folder that have
    its name. Without candidates, use the mask in the .mat file of the photographs, or the alpha
    channel of the first photograph. Return None for the mask if there is no candidate or more than
    one.
    """
    named = _masks_by_name(folder, images)
    try:
        size = read_header(images[0]).size[0] if named else ()
        masks = [path for path in named if read_header(path).size[0][:2] == size[:2]]
        if not named and read_header(images[0]).stated_channels in (2, 4):
            masks = [images[0]] if cut_out(decode_with_alpha(images[0])[1]) is not None else []
    except InputError:  # raised again when the images are read
        return None, ()
    stored, _ = page_of(images[0])
    if not masks and stored.suffix.lower() == ".mat":
        stack = find_stack(stored)
        has_mask = stack is not None and stack.mask is not None
        return stored.with_name(f"{stored.name}[mask]") if has_mask else None, ()
    if not masks:
        return None, ()
    source = f"The alpha channel of {masks[0].name}" if masks[0] in images else masks[0].name
    text = f"{source} is used as the mask. To use another mask, pass --mask FILE."
    if len(masks) > 1:
        text = (
            "No mask is used, because several files could be the mask:"
            f" {', '.join(path.name for path in masks)}. Choose one with --mask FILE."
        )
    return masks[0] if len(masks) == 1 else None, (CaptureWarning(MASK_CHOICE, text),)


def _masks_by_name(folder: Path, images: Sequence[Path]) -> list[Path]:
    named = pictures_of("mask", (folder, images[0].parent), images)
    for inside in list_folder(folder):
        if inside.name.lower() in ("mask", "masks") and is_folder(inside):
            named += [p for p in list_folder(inside) if p.suffix.lower() in PICTURE_SUFFIXES]
    name = folder_name(folder).lower()
    with suppress(InputError):  # the parent folder may be unreadable
        for path in pictures_of("mask", [folder.absolute().parent], images):
            if ROLES["mask"].sub("", path.stem.lower()).strip("._- ") == name:
                named.append(path)
    return named


def find_ambient(folder: Path, images: Sequence[Path]) -> Path | None:
    """Return the image taken with all lights off, or None.

    It has a usual name, or is the only picture of the photographs' size with the word "ambient" in
    its name.
    """
    folders = folder, images[0].parent
    usual = find_named(folder, AMBIENT) or find_named(folders[1], AMBIENT)
    named = [] if usual else pictures_of("ambient", folders, images)
    if named:
        size = read_header(images[0]).stated_size
        named = [path for path in named if read_header(path).stated_size == size]
    return usual or (named[0] if len(named) == 1 else None)
