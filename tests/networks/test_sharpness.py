"""How sharp images are, for steps of known width."""

import cv2
import numpy as np
import pytest

from splinecli.refinement.sharpness import image_sharpness

SIDE = 64
MASK = np.ones((SIDE, SIDE), np.bool_)


def discs(sigma: float, noise: float = 0.0) -> np.ndarray:
    """Six images (P, 6) of bright discs in different places on gray, blurred by a Gaussian of sigma pixels."""
    rng = np.random.default_rng(0)
    images = np.full((6, 4 * SIDE, 4 * SIDE), 0.2, np.float32)
    for image in images:
        for _ in range(8):
            cv2.circle(image, rng.integers(20, 4 * SIDE - 20, 2).tolist(), int(rng.integers(16, 50)), 0.8, -1)  # type: ignore[call-overload]
    small = images.reshape(6, SIDE, 4, SIDE, 4).mean(axis=(2, 4))
    if sigma:
        small = np.stack([cv2.GaussianBlur(image, (0, 0), sigma) for image in small])
    return (small + noise * rng.normal(size=small.shape)).reshape(6, -1).T.astype(np.float32)


def test_the_share_of_a_step_is_that_of_its_blur() -> None:
    """Steps between two pixels, behind a Gaussian."""
    sigma = 0.7
    step = np.repeat((np.arange(SIDE) // 16 % 2).astype(np.float32)[None], SIDE, axis=0)
    images = np.stack([step, np.roll(step, 5, axis=1)]) * 0.6 + 0.2
    soft = np.stack([cv2.GaussianBlur(image, (0, 0), sigma) for image in images])
    # The differences are the weights of the filter.
    expected = 5 * (1 / (1 + 2 * np.exp(-0.5 / sigma**2)) - 0.6)
    share, _ = image_sharpness(MASK, soft.reshape(2, -1).T)
    assert float(share) == pytest.approx(expected, abs=0.01)
    assert image_sharpness(MASK, images.reshape(2, -1).T)[0] == 2


def test_softer_images_have_lower_shares_and_higher_correlations() -> None:
    found = [image_sharpness(MASK, discs(sigma)) for sigma in (0.0, 0.5, 0.8, 1.2)]
    shares, correlations = np.array([each.tolist() for each in found]).T
    assert (np.diff(shares) < -0.1).all()
    assert (np.diff(correlations) > 0.02).all()


def test_noise_hardly_changes_what_is_found() -> None:
    clean, noisy = (image_sharpness(MASK, discs(0.8, noise)).numpy() for noise in (0.0, 0.02))
    np.testing.assert_allclose(noisy, clean, atol=0.15)


def test_a_plain_capture_has_no_sharpness() -> None:
    assert not image_sharpness(MASK, np.full((SIDE**2, 4), 0.5, np.float32)).any()
