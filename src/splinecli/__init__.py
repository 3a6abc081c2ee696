"""splinecli: surface normals from a few photographs under known lights (photometric stereo,
SPLINE-Net).

Use `estimate_normals` and `integrate_normals` on arrays, for example in a notebook. To work with
folders of files, use the command line or the functions in docs/python.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splinecli._version import __version__

if TYPE_CHECKING:
    from splinecli.api import estimate_material, estimate_normals, integrate_normals

__all__ = ["__version__", "estimate_material", "estimate_normals", "integrate_normals"]


def __getattr__(name: str) -> Any:
    """Return a function of splinecli.api, which is imported on first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from splinecli import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
