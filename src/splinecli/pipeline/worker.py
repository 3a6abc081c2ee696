"""What runs on a worker of a Dask cluster. Paths travel there and reports back, arrays never do."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from threading import Lock
from typing import Any

from splinecli import __version__
from splinecli.errors import InputError, SplinecliError, UsageError
from splinecli.memory import available_memory, keep_freed_memory

_ONE_AT_A_TIME = Lock()
"""A worker process does one task at a time, whatever its number of threads: the working folder, the limits on what is
read and PyTorch's threads belong to the process."""

_PROBE_SECONDS = 3.0
"""A network drive may show a new file a little later."""

SAME_STORAGE = "Workers need the storage of this machine at the same place, for example by NFS"

SAME_VERSIONS = "Install the same versions on all workers and the scheduler"


@dataclass(frozen=True)
class Work:
    """What all tasks of a command share. It travels with each task.

    Args:
        settings: of the command.
        prepare: called with the settings once on each worker. It raises what is wrong with the worker.
        do: called with the settings and the arguments of a task. It returns the result.
        folder: the working folder of the command, which its relative paths start from.
        probe: a file in the output folder. Workers that do not see it have another storage.
        versions: of the packages that must be the same.
        max_pixels, images_elsewhere: the limits on what is read; see cli/reading_limits.py.
    """

    settings: Any
    prepare: Callable[[Any], object]
    do: Callable[..., Any]
    folder: str
    probe: str
    versions: dict[str, str]
    max_pixels: int
    images_elsewhere: bool

    @classmethod
    def of_this_process(
        cls, settings: Any, prepare: Callable[[Any], object], do: Callable[..., Any], probe: Path
    ) -> Work:
        """Return the work of a command under the folder and the limits of this process."""
        from splinecli.capture.formats.image_size import most_pixels
        from splinecli.capture.layouts.image_lists import images_elsewhere_allowed

        return cls(
            settings,
            prepare,
            do,
            str(Path.cwd()),
            str(probe),
            _versions(),
            most_pixels(),
            images_elsewhere_allowed(),
        )


def prepare_worker(work: Work) -> float:
    """Make a worker ready, and return the bytes of memory that its machine has left.

    Raises:
        UsageError: a version is another one.
        InputError: the worker has another storage.
        SplinecliError: what `work.prepare` raises.
    """
    with _ONE_AT_A_TIME:
        _enter(work)
        _check_probe(Path(work.probe))
        keep_freed_memory()
        work.prepare(work.settings)
        return available_memory()


def do_task(work: Work, *args: Any) -> Any:
    """Do a task and return its result. Raises what prepare_worker and `work.do` raise."""
    with _ONE_AT_A_TIME:
        _enter(work)
        return work.do(work.settings, *args)


def with_worker(error: SplinecliError, address: str) -> SplinecliError:
    """Return the error of a worker, which its message names."""
    problem = f"{error.problem} (on the worker {address})"
    return type(error)(problem, path=error.path, line=error.line, hint=error.hint)


def _enter(work: Work) -> None:
    from splinecli.capture.formats.image_size import limit_pixels
    from splinecli.capture.layouts.image_lists import allow_images_elsewhere

    for (package, expected), found in zip(work.versions.items(), _versions().values(), strict=True):
        if found != expected:
            raise UsageError(
                f"found {package} {found}, expected {expected} as on this machine",
                hint=SAME_VERSIONS,
            )
    try:
        os.chdir(work.folder)
    except OSError as error:
        raise InputError(
            f"the folder cannot be entered ({error.strerror})", path=work.folder, hint=SAME_STORAGE
        ) from None
    limit_pixels(work.max_pixels)
    allow_images_elsewhere(work.images_elsewhere)


def _check_probe(probe: Path) -> None:
    deadline = time.monotonic() + _PROBE_SECONDS
    while not probe.exists():
        if not probe.parent.exists() or time.monotonic() > deadline:
            raise InputError(
                "the folder is not the one of this machine", path=probe.parent, hint=SAME_STORAGE
            )
        time.sleep(0.1)


def _versions() -> dict[str, str]:
    return {"splinecli": __version__, "distributed": metadata.version("distributed")}
