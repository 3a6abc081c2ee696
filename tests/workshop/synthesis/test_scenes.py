"""Scenes: reproducible one by one, and drawn from the stated ranges."""

import numpy as np
import pytest

from scenes import assert_unit, vectors

pytest.importorskip("embreex")

from splinecli.maths.normals import unit
from splinecli.workshop.synthesis.scenes import (
    MATERIALS,
    MIN_LIGHT_Z,
    SceneConfig,
    draw_lights,
    draw_scene,
    render_scene,
)
from workshop.synthesis.test_rendering import mesh_of

SMALL = SceneConfig(size=16, lights=24, samples=2, directions=8, bounces=2)


def tent():
    """Two slopes that meet in a valley along y."""
    corners = "-1 -1 1; 0 -1 0; 0 1 0; -1 1 1; 1 -1 1; 1 1 1"
    left, right = np.sqrt(0.5) * vectors("1 0 1; -1 0 1")
    up = (0, 0, 1)
    return mesh_of(corners, "0 1 2; 0 2 3; 1 4 5; 1 5 2", [left, up, up, left, right, right])


def test_a_scene_depends_on_its_seed_and_index_alone():
    scenes = [draw_scene(7, index, SMALL, tent()) for index in (0, 1, 0)]
    rendered = [render_scene(scene, SMALL) for scene in scenes]
    for name in MATERIALS:
        assert np.array_equal(rendered[0].observations[name], rendered[2].observations[name])
        assert not np.array_equal(rendered[0].observations[name], rendered[1].observations[name])
    for other in (scenes[1], draw_scene(8, 0, SMALL, tent())):
        assert not np.array_equal(scenes[0].lights, other.lights)


def test_what_is_rendered():
    rendered = render_scene(draw_scene(0, 2, SMALL, tent()), SMALL)
    pixels = rendered.mask.sum()
    assert rendered.mask.shape == (16, 16)
    assert pixels == 256  # the slopes fill the frame
    assert rendered.normals.shape == (pixels, 3)
    for observations in (rendered.observations[name] for name in MATERIALS):
        assert observations.shape == (pixels, 24)
        assert observations.dtype == np.float32
        assert np.isfinite(observations).all() and (observations >= 0).all()
    # The slopes light each other: without bounces the valley is darker, and nowhere brighter.
    direct = SceneConfig(**{**SMALL.__dict__, "bounces": 0})
    alone = render_scene(draw_scene(0, 2, direct, tent()), direct)
    for name in MATERIALS:
        added = rendered.observations[name] - alone.observations[name]
        assert added.min() > -1e-6
        assert added.mean() > 0.01 * alone.observations[name].mean()


def test_lights_cover_the_upper_hemisphere(rng):
    lights = draw_lights(500, rng)
    assert_unit(lights)
    assert (lights[:, 2] > MIN_LIGHT_Z).all()
    # Uniform by solid angle: z is uniform over 0..1, and every direction has a light within a few
    # mean distances.
    assert np.histogram(lights[:, 2], bins=5, range=(0, 1))[0] == pytest.approx(100, abs=15)
    probes = np.random.default_rng(1).normal(size=(500, 3))
    probes[:, 2] = np.abs(probes[:, 2])
    probes = unit(probes)
    assert np.degrees(np.arccos((probes @ lights.T).max(axis=1))).max() < 12
