"""Open a capture: find its files and read its lights."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splinecli.capture import lamp_files, linearise
from splinecli.capture.channel_lights import (
    CHANNELS,
    CROSSTALK,
    ChannelLights,
    channel_lights,
    find_reference,
)
from splinecli.capture.files import (
    CaptureFiles,
    Overrides,
    find_named,
    short_list,
    stamp_content,
    stamp_files,
)
from splinecli.capture.formats.facts import (
    UPRIGHT,
    ImageHeader,
    common_orientation,
    exposure_factors,
    read_header,
)
from splinecli.capture.formats.numbers import NumberRows
from splinecli.capture.layouts import find_capture_files
from splinecli.capture.light_files import (
    WrongCountError,
    above_plane,
    match_images,
    read_light_intensities,
    read_lights,
)
from splinecli.capture.light_rows import USUAL_FRAME, LightForm, LightFrame, RowForm
from splinecli.capture.record import ESTIMATE, placeholders
from splinecli.capture.roles import find_ambient
from splinecli.capture.source import CaptureSource
from splinecli.errors import InputError, UsageError
from splinecli.images.saturation import check_white_level
from splinecli.maths import Float64Array
from splinecli.records import capture_warnings as codes
from splinecli.records.capture_warnings import CaptureWarning
from splinecli.system.files import StrPath

EQUAL = "equal"  # instead of a file of intensities, states that all lights have the same intensity


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Options for reading a capture. Files named here take precedence over files in the folder.

    intensities: a file, EQUAL or ESTIMATE.
    radiometry: how stored values are converted to linear light. If it has no ambient image, an
        image called `ambient` in the folder is subtracted.
    white_level: stored value from which observations are considered saturated, such as 4095 for 12
        bits. By default, it is determined from the files and their values (see WhiteLevel).
    light_format: whether the rows of a text light file are vectors or angles.
    lamps: positions of near lamps, and the camera, if they are not in files in the folder.
    needs_lights: whether light files are read. Without them, the lights have to be estimated.
    lights_in_channels: whether the channels of each image are observations under three lights; see
        ChannelLights.
    crosstalk: a file with the crosstalk of these channels.
    """

    lights: StrPath | None = None
    intensities: StrPath | None = None
    mask: StrPath | None = None
    ground_truth: StrPath | None = None
    radiometry: linearise.RadiometricCalibration = linearise.AUTOMATIC
    white_level: float | None = None
    light_frame: LightFrame = USUAL_FRAME
    light_format: LightForm = "xyz"
    lamps: lamp_files.LampOptions = lamp_files.NO_LAMP_OPTIONS
    window: linearise.Window = linearise.WHOLE
    needs_lights: bool = True
    lights_in_channels: bool = False
    crosstalk: StrPath | None = None

    @property
    def are_equal(self) -> bool:
        """Whether the user states that all lights have the same intensity."""
        return self.intensities is not None and str(self.intensities) == EQUAL

    @property
    def ignores_intensities(self) -> bool:
        """Whether a file of intensities in the folder is ignored."""
        return self.are_equal or str(self.intensities) == ESTIMATE


