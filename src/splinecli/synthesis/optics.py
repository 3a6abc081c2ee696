"""The camera between the object and the files: lens, Bayer pattern, sharpening and JPEG, and translucent materials.

These effects mix neighbouring pixels, so they act on whole images (F, H, W) of linear radiance, background included.
Each draw documents its distribution. Faults that affect each pixel separately are in batches.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from splinecli.maths.transfer import decode_transfer, encode_srgb
from splinecli.synthesis import draw_number


@dataclass(frozen=True)
class Optics:
    """One camera."""

    kernels: Tensor  # (3, k, k), the blur of red, green and blue, each with the sum 1
    weights: tuple[float, float, float]  # of red, green and blue in the gray value, with the sum 1
    demosaic: int | None  # OpenCV's code for the Bayer interpolation; None for a sensor without a Bayer pattern
    sharpening: float  # amount of the unsharp mask, 0 for none
    sharpening_sigma: float  # its width in pixels
    jpeg_quality: int | None  # None for no JPEG

    def through_lens(self, images: Tensor) -> Tensor:
        """Return the red, green and blue irradiance on the sensor (3, F, H, W) for radiance (F, H, W)."""
        return torch.stack([_blurred(images, kernel) for kernel in self.kernels])

    def develop(self, colours: Tensor) -> Tensor:
        """Return the gray images (F, H, W), 0 to 1, from the noisy sensor exposure (3, F, H, W), 0 to 1."""
        if self.demosaic is not None:
            pattern = colours[1].clone()  # red, green / green, blue
            pattern[:, ::2, ::2] = colours[0, :, ::2, ::2]
            pattern[:, 1::2, 1::2] = colours[2, :, 1::2, 1::2]
            stored = (pattern.clamp(0, 1) * 65535).round().numpy().astype(np.uint16)  # OpenCV interpolates integers
            found = np.stack([cv2.cvtColor(image, self.demosaic) for image in stored])
            colours = torch.from_numpy(found.astype(np.float32) / 65535).permute(3, 0, 1, 2)
        gray = torch.einsum("c,cfhw->fhw", torch.tensor(self.weights), colours)
        if self.sharpening:
            soft = _blurred(gray, gaussian_kernel(self.sharpening_sigma))
            gray = gray + self.sharpening * (gray - soft)
        return gray.clamp(0, 1)

    def compress(self, images: Tensor) -> Tensor:
        """Return the linear values of images (F, H, W), 0 to 1, after JPEG compression with the sRGB curve."""
        if self.jpeg_quality is None:
            return images
        encoded = encode_srgb(images.numpy())
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality]
        files = (cv2.imencode(".jpg", image, quality)[1] for image in encoded)
        decoded = np.stack([np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)) for file in files])
        return torch.from_numpy(decode_transfer(decoded.astype(np.float32) / np.float32(255), None))


def draw_optics(generator: torch.Generator) -> Optics:
    """Draw a camera.

    Blur: none in 15 % of the captures, else with a standard deviation of U(0, 1.2) pixels, a Gaussian or, in a third,
    the disc of defocus. The widths of red, green and blue differ by U(-8, 8) % each. Bayer pattern: in half of
    the captures, of which half are interpolated bilinearly, the others along edges. Object colour and gray weights,
    combined: U(0.2, 1) for each of red, green and blue. Sharpening: in 20 %, an unsharp mask of U(0.2, 1) with a sigma
    of U(0.6, 1.5) pixels. JPEG, for 8-bit captures: in a third, with a quality of U(75, 98).
    """
    uniform = partial(draw_number, generator)
    sigma = uniform(0, 1.2) * (uniform() >= 0.15)
    kernel = disc_kernel if uniform() < 1 / 3 else gaussian_kernel
    kernels = [kernel(sigma * uniform(0.92, 1.08)) for _ in range(3)]
    widest = max(len(each) for each in kernels)
    kernels = [pad(each, ((widest - len(each)) // 2,) * 4) for each in kernels]
    red, green, blue = (uniform(0.2, 1) for _ in range(3))
    total = red + green + blue
    bayer = uniform()
    return Optics(
        kernels=torch.stack(kernels),
        weights=(red / total, green / total, blue / total),
        demosaic=(cv2.COLOR_BayerRGGB2RGB if bayer < 0.25 else cv2.COLOR_BayerRGGB2RGB_EA) if bayer < 0.5 else None,
        sharpening=uniform(0.2, 1) * (uniform() < 0.2),
        sharpening_sigma=uniform(0.6, 1.5),
        jpeg_quality=round(uniform(75, 98)) if uniform() < 1 / 3 else None,
    )


def gaussian_kernel(sigma: float) -> Tensor:
    """Return a Gaussian (k, k) with the sum 1 and a standard deviation of `sigma` pixels on either axis."""
    reach = math.ceil(3 * sigma)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / max(sigma, 1e-3)) ** 2)
    kernel = weights[:, None] * weights
    return kernel / kernel.sum()


def disc_kernel(sigma: float) -> Tensor:
    """Return a disc (k, k) with the sum 1 and a standard deviation of `sigma` pixels on either axis."""
    radius, finer = 2 * sigma, 5  # samples per pixel and axis
    reach = math.ceil(radius)
    places = (torch.arange((2 * reach + 1) * finer) + 0.5) / finer - 0.5 - reach
    inside = (places[:, None] ** 2 + places**2 <= max(radius, 0.2) ** 2).float()
    kernel = torch.nn.functional.avg_pool2d(inside[None, None], finer)[0, 0]
    return kernel / kernel.sum()


def scatter(maps: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
    """Return radiance (F, H, W) of an object (H, W) whose material scatters light below its surface.

    A share U(0.3, 1) of the light leaves the surface at a distance from its point of entry: a Gaussian with a sigma of
    U(1, 4) pixels. Light does not scatter out of the object.
    """
    share, kernel = draw_number(generator, 0.3, 1), gaussian_kernel(draw_number(generator, 1, 4))
    inside = mask[None].float()
    spread = _blurred(maps * inside, kernel) / _blurred(inside, kernel).clamp(min=1e-3)
    return torch.lerp(maps, spread, share) * inside


def _blurred(images: Tensor, kernel: Tensor) -> Tensor:
    """Return images (F, H, W), convolved with a kernel (k, k); the border values are extended outwards."""
    if len(kernel) == 1:
        return images
    reach = len(kernel) // 2
    around = pad(images[:, None], (reach,) * 4, mode="replicate")
    return conv2d(around, kernel[None, None].to(images))[:, 0]
