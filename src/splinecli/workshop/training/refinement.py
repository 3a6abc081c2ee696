"""Training of the refinement net on images of rendered scenes, after a SPLINE-Net with fixed
weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from splinecli._version import __version__
from splinecli.estimate.fits.least_squares import alternating_signs
from splinecli.estimate.inference import estimate_pixels
from splinecli.estimate.methods.batched import NetworkEstimator
from splinecli.estimate.networks.refine_net import channels, split_features
from splinecli.estimate.networks.spline_net import SplineNet
from splinecli.estimate.networks.weights import LoadedNetwork
from splinecli.estimate.refinement.features import (
    MapTurn,
    brightness,
    refine_features,
    turn_features,
    turn_maps,
)
from splinecli.images.lens_blur import REACH
from splinecli.lights.lighting import IndirectLight, PixelIndices, PixelLighting, parts_of_pixels
from splinecli.system.files import UNFINISHED, write_bytes
from splinecli.system.machine import choose_precision
from splinecli.system.publishing import refuse_link
from splinecli.system.weight_files import read_tensors, tensors_sha256
from splinecli.workshop.pixel_sets.store import Entry, PixelSet
from splinecli.workshop.save_weights import serialise
from splinecli.workshop.synthesis import stream_seed
from splinecli.workshop.synthesis.batches import CaptureConfig
from splinecli.workshop.synthesis.lights import choose_in_cone, draw_light_directions
from splinecli.workshop.synthesis.whole_capture import (
    add_background,
    draw_engraved,
    photograph_scene,
    scatter,
)
from splinecli.workshop.training.objective import angles, balanced, error_negative_log_likelihood

STEPS_PER_CAPTURE = 6  # after which another capture is photographed
CAPTURE_FORMAT = "splinecli-training-capture-1"
# Shares of the scene captures that are enlarged, and of all captures with a background and of
# engraved pieces.
ENLARGED_SHARE, BACKGROUND_SHARE, ENGRAVED_SHARE = 0.3, 0.35, 0.4


class SceneMaps(NamedTuple):
    """One capture of a rendered scene, after SPLINE-Net."""

    features: Tensor  # (FEATURE_CHANNELS, H, W) float16, see refine_features; zero outside the mask
    normals: Tensor  # (3, H, W) float16, ground truth; zero where unknown
    mask: Tensor  # (1, H, W) bool

    def to(self, device: torch.device) -> SceneMaps:
        """Return the maps on a device."""
        return SceneMaps(*(maps.to(device) for maps in self))


class Scene(NamedTuple):
    """A scene to be photographed."""

    maps: Tensor  # (F + 3, H, W), radiance under each light and true unit normals
    lights: Tensor  # (F, 3), unit directions
    mask: Tensor  # (H, W) bool


class ScenePool:
    """Scenes to be photographed, each time with other lights and faults.

    A capture depends only on (seed, its number). The scenes are pixel sets with selected entries,
    and the weight of each set; the network has an error head and is on the device of the captures.
    """

    def __init__(
        self,
        scenes: Sequence[tuple[PixelSet, Sequence[Entry], float]],
        network: SplineNet,
        config: CaptureConfig,
        seed: int,
    ) -> None:
        self.scenes = tuple(scenes)
        self.network = network
        self.config = config
        self.seed = seed

    def photograph(self, number: int) -> SceneMaps:
        """Return capture `number`, of a randomly drawn scene."""
        generator = torch.Generator().manual_seed(stream_seed(self.seed, number))
        return self._after_network(*self.draw_scene(generator), generator)

    def sha256(self) -> str:
        """Return a checksum of the scenes, settings and weights that the captures depend on."""
        tensors, config = (
            {name: value for name, value in part.items() if not name.startswith("refine")}
            for part in (self.network.state_dict(), self.network.config.to_dict())
        )
        weights = tensors_sha256({name: values.cpu() for name, values in tensors.items()})
        scenes = [
            (found.sha256, [entry.name for entry in entries], weight)
            for found, entries, weight in self.scenes
        ]
        known = __version__, scenes, asdict(self.config), self.seed, config, weights
        return hashlib.sha256(json.dumps(known).encode()).hexdigest()

    def draw_scene(
        self, generator: torch.Generator, engraved_share: float = ENGRAVED_SHARE
    ) -> Scene:
        """Draw a part of a scene, or an engraved piece, and the lights of its capture."""
        config = self.config
        if float(torch.rand((), generator=generator)) < engraved_share:
            lights = draw_light_directions(1, int(config.light_counts(1, generator)), generator)[0]
            truth, radiance, mask = draw_engraved(80, lights, generator)
            return Scene(_placed(torch.cat((radiance, truth), dim=1), mask), lights, mask)
        weights = torch.tensor([weight for _, _, weight in self.scenes])
        pixel_set, entries, _ = self.scenes[int(torch.multinomial(weights, 1, generator=generator))]
        entry = entries[int(torch.randint(len(entries), (), generator=generator))]
        pixels = pixel_set.load(entry)
        lights = torch.from_numpy(np.array(pixels.light_directions))
        count = int(config.light_counts(1, generator, available=entry.n_lights))
        chosen = choose_in_cone(lights, count, generator)
        mask = torch.from_numpy(np.array(pixels.mask))
        scale = 1 + 2.0 * float(torch.rand((), generator=generator))
        scale = scale if torch.rand((), generator=generator) < ENLARGED_SHARE else 1.0
        # A part of the map around a random pixel of the object.
        places, side = mask.nonzero(), round(96 / scale)
        middle = places[int(torch.randint(len(places), (), generator=generator))].tolist()
        bounds = zip(
            middle, places.amin(dim=0).tolist(), (places.amax(dim=0) + 1).tolist(), strict=True
        )
        starts = [(max(low, min(at - side // 2, high - side)), high) for at, low, high in bounds]
        box = tuple(slice(start, min(start + side, high)) for start, high in starts)
        kept = torch.zeros_like(mask)
        kept[box] = mask[box]
        rows = kept[mask].numpy()
        values = np.hstack(
            [pixels.observations[rows][:, chosen.numpy()], pixels.normals[rows]]
        ).astype(np.float32)
        maps, mask = _enlarged(_placed(torch.from_numpy(values), mask[box]), mask[box], scale)
        scatters = torch.rand((), generator=generator) < 0.2 * config.optics_share
        if scatters and "-diffuse" in entry.name:
            maps[:-3] = scatter(maps[:-3], mask, generator)
        return Scene(maps, lights[chosen], mask)

    def _after_network(
        self, maps: Tensor, lights: Tensor, mask: Tensor, generator: torch.Generator
    ) -> SceneMaps:
        """Photograph maps (F + 3, H, W) of radiance and true normals, and return SPLINE-Net's
        estimates.
        """
        if torch.rand((), generator=generator) < BACKGROUND_SHARE:
            maps, mask = add_background(maps, mask, lights, generator)
        else:  # a dark margin, which a lens and its inverse filter mix with the outline
            maps, mask = pad(maps * mask, (REACH,) * 4), pad(mask, (REACH,) * 4)
        truth = torch.nn.functional.normalize(maps[-3:, mask].T, dim=1)
        seen = photograph_scene(maps[:-3].flatten(1).T, lights, self.config, generator, mask)
        features = pixel_features(self.network, seen.observations, seen.light_directions, mask)
        features, truth = _placed(features, mask), _placed(truth, mask)
        return SceneMaps(features.half(), truth.half(), mask[None].contiguous())


class CaptureFolder:
    """The captures of a run, as files, so that a run that continues does not photograph them again.

    Each pool has its own subfolder, named after its checksum.
    """

    def __init__(self, pool: ScenePool, folder: Path, count: int) -> None:
        """Photograph the first `count` captures that are not stored. Raises OutputError."""
        refuse_link(folder)
        self.pool = pool
        self.folder = folder / pool.sha256()[:16]
        for unfinished in self.folder.glob(f".*{UNFINISHED}"):  # left by a killed process
            unfinished.unlink(missing_ok=True)
        self.count = 0
        while self.count < count:
            self.add()

    def add(self) -> None:
        """Add the next capture, which is photographed unless it is stored. Raises OutputError."""
        path = self._path(self.count)
        if not path.exists():
            tensors = self.pool.photograph(self.count)._asdict()
            metadata = {"format": CAPTURE_FORMAT, "tensors_sha256": tensors_sha256(tensors)}
            write_bytes(path, serialise(tensors, metadata))
        self.count += 1

    def draw(self, count: int, generator: torch.Generator) -> SceneMaps:
        """Draw `count` captures, rotate and mirror each, and return them stacked as float32 (count,
        ...). Raises ModelError if a file is damaged.
        """
        drawn = []
        for number in torch.randint(self.count, (count,), generator=generator).tolist():
            hint = "Remove this file and add --resume to photograph the capture again"
            capture = SceneMaps(**read_tensors(self._path(number), CAPTURE_FORMAT, hint)[0])
            draw = torch.rand(3, generator=generator).tolist()
            turn = MapTurn(int(4 * draw[0]), draw[1] < 0.5)
            features = turn_features(capture.features, turn).clone()
            if draw[2] < 0.5:
                features[channels("halves")].neg_()
            normals = turn_maps(capture.normals, turn, vectors=((0, 1),))
            drawn.append(SceneMaps(features, normals, turn_maps(capture.mask, turn)))
        return stack_maps(drawn)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06}.safetensors"


def _placed(values: Tensor, mask: Tensor) -> Tensor:
    """Return maps (C, H, W) of the values (P, C) of a mask's pixels."""
    maps = torch.zeros(values.shape[1], *mask.shape)
    maps[:, mask] = values.T.cpu()
    return maps


