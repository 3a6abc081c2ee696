"""Store the figures of the documentation's tables, and print the tables.

    python benchmarks/diligent_figures.py LIGHTS/results.json NOISE/results.json [--output docs/diligent.json]

The two files come from the commands in docs/measurements.md, over several numbers of lights and over several errors of
the light directions. tests/test_docs.py compares the tables of the documentation with the stored file.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

USUAL_LIGHTS = 10


def read_figures(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Return one record for each method, capture, number of lights and light noise, without repetitions."""
    figures: dict[tuple[Any, ...], dict[str, Any]] = {}
    for path in paths:
        for result in json.loads(path.read_text("utf-8"))["results"]:
            key = tuple(result[name] for name in ("light_noise_deg", "n_lights", "method", "capture"))
            figures[key] = {
                **{
                    name: result[name]
                    for name in ("method", "capture", "n_lights", "light_noise_deg", "trials")
                },
                # mae_deg has four decimals; rounding it again to two may differ from what evaluate prints.
                "mae_deg": round(fmean(result["maes_deg"]), 6),
                "std_deg": result["std_deg"],
            }
    return list(figures.values())


def table(figures: list[dict[str, Any]], name: str) -> str:
    """Return a Markdown table of methods and captures against "n_lights" or "light_noise_deg"."""
    other, usual = ("light_noise_deg", 0.0) if name == "n_lights" else ("n_lights", USUAL_LIGHTS)
    chosen = [figure for figure in figures if figure[other] == usual]
    columns = sorted({figure[name] for figure in chosen})
    lines = [" | ".join(["", name, *map(str, columns), ""]).strip(), "|---|" + "---:|" * len(columns)]
    for capture, method in dict.fromkeys((figure["capture"], figure["method"]) for figure in chosen):
        cells = {
            f[name]: f"{f['mae_deg']:.2f}" for f in chosen if (f["capture"], f["method"]) == (capture, method)
        }
        lines.append(f"| {capture}, `{method}` | " + " | ".join(cells.get(c, "-") for c in columns) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", nargs="+", type=Path, help="results.json of `splinecli evaluate`")
    parser.add_argument("--output", type=Path, default=Path("docs/diligent.json"))
    options = parser.parse_args(arguments)
    figures = read_figures(options.results)
    lines = ",\n".join(json.dumps(figure) for figure in figures)
    protocols = json.dumps([json.loads(path.read_text("utf-8"))["protocol"] for path in options.results])
    options.output.write_text(f'{{\n"protocols": {protocols},\n"results": [\n{lines}\n]\n}}\n', "utf-8")
    for name in ("n_lights", "light_noise_deg"):
        print(table(figures, name) + "\n")


if __name__ == "__main__":
    main()