def open_capture(folder: StrPath, options: CaptureOptions = CaptureOptions()) -> CaptureSource:
    """Return the capture in a folder with its files located and its lights read.

    Raises:
        InputError: find_capture_files does not recognise the folder, a light file is invalid, or
            the window extends beyond the images.
        UsageError: the white level is not a number above 0, or the object's width is given although
            only a part of the images is read.

    Examples:
        >>> from splinecli.capture import open_capture
        >>> source = open_capture("examples/medallion")
        >>> source.n_lights, source.files.images[0].name
        (10, '01.png')
    """
    check_white_level(options.white_level)
    files, near, form = _find_files(Path(folder), options)
    radiometry = options.radiometry
    camera_matrix, of_camera = lamp_files.find_camera(Path(folder), near, options.lamps)
    of_lamps = (*(() if near is None else near.stamp), *of_camera)
    stamp = stamp_files(files, radiometry.flat_field, of_lamps)
    options, of_near_ps = _with_near_ps(files, options, near, camera_matrix)
    channels, of_channels = _find_channels(files, options)
    files, reference, of_reference = _find_reference(files, options, form)
    if reference:
        radiometry = replace(radiometry, flat_field=reference)
        stamp = (*stamp, *map(stamp_content, reference))
    if channels is not None:
        stamp = (*stamp, of_channels)
        each = tuple(image for image in files.images for _ in range(CHANNELS))
        files = replace(files, images=each)
    in_folder = files.images
    files, directions, intensities, warnings = _read_all_lights(files, options, form, channels)
    warnings += (*files.warnings, *of_reference)
    radiometry = _with_flat_fields(radiometry, in_folder, files.images)
    if reference:  # dividing by it makes the flat surface equally bright in all channels
        intensities = np.broadcast_to(1 / directions[:, 2:], directions.shape).copy()
    if of_near_ps is not None:
        intensities = of_near_ps
    intensities = _given_intensities(files, options, in_folder, channels, intensities)
    if channels is not None:
        warnings.append(CaptureWarning(codes.LIGHTS_IN_CHANNELS, channels.in_words()))
    if files.light_directions is not None and form == "xyz" and near is None:
        warnings += lamp_files.positions_as_directions(files.light_directions)
    facts = tuple(map(read_header, files.images))
    factors = np.ones((len(facts), 3))
    if intensities is None and (exposures := exposure_factors(facts)) is not None:
        factors *= np.array(exposures[0])[:, None]
        warnings.append(CaptureWarning(codes.EXIF_EXPOSURE, exposures[1]))
    if radiometry.ambient is None and files.ambient is not None:
        radiometry = replace(radiometry, ambient=files.ambient)
        text = f"{files.ambient.name} was subtracted from all images as ambient light."
        warnings.append(CaptureWarning(codes.AMBIENT_SUBTRACTED, text))
    warnings += _left_out(files)
    radiometry, of_curve = radiometry.with_stated_curve(facts)
    warnings += of_curve
    # Earlier versions read such images as linear or, with a colour profile, as sRGB.
    is_decoded = radiometry.automatic and radiometry.curve != 1
    decoded = (radiometry.curve or "sRGB",) if is_decoded else ()
    warnings += _turned_by_viewers(facts)
    given_level = () if options.white_level is None else (options.white_level,)
    return CaptureSource(
        files=files,
        facts=facts,
        light_directions=directions,
        light_intensities=factors if intensities is None else intensities,
        warnings=tuple(warnings),
        radiometry=radiometry,
        white_level=options.white_level,
        intensities_known=options.are_equal or intensities is not None,
        intensities_measured=intensities is not None,
        light_frame=options.light_frame,
        lamps=near,
        camera_matrix=camera_matrix,
        channels=channels,
        window=options.window.on(facts[0]),
        # Values that are not given are omitted, so that stamps of earlier versions stay valid.
        stamp=(*stamp, *decoded, *given_level),
    )


def _with_near_ps(
    files: CaptureFiles,
    options: CaptureOptions,
    near: lamp_files.LampFiles | None,
    camera_matrix: Float64Array | None,
) -> tuple[CaptureOptions, Float64Array | None]:
    """Return the options, with the frame of the lamps if their file is in near_ps format, and their
    light intensities. Raises InputError.
    """
    path = None if near is None or not near.used else near.positions
    if near is None or path is None or not lamp_files.is_near_ps(path):
        return options, None
    shape = read_header(files.images[0]).size[0]
    frame = lamp_files.near_ps_frame(near, camera_matrix, shape)
    return replace(options, light_frame=frame), lamp_files.near_ps_intensities(path, frame)


