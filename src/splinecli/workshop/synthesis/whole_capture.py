"""Simulation of whole captures, with a background behind the object, a camera, and faults common to
all pixels.

Rendered scenes have little curvature at the scale of pixels. Engraved pieces do: they are plates
and half ellipsoids, smooth or with detail of a few pixels, but without cast shadows or
interreflection.

Between the object and the files, the camera has a lens, a Bayer pattern, sharpening and JPEG. These
effects and translucent materials mix neighbouring pixels, so they apply to whole images (F, H, W)
of linear radiance, including the background. Each draw documents its distribution. Faults that
affect pixels separately are in batches.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

from splinecli.images.lens_blur import remove_blur, surroundings
from splinecli.images.saturation import restore_saturated
from splinecli.maths.transfer import decode_transfer, encode_srgb
from splinecli.workshop.synthesis import batches, draw_number
from splinecli.workshop.synthesis.batches import CaptureConfig, PixelBatch, PixelTruth
from splinecli.workshop.synthesis.draw_materials import draw_material, with_one_gloss


@dataclass(frozen=True)
class Optics:
    """One camera."""

    kernels: Tensor  # (3, k, k), the blur of red, green and blue, each with the sum 1
    weights: tuple[float, float, float]  # of red, green and blue in the gray value, with the sum 1
    # OpenCV's code for the Bayer interpolation; None for a sensor without a Bayer pattern
    demosaic: int | None
    sharpening: float  # amount of the unsharp mask, 0 for none
    sharpening_sigma: float  # its width in pixels
    jpeg_quality: int | None  # None for no JPEG

    def through_lens(self, images: Tensor) -> Tensor:
        """Return the red, green and blue irradiance on the sensor (3, F, H, W) for radiance (F, H,
        W).
        """
        return torch.stack([_blurred(images, kernel) for kernel in self.kernels])

    def develop(self, colours: Tensor) -> Tensor:
        """Return the gray images (F, H, W), 0 to 1, from the noisy sensor exposure (3, F, H, W), 0
        to 1.
        """
        if self.demosaic is not None:
            pattern = colours[1].clone()  # red, green / green, blue
            pattern[:, ::2, ::2] = colours[0, :, ::2, ::2]
            pattern[:, 1::2, 1::2] = colours[2, :, 1::2, 1::2]
            # OpenCV interpolates integers
            stored = (pattern.clamp(0, 1) * 65535).round().numpy().astype(np.uint16)
            found = np.stack([cv2.cvtColor(image, self.demosaic) for image in stored])
            colours = torch.from_numpy(found.astype(np.float32) / 65535).permute(3, 0, 1, 2)
        gray = torch.einsum("c,cfhw->fhw", torch.tensor(self.weights), colours)
        if self.sharpening:
            soft = _blurred(gray, gaussian_kernel(self.sharpening_sigma))
            gray = gray + self.sharpening * (gray - soft)
        return gray.clamp(0, 1)

    def compress(self, images: Tensor) -> Tensor:
        """Return the linear values of images (F, H, W), 0 to 1, after JPEG compression with the
        sRGB curve.
        """
        if self.jpeg_quality is None:
            return images
        encoded = encode_srgb(images.numpy())
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality]
        files = (cv2.imencode(".jpg", image, quality)[1] for image in encoded)
        decoded = np.stack([np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE)) for file in files])
        return torch.from_numpy(decode_transfer(decoded.astype(np.float32) / np.float32(255), None))


def draw_optics(generator: torch.Generator) -> Optics:
    """Draw a camera.

    Blur: none in 15 % of the captures, else with a standard deviation of U(0, 1.2) pixels, a
    Gaussian or, in a third, the disc of defocus. The widths of red, green and blue differ by U(-8,
    8) % each. Bayer pattern: in half of the captures, of which half are interpolated bilinearly,
    the others along edges. Object colour and gray weights, combined: U(0.2, 1) for each of red,
    green and blue. Sharpening: in 20 %, an unsharp mask of U(0.2, 1) with a sigma of U(0.6, 1.5)
    pixels. JPEG, for 8-bit captures: in a third, with a quality of U(75, 98).
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
        demosaic=(cv2.COLOR_BayerRGGB2RGB if bayer < 0.25 else cv2.COLOR_BayerRGGB2RGB_EA)
        if bayer < 0.5
        else None,
        sharpening=uniform(0.2, 1) * (uniform() < 0.2),
        sharpening_sigma=uniform(0.6, 1.5),
        jpeg_quality=round(uniform(75, 98)) if uniform() < 1 / 3 else None,
    )


