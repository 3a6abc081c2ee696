"""The options of `info`, and the lines of its report."""

from typing import get_args

from splinecli.pipeline.infer import REFINED_PIXELS
from splinecli.pipeline.info import ORIGINS
from splinecli.refinement.refiner import MARGIN, TILE
from splinecli.restoration.images import Origin


def test_the_most_refined_pixels_are_a_tile_with_its_margin() -> None:
    assert REFINED_PIXELS == (TILE + 2 * MARGIN) ** 2


def test_every_origin_of_a_white_level_has_words() -> None:
    assert ORIGINS.keys() == set(get_args(Origin))