def _with_flat_fields(
    radiometry: linearise.RadiometricCalibration, in_folder: Sequence[Path], images: Sequence[Path]
) -> linearise.RadiometricCalibration:
    """Return the calibration with its flat fields, if there are several, assigned to the images.
    Raises InputError.
    """
    flats = radiometry.flat_field  # in the order of the folder's images
    if len(flats) < 2:
        return radiometry
    each = tuple(dict.fromkeys(in_folder))  # images with three lights only once
    if len(flats) != len(each):
        problem = f"found {len(flats)} flat-field images, expected 1 or {len(each)}"
        raise InputError(f"{problem}, one for each image", path=flats[0].parent)
    flat_of = dict(zip(each, flats, strict=True))
    return replace(radiometry, flat_field=tuple(flat_of[image] for image in images))


def _find_files(
    folder: Path, options: CaptureOptions
) -> tuple[CaptureFiles, lamp_files.LampFiles | None, RowForm]:
    """Return the files of a capture, its near lamps, and the form of the rows in its light file."""
    intensities = None if options.ignores_intensities else options.intensities
    given = (options.lights, intensities, options.mask, options.ground_truth)
    paths = (None if file is None else Path(file) for file in given)
    overrides = Overrides(*paths, needs_lights=options.needs_lights)
    if options.lamps.positions is not None and options.lights is not None:
        raise UsageError(
            "--lights and --light-positions cannot be used together", hint="Omit one of them"
        )
    form: RowForm = options.light_format
    near = None
    if options.needs_lights:
        near = lamp_files.find_lamps(folder, overrides.lights, options.lamps)
    if near is not None and near.used and near.positions is not None:
        if form != "xyz":
            problem = (
                f"--light-format {form} applies to light directions, but {near.positions} contains"
                " positions"
            )
            hint = "Omit it, or use --light-distance with a file of directions"
            raise UsageError(problem, hint=hint)
        overrides, form = replace(overrides, lights=near.positions), "positions"
    has_width = near is not None and near.options.object_width is not None
    if has_width and options.window.box is not None:
        raise UsageError(
            "--object-width requires the whole object to be in the image",
            hint="With --crop, use --pixel-size instead",
        )
    files = find_capture_files(folder, overrides)
    found = find_ambient(files.folder, files.images)
    others = tuple(path for path in files.others if path != found)
    return replace(files, ambient=options.radiometry.ambient or found, others=others), near, form


def _find_channels(
    files: CaptureFiles, options: CaptureOptions
) -> tuple[ChannelLights | None, str | None]:
    """Return the mapping from channels to observations, if it is used, and the stamp of the
    crosstalk file.
    """
    if not options.lights_in_channels:
        return None, None
    file = find_named(files.folder, (CROSSTALK,))
    if options.crosstalk is not None:
        file = Path(options.crosstalk)
    return channel_lights(file, len(files.images)), None if file is None else stamp_content(file)


def _find_reference(
    files: CaptureFiles, options: CaptureOptions, form: RowForm
) -> tuple[CaptureFiles, tuple[Path, ...], list[CaptureWarning]]:
    """Return the files without a sensor's reference picture, this picture if it serves as the flat
    field, and a warning.

    The reference was taken without contact. It is searched for if the light file has three lights
    for every image except one. Raises InputError if it is ambiguous.
    """
    path, images, given = files.light_directions, files.images, options.radiometry.flat_field
    if not options.lights_in_channels or path is None or len(images) < 2:
        return files, (), []

    def is_for(n_images: int) -> bool:
        with suppress(InputError):
            rows, _ = read_lights(path, CHANNELS * n_images, options.light_frame, form)
            return rows.names is None
        return False

    if is_for(len(images)) or not is_for(len(images) - 1):
        return files, (), []
    found = find_reference(images)
    if found is None:
        raise InputError(
            f"found {len(images)} images ({short_list(images)}), but"
            f" {path.name} has three lights each for {len(images) - 1}",
            files.folder,
            hint="Move the image without contact to a separate folder, and pass it with"
            " --flat-field DIR",
        )
    files = replace(files, images=tuple(image for image in images if image != found))
    has_own = find_named(files.folder, (CROSSTALK,)) is not None or options.crosstalk is not None
    if given or has_own or files.light_intensities is not None or options.intensities is not None:
        return replace(files, others=(*files.others, found)), (), []
    text = f"{found.name} was used as the flat field, because it shows the sensor without contact."
    note = CaptureWarning(
        codes.FLAT_FIELD_CHOICE, f"{text} To use another one, pass --flat-field DIR."
    )
    return files, (found,), [note]


