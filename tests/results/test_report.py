"""A report names its schema, how the capture was read, and each warning with a code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from splinecli.capture import Capture
from splinecli.capture.capture_warnings import EIGHT_BIT, CaptureWarning
from splinecli.inference import estimate_normals
from splinecli.methods import make_estimator
from splinecli.results.report import SCHEMA, report_of


@pytest.mark.parametrize(("as_stored", "reading"), [(True, "as stored"), (False, "restored")])
def test_a_report(matte_pixels, as_stored, reading):
    normals, lights, observations = matte_pixels
    warnings = (CaptureWarning(EIGHT_BIT, "The images have 8 bits."),)
    mask = (normals[:, 2] > -2)[:, None]
    capture = Capture("matte", observations, lights, tuple(range(12)), mask=mask, warnings=warnings)
    estimator = make_estimator("ls")
    report = report_of(
        estimate_normals(capture, estimator), estimator, {"method": "ls"}, "0" * 64,
        light_file=Path("lights.txt"), as_stored=as_stored,
    )  # fmt: skip
    assert report == json.loads(json.dumps(report))
    assert (report["schema"], report["reading"]) == (SCHEMA, reading)
    assert report["warnings"] == [{"code": "eight_bit", "text": "The images have 8 bits."}]
    assert (report["n_lights"], report["n_pixels"], report["image_size"]) == (12, 200, [1, 200])
    assert report["light_file"] == str(Path.cwd() / "lights.txt")
    assert report["angular_error_deg"] is None
