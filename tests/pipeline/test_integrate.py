"""The options of `integrate`, and the command without a terminal."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from splinecli.errors import OutputError
from splinecli.pipeline.integrate import IntegrateOptions, integrate_normal_map, summary_line
from splinecli.pipeline.observer import Advance, Observer


class Counter(Observer):
    """Adds up the progress."""

    def __init__(self) -> None:
        self.steps: list[float] = []

    @contextmanager
    def progress(self, label: str, total: float, *, start: float = 0.0, unit: str = "") -> Iterator[Advance]:
        yield lambda amount, note="": self.steps.append(amount)


@pytest.fixture
def tilted(tmp_path: Path) -> Path:
    """A plane that rises by 3 / 4 of a pixel in each column."""
    np.save(tmp_path / "normals.npy", np.tile(np.float32((-0.6, 0, 0.8)), (6, 9, 1)))
    return tmp_path / "normals.npy"


def test_a_plane(tilted: Path, tmp_path: Path) -> None:
    options = IntegrateOptions(normals=tilted, output=tmp_path / "out", formats=("npy",))
    observer = Counter()
    report = integrate_normal_map(options, observer)
    assert json.loads((tmp_path / "out/surface.json").read_text("utf-8")) == report
    assert report["range"] == pytest.approx([-3, 3], abs=1e-3)  # 8 columns
    assert (report["n_pixels"], report["image_size"], report["camera"]) == (54, [9, 6], "orthographic")
    assert f"{tmp_path / 'out'}: 54 pixels, from -3 to 3 pixels" in summary_line(options, report)
    assert all(step > 0 for step in observer.steps)
    assert sum(observer.steps) <= 1
    with pytest.raises(OutputError, match=r"depth\.npy already exists in this folder"):
        integrate_normal_map(options)
