"""Images written by the tests: the oracle of the readers is what was written."""

import pytest

import scenes


@pytest.fixture
def write_image(tmp_path):
    """Writes pixels (H, W) or (H, W, 3) RGB below tmp_path, in the format of the name."""
    return lambda name, pixels: scenes.write_image(
        tmp_path / name, pixels if pixels.ndim == 2 else pixels[..., ::-1]
    )
