"""Decide whether the results in a folder are still those of the capture and the options."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splinecli import __version__
from splinecli.errors import SplinecliError
from splinecli.files import read_json
from splinecli.pipeline.infer_options import InferOptions

if TYPE_CHECKING:
    from splinecli.capture import CaptureSource

_SINGULAR = {"formats": "format", "mesh_formats": "mesh-format"}
"""Fields of InferOptions whose option has another name."""


@dataclass(frozen=True)
class EarlierResults:
    """What a folder of results contains before a run.

    Args:
        report: the report in the folder if these results are still good, else None.
        changed: why they are not, in words; empty if they are, or if there are none.
        ours: whether `infer` wrote them, so that --update may replace them.
    """

    report: dict[str, Any] | None = None
    changed: str = ""
    ours: bool = True


def find_earlier(target: Path, folder: Path, options: InferOptions) -> EarlierResults:
    """Compare the results in `target` with the capture in `folder` and the options. Raises InputError."""
    from splinecli.results.files import OWN_FILES, REPORT
    from splinecli.results.index import row_of

    try:
        report = read_json(target / REPORT)
        earlier = InferOptions.from_dict(report["options"])
        version, stamp, names = report["version"], report["inputs_sha256"], [str(n) for n in report["files"]]
        row_of(report)  # raises if the report is not whole
    except (OSError, ValueError, KeyError, TypeError, AttributeError, SplinecliError):
        found = next((name for name in OWN_FILES if (target / name).exists()), None)
        if found is None:
            return EarlierResults()
        # A report of another version may have other options, but it is one of ours.
        if found != REPORT and not (target / REPORT).is_file():
            return EarlierResults(changed=f"contains {found}, but no {REPORT}", ours=False)
        return EarlierResults(changed="contains results made by another version")
    if version != __version__:
        return EarlierResults(changed=f"contains results made by version {version}")
    if earlier != options:
        return EarlierResults(changed=f"contains results made with {_differences(earlier, options)}")
    missing = [name for name in names if not (target / name).is_file()]
    if missing:
        return EarlierResults(changed=f"contains earlier results, but {missing[0]} is missing")
    if stamp != inputs_sha256(options.open(folder), options.weights):
        return EarlierResults(changed="contains results made from other input files")
    return EarlierResults(report)


def inputs_sha256(source: CaptureSource, weights: str | None, *, loaded: str | None = None) -> str:
    """Return a digest that changes when any file that is read for the capture, or the weight file, changes.

    `loaded` is the SHA-256 of the weight file when it was loaded; None reads the file.
    """
    from splinecli.capture.stamp import digest
    from splinecli.files import file_sha256

    if weights is not None and Path(weights).is_file():
        weights = loaded or file_sha256(Path(weights))
    return digest([*source.stamp, weights])


def _differences(earlier: InferOptions, options: InferOptions) -> str:
    """Return words for the options that differ, such as "another --method"."""
    names = [
        "--" + _SINGULAR.get(option.name, option.name).replace("_", "-")
        for option in fields(options)
        if option.compare and getattr(earlier, option.name) != getattr(options, option.name)
    ]
    return f"another {names[0]}" if len(names) == 1 else f"other options ({', '.join(names)})"
