"""Open a capture: find its files and read its lights."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from splinecli import capture_warnings as codes
from splinecli.capture.formats.exif import UPRIGHT, check_exposures, common_orientation
from splinecli.capture.formats.facts import read_facts
from splinecli.capture.layouts.capture_files import AMBIENT, CaptureFiles, Overrides, find_named
from splinecli.capture.layouts.registry import find_capture_files
from splinecli.capture.lights.found_lights import LightFinder, placeholders
from splinecli.capture.lights.lamp_checks import positions_as_directions
from splinecli.capture.lights.lamp_files import NO_LAMP_OPTIONS, LampOptions, find_lamps
from splinecli.capture.lights.light_files import read_light_intensities
from splinecli.capture.lights.light_frames import USUAL_FRAME, LightFrame
from splinecli.capture.lights.light_rows import LightForm, RowForm
from splinecli.capture.lights.named_lights import NamedLights, read_lights
from splinecli.capture.linearise import AUTOMATIC, RadiometricCalibration
from splinecli.capture.record import Capture
from splinecli.capture.restore.white_level import check_white_level
from splinecli.capture.source import CaptureSource, Progress
from splinecli.capture.stamp import stamp_files
from splinecli.capture.window import WHOLE, Window
from splinecli.capture_warnings import CaptureWarning
from splinecli.errors import InputError, UsageError
from splinecli.maths import Doubles
from splinecli.system.files import StrPath

EQUAL = "equal"  # given in place of a file of intensities: all lights have the same intensity


def open_capture(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
    radiometry: RadiometricCalibration = AUTOMATIC,
    white_level: float | None = None,
    light_frame: LightFrame = USUAL_FRAME,
    lights_format: LightForm = "xyz",
    lamps: LampOptions = NO_LAMP_OPTIONS,
    window: Window = WHOLE,
    find_lights: LightFinder | None = None,
) -> CaptureSource:
    """Return a capture whose files are found and whose lights are read.

    Files named here are used instead of those in the folder.

    Args:
        intensities: a file, or EQUAL.
        radiometry: how stored values become linear light. Where it names no ambient image, one called `ambient` in the
            folder is subtracted.
        white_level: stored value from which an observation counts as saturated, such as 4095 for 12 bits. By default it
            is found from the files and their values (see white_level.py).
        lights_format: whether the rows of a light file of text are vectors or angles.
        lamps: where near lamps are, if no files in the folder say so.
        find_lights: finds the lights from the images, in place of light files.

    Raises:
        InputError: the folder contains no capture (see find_capture_files), a light file is wrong, or the window is not
            inside the images.
        UsageError: the white level is not a number above 0, or the object's width is given and a part is read.
    """
    check_white_level(white_level)
    equal = intensities is not None and str(intensities) == EQUAL
    given = (lights, None if equal else intensities, mask, ground_truth)
    paths = (None if file is None else Path(file) for file in given)
    overrides = Overrides(*paths, needs_lights=find_lights is None)
    if lamps.positions is not None and lights is not None:
        raise UsageError("--lights and --light-positions contradict each other", hint="Leave one out")
    form: RowForm = lights_format
    near = None if find_lights is not None else find_lamps(Path(folder), overrides.lights, lamps)
    if near is not None and near.used and near.positions is not None:
        if lights_format != "xyz":
            problem = f"--lights-format {lights_format} concerns light directions, but {near.positions} has positions"
            raise UsageError(problem, hint="Leave it out, or use --light-distance with a file of directions")
        overrides, form = replace(overrides, lights=near.positions), "positions"
    if near is not None and near.object_width is not None and window.box is not None:
        raise UsageError("--object-width needs the whole object in the image", hint="Give --pixel-size beside --crop")
    files = find_capture_files(folder, overrides)
    found = find_named(files.folder, AMBIENT) or find_named(files.images[0].parent, AMBIENT)
    files = replace(files, ambient=radiometry.ambient or found)
    stamp = stamp_files(files, radiometry.flat_field, () if near is None else near.stamp)
    in_folder = files.images
    files, directions, found_intensities, warnings = _read_lights(files, light_frame, form)
    if len(radiometry.flat_field) == len(in_folder) > 1:  # they are in the order of the folder's images
        flat_of = dict(zip(in_folder, radiometry.flat_field, strict=True))
        radiometry = replace(radiometry, flat_field=tuple(flat_of[image] for image in files.images))
    if equal:
        found_intensities = None
    elif files.light_intensities is not None:
        found_intensities = _read_intensities(files.light_intensities, files.images, in_folder)
    if files.light_directions is not None and form == "xyz" and near is None:
        warnings += positions_as_directions(files.light_directions)
    facts = tuple(map(read_facts, files.images))
    if found_intensities is None:
        check_exposures(facts)
    if radiometry.ambient is None and files.ambient is not None:
        radiometry = replace(radiometry, ambient=files.ambient)
        text = f"{files.ambient.name} was subtracted from all images as ambient light."
        warnings.append(CaptureWarning(codes.AMBIENT_SUBTRACTED, text))
    if files.others:
        more = f" and {len(files.others) - 1} more" if len(files.others) > 1 else ""
        text = f"{files.others[0].name}{more}: left out, because the name says that it is no photograph under one of"
        text += " the lights. To use it, list all images in filenames.txt."
        warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
    radiometry, of_curve = radiometry.with_stated_curve(facts)
    warnings += of_curve
    # Earlier versions read such images as linear, or those with a colour profile as sRGB.
    decoded = (radiometry.curve or "sRGB",) if radiometry.automatic and radiometry.curve != 1 else ()
    orientation = common_orientation(facts)
    if orientation != UPRIGHT:
        text = (
            f"Viewers turn the images (EXIF orientation {orientation}), splinecli does not: mask, light directions and"
            " results are in the frame of the stored pixels."
        )
        warnings.append(CaptureWarning(codes.EXIF_ORIENTATION, text))
    return CaptureSource(
        files,
        facts,
        directions,
        np.ones((len(facts), 3)) if found_intensities is None else found_intensities,
        tuple(warnings),
        radiometry,
        white_level,
        intensities_known=equal or found_intensities is not None,
        intensities_measured=found_intensities is not None,
        light_frame=light_frame,
        lamps=near,
        window=window.on(facts[0]),
        find_lights=find_lights,
        # Left out where they are not given, so that earlier stamps stay valid.
        stamp=(*stamp, *decoded, *(() if white_level is None else (white_level,))),
    )


def read_capture(
    folder: StrPath,
    *,
    lights: StrPath | None = None,
    intensities: StrPath | None = None,
    mask: StrPath | None = None,
    ground_truth: StrPath | None = None,
    light_indices: Sequence[int] | None = None,
    progress: Progress | None = None,
    as_stored: bool = False,
    white_level: float | None = None,
) -> Capture:
    """Open a capture and read it: see open_capture and CaptureSource.read."""
    source = open_capture(
        folder, lights=lights, intensities=intensities, mask=mask, ground_truth=ground_truth, white_level=white_level
    )
    return source.read(light_indices, progress or (lambda: None), as_stored=as_stored)


def _read_lights(
    files: CaptureFiles, frame: LightFrame, form: RowForm
) -> tuple[CaptureFiles, Doubles, Doubles | None, list[CaptureWarning]]:
    """Return the files in the order of the lights, the directions (F, 3), their intensities (F, 3), and warnings."""
    path = files.light_directions
    if path is None:
        return files, placeholders(len(files.images)), None, []
    warnings = []
    images, lights = _match_count(files.images, path, frame, form)
    if len(images) < len(files.images):
        others = [image.name for image in files.images if image not in images]
        names = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        them = "it" if len(others) == 1 else "them"
        text = (
            f"{names}: left out, because {path.name} has no light for {them}, and the other images have another size."
        )
        warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
        files = replace(files, images=images)
    if not isinstance(lights, NamedLights):
        return files, lights, None, warnings
    images, how = lights.match(files.images)
    if len(images) < len(files.images):
        text = f"{path.name} names {len(images)} of the {len(files.images)} images; the others are left out."
        warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
    if how != "name":
        text = f"The lights of {path.name} were matched to the images by {how}."
        warnings.append(CaptureWarning(codes.LIGHTS_MATCHED, text))
    return replace(files, images=images), lights.directions, lights.intensities, warnings


def _match_count(
    images: tuple[Path, ...], path: Path, frame: LightFrame, form: RowForm
) -> tuple[tuple[Path, ...], Doubles | NamedLights]:
    """Return the images that a light file is for, and its lights: all images, or else those of the usual size."""
    try:
        return images, read_lights(path, len(images), frame, form)
    except InputError:
        stated = [read_facts(image).stated_size for image in images]
        sizes = [None if size is None else size[0][:2] for size in stated]
        usual = Counter(sizes).most_common(1)[0][0]
        alike = tuple(image for image, size in zip(images, sizes, strict=True) if size == usual)
        if len(alike) < len(images):
            with suppress(InputError):
                return alike, read_lights(path, len(alike), frame, form)
        raise


def _read_intensities(path: Path, images: Sequence[Path], in_folder: Sequence[Path]) -> Doubles:
    """Return the intensities (F, 3) of images from a file with a line for each, or for each image of the folder."""
    if len(images) < len(in_folder):
        with suppress(InputError):  # the file is for the chosen images, or wrong in any case
            return read_light_intensities(path, len(in_folder))[[in_folder.index(image) for image in images]]
    return read_light_intensities(path, len(images))
