"""The surface that decides from where, and how strongly, each near lamp lights each pixel.

Fit normals, integrate them, move the pixels onto the surface, and fit again with the light directions and the
inverse-square falloff that the lamps have there. The surface begins as the object's mean plane. (Logothetis et al., "A
CNN based approach for the point-light photometric stereo problem", arXiv 2210.04655, alternate alike.)
"""

from dataclasses import replace

import numpy as np

from splinecli.capture import Capture
from splinecli.lights.lamp_light import LampLight, flat_depth, surface_points
from splinecli.methods import make_estimator
from splinecli.surface.integration import integrate_normals
from splinecli.surface.pixel_grid import Blocks

ROUNDS = 2
"""Fits on the way. An error of the surface counts only as a share of the distance of the lamps, so few are enough."""

METHOD = "iw12"  # the fit on the way: fast, and robust against shadows and highlights

PIXELS_ON_THE_WAY = 40_000
"""Larger captures are fitted on the way at about this size: fine detail hardly moves the surface."""


def find_surface(capture: Capture) -> Capture:
    """Return the capture with the points of its surface. One that has them, or distant lights, stays as it is."""
    lamps = capture.lamps
    if lamps is None or lamps.points is not None:
        return capture
    estimator = make_estimator(METHOD)
    blocks = Blocks.over(capture.mask, PIXELS_ON_THE_WAY)
    observations = blocks.average(capture.observations, capture.mask)
    depth = np.full(blocks.mask.shape, flat_depth(lamps))
    for _ in range(ROUNDS):
        points = surface_points(lamps, *blocks.centres(), depth[blocks.mask])
        light = LampLight.of(observations, replace(lamps, points=points))
        normals = light.in_frame_of_capture(estimator.estimate(light.observations, light.directions))
        normal_map = np.zeros((*blocks.mask.shape, 3))
        normal_map[blocks.mask] = normals
        depth = integrate_normals(normal_map, blocks.mask, blocks.shrink_camera(lamps.camera_matrix))
        if lamps.camera_matrix is None:
            depth *= blocks.step  # from blocks to pixels
    rows, columns = (places.astype(np.float64) for places in np.nonzero(capture.mask))
    points = surface_points(lamps, rows, columns, blocks.interpolate(depth, capture.mask))
    return replace(capture, lamps=replace(lamps, points=points))
