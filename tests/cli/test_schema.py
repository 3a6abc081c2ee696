"""The documents of infer, integrate and evaluate are those that docs/reports.schema.json
describes.
"""

from pathlib import Path

import jsonschema
import pytest

from cli.conftest import read_report
from scenes import parametrize, read_json
from splinecli.records.documents import json_schema

SCHEMA = read_json(Path(__file__).resolve().parents[2] / "docs/reports.schema.json")


def check(document, name):
    """Raise ValidationError if the document is not what the definition `name` of the schema
    says.
    """
    validator = jsonschema.Draft202012Validator({**SCHEMA, "$ref": f"#/$defs/{name}"})
    validator.validate(document)


@parametrize(
    "arguments",
    [
        "--method ls --surface --maps albedo",
        "--method spline-net-pixelwise --light-indices 0,1,2,3",
    ],
)
def test_reports_of_infer(capture, run, arguments):
    [printed] = run(f"infer {capture} --json {arguments}").json
    written = read_report()
    assert printed == written
    check(written, "Report")
    assert (written["surface"] is None) == ("--surface" not in arguments)
    assert Path(written["light_file"]) == (capture / "light_directions.txt").absolute()
    assert Path(written["folder"]) == Path.cwd() / "out/sphere"
    assert all((Path(written["folder"]) / name).is_file() for name in written["files"])


def test_reports_of_integrate(capture, run):
    run(f"infer {capture} --method ls")
    check(run("integrate out/sphere --pixel-size 2 --json").json, "SurfaceReport")


@parametrize("lights", ["--n-lights 4", "--n-lights 4 --n-lights all"])
def test_results_of_evaluate(make_capture, run, lights):
    make_capture("data/matte")
    document = run(f"evaluate data --json --method ls --method l1 {lights} --trials 2").json
    assert document == read_json("evaluation/results.json")
    check(document, "Results")
    for change in ({"colour": 1}, {"averages": {"ls": "good"}}):
        with pytest.raises(jsonschema.ValidationError):
            check({**document, **change}, "Results")


def test_the_published_schema_is_that_of_the_documents():
    """Made by `python docs/generate.py`."""
    assert json_schema() == SCHEMA
