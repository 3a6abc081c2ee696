"""Observation maps: which cell a direction falls on, and the symmetries of what is laid out
there.
"""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from distributions import seeded
from scenes import on_sphere, parametrize, vectors
from splinecli.maths.observation_map import (
    cell_directions,
    light_cells,
    map_scale,
    rotate_about_view_axis,
    sparse_map,
    unit_disc,
)

SEEDS = st.integers(0, 2**31)
quick = settings(max_examples=25, deadline=None)


def random_rig(seed, pixels, lights):
    """Observations (P, F) and shared directions (F, 3) in float64: no light falls on the border of
    a cell.
    """
    generator = seeded(seed)
    directions = torch.randn(lights, 3, generator=generator, dtype=torch.float64)
    directions[:, 2] = directions[:, 2].abs() + 0.05
    observations = torch.rand(pixels, lights, generator=generator, dtype=torch.float64)
    return observations, torch.nn.functional.normalize(directions, dim=-1)


# Ours: a cell is 1/16 wide; the axis runs between columns 15 and 16 and rows 15 and 16; row 0 is y
# = +1. (0.6 + 1) * 16 = 25.6 and (1 - 0.3) * 16 = 11.2.
# CNN-PS: floor((n + 1) 31 / 2) from the lower left, which is row 31 and column 0; its last cell is
# a single point. (0.6 + 1) * 15.5 = 24.8 and (0.3 + 1) * 15.5 = 20.15.
CELLS = {
    "ours": """
0.01 0.01 15 16; -0.01 0.01 15 15; 0.01 -0.01 16 16; -0.01 -0.01 16 15; 0 0.99 0 16; 0 1 0 16;
0 -1 31 16; 1 0 16 31; -1 0 16 0; 1.0000001 0 16 31; 0.6 0.3 11 25""",
    "cnn-ps": """
0.01 0.01 16 15; -0.1 -0.1 18 13; 0 1 0 15; 0 0.99 1 15; 0 -1 31 15; 1 0 16 31; 0.99 0 16 30;
-1 0 16 0; 0.6 0.3 11 24""",
}


@parametrize("grid", CELLS)
def test_cell_of_a_known_direction(grid):
    options = {} if grid == "ours" else {"grid": grid}
    for x, y, row, column in vectors(CELLS[grid]):
        direction = torch.from_numpy(on_sphere(x, y))
        assert light_cells(direction, **options).item() == row * 32 + column, (x, y)
        occupied = sparse_map(torch.ones(1, 1), direction[None], **options).occupied
        assert occupied.flatten().nonzero().item() == row * 32 + column, (x, y)


def test_the_disc_of_both_grids():
    # By counting the odd a, b within 31 and 32 of the origin.
    assert unit_disc(32).sum() == 812
    assert torch.equal(unit_disc(32), cell_directions(32)[1])
    theirs = unit_disc(32, "cnn-ps")
    assert theirs.sum() == 740
    assert torch.equal(theirs, theirs.T)
    assert torch.equal(theirs, theirs.flip(0))
    assert not (theirs & ~unit_disc(32)).any()


@parametrize("size", [8, 31, 32, 64])
def test_every_cell_centre_lies_in_its_own_cell(size):
    directions, inside = cell_directions(size)
    expected = torch.arange(size * size).view(size, size)
    assert torch.equal(light_cells(directions, size)[inside], expected[inside])
    assert directions[inside].norm(dim=-1).sub(1).abs().max() < 1e-6
    assert not directions[~inside].any()


def test_lights_in_one_cell_are_averaged():
    directions = torch.tensor(vectors("0.01 0.01 1; 0.02 0.03 1; 0.05 0.01 1; 0.5 0.5 0.7")).float()
    values = torch.tensor([[[1.0, 10.0], [0.0, 20.0], [0.5, 60.0], [0.3, 7.0]]])
    maps = sparse_map(values, directions)
    assert_close(maps.values[0, :, 15, 16], torch.tensor([0.5, 30.0]))
    assert maps.occupied.sum() == 2
    assert maps.occupied[0, 0, 15, 16] == 1


def test_lights_that_are_not_valid_leave_no_trace():
    observations, directions = random_rig(1, 3, 12)
    valid = torch.arange(12) % 3 != 0
    with_flags = sparse_map(observations, directions, valid.expand(3, 12))
    without = sparse_map(observations[:, valid], directions[valid])
    assert_close(with_flags.values, without.values)
    assert torch.equal(with_flags.occupied, without.occupied)
    bright = torch.where(valid, observations, 100.0)
    assert torch.equal(map_scale(bright, valid.expand(3, 12)), map_scale(observations[:, valid]))


ZERO, ONE = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
SYMMETRIES = {
    "another order": (lambda lights: lights, lambda maps: maps),
    # rot90 with k = 1 turns a picture counterclockwise, as the lights are.
    "turned by 90 degrees": (
        lambda light: rotate_about_view_axis(light, ZERO, ONE),
        lambda maps: maps.rot90(1, (2, 3)),
    ),
    "mirrored in y": (
        lambda lights: lights * torch.tensor((1.0, -1.0, 1.0)),
        lambda maps: maps.flip(2),
    ),
}


@parametrize("name", SYMMETRIES)
@quick
@given(SEEDS)
def test_maps_follow_the_lights(name, seed):
    change, changed = SYMMETRIES[name]
    observations, directions = random_rig(seed, 3, 20)
    order = torch.randperm(20, generator=seeded(seed))
    one = sparse_map(observations, directions)
    other = sparse_map(observations[:, order], change(directions)[order])
    assert_close(other.values, changed(one.values))
    assert torch.equal(other.occupied, changed(one.occupied))
