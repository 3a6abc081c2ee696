"""Simulation of whole captures, with a background behind the object and faults common to all pixels."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from splinecli.restoration.images import restore_saturated
from splinecli.restoration.lens_blur import remove_blur, surroundings
from splinecli.synthesis import batches, draw_number
from splinecli.synthesis.batches import CaptureConfig, PixelBatch, PixelTruth
from splinecli.synthesis.engraved import draw_engraved
from splinecli.synthesis.optics import draw_optics


def photograph_captures(
    truth: PixelTruth,
    radiance: Tensor,
    directions: Tensor,
    valid: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
) -> PixelBatch:
    """Photograph pixels of the G captures set by the configuration; pixel p belongs to capture p % G.

    See `photograph_scene` for the arguments. All pixels of a capture have the same directions, valid ones first.
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
        observations[rows, lights], calibrated[rows, lights] = seen.to(radiance), found.to(directions)
        exposure[rows] = factor
    return PixelBatch(observations, calibrated, valid, truth, exposure, captures)


def photograph_scene(
    radiance: Tensor,
    directions: Tensor,
    config: CaptureConfig,
    generator: torch.Generator,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor, float]:
    """Photograph radiance (P, F) under unit directions (F, 3) with faults that the whole capture shares.

    Returns observations (P, F), divided by the intensities, calibrated directions (F, 3), and the factor from the
    radiance to the observations. With a mask (H, W), the radiance (H * W, F) is of whole images with a background, and
    the observations are of the mask's pixels.

    Ambient light adds to all images a share 10^U(-3.2, -1) of the pixel's mean radiance over the lights, as from room
    light, and of the capture's mean, as from lens glare; see `_ambient`.

    The functions of synthesis/batches.py draw faults for each row. Here the whole capture is one row. The exposure
    places the 0.999 quantile at 10^U(-0.7, 0) of full scale. In `config.saturated_share` of the captures, 0.1 to 3 % of
    the observations are clipped, and restored as in `infer`. A third of the captures with sensor noise also have grain:
    each observation is multiplied by its own factor, with a sigma of 10^U(-2.5, -1.2). Fine texture causes such grain
    if images are shifted by a fraction of a pixel or light scatters between neighbours. Of the captures with intensity
    errors, 30 % have an additional error with a sigma of U(0, 0.5) stops, as if the intensities had not been measured.
    The normals are then wrong by many degrees, but their detail is still correct.

    `config.optics_share` of the captures of images use a camera from draw_optics, which mixes neighbouring pixels.
    Saturation and noise are applied at the sensor, before the Bayer pattern is interpolated. As in `infer`, the blur is
    estimated and removed.
    """
    uniform = partial(draw_number, generator)
    lights = radiance.shape[1]
    intensities = batches.draw_light_intensities(1, lights, config.unequal_lights_share, generator)
    arriving = radiance * intensities + _ambient(radiance, config.ambient_share, uniform)
    saturated = uniform() < config.saturated_share
    share = uniform(1e-3, 0.03) if saturated else 1e-3  # of the observations that are clipped, or nearly
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
        exposed = exposed * (1 + grain * torch.randn(exposed.shape[-3:], generator=generator)).clamp(min=0)
        exposed = batches.add_sensor_noise(exposed.reshape(1, -1), generator).view_as(exposed)
    is_jpeg = False
    if optics is not None:
        exposed, clipped = optics.develop(exposed), clipped.any(dim=0)
        is_jpeg = config.sensor_noise and optics.jpeg_quality is not None and uniform() < config.eight_bit_share
        exposed = (optics.compress(exposed) if is_jpeg else exposed).flatten(1).T[wanted]
        clipped = clipped.flatten(1).T[wanted]
    elif mask is not None:
        exposed, clipped = exposed[wanted], clipped[wanted]
    if config.sensor_noise and not is_jpeg:
        exposed = batches.quantise(exposed.reshape(1, -1), config.eight_bit_share, generator).view_as(exposed)
    exposed = torch.where(clipped, 1, exposed)
    errors = batches.disturb_light_intensities(torch.ones(1, lights), config.light_intensity_error_share, generator)
    if uniform() < 0.3 * config.light_intensity_error_share:
        errors = errors * 2 ** (uniform(0, 0.5) * torch.randn(1, lights, generator=generator))
    observed = exposed * errors / intensities
    if mask is not None and around is not None:
        values = observed.contiguous().numpy()
        remove_blur(values, mask.numpy(), around.numpy())
        pixels = slice(0, int(mask.sum()))
        observed, clipped = torch.from_numpy(values)[pixels], clipped[pixels]
    calibrated = batches.disturb_light_directions(directions[None], config.light_direction_error_share, generator)[0]
    if saturated:
        values = observed.contiguous().numpy()
        restore_saturated(values, clipped.numpy(), calibrated.double().numpy())
        observed = torch.from_numpy(values)
    return observed.contiguous(), calibrated, exposure


def _ambient(radiance: Tensor, share: float, uniform: Callable[..., float]) -> Tensor:
    """Draw the ambient light (P, 1) of radiance (P, F): none, or a mixture of the two kinds in `photograph_scene`.

    Light transport is linear, so the mean over the lights is the radiance in a uniformly bright room. It is about half
    of the albedo, so the levels match draw_ambient in pixels.py.
    """
    level = 10 ** uniform(-3.2, -1.0) * (uniform() < share)
    return level * torch.lerp(radiance.mean(dim=1, keepdim=True), radiance.mean(), uniform())


def add_background(maps: Tensor, mask: Tensor, lights: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Put a background behind an object; return its maps (F + 3, h, w) and a mask (h, w) that includes some background.

    Real masks may include more than the object, and captures may have no mask. The maps of the object are radiance
    (F, H, W) and unit normals (3, H, W), under unit lights (F, 3). The returned maps have zero for unknown normals: in
    darkness, and under uneven light.

    A third of the backgrounds are nearly dark. The others are plates from draw_engraved in the shadow of the object, at
    a distance of up to half its size. Half of the plates are lit unevenly, as by near lamps. Half of the masks cover
    everything, the others are up to 12 pixels too wide.
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
        behind[:count] *= typical * 10 ** uniform(-1.5, 0.3) / radiance.amax(dim=1).median().clamp(min=1e-6)
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
    """Return the mask (F, H, W) of the shadow that the object casts on a plane `distance` pixels behind it."""
    reach = max(mask.shape)
    canvas = pad(mask, (reach,) * 4)
    found = []
    for x, y, z in lights.tolist():
        right, down = (max(-reach, min(reach, round(distance * side / max(z, 1e-3)))) for side in (-x, y))
        top, left = reach - down, reach - right
        found.append(canvas[top : top + mask.shape[0], left : left + mask.shape[1]])
    return torch.stack(found)