def _enlarged(maps: Tensor, mask: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Return maps (C, H, W) and their mask, enlarged by bilinear interpolation inside the mask.

    Scenes are rendered at low resolution, so normals change considerably between adjacent pixels. A
    photograph of a real object has more pixels, and adjacent normals are more similar.
    """
    if scale == 1:
        return maps, mask
    weighed = torch.cat((maps * mask, mask[None].float()))
    found = torch.nn.functional.interpolate(weighed[None], scale_factor=scale, mode="bilinear")[0]
    return found[:-1] / found[-1:].clamp(min=0.5), found[-1] > 0.5


@torch.no_grad()
def pixel_features(
    network: SplineNet, observations: Tensor, light_directions: Tensor, mask: Tensor
) -> Tensor:
    """Return the refinement net's features (P, FEATURE_CHANNELS) for the pixels of a mask (H, W).

    They are the same as at inference.
    """
    method = "spline-net" if network.config.interpolates else "cnn-ps"
    loaded = LoadedNetwork(network.eval(), "in training", "")
    device = network.cells.device
    precision = choose_precision("auto", device)
    estimator = NetworkEstimator(method, loaded, device=device, precision=precision)
    directions = light_directions.numpy()

    def lighting_without(indirect: IndirectLight | None, rows: PixelIndices) -> PixelLighting:
        own = observations.numpy()[rows]
        return PixelLighting(own if indirect is None else indirect.remove(own, rows), directions)

    estimated, errors, lighting_at = estimate_pixels(
        mask.numpy(), observations.numpy(), lighting_without, estimator
    )
    assert errors is not None, "TrainingConfig asks for an error head"
    lights = light_directions.to(estimator.device)
    signs, reference = alternating_signs(lights), brightness(observations)

    def features_of(rows: PixelIndices) -> Tensor:
        values = lighting_at(rows).observations, estimated[rows], errors[rows]
        seen, normals, error = (torch.from_numpy(part).to(lights.device) for part in values)
        return refine_features(seen, lights, normals, error, reference, signs)

    return torch.cat([features_of(rows) for rows in parts_of_pixels(len(observations))])


def stack_maps(captures: Sequence[SceneMaps]) -> SceneMaps:
    """Return captures stacked as float32 (B, ...). Smaller ones get a margin outside the mask."""
    height, width = (max(capture.mask.shape[axis] for capture in captures) for axis in (-2, -1))
    return SceneMaps(
        *(
            torch.stack(
                [
                    pad(maps.float(), (0, width - maps.shape[-1], 0, height - maps.shape[-2]))
                    for maps in field
                ]
            )
            for field in zip(*captures, strict=True)
        )
    )


class RefinementLosses(NamedTuple):
    """The total loss, and the mean angles in radians before and after refinement, averaged over
    captures.
    """

    total: Tensor
    before: Tensor
    angle: Tensor


def refinement_losses(
    network: SplineNet, maps: SceneMaps, *, detail_weight: float = 0.0, bfloat16: bool = False
) -> RefinementLosses:
    """Return the losses of stacked captures.

    The error of each capture is its mean angle, plus `detail_weight` times the mean error of the
    differences between neighbours. Wrong lights rotate all normals of a surface in the same way,
    which hides the sharpness of detail in the angles, but not in these differences. The error is
    divided by the square root of the capture's mean angle before refinement, so a degree has more
    weight in a capture that is already accurate. The likelihood of the errors is the same as for
    the error head.
    """
    assert network.refine_net is not None, "TrainingConfig asks for a refinement net"
    with torch.autocast(maps.features.device.type, dtype=torch.bfloat16, enabled=bfloat16):
        normals, error = network.refine_net(maps.features, maps.mask)
    known = maps.normals.any(dim=1)

    def mean_over_capture(values: Tensor, known: Tensor = known) -> Tensor:
        return (values * known).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)

    def angles_of(estimate: Tensor) -> Tensor:
        return angles(estimate.movedim(1, -1), maps.normals.movedim(1, -1))

    with torch.no_grad():
        before = mean_over_capture(angles_of(split_features(maps.features)[0]))
    angle = angles_of(normals)
    after = mean_over_capture(angle)
    surprise = mean_over_capture(
        error_negative_log_likelihood(error.movedim(1, -1), angle.detach())
    )
    detail = torch.zeros_like(after)
    for axis in (1, 2):
        both = known.narrow(axis, 1, known.shape[axis] - 1) & known.narrow(
            axis, 0, known.shape[axis] - 1
        )
        off = (normals - maps.normals).diff(dim=axis + 1).square().sum(dim=1).add(1e-8).sqrt()
        detail = detail + mean_over_capture(off, both) / 2
    total = balanced(after + detail_weight * detail, before) + 0.05 * surprise.mean()
    return RefinementLosses(total, before.mean(), after.mean())
