"""What the plots share: a fixed look for each method, and PNG by matplotlib without its global state."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from splinecli.methods import method_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Look(NamedTuple):
    """matplotlib's names of a colour and a marker."""

    colour: str
    marker: str


# The colours of Okabe and Ito ("Color Universal Design", 2008), told apart by the colour-blind; gray in place of
# their yellow, too light for a line on white. The markers help where a print has no colours.
_LOOKS = tuple(
    Look(colour, marker)
    for colour, marker in zip(
        ("#D55E00", "#0072B2", "#000000", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#808080"),
        "osD^vXP*",
        strict=True,
    )
)


def method_looks(methods: Sequence[str]) -> dict[str, Look]:
    """Each method's look: by its place in the registry, so the same in every plot; other names follow in order."""
    known = method_names()
    places = known + [name for name in methods if name not in known]
    return {name: _LOOKS[places.index(name) % len(_LOOKS)] for name in methods}


def png_bytes(figure: Figure, dpi: int) -> bytes:
    """The figure as PNG, on white whatever the user's matplotlibrc says."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A capture's name in a script that the font lacks is drawn as boxes; no reason to disturb the terminal.
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()
