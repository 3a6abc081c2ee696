"""Pictures that are not photographs: masks in every format, ambient images, and sensors without
contact.
"""

from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

import scenes
from capture.conftest import DISC, LIGHTS, MASK, PICTURES, normals_by_ls
from scenes import codes, on_sphere, parametrize, put, refuses, to_uint16, vectors, write_image
from splinecli.capture import CaptureOptions, find_capture_files, open_capture
from splinecli.capture.files import Overrides
from splinecli.lights.calibration.balls import find_ball_files
from splinecli.maths.normals import angle_between_deg


def write(path, picture):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".webp":
        Image.fromarray(np.dstack([picture] * 3).astype(np.uint8)).save(path, lossless=True)
    else:
        write_image(path, np.dstack([picture] * 3) if path.suffix == ".ppm" else picture)


MASKS = """
mask.pgm mask.webp mask_1.png owl_mask.png face_mask.pgm owlMask.webp stack_mask.tif owl.mask.tif
../owl_mask.png ../owl.mask.bmp
"""


@parametrize("photographs", ".png .pgm .webp .jpg stack")
@parametrize("mask", MASKS.split())
def test_masks_in_every_format(tmp_path, photographs, mask):
    folder = tmp_path / "owl"
    write(folder / mask, MASK)
    put(folder / "lights.txt")
    np.savetxt(folder / "lights.txt", LIGHTS)
    if photographs == "stack":
        tifffile.imwrite(folder / "stack.tif", PICTURES, photometric="minisblack")
    else:
        for number, picture in enumerate(PICTURES):
            write(folder / f"{number}{photographs}", np.uint8(picture >> 8))
    for options in (CaptureOptions(), CaptureOptions(needs_lights=False)):
        source = open_capture(folder, options)
        assert source.n_lights == 12 and (source.read_mask(DISC.shape) == DISC).all()
        chosen = f"{Path(mask).name} is used as the mask. To use another mask, pass"
        found = any(str(warning).startswith(chosen) for warning in source.warnings)
        assert found == ("mask_choice" in codes(source)) == (not mask.startswith("mask."))
    balls = find_ball_files(folder)
    assert len(balls.images) == 12 and balls.mask == source.files.mask


def test_two_masks_are_named_by_all(folder):
    for name in ("a_mask.pgm", "b.mask.png"):
        write(folder / name, MASK)
    write(folder / "small_mask.pgm", MASK[::2, ::2])
    text = (
        "No mask is used, because several files could be the mask: a_mask.pgm, b.mask.png. Choose"
        " one with --mask FILE."
    )
    source = open_capture(folder)
    assert codes(source) == ["mask_choice"] and str(source.warnings[0]) == text
    assert source.n_lights == 12 and source.read_mask(DISC.shape).all()
    assert [str(warning) for warning in find_ball_files(folder).warnings] == [text]
    with refuses(text):
        open_capture(folder, CaptureOptions(needs_lights=False))
    mask = folder / "b.mask.png"
    assert open_capture(folder, CaptureOptions(needs_lights=False, mask=mask)).n_lights == 12
    source = open_capture(folder, CaptureOptions(mask=mask))
    assert codes(source) == ["images_left_out"] and (source.read_mask(DISC.shape) == DISC).all()


def test_an_object_that_is_called_mask(tmp_path):
    folder = scenes.write_capture(tmp_path, PICTURES, LIGHTS, names="mask_{}.png")
    assert open_capture(folder).n_lights == 12 and codes(open_capture(folder)) == []


def test_a_preview_among_rare_formats_is_no_photograph(folder):
    for number, path in enumerate(sorted(folder.glob("*.png"))):
        write(folder / f"{number}.pgm", PICTURES[number])
        path.unlink()
    write(folder / "preview.png", MASK)
    assert len(find_capture_files(folder, Overrides()).images) == 12


def test_ambient_by_name(folder):
    write(folder / "owl_Ambient.png", np.full(DISC.shape, 500, np.uint16))
    source = open_capture(folder)
    assert codes(source) == ["ambient_subtracted"]
    assert source.files.ambient == folder / "owl_Ambient.png" and source.n_lights == 12
    write(folder / "ambient_2.png", np.full(DISC.shape, 900, np.uint16))
    source = open_capture(folder)  # it is unclear which
    assert codes(source) == ["images_left_out"] and source.files.ambient is None


GEL_LIGHTS = vectors("0 0.8 0.6; -0.6 -0.4 0.69; 0.6 -0.5 0.62")


def write_gel(folder, names):
    """Write a flat gel, unevenly lit by unequal coloured lamps, and the same with a ball in it."""
    y, x = np.indices((48, 64))
    inside = np.hypot(x - 30, y - 22) < 10
    normals = on_sphere((x - 30) / 20 * inside, (22 - y) / 20 * inside)
    uneven = (0.6 - 0.2 * ((x - 32) / 32) ** 2)[..., None] * (1.0, 0.8, 0.6)
    flat = np.broadcast_to((0.0, 0, 1), normals.shape)
    for name, surface in zip(names, (flat, normals), strict=True):
        shading = (surface @ GEL_LIGHTS.T).clip(0) * uneven
        write_image(folder / name, to_uint16(shading[..., ::-1] * 65_535))
    np.savetxt(folder / "light_directions.txt", GEL_LIGHTS)
    return normals


@parametrize("reference", "ref Background gel_empty no-contact 000")
def test_a_gel_without_contact_is_the_flat_field(tmp_path, reference):
    normals = write_gel(tmp_path, (f"{reference}.png", "press.png"))
    options = CaptureOptions(lights_in_channels=True)
    source = open_capture(tmp_path, options)
    assert codes(source) == ["flat_field_choice", "lights_in_channels"]
    _, found = normals_by_ls(source)
    # Divided by the picture without contact, uneven and unequal lamps leave no trace.
    assert angle_between_deg(found, normals).max() < 0.1
    (tmp_path / "flats").mkdir()
    (tmp_path / f"{reference}.png").rename(tmp_path / "flats/1.png")
    assert open_capture(tmp_path, options).n_lights == 3


def test_a_gel_of_which_no_picture_is_clearly_without_contact(tmp_path):
    write_gel(tmp_path, ("other.png", "1.png"))
    write_gel(tmp_path, ("other.png", "2.png"))
    (tmp_path / "other.png").unlink()
    with refuses(r"found 2 images .* but .* has three lights each for 1.* --flat-field"):
        open_capture(tmp_path, CaptureOptions(lights_in_channels=True))
    with refuses(r"shine at once, add --lights-in-channels"):
        open_capture(tmp_path)
    write_gel(tmp_path, ("ref.png", "3.png"))
    with refuses(r"expected 12, three .* a separate folder"):
        open_capture(tmp_path, CaptureOptions(lights_in_channels=True))


def test_too_few_photographs(tmp_path):
    write(tmp_path / "1.png", PICTURES[0])
    put(tmp_path / "output.txt", "1 2 3")
    with refuses(r"found 1 image \(1\.png\) .* at least three photographs"):
        open_capture(tmp_path)