def _read_all_lights(
    files: CaptureFiles, options: CaptureOptions, form: RowForm, channels: ChannelLights | None
) -> tuple[CaptureFiles, Float64Array, Float64Array | None, list[CaptureWarning]]:
    """Return the result of _read_lights, with adapted errors for lights in channels."""
    try:
        return _read_lights(files, options.light_frame, form)
    except WrongCountError as error:
        if channels is None:
            raise
        problem = error.problem.replace("one for each image", "three for each image")
        hint = (
            "With --lights-in-channels, the file needs three lines for each image, in the order"
            " R, G, B"
        )
        if error.n_found == CHANNELS:
            hint = (
                "Put each image under these three lamps into a separate folder, together with the"
                " image without contact if there is one"
            )
        raise InputError(problem, path=error.path, hint=hint) from None


def _left_out(files: CaptureFiles) -> list[CaptureWarning]:
    if not files.others:
        return []
    more = f" and {len(files.others) - 1} more" if len(files.others) > 1 else ""
    text = (
        f"{files.others[0].name}{more}: left out, because the name suggests that it is not a"
        " photograph under one of the lights. To include it, list all images in filenames.txt."
    )
    return [CaptureWarning(codes.IMAGES_LEFT_OUT, text)]


def _turned_by_viewers(facts: Sequence[ImageHeader]) -> list[CaptureWarning]:
    orientation = common_orientation(facts)
    if orientation == UPRIGHT:
        return []
    text = (
        f"Viewers rotate the images (EXIF orientation {orientation}), but splinecli does not, so"
        " the mask, light directions and results are in the frame of the stored pixels."
    )
    return [CaptureWarning(codes.EXIF_ORIENTATION, text)]


def _read_lights(
    files: CaptureFiles, frame: LightFrame, form: RowForm
) -> tuple[CaptureFiles, Float64Array, Float64Array | None, list[CaptureWarning]]:
    """Return the files in the order of the lights, the directions (F, 3), their intensities (F, 3),
    and warnings.
    """
    path = files.light_directions
    warnings = []
    if path is None:
        images = _alike(files.images, _stated_size)
        if len(images) < len(files.images):
            odd = [image for image in files.images if image not in images]
            text = f"{short_list(odd)}: left out, because most images have another size."
            warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
        return replace(files, images=images), placeholders(len(images)), None, warnings
    images, table, directions = _match_count(files.images, path, frame, form)
    if len(images) < len(files.images):
        others = [image.name for image in files.images if image not in images]
        names = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        them = "it" if len(others) == 1 else "them"
        text = (
            f"{names}: left out, because {path.name} has no light for {them}, and the other images"
            " have another"
        )
        text += f" {'size' if len(set(map(_stated_size, files.images))) > 1 else 'form of name'}."
        warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
        files = replace(files, images=images)
    if table.names is None:
        return _drop_bad_lights(files, directions, table.intensities, warnings)
    images, how = match_images(table, files.images)
    if len(images) < len(files.images):
        text = (
            f"{path.name} lists {len(images)} of the {len(files.images)} images; the others were"
            " left out."
        )
        warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
    if how != "name":
        text = f"The lights of {path.name} were matched to the images by {how}."
        warnings.append(CaptureWarning(codes.LIGHTS_MATCHED, text))
    return _drop_bad_lights(replace(files, images=images), directions, table.intensities, warnings)


