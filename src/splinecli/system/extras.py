"""Import of optional packages, which pip installs as extras of splinecli."""

import importlib
from pathlib import Path
from types import ModuleType

from splinecli.errors import SplinecliError, UsageError

_PROBLEMS = {
    "cluster": "--workers above 1 and --cluster need the package distributed, which is not installed",
    "exr": "EXR files need the package OpenEXR, which is not installed",
    "mesh": "--decimate needs the package fast-simplification, which is not installed",
    "raw": "camera RAW files need rawpy, which is not installed",
    "render": "rendering needs embreex and scikit-image, which are not all installed",
    "tensorboard": "--tensorboard needs the package tensorboard, which is not installed",
}
"""The message for each extra."""


def import_extra(
    module: str,
    extra: str,
    *,
    error: type[SplinecliError] = UsageError,
    path: Path | None = None,
    otherwise: str | None = None,
) -> ModuleType:
    """Import a module of an extra, a key of _PROBLEMS, when it is used for the first time.

    Raises UsageError or `error` if the module is not installed. The message names the command that installs it, the
    file at `path` that cannot be read without it, and `otherwise`, another way out.
    """
    try:
        return importlib.import_module(module)
    except ImportError as cause:
        alternative = f", or {otherwise}" if otherwise else ""
        raise error(_PROBLEMS[extra], path=path, hint=f"Run pip install 'splinecli[{extra}]'{alternative}") from cause
