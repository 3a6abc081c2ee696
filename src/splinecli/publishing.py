"""Sets of output files that replace earlier ones as a whole, in folders that one process at a time writes into.

New files are first written into a hidden folder inside the output folder and synced to disk. One rename then marks them
as complete. After that they are moved to their places, the report last. A process that is killed before this rename
leaves the earlier files as they were. If it is killed later, the next process that holds the folder moves the rest. In
between the folder has no report while it has files of both runs, so nothing describes a mixture. No reader of splinecli
takes a file from such a folder (see is_unfinished).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath

from splinecli.errors import OutputError
from splinecli.files import (
    COMPLETE,
    DRAFT,
    UNFINISHED,
    check_writable,
    is_unfinished,
    read_json,
    refusals_as_output_errors,
    sync,
    sync_names,
)
from splinecli.locks import locked

_FILES, _PLAN = "files", "plan.json"

FINISHED = "an interrupted run left new files that were not yet in their places; they are now"
UNDONE = "an interrupted run left unfinished files, which are removed"


@contextmanager
def held_folder(
    folder: Path, warn: Callable[[str], object] = lambda _: None, *, wait: bool = False
) -> Iterator[None]:
    """Make a folder, lock it, and finish or undo what a killed process left in it.

    A folder that was made here and is empty at the end is removed, as are its parents.

    Args:
        folder: the folder.
        warn: receives a sentence about what a killed process had left and what became of it.
        wait: wait for another process that has locked the folder, instead of raising BusyError.

    Raises:
        BusyError: another process has locked the folder.
        OutputError: the folder cannot be made or written.
    """
    check_writable(folder)
    made: list[Path] = []
    try:
        with ExitStack() as stack:
            with refusals_as_output_errors(folder):
                made = [place for place in (folder, *folder.parents) if not place.exists()]
                stack.enter_context(locked(folder, wait=wait))
                sync_names(folder, *made)
                for found in _put_in_order(folder):
                    warn(f"{folder}: {found}")
            yield
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


@contextmanager
def new_files(folder: Path, *, report: str, stale: Iterable[str] = ()) -> Iterator[Path]:
    """Yield an empty folder for new files. After the block they replace those of the same names, all or none.

    The caller must hold the folder (see held_folder).

    Args:
        folder: where the files belong. A file in a subfolder goes to the subfolder of that name.
        report: the name of the new file that describes the others.
        stale: names of earlier files that are removed if no new file replaces them.

    Raises:
        OutputError: a file cannot be written.
    """
    draft = folder / DRAFT
    with refusals_as_output_errors(folder):
        try:
            (draft / _FILES).mkdir(parents=True)
            try:
                yield draft / _FILES
            except OSError:
                # The error of a write has no name of a file.
                with refusals_as_output_errors(_last_written(draft / _FILES)):
                    raise
            names = [path.relative_to(draft / _FILES).as_posix() for path in _files_in(draft / _FILES)]
            for name in names:
                _check_place(folder / name)
            plan = {"report": report, "remove": [name for name in stale if name not in names]}
            (draft / _PLAN).write_text(json.dumps(plan), "utf-8")
            for path in (*draft.rglob("*"), draft):
                sync(path)
            draft.rename(folder / COMPLETE)
        except BaseException:
            shutil.rmtree(draft, ignore_errors=True)
            raise
        try:
            _install(folder)
        except KeyboardInterrupt:
            _install(folder)
            raise
        except OSError as error:
            raise OutputError(
                f"the new files are complete, but are not all in their places ({error.strerror or error})",
                path=folder,
                hint="Run the command again, which finishes this",
            ) from error


def _put_in_order(folder: Path) -> list[str]:
    """Finish or undo what a killed process left in the folder, and say so."""
    done = []
    if (folder / DRAFT).is_dir():
        shutil.rmtree(folder / DRAFT)
        done = [UNDONE]
    for path in folder.glob(f".*{UNFINISHED}"):
        if path.is_file():
            path.unlink()
            done = [UNDONE]
    if is_unfinished(folder):
        _install(folder)
        done = [FINISHED]
    return done


def _install(folder: Path) -> None:
    """Move complete new files to their places. Whatever part of this was done before, the result is the same."""
    sync(folder)  # before an earlier file goes
    files = folder / COMPLETE / _FILES
    remove, report = _read_plan(folder)
    # Without its report, everything is in its place.
    if (files / report).is_file():
        for name in (report, *remove):
            (folder / name).unlink(missing_ok=True)
        for path in sorted(_files_in(files), key=lambda path: path == files / report):
            place = folder / path.relative_to(files)
            made = [parent for parent in place.parents if not parent.exists()]
            place.parent.mkdir(parents=True, exist_ok=True)
            path.replace(place)
            if place.parent != folder:
                sync_names(place.parent, *made)
        sync(folder)
    shutil.rmtree(folder / COMPLETE)
    sync(folder)


def _read_plan(folder: Path) -> tuple[list[str], str]:
    """Return the names to remove and the report's name. The folder may come from somebody else: check the names."""
    path = folder / COMPLETE / _PLAN
    try:
        plan = read_json(path)
        remove, report = list(plan["remove"]), plan["report"]
        if all(_is_inside(name) for name in (*remove, report)):
            return remove, report
    except FileNotFoundError:
        if not _files_in(folder / COMPLETE / _FILES):
            return [], "."
    except (ValueError, KeyError, TypeError):
        pass
    raise OutputError(
        "holds new files of an interrupted run, but its plan.json is damaged",
        path=folder / COMPLETE,
        hint="Remove this hidden folder",
    )


def _is_inside(name: object) -> bool:
    """Return whether this is the name of a file inside a folder."""
    if not isinstance(name, str) or "\0" in name:
        return False
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


def _check_place(path: Path) -> None:
    if path.is_dir():
        raise OutputError("found a folder, expected a file", path=path)
    if path.parent.exists() and not path.parent.is_dir():
        raise OutputError("found a file, expected a folder", path=path.parent)


def _last_written(folder: Path) -> Path:
    """Return the file that changed last; the folder where there is none."""
    return max(_files_in(folder), key=lambda path: path.stat().st_mtime_ns, default=folder)


def _files_in(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if not path.is_dir()]
