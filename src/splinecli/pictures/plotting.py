"""Parts that all plots share: a fixed style for each method, and PNG files without matplotlib's global state."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from splinecli.methods import method_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class MethodStyle(NamedTuple):
    """The style of a line: matplotlib's names of a colour and a marker."""

    colour: str
    marker: str


# The colours of Okabe and Ito ("Color Universal Design", 2008), which colour-blind readers can distinguish. Gray
# replaces their yellow, which is too light for a line on white. The markers help in prints without colour.
_COLOURS = ["#D55E00", "#0072B2", "#000000", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#808080", "#7F5F3F"]
_STYLES = tuple(map(MethodStyle, _COLOURS, "osD^vXP*h"))


def method_styles(methods: Sequence[str]) -> dict[str, MethodStyle]:
    """Return the style of each method. It depends on the registry's order, so it is the same in every plot.

    Names that are not in the registry follow in their order.
    """
    known = method_names()
    places = known + [name for name in methods if name not in known]
    return {name: _STYLES[places.index(name) % len(_STYLES)] for name in methods}


def png_bytes(figure: Figure, dpi: int) -> bytes:
    """Return a figure as a PNG file, on white whatever the user's matplotlibrc says."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Characters that the font lacks, as in a capture's name, appear as boxes; that needs no warning.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()
