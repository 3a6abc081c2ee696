"""The functions for notebooks: the same normals as `splinecli infer`, from arrays."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import splinecli
from scenes import read_image, read_json, write_image
from splinecli.capture.arrays import open_arrays
from splinecli.cli.main import main
from splinecli.errors import InputError, UsageError
from splinecli.recipe import RecipeOptions, prepare_capture

MEDALLION = Path(__file__).resolve().parents[1] / "examples/medallion"
LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.48, -0.36, 0.8]])


def read_medallion(folder: Path = MEDALLION) -> tuple[NDArray[Any], ...]:
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


def matte(dtype: type = np.float64, scale: float = 1.0) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Images (F, H, W) of a matte bowl, and its normals (H, W, 3)."""
    y, x = np.mgrid[0.2:-0.2:13j, -0.2:0.2:11j]
    normals = np.stack((x, y, np.ones_like(x)), axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return (scale * np.moveaxis(normals @ LIGHTS.T, -1, 0)).astype(dtype), normals


@pytest.mark.parametrize("intensities_known", [True, False])
def test_the_same_to_the_last_bit_as_infer(intensities_known, tmp_path):
    """With unknown intensities, both estimate them from the images."""
    images, directions, intensities, mask = read_medallion()
    folder = tmp_path / "medallion"
    folder.mkdir()
    for path in MEDALLION.iterdir():
        if intensities_known or path.name != "light_intensities.txt":
            (folder / path.name).write_bytes(path.read_bytes())
    options = ["--method", "iw12", "--format", "npy", "-q", "-o", str(tmp_path / "out")]
    assert main(["infer", str(folder), *options]) == 0
    expected = np.load(tmp_path / "out/medallion/normals.npy")
    estimate = splinecli.estimate_normals(
        images,
        directions,
        mask,
        light_intensities=intensities if intensities_known else None,
        method="iw12",
    )
    assert (estimate.capture.estimated_intensities is None) == intensities_known
    assert estimate.normal_map.tobytes() == expected.tobytes()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_same_warnings_as_infer(tmp_path):
    """Three lights of a small part: the network was not trained with so few."""
    images, directions, intensities, mask = read_medallion()
    small = np.zeros_like(mask)
    small[80:110, 80:110] = mask[80:110, 80:110]
    write_image(tmp_path / "mask.png", small * np.uint8(255))
    options = [
        "--light-indices",
        "0,3,6",
        "--mask",
        str(tmp_path / "mask.png"),
        "-q",
        "-o",
        str(tmp_path),
    ]
    assert main(["infer", str(MEDALLION), *options]) == 0
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
    assert [warning.code for warning in estimate.capture.warnings] == [
        warning["code"] for warning in told
    ]
    assert "untrained_lights" in [warning["code"] for warning in told]


@pytest.mark.parametrize(
    ("dtype", "scale"),
    [(np.float32, 3.0), (np.float64, 1e-3), (np.uint16, 50_000), (np.uint8, 200)],
)
def test_matte_images_of_each_type(dtype, scale):
    images, normals = matte(dtype, scale)
    estimate = splinecli.estimate_normals(
        images, 5 * LIGHTS, method="ls", light_intensities=np.ones(len(LIGHTS))
    )
    # 8 bits round by up to 0.25 %.
    np.testing.assert_allclose(
        estimate.normal_map, normals, atol=1e-2 if dtype is np.uint8 else 1e-4
    )


# clipped ones, as stored
@pytest.mark.filterwarnings("ignore:The images fit the lights much better if")
def test_saturated_values_are_restored_unless_as_stored():
    lights = np.concatenate((LIGHTS, LIGHTS[1:] * (-1, -1, 1)))
    _, normals = matte()
    images = np.moveaxis(normals @ lights.T, -1, 0)
    clipped = np.minimum(65_535 * images / 0.85, 65_535).astype(np.uint16)
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


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"images": np.ones((4, 5))}, UsageError, "found images of shape"),
        ({"images": np.ones((8, 0, 0))}, UsageError, "found images of shape"),
        ({"images": np.ones((4, 5, 6, 2))}, UsageError, "expected (F, H, W) or (F, H, W, 3)"),
        ({"images": np.ones((4, 5, 6), np.int64)}, UsageError, "found images of type int64"),
        ({"images": []}, UsageError, "found no images"),
        ({"images": [np.ones((5, 6)), np.ones((5, 7))]}, UsageError, "images[1]"),
        ({"images": -np.ones((4, 5, 6))}, InputError, "images[0]: found the negative value -1"),
        (
            {"light_directions": LIGHTS[:3]},
            UsageError,
            "expected (F, 3) = (4, 3), one for each image",
        ),
        (
            {"light_directions": -LIGHTS},
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
    arguments: dict[str, Any] = {
        "images": np.ones((4, 5, 6)),
        "light_directions": LIGHTS,
        "method": "ls",
    }
    with pytest.raises(error) as caught:
        splinecli.estimate_normals(**(arguments | change))
    assert message in str(caught.value)


def test_importing_the_package_loads_neither_torch_nor_numpy():
    code = "import sys, splinecli; print({'numpy', 'torch', 'cv2'}.intersection(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == "set()\n"


def test_the_capture_has_a_mask_of_its_own():
    images, normals = matte()
    mask = np.ones(normals.shape[:2], np.bool_)
    estimate = splinecli.estimate_normals(images, LIGHTS, mask, method="ls")
    mask[:] = False
    assert estimate.capture.mask.all()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float64])
def test_a_mask_of_numbers_obeys_the_rule_of_mask_files(kind):
    """A gray edge at or below half of the largest value is outside; any value of a bool mask that
    is True counts.
    """
    generator = np.random.default_rng(0)
    images = generator.uniform(0.1, 1, (4, 2, 3))
    directions = [(0.1, 0, 1), (0, 0.4, 1), (-0.5, 0, 1), (0, -0.6, 1)]
    numbers = np.array([[0, 100, 101], [200, 50, 200]], kind)
    capture = prepare_capture(
        open_arrays(images, directions, numbers), options=RecipeOptions(as_stored=True)
    )
    assert capture.mask.tolist() == [[False, False, True], [True, False, True]]
    capture = prepare_capture(
        open_arrays(images, directions, numbers > 0), options=RecipeOptions(as_stored=True)
    )
    assert capture.n_pixels == 5
    with pytest.raises(InputError, match="mask"):
        prepare_capture(
            open_arrays(images, directions, np.zeros((2, 3), kind)),
            options=RecipeOptions(as_stored=True),
        )