def _drop_bad_lights(
    files: CaptureFiles,
    directions: Float64Array,
    intensities: Float64Array | None,
    warnings: list[CaptureWarning],
) -> tuple[CaptureFiles, Float64Array, Float64Array | None, list[CaptureWarning]]:
    """Return the arguments without lights that are zero or not above the image plane (see
    unit_directions).
    """
    good = above_plane(directions)
    if good.all():
        return files, directions, intensities, warnings
    first = np.flatnonzero(~good)
    bad = ", ".join(
        f"{files.images[light].name} (z = {directions[light, 2]:.2g})" for light in first[:3]
    )
    assert files.light_directions is not None
    text = (
        f"{bad}: left out, because its light direction in {files.light_directions.name} is not"
        " above the horizon."
    )
    if len(first) > 1:
        text = (
            f"{bad}{', ...' if len(first) > 3 else ''}: {len(first)} of {len(good)} images were"
            f" left out, because their lights in {files.light_directions.name} are in the image"
            " plane or behind it. If this is wrong, the file uses another frame (--light-frame)."
        )
    warnings.append(CaptureWarning(codes.IMAGES_LEFT_OUT, text))
    files = replace(
        files,
        images=tuple(np.array(files.images, object)[good]),
        kept=tuple(np.flatnonzero(good).tolist()),
    )
    return files, directions[good], None if intensities is None else intensities[good], warnings


def _match_count(
    images: tuple[Path, ...], path: Path, frame: LightFrame, form: RowForm
) -> tuple[tuple[Path, ...], NumberRows, Float64Array]:
    """Return the images that belong to a light file, its rows, and their directions (F, 3).

    These are all images or, if the numbers differ, the images of the most frequent size or those
    whose names differ only in their numbers.
    """
    try:
        return images, *read_lights(path, len(images), frame, form)
    except InputError as error:
        for key in (_stated_size, lambda image: re.sub(r"\d+", "0", image.name.lower())):
            alike = _alike(images, key)
            if len(alike) < len(images):
                with suppress(InputError):
                    return alike, *read_lights(path, len(alike), frame, form)
        if not isinstance(error, WrongCountError):
            raise
        hint = f"{error.hint}"
        if error.n_found < len(images):
            hint += f". In this order, there is no light for {short_list(images[error.n_found :])}"
        if error.n_found in (CHANNELS, CHANNELS * len(images)) and _is_colour(images):
            hint += (
                ". If the lights are three coloured lamps that shine at once, add"
                " --lights-in-channels"
            )
        raise error.with_hint(hint) from None


def _alike(images: tuple[Path, ...], key: Callable[[Path], object]) -> tuple[Path, ...]:
    """Return the images with the most frequent key, or all images if two keys are equally
    frequent.
    """
    keys = [key(image) for image in images]
    (usual, count), *others = Counter(keys).most_common(2)
    if others and others[0][1] == count:
        return images
    return tuple(image for image, own in zip(images, keys, strict=True) if own == usual)


def _is_colour(images: Sequence[Path]) -> bool:
    return (read_header(images[0]).stated_channels or 1) >= CHANNELS


def _stated_size(image: Path) -> tuple[int, ...] | None:
    size = read_header(image).stated_size
    return None if size is None else size[0][:2]


def _given_intensities(
    files: CaptureFiles,
    options: CaptureOptions,
    in_folder: Sequence[Path],
    channels: ChannelLights | None,
    found: Float64Array | None,
) -> Float64Array | None:
    """Return the intensities (F, 3) given by options or files, or else the intensities found with
    the lights, or None.
    """
    if options.ignores_intensities:
        return None
    if files.light_intensities is None:
        return found
    return _read_intensities(files.light_intensities, files.images, in_folder, channels)


def _read_intensities(
    path: Path,
    images: Sequence[Path],
    in_folder: Sequence[Path],
    channels: ChannelLights | None,
) -> Float64Array:
    """Return the intensities (F, 3) of images from a file with one line for each of them, or for
    each image in the folder.
    """
    if channels is not None:  # one line r g b for each image
        of_images = read_light_intensities(path, len(images) // CHANNELS)
        return np.repeat(of_images.reshape(-1, 1), 3, axis=1)
    if len(images) < len(in_folder):
        with suppress(InputError):  # then it must have a line for each of the chosen images
            chosen = [in_folder.index(image) for image in images]
            return read_light_intensities(path, len(in_folder))[chosen]
    return read_light_intensities(path, len(images))
