"""Fill the tables of the documentation from docs/figures.json.

    python benchmarks/figure_tables.py

A table stands between `<!-- figures: NAME -->` and `<!-- end -->`; TABLES says what it shows. Below
it stand the version and the weights that it was measured with. all_figures.py measures.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs/figures.json"
PAGES = ("README.md", "docs/measurements.md", "docs/robustness.md")

Measured = dict[str, dict[str, Any]]
"""By name of the measurement: {"version", "weights", "machine", "rows": {row: {column: number or
text}}}.
"""

FITS = ("ls", "ls-trimmed", "l1", "iw12", "st14", "ia14")
NETWORKS = ("spline-net-pixelwise", "spline-net")
RESTORED = "spline-net, restored"
"""The default method on images as `infer` reads them. In the other rows, they are read as stored.
"""
OBJECTS = {"Ball": "ballPNG", "Cat": "catPNG", "Reading": "readingPNG"}
STATUES = {
    "bust_diffuse": "bust, matte and glossy",
    "bust_specular": "bust, specular",
    "maria_specular": "draped figure",
}
CAMERAS = (
    "as rendered",
    *(f"blurred, sigma {sigma}" for sigma in (0.5, 0.7, 1.0)),
    "Bayer pattern, interpolated",
)
RANGES = (90, 50, 20, 10, 5)
SLANTS = {"below 60 degrees": (0, 60), "60 to 75 degrees": (60, 75), "above 75 degrees": (75, 91)}
SYNTH = [f"{shape} {material}" for shape in ("sphere", "relief", "bowl") for material in "SM"]
PUBLISHED = "published"
"""Figures of papers, for ten lights."""
SCENES = [
    f"{look} {shape}" for shape in ("sphere", "relief", "plane") for look in ("matte", "glossy")
]
DEPTHS = ("Bear", "Cat", "Reading")
FLAT_THINGS = [
    f"{shape}, {lights}"
    for shape in ("plate", "coin", "inscription")
    for lights in ("ring", "dome", "handheld")
]
LIGHTS = (4, 10, 20, 96)
NOISE_DEG = (2.0, 4.0, 8.0)
MIRROR_BALLS = ("University of Washington", "PSBox, mean of two", "examples/mirror_ball")
WRONG_FILES = (
    "right",
    "x negated",
    "y negated",
    "x and y exchanged",
    "turned by 90 degrees",
    "x and y negated",
    "shifted by one",
    "reversed",
    "shuffled",
    "two exchanged",
)
LIGHT_FILE_CAPTURES = ("photographs", "diffuse, specular", "metal")
EXPOSED = ("well exposed", "as stored", "left out", "restored")
INTENSITIES = ("measured", "equal", "estimated")
PICTURES = {"material": "material", "Lambertian": "lambertian", "nearest photograph": "nearest"}
SPEEDS = (
    "layers of the paper, float32",
    "spline-net-pixelwise, float32",
    "spline-net-pixelwise, bfloat16",
)
SIZES = ("0.5", "2", "6", "24")


@dataclass(frozen=True)
class Table:
    """One table of the documentation: which cells of which measurements it shows, and how.

    Args:
        sources: measurements, whose cells are put together.
        rows, columns: label -> key in the measurement.
        form: how a number is written.
    """

    sources: tuple[str, ...]
    head: str
    rows: Mapping[str, str]
    columns: Mapping[str, str]
    form: str = "{:.2f}"

    def text(self, measured: Measured, weights: str) -> str:
        """Return the Markdown of the table, and which version and weights it was measured with."""
        sources = [source for source in self.sources if source in measured]
        known: dict[str, dict[str, Any]] = {}
        for source in sources:
            for row, cells in measured[source]["rows"].items():
                known.setdefault(row, {}).update(cells)
        if not known.keys() & set(self.rows.values()):
            return "(not measured with these weights)"
        lines = [
            "| " + " | ".join((self.head, *self.columns)) + " |",
            "|---|" + "---:|" * len(self.columns),
        ]
        for label, row in self.rows.items():
            if row not in known:
                continue  # not measured at all
            values = [known[row].get(column, "-") for column in self.columns.values()]
            shown = (
                value if isinstance(value, str) else self.form.format(value) for value in values
            )
            lines.append("| " + " | ".join((label, *shown)) + " |")
        captions = dict.fromkeys(
            caption(measured[source], weights) for source in sources if source != PUBLISHED
        )
        return "\n".join(lines) + f"\n\n{' '.join(captions)}"


class Headline:
    """The sentence at the top of the README: our errors beside the best published ones."""

    def text(self, measured: Measured, weights: str) -> str:
        """Return the sentence, or a mark if the shipped weights were not measured."""
        ours = measured.get("lights-10", {"weights": ""})
        if ours["weights"] != weights:
            return "(not measured with these weights)"
        published = measured[PUBLISHED]["rows"].values()
        keys = [f"{label} 10" for label in OBJECTS]
        best = [min(cells[key] for cells in published if key in cells) for key in keys]
        errors = [ours["rows"]["spline-net"][key] for key in keys]
        return (
            f"With ten lights, the mean angular errors on {listed(OBJECTS)} of the DiLiGenT"
            f" benchmark are\n{numbers(errors)} degrees; the best of the published methods in the"
            f" [table](#accuracy) reach {numbers(best)}."
        )


def numbers(values: Iterable[float]) -> str:
    return listed([f"{value:.1f}" for value in values])


def listed(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} and {last}"


def caption(measurement: Mapping[str, Any], weights: str) -> str:
    """Return which version, weights and machine a measurement is of. Other weights than the shipped
    are marked.
    """
    used = measurement["weights"]
    parts = [f"version {measurement['version']}"]
    parts += [f"weights {used}"] if used else []
    parts += [measurement["machine"]] if measurement["machine"] else []
    if used in (None, weights):
        return f"({', '.join(parts)})"
    return f"(**not measured with these weights**: {', '.join(parts)})"


def same(keys: Iterable[str]) -> dict[str, str]:
    return {key: key for key in keys}


def code(keys: Iterable[str]) -> dict[str, str]:
    return {f"`{key}`": key for key in keys}


TABLES: dict[str, Table | Headline] = {
    "headline": Headline(),
    "ten-lights": Table(
        ("lights-10", PUBLISHED),
        "method",
        {
            "least squares": "LS",
            "LMPS": "LMPS",
            "SPLINE-Net": "SPLINE-Net",
            "GPS-Net": "GPS-Net",
            "PX-Net": "PX-Net",
            "PS-Transformer": "PS-Transformer",
            "here: least squares (`ls`)": "ls",
            "here: without refinement (`spline-net-pixelwise`)": "spline-net-pixelwise",
            "**here: `spline-net`, the default**": "spline-net",
            "here: the same, lens blur removed from the images": RESTORED,
        },
        {**{label: f"{label} 10" for label in OBJECTS}, "all ten objects": "all 10"},
    ),
    **{
        f"lights-{label.lower()}": Table(
            (*(f"lights-{count}" for count in LIGHTS), "cnn-ps"),
            f"{label}, lights",
            {**code((*FITS, "cnn-ps", *NETWORKS)), "`spline-net`, lens blur removed": RESTORED},
            {str(count): f"{label} {count}" for count in LIGHTS},
        )
        for label in OBJECTS
    },
    "noise": Table(
        ("noise",),
        "sigma in degrees",
        code((*FITS, *NETWORKS)),
        {f"{deg:g}": f"{deg:g}" for deg in (0, *NOISE_DEG)},
    ),
    "refined-lights": Table(
        ("refined-lights",),
        "sigma in degrees",
        code(("iw12", *NETWORKS)),
        {f"{deg:g}, {how}": f"{deg:g} {how}" for deg in (0, 4, 8) for how in ("given", "refined")},
    ),
    "eight-bits": Table(
        ("eight-bits",),
        "images",
        same(("16 bits", "rounded to 8 bits", "cut to 8 bits")),
        {
            f"{label}, {name}": f"{label} {name}"
            for label in OBJECTS
            for name in ("pixelwise", "refined")
        },
    ),
    "eight-bits-range": Table(
        ("eight-bits-range",),
        "images",
        same(("rounded to 8 bits", "cut to 8 bits")),
        same([f"{share} %" for share in RANGES]),
        "{:.1f}",
    ),
    "optics": Table(
        ("optics",),
        "images",
        same(CAMERAS),
        {
            f"{words}, {name}": f"{label} {name}"
            for label, words in STATUES.items()
            for name in ("pixelwise", "refined")
        },
    ),
    "slants": Table(
        ("slants",),
        "object",
        same(OBJECTS),
        same([f"{slant}, {name}" for slant in SLANTS for name in ("pixelwise", "refined")]),
        "{:.1f}",
    ),
    "overexposed": Table(("photographs",), "object", same((*OBJECTS, *SYNTH)), same(EXPOSED)),
    "intensities": Table(("photographs",), "object", same((*OBJECTS, *SYNTH)), same(INTENSITIES)),
    "synth": Table(("synth",), "object", same(SYNTH), code(("ls", "iw12", *NETWORKS))),
    "confidence": Table(
        ("confidence",),
        "object",
        same((*OBJECTS, *SYNTH)),
        same(("expected", "found", "worst tenth")),
        "{:.0f} %",
    ),
    "wrong-lights": Table(
        ("wrong-lights",), "light file", same(WRONG_FILES), same(LIGHT_FILE_CAPTURES)
    ),
    "near-lamps": Table(
        ("near-lamps",),
        "object",
        same(SCENES),
        same(("distant", *(f"{width}: {how}" for width in (2, 4, 8) for how in ("no", "yes")))),
    ),
    "calibration": Table(
        ("calibration",), "ball", same(MIRROR_BALLS), same(("mean", "largest")), "{:.1f}"
    ),
    "depths": Table(
        ("depths",),
        "object",
        same(DEPTHS),
        {"true normals": "true normals", **code(("ls", *NETWORKS))},
    ),
    "flat-things": Table(
        ("flat-things",),
        "object, lights",
        same(FLAT_THINGS),
        {
            "distant": "distant",
            "unequal": "unequal",
            "unequal, levelled": "unequal, levelled",
            "near": "near",
            "near, levelled": "near, levelled",
            "near, positions given": "near, given",
        },
        "{:.0f} %",
    ),
    "relighting": Table(("relighting",), "object", same(OBJECTS), PICTURES, "{:.1f}"),
    "distilled": Table(("distilled",), "object", same(OBJECTS), same(("network", "distilled"))),
    "speed": Table(("speed",), "network", same(SPEEDS), same(("pixels/s", "relative")), "{:,.0f}"),
    "sizes": Table(
        ("sizes",),
        "megapixels",
        same(SIZES),
        same(("processor s", "memory MiB", "processor s a megapixel")),
        "{:,.0f}",
    ),
}


def fill(text: str, measured: Measured, weights: str) -> str:
    """Return the text of a page with its marked tables written anew."""

    def table(found: re.Match[str]) -> str:
        return f"{found[1]}\n{TABLES[found[2]].text(measured, weights)}\n{found[3]}"

    return re.sub(r"(<!-- figures: ([\w-]+) -->)\n.*?(<!-- end -->)", table, text, flags=re.DOTALL)


def shipped_weights() -> str:
    """Return the first eight digits of the SHA-256 of the weights of spline-net."""
    index = json.loads((ROOT / "src/splinecli/assets/weights.json").read_text("utf-8"))
    return str(index["spline-net"]["sha256"])[:8]


def main(arguments: Sequence[str] | None = None) -> None:
    measured = json.loads(FIGURES.read_text("utf-8"))
    for name in PAGES:
        page = ROOT / name
        page.write_text(fill(page.read_text("utf-8"), measured, shipped_weights()), "utf-8")
        print(f"{name}: {page.read_text('utf-8').count('<!-- figures: ')} tables")


if __name__ == "__main__":
    main()
