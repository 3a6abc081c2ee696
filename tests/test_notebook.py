"""The functions for notebooks: the same normals as `splinecli infer`, from arrays."""

import base64
import contextlib
import io
import json
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest

import splinecli
from scenes import (
    FOUR_LIGHTS,
    codes,
    parametrize,
    put,
    read_image,
    read_json,
    refuses,
    run_python,
    tilted,
    write_image,
)
from splinecli.capture.arrays import open_arrays
from splinecli.cli.main import main
from splinecli.errors import InputError, UsageError
from splinecli.recipe import RecipeOptions, prepare_capture

MEDALLION = Path(__file__).resolve().parents[1] / "examples/medallion"


def read_medallion(folder=MEDALLION):
    """Images (F, H, W, 3), light directions (F, 3), intensities (F, 3) and mask (H, W), as a
    notebook reads them.
    """
    images = [read_image(path)[..., ::-1] for path in sorted(folder.glob("[01]*.png"))]
    directions, intensities = (
        np.loadtxt(folder / f"light_{name}.txt") for name in ("directions", "intensities")
    )
    return (
        np.stack(images),
        directions,
        intensities,
        cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0,
    )


def matte(dtype=np.float64, scale=1.0):
    """Images (F, H, W) of a matte bowl, and its normals (H, W, 3)."""
    y, x = np.mgrid[0.2:-0.2:13j, -0.2:0.2:11j]
    normals = tilted(x, y)
    return (scale * np.moveaxis(normals @ FOUR_LIGHTS.T, -1, 0)).astype(dtype), normals


def outputs_of(source, names):
    """Run a cell and return what Jupyter would store of it: its text, and its figures."""
    figures = []

    def keep_figure():
        file = io.BytesIO()
        plt.savefig(file, format="png", dpi=60, bbox_inches="tight")
        plt.close()
        figures.append(base64.b64encode(file.getvalue()).decode("ascii"))

    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.MonkeyPatch.context() as patch:
        patch.setattr(plt, "show", keep_figure)
        exec(source, names)
    text = out.getvalue().splitlines(keepends=True)
    stream = {"name": "stdout", "output_type": "stream", "text": text}
    shown = [
        {"data": {"image/png": png}, "metadata": {}, "output_type": "display_data"}
        for png in figures
    ]
    return [stream] * bool(text) + shown


def test_quickstart(request, monkeypatch):
    """The stored outputs are those of its cells; --update-golden stores them anew."""
    monkeypatch.chdir(MEDALLION.parent)
    plt.switch_backend("agg")
    notebook, names = read_json("quickstart.ipynb"), {}
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    stored = [cell["outputs"] for cell in cells]
    for number, cell in enumerate(cells, start=1):
        cell["outputs"] = outputs_of("".join(cell["source"]), names)
        cell["execution_count"] = number
    if request.config.getoption("--update-golden"):
        text = json.dumps(notebook, indent=1, ensure_ascii=False)
        put("quickstart.ipynb", text + "\n")
        return
    for before, cell in zip(stored, cells, strict=True):
        found, expected = (
            [(output["output_type"], output.get("text")) for output in outputs]
            for outputs in (cell["outputs"], before)
        )
        assert found == expected
    assert names["error_deg"].mean() < 1.7


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_same_warnings_as_infer(tmp_path):
    """Three lights of a small part: the network was not trained with so few."""
    images, directions, intensities, mask = read_medallion()
    small = np.zeros_like(mask)
    small[80:110, 80:110] = mask[80:110, 80:110]
    write_image(tmp_path / "mask.png", small * np.uint8(255))
    command = f"infer {MEDALLION} --light-indices 0,3,6 --mask {tmp_path}/mask.png -q -o {tmp_path}"
    assert main(command.split()) == 0
    chosen, done = [0, 3, 6], []
    estimate = splinecli.estimate_normals(
        images[chosen],
        directions[chosen],
        small,
        light_intensities=intensities[chosen],
        progress=done.append,
    )
    assert sum(done) == small.sum() > 0
    told = read_json(tmp_path / "medallion/report.json")["warnings"]
    assert codes(estimate.capture) == codes(told)
    assert "untrained_lights" in codes(told)


@parametrize(
    "dtype, scale", [(np.float32, 3.0), (np.float64, 1e-3), (np.uint16, 50_000), (np.uint8, 200)]
)
def test_matte_images_of_each_type(dtype, scale):
    images, normals = matte(dtype, scale)
    estimate = splinecli.estimate_normals(
        images, 5 * FOUR_LIGHTS, method="ls", light_intensities=np.ones(len(FOUR_LIGHTS))
    )
    # 8 bits round by up to 0.25 %.
    np.testing.assert_allclose(
        estimate.normal_map, normals, atol=1e-2 if dtype is np.uint8 else 1e-4
    )


