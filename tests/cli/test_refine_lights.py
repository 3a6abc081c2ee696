"""`--refine-lights` on a matte capture whose light file is rough."""

import json
from pathlib import Path

import numpy as np
import pytest

from scenes import BUMP_LAMPS, write_bump


@pytest.fixture
def rough() -> np.ndarray:
    """Write a matte bump under distant lights. Returns directions (7, 3) with errors of about 5 degrees."""
    write_bump(Path("bump"), distant=True)
    directions = BUMP_LAMPS / np.linalg.norm(BUMP_LAMPS, axis=1, keepdims=True)
    Path("bump/light_intensities.txt").write_text("1\n" * len(directions))
    rough = directions + np.random.default_rng(1).normal(scale=0.06, size=directions.shape)
    np.savetxt("bump/light_directions.txt", rough)
    return rough / np.linalg.norm(rough, axis=1, keepdims=True)


def test_infer(document, rough: np.ndarray) -> None:
    command = ("infer", "bump", "--method", "ls", "--overwrite")
    given, refined = (document(*command, *more) for more in ((), ("--refine-lights",)))
    np.testing.assert_allclose(given["light_directions"], rough, atol=1e-5)
    moved = np.degrees(np.arccos((np.array(refined["light_directions"]) * rough).sum(axis=1).clip(-1, 1)))
    assert 1 < moved.mean() < 10
    assert "refined_lights" in [warning["code"] for warning in refined["warnings"]]
    # A common rotation of lights and normals stays.
    assert refined["angular_error_deg"]["mean"] < 0.9 * given["angular_error_deg"]["mean"]


def test_evaluate(document, rough: np.ndarray) -> None:
    """Both protocols share a folder: trials with refined lights are other trials."""
    command = ("evaluate", "bump", "--method", "ls", "--n-lights", "all", "-o", "scores")
    options = ((), ("--refine-lights",), ("--refine-lights", "--light-error-deg", "3"))
    found = [document(*command, *more) for more in options]
    errors = [one["results"][0]["mae_deg"] for one in found]
    assert found[2]["protocol"]["light_error_deg"] == 3
    assert errors[1] < 0.9 * errors[0]
    assert errors[2] not in errors[:2]


def test_evaluate_skips_a_capture_with_near_lamps(run, rough: np.ndarray) -> None:
    write_bump(Path("near"))
    np.savetxt("near/light_positions.txt", BUMP_LAMPS)
    Path("near/pixel_size.txt").write_text("2\n")
    arguments = ["--method", "ls", "--n-lights", "all", "--refine-lights", "--json"]
    result = run("evaluate", "bump", "near", *arguments)
    document = json.loads(result.out)
    assert [scored["capture"] for scored in document["results"]] == ["bump"]
    assert [skipped["capture"] for skipped in document["skipped"]] == ["near"]
    assert "--refine-lights refines distant lights, and this capture has near lamps" in result.err
    assert run("evaluate", "near", *arguments).code == 2


def test_a_light_error_without_refined_lights_is_refused(run, rough: np.ndarray) -> None:
    result = run("evaluate", "bump", "--method", "ls", "--light-error-deg", "4")
    assert (result.code, "--light-error-deg needs --refine-lights" in result.err) == (2, True)
