"""Methods, maps and warnings are rows of tables: one row adds one everywhere, and nothing tests for
it by name.
"""

import re
from pathlib import Path

import numpy as np
import typer

import make_tables
import splinecli
from html_page import REPORT
from judged import warnings_of
from scenes import FOUR_LIGHTS, codes, parametrize, refuses
from splinecli.capture import Capture
from splinecli.cli.main import app
from splinecli.estimate.inference import estimate_normals
from splinecli.estimate.methods import METHODS, Estimator, Method, make_estimator, method_names
from splinecli.judge import checks
from splinecli.pictures.maps import signed_picture
from splinecli.pipeline.infer import results_bytes
from splinecli.pipeline.infer_options import InferOptions
from splinecli.records.capture_warnings import WARNINGS, CaptureWarning, WarningKind
from splinecli.records.output_files import MAPS, OutputMap, own_files
from splinecli.results.map_values import MAP_FUNCTIONS, MapFunctions
from splinecli.results.maps import chosen_maps, make_map, map_files
from splinecli.results.pages import result_page

SOURCE = Path(splinecli.__file__).parent


def capture():
    observations = np.ones((6, 4), np.float32)
    return Capture("flat", observations, FOUR_LIGHTS, tuple(range(4)), np.ones((2, 3), np.bool_))


@parametrize("name", make_tables.PAGES)
def test_tables_of_the_documentation(name):
    """`python docs/generate.py` writes them."""
    text = (make_tables.DOCS / name).read_text("utf-8")
    assert text == make_tables.fill(text)
    assert "<!-- table: " in text


def test_no_method_is_known_by_its_name_or_has_hidden_hooks():
    names = "|".join(METHODS)
    by_name = re.compile(
        rf"""(?<!grid) [!=]= "(?:{names})"|startswith\("(?:spline|cnn)|(?:get|has)attr\(estimator"""
    )
    assert [
        path.name for path in SOURCE.rglob("*.py") if by_name.search(path.read_text("utf-8"))
    ] == []


class Flat(Estimator):
    """Says that every pixel faces the camera."""

    name = fingerprint = "flat"

    def estimate(self, observations, light_directions, *, progress=None):
        return np.tile((0.0, 0.0, 1.0), (len(observations), 1))

    def warn_of_lights(self, n_lights):
        return [f"{n_lights} lights are not needed."]


def test_a_method_is_a_row(monkeypatch):
    monkeypatch.setitem(
        METHODS, "flat", Method(lambda name, options: Flat(), "a constant", "nobody")
    )
    assert method_names()[-1] == "flat"
    assert "| `flat` | a constant | nobody |" in make_tables.methods_table()
    estimate = estimate_normals(capture(), make_estimator("flat"))
    assert np.array_equal(estimate.normal_map, np.tile(np.float32((0, 0, 1)), (2, 3, 1)))
    assert estimate.confidence_map is None


def test_a_warning_is_a_row(monkeypatch):
    uniform = WarningKind(
        "uniform", "All values are equal", "Photograph an object", severity="error"
    )
    monkeypatch.setitem(WARNINGS, uniform.code, uniform)
    assert (
        "| `uniform` | All values are equal | Photograph an object | error |"
        in make_tables.warnings_table()
    )

    def check(seen):
        return (
            [checks.Finding(CaptureWarning(uniform, "All values are equal."))]
            if np.ptp(seen.observations) == 0
            else []
        )

    monkeypatch.setattr(checks, "CHECKS", [*checks.CHECKS, checks.Check(check)])
    warnings = warnings_of(capture())
    assert "uniform" in codes(warnings)
    with refuses("All values are equal"):
        checks.refuse_if_strict(warnings[-1:], "flat", strict=True)


def test_a_map_is_a_row(monkeypatch):
    row = OutputMap(
        name="slant",
        content="cosine between normal and camera axis",
        unit="cosine",
        scale=1.0,
        scale_text="cosine, black -{scale}, white {scale}",
        caption="Slant",
        bytes_per_pixel=7,
    )
    InferOptions()  # so that the new row does not enter the help, which other tests compare
    monkeypatch.setitem(MAPS, "slant", row)
    monkeypatch.setitem(MAP_FUNCTIONS, "slant", MapFunctions(slant, signed_picture))
    mask, estimate = np.ones((2, 3), np.bool_), estimate_normals(capture(), make_estimator("ls"))
    assert chosen_maps(["slant", "preview"])[-1] is row
    values = make_map(row, None, estimate)
    assert dict(map_files(row, values, mask, ["tiff"])).keys() == {
        "slant.npy",
        "slant.tiff",
        "slant.png",
    }
    # so that it is no photograph
    assert {"slant.npy", "slant.tiff", "slant.png"} <= set(own_files())
    assert (
        "| `slant` | `slant.npy`, `slant.tiff`, `slant.png` | cosine between normal and camera "
        "axis |" in (make_tables.maps_table())
    )
    assert results_bytes(100, 4, maps=["slant"]) - results_bytes(100, 4) == 700
    page = result_page(REPORT, estimate.normal_map, mask, values={"slant": values})
    assert "<figcaption>Slant</figcaption>" in page
    given = (
        typer.main.get_command(app)  # type: ignore[attr-defined]
        .commands["infer"]
        .make_context("infer", ["x", "--maps", "slant:0.5"])
        .params
    )
    assert InferOptions.from_arguments(given).map_scales == (("slant", 0.5),)


def slant(source, estimate, progress):
    return estimate.normal_map[..., 2]
