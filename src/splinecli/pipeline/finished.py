"""Decide whether the results in a folder are still those of the capture and the options."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from splinecli import __version__
from splinecli.capture import CaptureSource
from splinecli.capture.stamp import digest
from splinecli.errors import OutputError, SplinecliError
from splinecli.pipeline.infer_options import InferOptions
from splinecli.results.files import OWN_FILES, REPORT, UnfinishedError, read_report
from splinecli.results.index import Entry
from splinecli.system.files import file_sha256
from splinecli.system.locks import RefusedFolderError
from splinecli.system.publishing import is_plain


class ChangedError(OutputError):
    """A folder has results of other input files, other options or another version."""

    def __init__(self, made: str, folder: Path) -> None:
        hint = "Add --update to redo what changed, --overwrite to redo everything, or choose another place with -o"
        super().__init__(f"contains results made {made}", path=folder, hint=hint)


def find_earlier(
    target: Path, folder: Path, options: InferOptions, warn: Callable[[str], object]
) -> dict[str, Any] | None:
    """Return the report in `target` if its results are those of the capture in `folder` and the options.

    Without results it is None. If an interrupted run left some, `warn` receives a sentence about that.

    Raises:
        ChangedError: the results are not those of this capture and these options.
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
        if found is None:
            return None
        if not is_plain(target / REPORT) and target.samefile(folder):
            raise RefusedFolderError(
                f"contains {found}, but no {REPORT}, and is the folder of the capture",
                path=target,
                hint="Add --overwrite, or choose another place with -o",
            ) from None
        warn(f"{target}: {error}, so it is computed again")
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, SplinecliError):
        raise ChangedError("by another version", target) from None
    if version != __version__:
        raise ChangedError(f"by version {version}", target)
    if earlier != options:
        raise ChangedError(f"with {_differences(earlier, options)}", target)
    if stamp != inputs_sha256(options.open(folder), options.weights):
        raise ChangedError("from other input files", target)
    return report


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
