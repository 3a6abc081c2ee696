"""Decide whether the results in a folder are still those of the capture and the options."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.capture import CaptureSource
from splinecli.capture.stamp import digest
from splinecli.errors import SplinecliError
from splinecli.pipeline.infer_options import InferOptions
from splinecli.results.files import OWN_FILES, REPORT, UnfinishedError, read_report
from splinecli.results.index import Entry
from splinecli.system.files import file_sha256
from splinecli.system.locks import RefusedFolderError
from splinecli.system.publishing import is_plain


@dataclass(frozen=True)
class EarlierResults:
    """What a folder of results contains before a run.

    Args:
        report: the report in the folder if these results are still good, else None.
        changed: why they are not, in words; empty if they are, or if there are none.
        unfinished: why what is in the folder does not count as results, in words; empty if it does.
    """

    report: dict[str, Any] | None = None
    changed: str = ""
    unfinished: str = ""


def find_earlier(target: Path, folder: Path, options: InferOptions) -> EarlierResults:
    """Compare the results in `target` with the capture in `folder` and the options.

    Raises:
        InputError: the capture cannot be read.
        RefusedFolderError: both are one folder, which may have files of the user with the names of results.
    """
    try:
        report = read_report(target)
        earlier = InferOptions.from_dict(report["options"])
        version, stamp = report["version"], report["inputs_sha256"]
        if Entry.of(report).row.capture != target.name:  # raises if the report is not whole
            raise ValueError
    except UnfinishedError as error:
        found = next((name for name in OWN_FILES if (target / name).exists()), None)
        if found is not None and not is_plain(target / REPORT) and target.samefile(folder):
            raise RefusedFolderError(
                f"contains {found}, but no {REPORT}, and is the folder of the capture",
                path=target,
                hint="Add --overwrite, or choose another place with -o",
            ) from None
        return EarlierResults(unfinished="" if found is None else str(error))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, SplinecliError):
        return EarlierResults(changed="contains results made by another version")
    if version != __version__:
        return EarlierResults(changed=f"contains results made by version {version}")
    if earlier != options:
        return EarlierResults(changed=f"contains results made with {_differences(earlier, options)}")
    if stamp != inputs_sha256(options.open(folder), options.weights):
        return EarlierResults(changed="contains results made from other input files")
    return EarlierResults(report)


def inputs_sha256(source: CaptureSource, weights: str | None, *, loaded: str | None = None) -> str:
    """Return a digest that changes when any file that is read for the capture, or the weight file, changes.

    `loaded` is the SHA-256 of the weight file when it was loaded; None reads the file.
    """
    if weights is not None and Path(weights).is_file():
        weights = loaded or file_sha256(Path(weights))
    return digest([*source.stamp, weights])


def _differences(earlier: InferOptions, options: InferOptions) -> str:
    """Return words for the options that differ, such as "another --method"."""
    names = [
        "--" + option.name.replace("formats", "format").replace("_", "-")
        for option in fields(options)
        if option.compare and getattr(earlier, option.name) != getattr(options, option.name)
    ]
    return f"another {names[0]}" if len(names) == 1 else f"other options ({', '.join(names)})"
