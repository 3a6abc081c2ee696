"""Radiance under points of light at finite distances: direct light with cast shadows, and no
indirect light.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.workshop.synthesis.meshes import Floats
from splinecli.workshop.synthesis.ray_tracing import TRACED_ROWS, Hits, Tracer, VisibleSurface
from splinecli.workshop.synthesis.scenes import Materials, before_black


def render_point_lights(
    tracer: Tracer,
    visible: VisibleSurface,
    positions: Floats,
    materials: Materials,
    patch_of_face: NDArray[np.int64],
) -> dict[str, Tensor]:
    """Return radiances (P, F) of each material under points of light at positions (F, 3) in the
    mesh's frame.

    The radiance of a matte white surface that faces a light is 1 where the surface is as far from
    the light as the frame's origin is. It falls with the square of the distance.
    """
    pixels, samples = len(visible.normals), visible.samples_per_pixel
    radiance = {name: torch.empty(pixels, len(positions)) for name in materials}
    at_once = max(1, TRACED_ROWS // samples)
    for start in range(0, pixels, at_once):
        rows = np.arange(start, min(start + at_once, pixels))
        hits = visible.samples_of(rows)
        directions, falloff = _light_at(hits, positions)
        cosines = np.einsum("nfc,nc->nf", directions, hits.normal)
        lit = np.stack(
            [
                tracer.lit(hits.lifted(), cosines[:, light : light + 1] > 0, directions[:, light])[
                    :, 0
                ]
                for light in range(len(positions))
            ],
            axis=1,
        )
        shading = torch.from_numpy((cosines * lit).astype(np.float32))
        patches = torch.from_numpy(patch_of_face[hits.triangle])
        towards_camera, above = (
            torch.from_numpy(hits.normal[:, 2:]),
            torch.from_numpy(directions[..., 2]),
        )
        for name, material in materials.items():
            shaded = material.take(patches).shade(
                shading, towards_camera, above
            ) * torch.from_numpy(falloff)
            radiance[name][rows] = shaded.view(len(rows), samples, -1).mean(dim=1)
    return before_black(radiance, visible)


def _light_at(hits: Hits, positions: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the unit directions (N, F, 3) to the lights, and their falloff (N, F), 1 at the
    origin.
    """
    towards = positions - hits.position[:, None].astype(np.float64)
    distance = np.linalg.norm(towards, axis=2)
    falloff = (np.linalg.norm(positions, axis=1) / distance) ** 2
    return (towards / distance[..., None]).astype(np.float32), falloff.astype(np.float32)