# clipped ones, as stored
@pytest.mark.filterwarnings("ignore:The images fit the lights much better if")
def test_saturated_values_are_restored_unless_as_stored():
    lights = np.concatenate((FOUR_LIGHTS, FOUR_LIGHTS[1:] * (-1, -1, 1)))
    _, normals = matte()
    images = np.moveaxis(normals @ lights.T, -1, 0)
    clipped = np.uint16(np.minimum(65_535 * images / 0.85, 65_535))
    assert 0.1 < (clipped == 65_535).mean() < 0.5

    def worst(images, **options):
        known = np.ones(len(lights))
        estimate = splinecli.estimate_normals(
            images, lights, light_intensities=known, method="ls", **options
        )
        return float(np.abs(estimate.normal_map - normals).max())

    stored, restored = worst(clipped, as_stored=True), worst(clipped)
    assert stored > 0.02
    assert restored < 0.3 * stored
    # Floating-point images have no full scale, but a white level can be given.
    shares = clipped / 65_535
    assert worst(shares) == pytest.approx(stored)
    assert worst(shares, white_level=1.0) == pytest.approx(restored, abs=1e-4)


@parametrize(
    "change, error, message",
    [
        ({"images": np.ones((4, 5))}, UsageError, "found images of shape"),
        ({"images": np.ones((4, 5, 6, 2))}, UsageError, "expected (F, H, W) or (F, H, W, 3)"),
        ({"images": np.ones((4, 5, 6), np.int64)}, UsageError, "found images of type int64"),
        ({"images": []}, UsageError, "found no images"),
        ({"images": [np.ones((5, 6)), np.ones((5, 7))]}, UsageError, "images[1]"),
        ({"images": -np.ones((4, 5, 6))}, InputError, "images[0]: found the negative value -1"),
        (
            {"light_directions": FOUR_LIGHTS[:3]},
            UsageError,
            "expected (F, 3) = (4, 3), one for each image",
        ),
        (
            {"light_directions": -FOUR_LIGHTS},
            InputError,
            "light_directions: found a light below the horizon in row 0",
        ),
        (
            {"mask": np.ones((5, 5))},
            UsageError,
            "found a mask of shape (5, 5), expected (H, W) = (5, 6)",
        ),
        ({"mask": np.zeros((5, 6))}, InputError, "the mask is empty"),
        ({"light_intensities": np.ones(3)}, UsageError, "found light intensities of shape (3,)"),
        ({"light_intensities": np.zeros(4)}, InputError, "not a finite number above 0"),
    ],
)
def test_wrong_arguments(change, error, message):
    arguments = {"images": np.ones((4, 5, 6)), "light_directions": FOUR_LIGHTS, "method": "ls"}
    with pytest.raises(error) as caught:
        splinecli.estimate_normals(**(arguments | change))
    assert message in str(caught.value)


def test_importing_the_package_loads_neither_torch_nor_numpy():
    code = "import sys, splinecli; print({'numpy', 'torch', 'cv2'}.intersection(sys.modules))"
    assert run_python(code, check=True).stdout == "set()\n"


def test_the_capture_has_a_mask_of_its_own():
    images, normals = matte()
    mask = np.ones(normals.shape[:2], np.bool_)
    estimate = splinecli.estimate_normals(images, FOUR_LIGHTS, mask, method="ls")
    mask[:] = False
    assert estimate.capture.mask.all()


@parametrize("kind", [np.uint8, np.uint16, np.float64])
def test_a_mask_of_numbers_obeys_the_rule_of_mask_files(kind, rng):
    """A gray edge at or below half of the largest value is outside; any value of a bool mask that
    is True counts.
    """
    images = rng.uniform(0.1, 1, (4, 2, 3))
    directions = [(0.1, 0, 1), (0, 0.4, 1), (-0.5, 0, 1), (0, -0.6, 1)]
    numbers = np.array([[0, 100, 101], [200, 50, 200]], kind)

    def prepared(mask):
        source = open_arrays(images, directions, mask)
        return prepare_capture(source, options=RecipeOptions(as_stored=True))

    assert prepared(numbers).mask.tolist() == [[False, False, True], [True, False, True]]
    assert prepared(numbers > 0).n_pixels == 5
    with refuses("mask"):
        prepared(np.zeros((2, 3), kind))
