"""Fixtures for all tests."""

import math
import os
import re
from pathlib import Path

# The tests run in one process a core. Each of these, and the commands that they start, computes in
# one thread.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from numpy.random import default_rng

from browser import browser, open_page
from scenes import cap_directions, put, shade, spiral_lights
from small_pixel_sets import make_set
from splinecli.system.progress import STAGES

__all__ = ["browser", "make_set", "open_page"]
GOLDEN = Path(__file__).resolve().parent / "golden"


def pytest_addoption(parser):
    parser.addoption(
        "--update-golden", action="store_true", help="write tests/golden/ anew; then read the diff"
    )


@pytest.fixture(autouse=True)
def no_lines_of_progress(monkeypatch):
    """Print none of the lines that come every half minute, because a busy machine would add them to
    compared text.
    """
    monkeypatch.setattr("splinecli.cli.console.LINE_SECONDS", math.inf)


@pytest.fixture
def rng():
    return default_rng(0)


@pytest.fixture
def no_pictures(monkeypatch):
    """Save training runs without drawing the figures, which takes longer than the run itself."""
    monkeypatch.setattr(
        "splinecli.workshop.training.run_files.RunLog.draw", lambda self, maps: None
    )


@pytest.fixture
def coarse_shapes(monkeypatch):
    """Drawn shapes of few triangles, which small pictures show as well."""
    pytest.importorskip("embreex")
    monkeypatch.setattr("splinecli.workshop.synthesis.shapes.SPACING", 0.04)
    monkeypatch.setattr("splinecli.workshop.synthesis.shapes.FEWEST_FACES", 100)


@pytest.fixture(scope="session")
def shared_data():
    """Real captures that lie beside the repository on the authors' machines; none of them is part
    of it.
    """
    folder = Path(__file__).resolve().parents[1] / "../shared/data"
    if not folder.is_dir():
        pytest.skip(f"no real captures in {folder}")
    return folder.resolve()


@pytest.fixture
def matte_pixels():
    """Normals (200, 3), 12 lights and observations (200, 12) of matte pixels,
    no shadow among them.
    """
    normals, lights = cap_directions(200, 50), spiral_lights(12)
    albedo = default_rng(1).uniform(0.01, 100, (200, 1))
    return normals, lights, albedo * (normals @ lights.T)


@pytest.fixture
def glossy_pixels():
    """Normals (60, 3), 14 lights and observations (60, 14): Lambert's cosine, a Phong lobe,
    attached shadows.
    """
    normals, lights = cap_directions(60, 70), spiral_lights(14, 60)
    return normals, lights, 0.6 * shade(normals, lights, gloss=5 / 6, exponent=40)


@pytest.fixture
def golden(request):
    """Compare a text with tests/golden/<name>; `pytest --update-golden` writes it anew, and the
    diff is read.

    What differs from run to run (seconds, memory, sizes of files, version) is blanked out.
    """

    def check(name, text):
        path = GOLDEN / name
        text = _without_measurements(text)
        if request.config.getoption("--update-golden"):
            put(path, text)
        assert text == path.read_text("utf-8")

    return check


def _without_measurements(text):
    """The text with seconds, memory, sizes of files, version and absolute paths blanked out."""
    text = re.sub(r'("[a-z_0-9]+\.[a-z]+": )\d+', r"\1...", text)
    text = re.sub(
        rf'("(?:{"|".join(STAGES)}|total|peak_memory_mib|seconds)": )[\d.]+', r"\1...", text
    )
    text = re.sub(r", [\d.]+ s\n", ", ... s\n", text)
    return re.sub(r'("(?:version|inputs_sha256|folder|light_file)": )"[^"]*"', r'\1"..."', text)