def gaussian_kernel(sigma: float) -> Tensor:
    """Return a Gaussian (k, k) with the sum 1 and a standard deviation of `sigma` pixels on either
    axis.
    """
    reach = math.ceil(3 * sigma)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / max(sigma, 1e-3)) ** 2)
    kernel = weights[:, None] * weights
    return kernel / kernel.sum()


def disc_kernel(sigma: float) -> Tensor:
    """Return a disc (k, k) with the sum 1 and a standard deviation of `sigma` pixels on either
    axis.
    """
    radius, finer = 2 * sigma, 5  # samples per pixel and axis
    reach = math.ceil(radius)
    places = (torch.arange((2 * reach + 1) * finer) + 0.5) / finer - 0.5 - reach
    inside = (places[:, None] ** 2 + places**2 <= max(radius, 0.2) ** 2).float()
    kernel = torch.nn.functional.avg_pool2d(inside[None, None], finer)[0, 0]
    return kernel / kernel.sum()


def scatter(maps: Tensor, mask: Tensor, generator: torch.Generator) -> Tensor:
    """Return radiance (F, H, W) of an object (H, W) whose material scatters light below its
    surface.

    A share U(0.3, 1) of the light leaves the surface at a distance from its point of entry, with a
    Gaussian distribution of sigma 10^U(0, 1) pixels. Light is not scattered out of the object.
    """
    share, sigma = draw_number(generator, 0.3, 1), 10 ** draw_number(generator, 0, 1)
    kernel = gaussian_kernel(sigma)
    inside = mask[None].float()
    spread = _blurred(maps * inside, kernel) / _blurred(inside, kernel).clamp(min=1e-3)
    return torch.lerp(maps, spread, share) * inside


def _blurred(images: Tensor, kernel: Tensor) -> Tensor:
    """Return images (F, H, W), convolved with a kernel (k, k); the border values are extended
    outwards.
    """
    if len(kernel) == 1:
        return images
    reach = len(kernel) // 2
    around = pad(images[:, None], (reach,) * 4, mode="replicate")
    return conv2d(around, kernel[None, None].to(images))[:, 0]


