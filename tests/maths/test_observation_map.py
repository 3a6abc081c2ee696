"""Observation maps: which cell a direction falls on, and what lights in one cell give."""

import torch
from torch.testing import assert_close

from scenes import on_sphere, parametrize, vectors
from splinecli.maths.observation_map import (
    cell_directions,
    light_cells,
    sparse_map,
)

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
