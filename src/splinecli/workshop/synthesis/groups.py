"""Groups of bodies that shadow and illuminate each other, and hollows seen from above that contain
bodies.

Errors are largest in glossy hollows next to bodies, and at sharp edges. Groups are graded by their
share of sharp edges, as in PS-Verse (Li et al., "Light of Normals", 2025): from round bodies with
wide fillets to facets, ridges and cuts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splinecli.maths.normals import unit
from splinecli.workshop.synthesis import meshes
from splinecli.workshop.synthesis.meshes import Floats, Mesh, fit_to_frame, read_mesh
from splinecli.workshop.synthesis.shapes import (
    Range,
    draw_folds,
    draw_rotation,
    draw_solid,
    draw_vessel,
    draw_waves,
    joined,
    magnified,
    place_solid,
    turn,
)

MOST_BODIES = 6
SPACING = 0.016  # of the samples of a field
FEWEST_FACES = 2_000  # bodies with fewer faces are drawn again


def draw_group(
    rng: np.random.Generator, files: Sequence[Path], sharpness: float
) -> tuple[str, Mesh]:
    """Draw a group of one to six bodies, fitted into the frame, and return its kind and its mesh.

    60 % are `bodies` beside each other, half of them magnified (see `magnified`). 20 % each are a
    `bowl` and a `niche`, seen from above, with up to five bodies in them. Half of the bodies are
    random views of the mesh files, if any; the others come from draw_body. Each body touches the
    ones before it. `sharpness`, from 0 to 1, is the share of sharp edges. Raises InputError for a
    file, or UsageError if the extra `render` is not installed.
    """

    def draw() -> Mesh:
        if files and rng.random() < 0.5:
            return turn(read_mesh(files[int(rng.integers(len(files)))]), draw_rotation(rng))
        return draw_body(rng, sharpness)

    kind, others = rng.random(), int(rng.integers(MOST_BODIES))
    if kind < 0.6:
        group = draw()
        for _ in range(others):
            group = _leaning(group, draw(), rng, upward=(-0.5, 0.7), sizes=(0.35, 0.9))
        return "bodies", magnified(fit_to_frame(group), rng)
    hollow = None
    while hollow is None:
        hollow = draw_vessel(rng, most_tilt_deg=25) if kind < 0.8 else draw_niche(rng, sharpness)
    for _ in range(others):
        hollow = _leaning(hollow, draw(), rng, upward=(0.2, 1), sizes=(0.12, 0.4))
    return ("bowl", fit_to_frame(hollow)) if kind < 0.8 else ("niche", hollow)


def _leaning(
    group: Mesh, body: Mesh, rng: np.random.Generator, *, upward: Range, sizes: Range
) -> Mesh:
    """Add a body, scaled by U(sizes), that touches the group at a random point.

    The z of the point's normal is within `upward`. Up to a fifth of the depth of the body is below
    the tangent plane of this point.
    """
    z = group.vertex_normals[:, 2]
    places = (
        (z > upward[0]) & (z < upward[1]) & (np.abs(group.vertices[:, :2]) < 1).all(axis=1)
    ).nonzero()[0]
    if not len(places):
        return group
    place = places[rng.integers(len(places))]
    normal = group.vertex_normals[place]
    vertices = body.vertices * np.float32(rng.uniform(*sizes))
    heights, centre = vertices @ normal, (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    foot = (
        centre + (heights.min() + rng.uniform(0, 0.2) * np.ptp(heights) - centre @ normal) * normal
    )
    return joined(group, body, vertices + group.vertices[place] - foot)


def draw_body(rng: np.random.Generator, sharpness: float) -> Mesh:
    """Draw a warped solid with up to three pieces cut out, fitted into the frame.

    A share `sharpness` of the solids have facets, and half of that share has ridges. The others are
    ellipsoids, rounded boxes, tori and rods. The seams of the cuts are 0.005 + 0.09 (1 - sharpness)
    wide.
    """
    while True:
        # Of this size, no solid reaches the border of the sampled box, even if it is warped.
        solid = (
            _draw_facets(rng, 0.5, sharpness) if rng.random() < sharpness else draw_solid(rng, 0.5)
        )
        ridges = draw_folds(rng, (0.6, 1.6), (0.1, 0.5)) if rng.random() < sharpness / 2 else None
        tools = [
            place_solid(draw_solid(rng, rng.uniform(0.1, 0.27)), rng, (0.2, 0.6))
            for _ in range(rng.integers(4))
        ]
        field = _carved(
            solid, ridges, tools, draw_waves(rng, (0.3, 0.7), (0.0, 0.3), outputs=3), sharpness
        )
        mesh = meshes.triangulate(field, (1.3, 1.3, 1.3), SPACING)
        if mesh is not None and len(mesh.faces) > FEWEST_FACES:
            return fit_to_frame(turn(mesh, draw_rotation(rng)))


def draw_niche(rng: np.random.Generator, sharpness: float) -> Mesh | None:
    """Draw a wavy slab that fills the frame, with one to four cavities, tilted by up to 15
    degrees.
    """
    swell = draw_waves(rng, (0.3, 0.8), (0.0, 0.3))
    tools = []
    for _ in range(rng.integers(1, 5)):
        size = rng.uniform(0.4, 0.9)
        tool = (
            _draw_facets(rng, size, sharpness)
            if rng.random() < sharpness
            else draw_solid(rng, size)
        )
        centre = rng.uniform((-0.5, -0.5, -0.1), (0.5, 0.5, 0.3)).astype(np.float32)
        tools.append(meshes.moved(tool, draw_rotation(rng), centre))
    border = meshes.box(np.array((1.4, 1.4, 1.0), dtype=np.float32), 0.01)

    def ground(points: Floats) -> Floats:
        return np.asarray(
            points[:, 2] - swell(points * np.array((1, 1, 0.3), dtype=np.float32))
        ) * np.float32(0.8)

    carved = _carved(ground, None, tools, None, sharpness)
    mesh = meshes.triangulate(
        lambda points: np.maximum(carved(points), border(points)), (1.42, 1.42, 1.05), SPACING
    )
    if mesh is None:
        return None
    from scipy.spatial.transform import Rotation

    tilt, azimuth = np.radians(15) * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
    axis = tilt * np.array((-np.sin(azimuth), np.cos(azimuth), 0))
    return turn(mesh, Rotation.from_rotvec(axis).as_matrix().astype(np.float32))


def _carved(
    solid: meshes.Field,
    ridges: meshes.Field | None,
    tools: Sequence[meshes.Field],
    bend: meshes.Field | None,
    sharpness: float,
) -> meshes.Field:
    seam = 0.005 + 0.09 * (1 - sharpness)

    def distance(points: Floats) -> Floats:
        bent = points if bend is None else points + bend(points)
        shape = solid(bent)
        for tool in tools:
            shape = meshes.smooth_cut(shape, tool(bent), seam)
        return shape if ridges is None else shape - ridges(bent)

    return distance


def _draw_facets(rng: np.random.Generator, size: float, sharpness: float) -> meshes.Field:
    """Draw a polyhedron with three pairs of parallel faces and up to 6 + 24 sharpness others.

    The faces are at U(0.5, 1.2) size from the origin.
    """
    pairs = np.concatenate((np.eye(3), -np.eye(3))) @ draw_rotation(rng)
    others = int(rng.integers(5, 7 + round(24 * sharpness)))
    normals = np.concatenate((pairs, unit(rng.normal(size=(others, 3)))))
    distances = size * rng.uniform(0.5, 1.2, len(normals))
    return meshes.polyhedron(normals.astype(np.float32), distances.astype(np.float32))