def draw_engraved(
    size: int, lights: Tensor, generator: torch.Generator, *, round_share: float = 1 / 3
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a piece, and return its unit normals (P, 3), its radiance (P, F), and its mask (size,
    size).

    `round_share` of the pieces are half ellipsoids, whose mask ends at their rim. The others are
    plates that fill the frame: tilted by a slope of up to 0.7, with three waves of U(0.3, 2) frames
    and slopes of up to 0.3. Each piece has one kind of detail: grooves U(1, 6) pixels wide to
    either side, regular or not, straight or curved; facets of 3 to 20 pixels; or a random texture
    with a grain of U(0.4, 1.5) pixels. The slopes of the detail are about U(0.05, 0.6), and a third
    of this for the texture. A third of the pieces are smooth. The material comes from
    draw_material, with 1 to 300 patches; in half of the pieces, the patches differ only in their
    base colour. The lights (F, 3) are unit, and the mask has P true pixels.
    """
    uniform = partial(draw_number, generator)
    normals, mask = _draw_base(size, round_share, generator)
    # A third of the pieces have no detail, because smooth surfaces must stay smooth whatever their
    # material.
    if uniform() >= 1 / 3:
        detail = _draw_detail(size, generator)
        normals = normals - normals[:, 2:] * torch.nn.functional.pad(detail, (0, 1))
        normals = torch.nn.functional.normalize(normals, dim=1)
    patches = int(300 ** uniform())
    material = draw_material(patches, generator)
    if uniform() < 0.5:
        material = with_one_gloss(material)
    material = material.take(_cells(patches, size, generator)[mask])
    normals = normals[mask]
    cosines = (normals @ lights.T).clamp(min=0)
    return normals, material.shade(cosines, normals[:, 2:], lights[:, 2]), mask.view(size, size)


def _draw_base(size: int, round_share: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw a half ellipsoid or a plate, and return its unit normals (size^2, 3) and its mask
    (size^2,).
    """
    uniform = partial(draw_number, generator)
    places = _places(size)
    if uniform() < round_share:
        direction = _draw_direction(generator)
        across = torch.stack((direction, torch.tensor((-direction[1], direction[0]))))
        middle = places - places.mean(dim=0)
        axes = torch.tensor((uniform(0.3, 0.49), uniform(0.3, 0.49))) * size
        at = middle @ across.T / axes
        radius = at.square().sum(1)
        height = (1 - radius).clamp(min=0).sqrt()[:, None]
        base = torch.cat((uniform(0.3, 1.5) * (at / axes * axes.mean()) @ across, height), dim=1)
        return torch.nn.functional.normalize(base, dim=1), radius < 1
    slopes = uniform(0, 0.7) * _draw_direction(generator).expand(size * size, 2)
    for _ in range(3):
        direction = _draw_direction(generator)
        wave = (2 * math.pi * (places @ direction / (uniform(0.3, 2) * size) + uniform())).sin()
        slopes = slopes + uniform(0, 0.3) * wave[:, None] * direction
    base = torch.cat((-slopes, torch.ones(size * size, 1)), dim=1)
    return torch.nn.functional.normalize(base, dim=1), torch.ones(size * size, dtype=torch.bool)


def _draw_detail(size: int, generator: torch.Generator) -> Tensor:
    """Draw the slopes (size^2, 2) of grooves, facets or a texture."""
    uniform = partial(draw_number, generator)
    steepness = uniform(0.05, 0.6)
    kind = int(3 * uniform())
    if kind == 0:
        direction = _draw_direction(generator)
        bend = _smooth(torch.randn(1, size, size, generator=generator), 12).view(-1)
        place = _places(size) @ direction + (uniform() < 0.5) * uniform(0, 12) * bend / bend.std()
        number = (place / uniform(1, 6) + uniform(0, 2)).floor().long()
        number = number - number.min()
        side = 2.0 * (number % 2) - 1
        if uniform() < 0.5:
            side = torch.randn(int(number.max()) + 1, generator=generator)[number]
        return steepness * side[:, None] * direction
    if kind == 1:
        count = int((size / uniform(3, 20)) ** 2) + 1
        return (steepness * torch.randn(count, 2, generator=generator))[
            _cells(count, size, generator)
        ]
    grain = _smooth(torch.randn(2, size, size, generator=generator), uniform(0.4, 1.5))
    return steepness / 3 * (grain / grain.std()).view(2, -1).T


def _places(size: int) -> Tensor:
    """Return the positions (size^2, 2) of the pixels, y up."""
    rows, columns = torch.meshgrid(
        torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij"
    )
    return torch.stack((columns, -rows), dim=-1).view(-1, 2)


def _draw_direction(generator: torch.Generator) -> Tensor:
    """Draw a unit vector (2,)."""
    angle = draw_number(generator, 0, 2 * math.pi)
    return torch.tensor((math.cos(angle), math.sin(angle)))


def _cells(count: int, size: int, generator: torch.Generator) -> Tensor:
    """Return the Voronoi cell (P,) of each pixel, 0 to count - 1, around random points."""
    from scipy.spatial import cKDTree

    points = size * torch.rand(count, 2, generator=generator).numpy()
    places = np.indices((size, size)).reshape(2, -1).T
    return torch.from_numpy(cKDTree(points).query(places)[1])


def _smooth(maps: Tensor, sigma: float) -> Tensor:
    from scipy.ndimage import gaussian_filter

    return torch.from_numpy(gaussian_filter(maps.numpy(), (0, sigma, sigma), mode="wrap"))


def photograph_captures(
    truth: PixelTruth,
    radiance: Tensor,
    directions: Tensor,
    valid: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
) -> PixelBatch:
    """Photograph the pixels of G captures. Pixel p belongs to capture p % G.

    For the arguments, see `photograph_scene`. The configuration determines G. All pixels of a
    capture have the same directions, valid ones first.
    """
    if config.capture_pixels == 1:
        return batches.photograph(truth, radiance, directions, valid, config, generator)
    captures = config.captures(len(radiance))
    observations, calibrated = torch.zeros_like(radiance), directions.clone()
    exposure = torch.ones_like(radiance[:, :1])
    # Draw the faults of a capture on the CPU.
    seed = int(torch.randint(2**62, (), generator=generator, device=generator.device))
    own = torch.Generator().manual_seed(seed)
    for capture in range(captures):
        rows, lights = slice(capture, None, captures), slice(0, int(valid[capture].sum()))
        seen, found, factor = photograph_scene(
            radiance[rows, lights].cpu(), directions[capture, lights].cpu(), config, own
        )
        observations[rows, lights], calibrated[rows, lights] = (
            seen.to(radiance),
            found.to(directions),
        )
        exposure[rows] = factor
    return PixelBatch(observations, calibrated, valid, truth, exposure, captures)


class Photographs(NamedTuple):
    """One capture of a scene."""

    observations: Tensor  # (P, F), divided by the intensities
    light_directions: Tensor  # (F, 3), unit, as calibrated
    exposure: float  # the factor from the radiance to the observations


def photograph_scene(
    radiance: Tensor,
    directions: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
    mask: Tensor | None = None,
) -> Photographs:
    """Photograph radiance (P, F) under unit directions (F, 3) with faults that the whole capture
    shares.

    With a mask (H, W), the radiance (H * W, F) is of whole images with a background, and the
    observations are of the mask's pixels.

    Ambient light adds to all images a share 10^U(-3.2, -1) of the pixel's mean radiance over the
    lights, as from room light, and of the capture's mean, as from lens glare; see `_ambient`.

    The functions of synthesis/batches.py draw faults for each row. Here the whole capture is one
    row. The exposure places the 0.999 quantile at 10^U(-0.7, 0) of full scale. In
    `config.saturated_share` of the captures, 0.1 to 3 % of the observations are clipped, and
    restored as in `infer`. A third of the captures with sensor noise also have grain: each
    observation is multiplied by its own factor, with a sigma of 10^U(-2.5, -1.2). Fine texture
    causes such grain if images are shifted by a fraction of a pixel or light scatters between
    neighbours. Of the captures with intensity errors, 30 % have an additional error with a sigma of
    U(0, 0.5) stops, as if the intensities had not been measured. The normals are then wrong by many
    degrees, but their detail is still correct.

    `config.optics_share` of the captures of images use a camera from draw_optics, which mixes
    neighbouring pixels. Saturation and noise are applied at the sensor, before the Bayer pattern is
    interpolated. As in `infer`, the blur is estimated and removed.
    """
    uniform = partial(draw_number, generator)
    lights = radiance.shape[1]
    intensities = batches.draw_light_intensities(1, lights, config.unequal_lights_share, generator)
    arriving = radiance * intensities + _ambient(radiance, config.ambient_share, uniform)
    saturated = uniform() < config.saturated_share
    # of the observations that are clipped, or nearly
    share = uniform(1e-3, 0.03) if saturated else 1e-3
    around = None if mask is None else torch.from_numpy(surroundings(mask.numpy()))
    wanted: slice | Tensor = slice(None)
    if mask is not None and around is not None:
        wanted = torch.cat([part.flatten().nonzero()[:, 0] for part in (mask, around)])
    metered = (arriving if mask is None else arriving[mask.flatten()]).flatten()
    bright = metered.sort().values[-1 - math.floor(share * metered.numel())].clamp(min=1e-6)
    exposure = float((1.0 if saturated else 10 ** uniform(-0.7, 0.0)) / bright)
    exposed = arriving * exposure
    optics = None
    if mask is not None and uniform() < config.optics_share:
        optics = draw_optics(generator)
        exposed = optics.through_lens(exposed.T.reshape(lights, *mask.shape))  # (3, F, H, W)
    exposed = exposed.clamp(max=1)
    clipped = exposed >= 1
    if config.sensor_noise:
        grain = 10 ** uniform(-2.5, -1.2) * (uniform() < 1 / 3)
        exposed = exposed * (
            1 + grain * torch.randn(exposed.shape[-3:], generator=generator)
        ).clamp(min=0)
        exposed = batches.add_sensor_noise(exposed.reshape(1, -1), generator).view_as(exposed)
    is_jpeg = False
    if optics is not None:
        exposed, clipped = optics.develop(exposed), clipped.any(dim=0)
        is_jpeg = (
            config.sensor_noise
            and optics.jpeg_quality is not None
            and uniform() < config.eight_bit_share
        )
        exposed = (optics.compress(exposed) if is_jpeg else exposed).flatten(1).T[wanted]
        clipped = clipped.flatten(1).T[wanted]
    elif mask is not None:
        exposed, clipped = exposed[wanted], clipped[wanted]
    if config.sensor_noise and not is_jpeg:
        exposed = batches.quantise(
            exposed.reshape(1, -1), config.eight_bit_share, generator
        ).view_as(exposed)
    exposed = torch.where(clipped, 1, exposed)
    errors = batches.disturb_light_intensities(
        torch.ones(1, lights), config.light_intensity_error_share, generator
    )
    if uniform() < 0.3 * config.light_intensity_error_share:
        errors = errors * 2 ** (uniform(0, 0.5) * torch.randn(1, lights, generator=generator))
    observed = exposed * errors / intensities
    if mask is not None and around is not None:
        values = observed.contiguous().numpy()
        remove_blur(values, mask.numpy(), around.numpy())
        pixels = slice(0, int(mask.sum()))
        observed, clipped = torch.from_numpy(values)[pixels], clipped[pixels]
    calibrated = batches.disturb_light_directions(
        directions[None], config.light_direction_error_share, generator
    )[0]
    if saturated:
        values = observed.contiguous().numpy()
        restore_saturated(values, clipped.numpy(), calibrated.double().numpy())
        observed = torch.from_numpy(values)
    return Photographs(observed.contiguous(), calibrated, exposure)


def _ambient(radiance: Tensor, share: float, uniform: Callable[..., float]) -> Tensor:
    """Draw the ambient light (P, 1) of radiance (P, F).

    There is none, or a mixture of the two kinds in `photograph_scene`. Light transport is linear,
    so the mean over the lights is the radiance in a uniformly bright room. It is about half of the
    albedo, so the levels match draw_ambient in pixels.py.
    """
    level = 10 ** uniform(-3.2, -1.0) * (uniform() < share)
    return level * torch.lerp(radiance.mean(dim=1, keepdim=True), radiance.mean(), uniform())


def add_background(
    maps: Tensor, mask: Tensor, lights: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Add a background behind an object, and return maps (F + 3, h, w) and a mask (h, w).

    The mask includes some background, because real masks may include more than the object, and
    captures may have no mask. The maps of the object are radiance (F, H, W) and unit normals (3, H,
    W), under unit lights (F, 3). In the returned maps, normals are zero where they are unknown: in
    darkness, and under uneven light.

    A third of the backgrounds are nearly dark. The others are plates from draw_engraved in the
    shadow of the object, at a distance of up to half its size. Half of the plates are lit unevenly,
    as by near lamps. Half of the masks cover everything, the others are up to 12 pixels too wide.
    """
    uniform = partial(draw_number, generator)
    sides = [int(uniform(0, 17)) for _ in range(4)]
    maps, mask = pad(maps * mask, sides), pad(mask, sides)
    count, (height, width) = len(lights), mask.shape
    typical = maps[:count, mask].amax(dim=0).median()
    behind = torch.zeros_like(maps)
    if uniform() < 1 / 3:
        grain = torch.rand(count, height, width, generator=generator)
        behind[:count] = typical * 10 ** uniform(-4, -1.5) * grain
    else:
        size = max(height, width)
        normals, radiance, _ = draw_engraved(size, lights, generator, round_share=0.0)
        plate = torch.cat((radiance, normals), dim=1).T.view(-1, size, size)
        behind = plate[:, :height, :width].clone()
        behind[:count] *= (
            typical * 10 ** uniform(-1.5, 0.3) / radiance.amax(dim=1).median().clamp(min=1e-6)
        )
        behind[:count] *= ~_shadows(mask, lights, uniform(0, 0.5) * size)
        if uniform() < 0.5:
            rows, columns = torch.linspace(-1, 1, height)[:, None], torch.linspace(-1, 1, width)
            slope = torch.randn(3, count, 1, 1, generator=generator) / 2
            behind[:count] *= (slope[0] + slope[1] * rows + slope[2] * columns).exp()
            behind[count:] = 0
    shown = torch.ones_like(mask)
    if uniform() < 0.5:
        rim = 1 + int(uniform(0, 12))
        shown = max_pool2d(mask[None].float(), 2 * rim + 1, stride=1, padding=rim)[0] > 0
    return torch.where(mask, maps, behind), shown


def _shadows(mask: Tensor, lights: Tensor, distance: float) -> Tensor:
    """Return the mask (F, H, W) of the shadow that the object casts on a plane `distance` pixels
    behind it.
    """
    reach = max(mask.shape)
    canvas = pad(mask, (reach,) * 4)
    found = []
    for x, y, z in lights.tolist():
        right, down = (
            max(-reach, min(reach, round(distance * side / max(z, 1e-3)))) for side in (-x, y)
        )
        top, left = reach - down, reach - right
        found.append(canvas[top : top + mask.shape[0], left : left + mask.shape[1]])
    return torch.stack(found)
