"""Wrong and rough light files on the command line: the option that mends them is named; --strict
makes them errors.
"""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from cli.conftest import EXAMPLE, read_report
from scenes import (
    BUMP_LAMPS,
    codes,
    parametrize,
    read_image,
    read_json,
    to_uint16,
    write_bump,
    write_image,
)
from splinecli.maths.normals import angle_between_deg, unit


def write_lights(folder, change):
    lights = np.loadtxt(EXAMPLE / "light_directions.txt")
    np.savetxt(folder / "light_directions.txt", change(lights), fmt="%.6f")


def test_a_flipped_axis_is_mended_unless_a_frame_is_given(run, medallion):
    write_lights(medallion, lambda lights: lights * (1, -1, 1))
    why = "with y negated (curl 0.03 instead of 0.52, outline +1.00 instead of -0.00). "
    found = {}
    for options, says in (
        ("", f"{why}They were corrected; --light-frame x-right,y-up keeps"),
        ("--light-frame x-right,y-up", f"{why}Run again with --light-frame y-down."),
        ("--light-frame y-down", ""),
    ):
        run(f"infer {medallion} --method ls --overwrite {options}", says=says)
        report = read_report("medallion")
        found[options] = report["angular_error_deg"]["mean"], report["mended"], codes(report)
    mended, kept, given = found.values()
    assert mended[0] == given[0] < kept[0] / 5
    assert mended[1:] == (["light_frame"], ["lights_mended"])
    assert kept[1:] == ([], ["light_frame"])
    assert given[1:] == ([], [])
    says = "Without --strict, infer corrects this."
    run(f"infer {medallion} --method ls --strict --overwrite", input_error=says)


def test_lights_that_all_point_away(run, medallion):
    write_lights(medallion, lambda lights: -lights)
    run(
        f"infer {medallion} --method ls",
        input_error="z points away from the camera in this file, so add --light-frame z-away",
    )


def test_strict_writes_nothing_and_ends_with_3(run, medallion):
    write_lights(medallion, lambda lights: np.roll(lights, 1, axis=0))
    run(
        f"infer {medallion} --method ls --strict",
        input_error=(
            "much better if image 1 belongs to light 2, image 2 to the next, and so on",
            "Without --strict, infer corrects this.",
        ),
        out="",
    )
    assert not Path("out/medallion").exists()


@parametrize("options", ["", "--intensities equal"])
def test_an_order_is_named_although_the_intensities_are_unequal_and_unknown(
    run, medallion, options
):
    (medallion / "light_intensities.txt").unlink()
    for number in (3, 7, 8):
        path = medallion / f"{number:02}.png"
        write_image(path, to_uint16(0.6 * read_image(path)))
    for command in (f"info {medallion}", f"infer {medallion} --method ls"):
        said = run(f"{command} {options}").err
        assert "light_directions" not in said and "lights of" not in said
    write_lights(medallion, lambda lights: lights[[0, 5, 2, 3, 4, 1, 6, 7, 8, 9]])
    for command in (f"info {medallion}", f"infer {medallion} --method ls --overwrite"):
        found = run(f"{command} {options}").err
        assert "much better with the lights of 02.png and 06.png exchanged (misfit" in found


def test_info_lists_the_readings(run, medallion):
    rows = run(f"info {medallion} --strict --check-lights --json").json["light_candidates"]
    assert rows[0]["reading"] == "as given"
    assert rows[0]["rim"] > 0.99 and max(row["advantage"] or 0 for row in rows) == 0
    assert len(rows) >= 12
    orders = {row["reading"].split()[0]: row["misfit"] for row in rows if row["advantage"] is None}
    assert set(orders) == {"if", "in", "with"}
    assert min(orders.values()) > rows[0]["misfit"]
    write_lights(medallion, lambda lights: lights[:, [1, 0, 2]])
    wrong = run(
        f"info {medallion} --strict --check-lights",
        input_error=(
            "--light-frame swap-xy",
            "splinecli: medallion: an input is probably wrong (light_frame); see the warnings",
        ),
    )
    assert "x and y exchanged  " in wrong.out
    assert "in reversed order, beginning with light" in wrong.out
    assert "advantage: evidence from curl and outline" in wrong.out


def test_mended_lights(run, medallion):
    """What is written needs no frame and no other order."""
    right = np.loadtxt(medallion / "light_directions.txt")
    good = run(f"info {medallion} --mended-lights mended.txt")
    assert not Path("mended.txt").exists()
    assert "not written, because no other reading of the lights fits clearly better" in good.out
    write_lights(medallion, lambda lights: np.roll(lights, 2, axis=0)[:, [1, 0, 2]])
    report = run(f"info {medallion} --mended-lights mended.txt --json").json
    assert report["mended_lights"] == "mended.txt"
    right = unit(right)
    assert_allclose(np.loadtxt("mended.txt"), right, atol=1e-6)
    run(f"info {medallion} --mended-lights mended.txt", code=5)
    run(f"infer {medallion} --lights mended.txt --method ls --strict")
    for name in ("mended.lp", "mended.npy"):
        run(f"info {medallion} --mended-lights {name}")
        run(f"infer {medallion} --lights {name} --method ls --strict -o {name[-3:]}", err="")
        found = read_json(Path(name[-3:], "medallion/report.json"))["light_directions"]
        assert_allclose(found, right, atol=1e-5)
    for suffix in ("json", "mat", "yml", "xml"):
        run(
            f"info {medallion} --mended-lights mended.{suffix}",
            usage_error=f".{suffix} light files can be read but not written. Write .txt",
        )
        assert not Path(f"mended.{suffix}").exists()


