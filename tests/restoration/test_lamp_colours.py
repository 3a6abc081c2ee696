"""Lamps whose colours differ from image to image, over an object with stripes of many colours."""

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import shade, sphere, spiral_lights, write_capture
from splinecli.capture.reader import capture_from_arrays, open_capture
from splinecli.fits.robust import fit_scaled_normals
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.results.maps import albedo_map

LIGHTS = spiral_lights(10, 50, 15)
SOFT = np.tile([(1.5, 0.8, 0.7), (0.7, 1.5, 0.8), (0.8, 0.7, 1.5), (1, 1, 1), (1.3, 1.3, 0.4)], (2, 1))
PURE = np.tile([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (1, 1, 0)], (2, 1)).astype(float)


def striped(colours: NDArray[np.float64]) -> tuple[NDArray[np.uint16], NDArray[np.float64], NDArray[np.bool_]]:
    """Return 16-bit images (F, H, W, 3) of a ball with stripes, its normals (H, W, 3) and its mask."""
    normals, mask = sphere(48, 0.9)
    stripes = np.array([(0.9, 0.2, 0.2), (0.2, 0.8, 0.3), (0.2, 0.3, 0.9), (0.7, 0.7, 0.7)])[np.arange(48) // 4 % 4]
    shaded = np.where(mask[..., None], shade(normals, LIGHTS), 0)
    images = np.einsum("hwf,wc,fc->fhwc", shaded, stripes, colours)
    noise = np.random.default_rng(0).normal(0, 0.002, images.shape)
    return np.rint((images / images.max() + noise).clip(0, 1) * 60_000).astype(np.uint16), normals, mask


def error_deg(observations: NDArray[np.float32], normals: NDArray[np.float64], mask: NDArray[np.bool_]) -> float:
    lit = observations.min(axis=1) > 0.02
    fitted = unit(fit_scaled_normals(observations[lit], np.ones_like(observations[lit]), LIGHTS))
    return float(angle_between_deg(fitted, normals[mask][lit]).mean())


def test_colours_are_divided_out(tmp_path) -> None:
    images, normals, mask = striped(SOFT)
    folder = write_capture(tmp_path, images, LIGHTS, mask=mask, intensities=np.ones((10, 3)))
    source = open_capture(folder)
    capture = source.read()
    for untouched in (source.read(as_stored=True), open_capture(folder, intensities="equal").read()):
        assert untouched.estimated_colours is None
        assert "estimated_colours" not in [warning.code for warning in untouched.warnings]
    assert "estimated_colours" in [warning.code for warning in capture.warnings]
    ratios = capture.estimated_colours / SOFT
    np.testing.assert_allclose(ratios / ratios.mean(axis=0), np.ones((10, 3)), atol=0.1)
    plain = images[:, mask].mean(axis=2).T.astype(np.float32)
    assert error_deg(capture.observations, normals, mask) < 2 < 5 < error_deg(plain / plain.max(), normals, mask)
    # Lamps of any colour give the same object the same colours.
    normal_map = np.where(mask[..., None], normals, 0).astype(np.float32)
    albedo = albedo_map(source, capture, normal_map)[mask]
    red = albedo / albedo.sum(axis=1, keepdims=True)
    stripe = np.nonzero(mask)[1] // 4 % 4 == 0
    assert np.std(red[stripe][:, 0]) < 0.03
    from_arrays = capture_from_arrays(images, LIGHTS, mask, light_intensities=np.ones(10))
    np.testing.assert_allclose(from_arrays.observations, capture.observations, rtol=1e-4, atol=1e-5)


def test_pure_colours_are_named() -> None:
    images, _, mask = striped(PURE)
    codes = {warning.code: warning for warning in capture_from_arrays(images, LIGHTS, mask).warnings}
    assert "light_colours" in codes and codes["light_colours"].error_deg


def test_a_gray_object_needs_no_colours() -> None:
    normals, mask = sphere(48, 0.9)
    shaded = np.where(mask[..., None], shade(normals, LIGHTS), 0)
    images = np.rint(np.einsum("hwf,fc->fhwc", shaded, PURE) * 40_000).astype(np.uint16)
    capture = capture_from_arrays(images, LIGHTS, mask, light_intensities=np.ones(10))
    assert not {"light_colours", "estimated_colours"} & {warning.code for warning in capture.warnings}


@pytest.mark.parametrize("change", [0.0, 0.03])
def test_white_lamps_are_left_alone(change: float) -> None:
    colours = 1 + change * np.random.default_rng(1).normal(size=(10, 3))
    images, _, mask = striped(colours)
    assert capture_from_arrays(images, LIGHTS, mask).estimated_colours is None
