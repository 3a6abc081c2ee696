"""The camera of a capture, against what its parts do to points, ramps and constants."""

import cv2
import numpy as np
import pytest
import torch

from splinecli.synthesis.optics import Optics, disc_kernel, gaussian_kernel, scatter

SHARP = torch.ones(3, 1, 1)


def camera(
    kernels: torch.Tensor = SHARP, demosaic: int | None = None, sharpening: float = 0.0, quality: int | None = None
) -> Optics:
    return Optics(kernels, (0.25, 0.5, 0.25), demosaic, sharpening, 1.0, quality)


def spread(kernel: torch.Tensor) -> float:
    """The standard deviation of a kernel along its rows."""
    places = torch.arange(len(kernel)) - len(kernel) // 2
    return float((kernel.sum(0) * places**2).sum().sqrt())


@pytest.mark.parametrize("sigma", [0.6, 0.9, 1.2])
def test_kernels_have_the_width_that_they_state(sigma: float) -> None:
    assert spread(gaussian_kernel(sigma)) == pytest.approx(sigma, rel=0.05)
    # The mean over a pixel adds the variance of its own width, a twelfth.
    assert spread(disc_kernel(sigma)) == pytest.approx(np.sqrt(sigma**2 + 1 / 12), rel=0.08)
    for kernel in (gaussian_kernel(sigma), disc_kernel(sigma)):
        assert float(kernel.sum()) == pytest.approx(1)


def test_a_lens_spreads_a_point_into_its_kernel() -> None:
    image = torch.zeros(1, 11, 11)
    image[0, 5, 5] = 1
    kernel = gaussian_kernel(0.7)
    colours = camera(kernel.expand(3, -1, -1)).through_lens(image)
    reach = len(kernel) // 2
    torch.testing.assert_close(colours[1, 0, 5 - reach : 6 + reach, 5 - reach : 6 + reach], kernel)
    assert float(colours[2].sum()) == pytest.approx(1)


@pytest.mark.parametrize("code", [cv2.COLOR_BayerRGGB2RGB, cv2.COLOR_BayerRGGB2RGB_EA])
def test_a_bayer_pattern_keeps_ramps_and_blurs_points(code: int) -> None:
    """Linear interpolation is exact on a ramp, whichever colours the ramp has. A point spreads."""
    ramp = (0.1 + 0.05 * torch.arange(12.0)).expand(1, 12, 12)
    colours = torch.stack((0.5 * ramp, ramp, 0.8 * ramp))
    developed = camera(demosaic=code).develop(colours)
    inside = (0, slice(2, -2), slice(2, -2))
    torch.testing.assert_close(developed[inside], 0.825 * ramp[inside], atol=2e-4, rtol=0)
    point = torch.zeros(3, 1, 12, 12)
    point[:, 0, 6, 6] = 1  # a red cell: green and blue miss it
    seen = camera(demosaic=code).develop(point)
    assert float(seen[0, 6, 6]) == pytest.approx(0.25, abs=1e-3)
    assert float(seen[0, 6, 7]) == pytest.approx(0.125, abs=1e-3)


def test_sharpening_raises_contrast_and_jpeg_keeps_flat_areas() -> None:
    edge = torch.cat((torch.full((1, 16, 8), 0.2), torch.full((1, 16, 8), 0.6)), dim=2)
    sharp = camera(sharpening=0.8).develop(edge.expand(3, 1, 16, 16))
    assert float(sharp[0, 8, 7]) < 0.19 and float(sharp[0, 8, 8]) > 0.61
    torch.testing.assert_close(sharp[0, :, :3], edge[0, :, :3])
    flat = torch.full((1, 16, 16), 0.3)
    rough = torch.rand(1, 16, 16, generator=torch.Generator().manual_seed(0))
    coarse, fine = (camera(quality=quality).compress(rough) for quality in (20, 98))
    assert (coarse - rough).abs().mean() > 2 * (fine - rough).abs().mean()
    torch.testing.assert_close(camera(quality=90).compress(flat), flat, atol=3e-3, rtol=0)


def test_light_that_scatters_stays_in_the_object() -> None:
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[4:16, 4:16] = True
    radiance = torch.rand(3, 20, 20, generator=torch.Generator().manual_seed(0)) * mask
    spread_out = scatter(radiance, mask, torch.Generator().manual_seed(1))
    assert not spread_out[:, ~mask].any()
    assert spread_out[:, mask].std() < 0.9 * radiance[:, mask].std()
    even = scatter(mask.float()[None], mask, torch.Generator().manual_seed(1))
    torch.testing.assert_close(even[0], mask.float())