def test_what_cannot_be_checked_is_said_and_no_error(run, medallion):
    usual = run(f"infer {medallion} --method ls --light-indices 0,2,4,6,8 -o usual")
    assert "not be checked" not in usual.err
    few = run(f"infer {medallion} --method ls --light-indices 0,2,4,6,8 --strict --json")
    other, warning = few.json[0]["warnings"]
    assert (warning["code"], other["code"]) == ("lights_unchecked", "few_lights")
    assert warning["text"].endswith(
        "their order (fewer than 6 lights, too few lit pixels, or a flat object)."
    )
    mask = np.zeros((128, 128), np.uint8)
    mask[40:90, 40:90] = 255
    write_image(medallion / "mask.png", mask)
    (medallion / "normals_gt.png").unlink()  # it would contradict the lights
    write_lights(medallion, lambda lights: lights * (-1, -1, 1))
    run(
        f"info {medallion} --strict",
        says="The lights of light_directions.txt could not be fully verified. Unchecked: whether x"
        " and y",
    )


def test_angles_from_the_camera_axis_are_told_by_the_images(run, medallion):
    def zenith_angles(lights):
        azimuth = np.arctan2(lights[:, 1], lights[:, 0])
        return np.degrees(np.stack((azimuth, np.arccos(lights[:, 2])), axis=1))

    write_lights(medallion, zenith_angles)
    result = run(
        f"info {medallion} --light-format azel --strict --json",
        input_error=(
            "much better if their elevations are measured from the camera axis (misfit",
            "Replace each elevation with 90 degrees minus its value.",
        ),
    )
    assert result.json["warning_codes"] == ["light_frame"]


def test_a_file_of_all_intensities_fits_a_light_file_that_names_some_images(run, medallion):
    lights = np.loadtxt(medallion / "light_directions.txt")
    (medallion / "light_directions.txt").unlink()
    intensities = medallion / "light_intensities.txt"
    rows = intensities.read_text().splitlines()
    chosen = [8, 0, 2, 3, 5, 6, 9]
    text = "".join(f"{i + 1:02}.png {x} {y} {z}\n" for i in chosen for x, y, z in [lights[i]])
    (medallion / "lights.txt").write_text(text)
    normals = []
    for content in (rows, [rows[i] for i in chosen]):
        intensities.write_text("\n".join(content))
        run(f"infer {medallion} --method ls --overwrite")
        normals.append(np.load("out/medallion/normals.npy"))
    assert_array_equal(*normals)


def test_an_image_that_contradicts_the_others_is_named(run, medallion):
    picture = read_image(medallion / "07.png")
    write_image(medallion / "07.png", (picture * 0.4).astype(picture.dtype))
    report = run(f"info {medallion} --strict --json", code=3).json
    assert report["warning_codes"] == ["image_inconsistent"]
    assert "07.png contradicts the other images and is 0.4" in report["warnings"][0]
    left_out = ",".join(str(place) for place in range(10) if place != 6)
    run(f"infer {medallion} --method ls --strict --light-indices {left_out}")


@pytest.fixture
def rough():
    """Write a matte bump under distant lights. Returns directions (7, 3) with errors of about 5
    degrees.
    """
    write_bump(Path("bump"), distant=True)
    directions = unit(BUMP_LAMPS)
    Path("bump/light_intensities.txt").write_text("1\n" * len(directions))
    rough = directions + np.random.default_rng(1).normal(scale=0.06, size=directions.shape)
    np.savetxt("bump/light_directions.txt", rough)
    return unit(rough)


def test_infer(document, rough):
    command = "infer bump --method ls --overwrite"
    given, refined = (document(f"{command} {more}") for more in ("", "--refine-lights"))
    assert_allclose(given["light_directions"], rough, atol=1e-5)
    moved = angle_between_deg(refined["light_directions"], rough)
    assert 1 < moved.mean() < 10
    assert "refined_lights" in codes(refined)
    # A common rotation of lights and normals stays.
    assert refined["angular_error_deg"]["mean"] < 0.9 * given["angular_error_deg"]["mean"]


def test_evaluate(document, rough):
    """Both protocols share a folder: trials with refined lights are other trials."""
    command = "evaluate bump --method ls --n-lights all -o scores"
    options = ("", "--refine-lights", "--refine-lights --light-error-deg 3")
    found = [document(f"{command} {more}") for more in options]
    errors = [one["results"][0]["mae_deg"] for one in found]
    assert found[2]["protocol"]["light_error_deg"] == 3
    assert errors[1] < 0.9 * errors[0]
    assert errors[2] not in errors[:2]


def test_evaluate_skips_a_capture_with_near_lamps(run, rough):
    write_bump(Path("near"))
    np.savetxt("near/light_positions.txt", BUMP_LAMPS)
    Path("near/pixel_size.txt").write_text("2\n")
    arguments = "--method ls --n-lights all --refine-lights --json"
    result = run(
        f"evaluate bump near {arguments}",
        input_error="--refine-lights refines distant lights, but this capture has near lamps",
    )
    document = result.json
    assert [scored["capture"] for scored in document["results"]] == ["bump"]
    assert [skipped["capture"] for skipped in document["skipped"]] == ["near"]
    run(f"evaluate near {arguments}", code=2)


def test_a_light_error_without_refined_lights_is_refused(run, rough):
    run(
        "evaluate bump --method ls --light-error-deg 4",
        usage_error="--light-error-deg needs --refine-lights",
    )


def test_a_black_patch_amid_the_object(run, medallion):
    """The check of the lights integrates its surface, also where no light reaches a pixel."""
    for path in medallion.glob("[01]*.png"):
        image = read_image(path)
        image[54:74, 54:74] = 0
        write_image(path, image)
    run(f"infer {medallion} --method ls")
    assert "black_pixels" in codes(read_report("medallion"))
