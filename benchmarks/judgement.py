"""How the checks of a capture, and what is mended, behave on right and on faulty captures.

    python benchmarks/judgement.py render FOLDER [--right 150] [--faulty 300] [--seed S]
    python benchmarks/judgement.py measure FOLDER OUT [--method spline-net] [--part I/N]
    python benchmarks/judgement.py report OUT [OUT_BEFORE]

`render` makes capture folders as users have them: ten kinds of shapes, up to ten materials, five
arrangements of lights. `measure` runs `infer` on each, then again with every option that a warning
names as a remedy. `report` prints tables in Markdown, or two measurements side by side. All
continue where they were interrupted; --part I/N takes every N-th capture.
"""

import argparse
import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from judged_captures import FAULTS, make_capture, plan
from splinecli.errors import SplinecliError
from splinecli.pipeline.infer import infer_capture, make_method
from splinecli.pipeline.infer_options import InferOptions
from splinecli.records.capture_warnings import PROBABLY_WRONG

NO_CAUSE = {"low_confidence", "unknown_material"}  # warnings that accuse no input
DOUBTS = {"reading_undecided", "lights_uncertain"}  # warnings that state a doubt, but no cause
GAP, WORSE_DEG, HARMLESS_DEG = 25, 0.5, 0.2
"""An estimate is silently wrong if its expected share exceeds the true one by so many points."""
UNDO = {
    "estimated_intensities",
    "estimated_colours",
    "display_decoded",
    "lights_mended",
    "curve_mended",
    "images_aligned",
}
"""Warnings whose text says how to undo what was done, not how to mend."""

REMEDIES: dict[str, tuple[str, Callable[[str], dict[str, Any]]]] = {
    "transfer": (
        r"--transfer (srgb|linear|gamma:[\d.]*\d)(?: or (gamma:[\d.]*\d))?",
        lambda text: {"transfer": text},
    ),
    "distance": (
        r"--light-distance ([\d.]*\d) --object-width 1",
        lambda text: {"light_distance": float(text), "object_width": 1.0},
    ),
    "frame": (
        r"--light-frame ([\w,-]*\w)(?: or ([\w,-]*\w))?",
        lambda text: {"light_frame": text},
    ),
    "intensities": (r"--intensities (equal)", lambda text: {"intensities": text}),
    "refine": (r"--refine-lights()", lambda text: {"refine_lights": True}),
    "align": (r"--align()", lambda text: {"align": True}),
    "auto-mask": (r"--auto-mask()", lambda text: {"auto_mask": True}),
}
"""The options that warnings name, and what they set."""


def render_all(options: argparse.Namespace) -> None:
    part, parts = map(int, options.part.split("/"))
    meshes = sorted(options.shapes.glob("*.ply")) if options.shapes else []
    for number in range(part - 1, options.right + options.faulty, parts):
        kind, degree = plan(number, options.right)
        name = f"{number:03d}.{kind}.{degree}".replace(" ", "_")
        if not (options.folder / name / "truth.json").exists():
            make_capture(
                options.folder / name, number, options.right, options.seed, (meshes, options.merl)
            )


# Measure


def run(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Run `infer` and return what is kept of its report, or the text of its error."""
    with tempfile.TemporaryDirectory() as output:
        try:
            report = infer_capture(folder, options.replace(output=output), load=load)
        except SplinecliError as error:
            return {"exception": f"{type(error).__name__}: {error}"}
    errors = report["angular_error_deg"]
    warnings = [each | {"is_error": each["code"] in PROBABLY_WRONG} for each in report["warnings"]]
    return {
        "mae": errors["mean"],
        "median": errors["median"],
        "true_under_5": errors["under_5"],
        "expected_under_5": report["expected_under_5"],
        "warnings": warnings,
        "mended": report.get("mended") or [],
        "seconds": report["seconds"]["total"],
        "check_seconds": report["seconds"].get("check"),
    }


def as_given(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Run `infer` without mending: values that options give are kept."""
    return run(folder, options.replace(light_frame="x-right,y-up", transfer="linear"), load)


def named_remedies(warnings: Iterable[dict[str, Any]]) -> Iterator[tuple[str, str, list[str]]]:
    """Yield the code of each warning that names a remedy, the remedy, and its values, once each.

    Of two frames, the user knows which is right: they are one remedy. Two curves are two.
    """
    done = []
    for warning in warnings:
        if warning["code"] in UNDO:
            continue
        for name, (pattern, _) in REMEDIES.items():
            for found in re.finditer(pattern, warning["text"]):
                values = [value for value in found.groups() if value is not None]
                for group in [values] if name == "frame" else [[value] for value in values]:
                    if (name, group) not in done:
                        done.append((name, group))
                        yield warning["code"], name, group


def measure_one(folder: Path, options: InferOptions, load: Callable[[], Any]) -> dict[str, Any]:
    """Return what `infer` makes of a capture, as given, and after each remedy that it names."""
    result = {
        "truth": json.loads((folder / "truth.json").read_text()),
        **run(folder, options, load),
    }
    if result.get("mended"):
        result["as_given"] = as_given(folder, options, load)
    result["remedies"] = []
    for code, name, values in named_remedies(result.get("warnings", [])):
        tries = [run(folder, options.replace(**REMEDIES[name][1](value)), load) for value in values]
        best = min(tries, key=lambda each: each.get("mae", np.inf))
        result["remedies"].append({"code": code, "remedy": name, "values": values, **best})
    return result


def measure_all(options: argparse.Namespace) -> None:
    torch.set_num_threads(1)
    part, parts = map(int, options.part.split("/"))
    infer = InferOptions(method=options.method)
    load = cache(partial(make_method, infer))
    options.out.mkdir(parents=True, exist_ok=True)
    folders = sorted(path.parent for path in options.folder.glob("*/truth.json"))
    for folder in folders[part - 1 :: parts]:
        stored = options.out / f"{folder.name}.json"
        if not stored.exists():
            stored.write_text(json.dumps(measure_one(folder, infer, load)))


# Report


class Measured:
    """What was measured of one capture."""

    def __init__(self, name: str, result: dict[str, Any]) -> None:
        self.name, self.result, self.truth = name, result, result["truth"]
        self.kind: str = self.truth["kind"]
        self.warnings = result.get("warnings", [])
        self.codes = {each["code"] for each in self.warnings} | set(result.get("mended", []))
        self.errors = {each["code"] for each in self.warnings if each["is_error"]}
        if self.truth["degree"] == "unknown":  # the lamps do differ
            self.errors.discard("unequal_intensities")
        self.mended = bool(result.get("mended"))
        self.mae = result.get("mae", np.nan)
        self.mae_given = result.get("as_given", result).get("mae", np.nan)
        self.worse = bool(self.mae > self.mae_given + WORSE_DEG)
        expected, true = (result.get(f"{each}_under_5") for each in ("expected", "true"))
        self.gap = np.nan if expected is None else 100 * (expected - true)
        right_codes = FAULTS.get(self.kind, ((), ()))[1]
        self.named = not self.codes.isdisjoint(right_codes)
        self.silent = bool(self.gap > GAP) and not self.named
        self.sure = self.silent and self.codes.isdisjoint(DOUBTS)
        self.misnamed = bool(self.errors - NO_CAUSE) and not self.named


Table = dict[str, list[str]]  # rows of cells, the first one is the header


def share(captures: Sequence[Measured], chosen: Callable[[Measured], bool]) -> str:
    count = sum(map(chosen, captures))
    return f"{count} ({100 * count / max(len(captures), 1):.0f} %)" if count else "0"


def mean(values: Iterable[float]) -> str:
    known = [value for value in values if not np.isnan(value)]
    return f"{np.mean(known):.1f}" if known else "-"


def grouped(
    captures: Sequence[Measured], key: Callable[[Measured], str]
) -> dict[str, list[Measured]]:
    groups: dict[str, list[Measured]] = {}
    for each in captures:
        groups.setdefault(key(each), []).append(each)
    return {**groups, "all": list(captures)}


def right_table(captures: Sequence[Measured], key: str) -> Table:
    """Return how many right captures are accused, by a property of their scenes."""
    table = {key: ["n", "accused", "of what", "worse by mending", "MAE", "largest gap"]}
    for name, group in grouped(captures, lambda each: str(each.truth[key])).items():
        codes = Counter(code for each in group for code in sorted(each.errors))
        table[name] = [
            str(len(group)),
            share(group, lambda each: bool(each.errors)),
            ", ".join(f"{code} {count}" for code, count in codes.most_common()) or "-",
            share(group, lambda each: each.worse),
            mean(each.mae for each in group),
            f"{max((each.gap for each in group), default=0):.0f}",
        ]
    return table


def faulty_table(captures: Sequence[Measured], *, degrees: bool) -> Table:
    """Return what becomes of faulty captures, by the kind of their fault."""
    header = ["n", "named", "silent, wrong", "without a stated doubt", "misnamed", "mended"]
    header += ["MAE as given", "MAE", "worse"]
    table = {"fault": header}
    groups = grouped(
        captures,
        lambda each: f"{each.kind} {each.truth['degree']}" if degrees else each.kind,
    )
    for name, group in groups.items():
        table[name] = [
            str(len(group)),
            share(group, lambda each: each.named),
            share(group, lambda each: each.silent),
            share(group, lambda each: each.sure),
            share(group, lambda each: each.misnamed),
            share(group, lambda each: each.mended),
            mean(each.mae_given for each in group),
            mean(each.mae for each in group),
            share(group, lambda each: each.worse),
        ]
    return table


def remedy_table(captures: Sequence[Measured]) -> Table:
    """Return how many of the remedies that warnings name lower the error, or leave it."""
    found = [(each, remedy) for each in captures for remedy in each.result["remedies"]]
    table = {"remedy": ["named", "help or harm not", "harm", "MAE", "MAE after", "harm right"]}
    names = sorted({f"{remedy['remedy']} ({remedy['code']})" for _, remedy in found})
    for name in [*names, "all"]:
        maes = np.array(
            [
                (each.mae, remedy.get("mae", np.nan), each.kind == "right")
                for each, remedy in found
                if name in ("all", f"{remedy['remedy']} ({remedy['code']})")
            ]
        ).reshape(-1, 3)
        harms = ~(maes[:, 1] <= maes[:, 0] + HARMLESS_DEG)
        table[name] = [
            str(len(maes)),
            f"{(~harms).sum()} ({100 * (~harms).mean() if len(maes) else 0:.0f} %)",
            str(harms.sum()),
            mean(maes[:, 0]),
            mean(maes[:, 1]),
            str(int(harms @ maes[:, 2])),
        ]
    return table


def gap_table(captures: Sequence[Measured], count: int = 10) -> Table:
    """Return the captures that are expected to be better than they are by most."""
    table = {"capture": ["object", "lights", "gap", "MAE", "warnings"]}
    known = [each for each in captures if not np.isnan(each.gap)]
    for each in sorted(known, key=lambda each: -each.gap)[:count]:
        truth = each.truth
        table[each.name] = [
            f"{truth['shape']}, {truth['material']}",
            f"{truth['n_lights']}, {truth['arrangement']}",
            f"{each.gap:.0f}",
            f"{each.mae:.1f}",
            ", ".join(sorted(each.codes)) or "-",
        ]
    return table


def tables(out: Path, *, degrees: bool) -> dict[str, Table]:
    """Return the tables of a folder of measurements by their titles."""
    files = sorted(out.glob("*.json"))
    captures = [Measured(path.stem, json.loads(path.read_text())) for path in files]
    right = [each for each in captures if each.kind == "right"]
    faulty = [each for each in captures if each.kind != "right"]
    refused = {
        each.name: [str(each.result["exception"])] for each in captures if each.mae != each.mae
    }
    return {
        "Right captures, by material": right_table(right, "material"),
        "Right captures, by arrangement": right_table(right, "arrangement"),
        "Faulty captures": faulty_table(faulty, degrees=degrees),
        "Remedies that warnings name": remedy_table(captures),
        "Largest gaps between expected and true share, right captures": gap_table(right),
        "Largest gaps, faulty captures without a warning of the cause": gap_table(
            [each for each in faulty if not each.named], 20
        ),
        "Refused": {"capture": ["error"], **refused},
    }


def side_by_side(before: Table, now: Table) -> Table:
    """Return one table with the cells of both where they differ."""
    joint = {}
    for name in dict.fromkeys((*now, *before)):
        cells = [table.get(name, ["-"] * len(next(iter(now.values())))) for table in (before, now)]
        joint[name] = [
            one if one == other else f"{one} → {other}" for one, other in zip(*cells, strict=True)
        ]
    return joint


def report(options: argparse.Namespace) -> None:
    found = tables(options.out, degrees=options.degrees)
    if options.before is not None:
        before = tables(options.before, degrees=options.degrees)
        found = {title: side_by_side(before[title], table) for title, table in found.items()}
    for title, table in found.items():
        print(f"## {title}\n")
        for number, (name, cells) in enumerate(table.items()):
            print(f"| {name} |", " | ".join(cells), "|")
            if not number:
                print("|---|" + "---|" * len(cells))
        print()


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    each = commands.add_parser("render")
    each.add_argument("folder", type=Path)
    each.add_argument("--right", type=int, default=150)
    each.add_argument("--faulty", type=int, default=300)
    each.add_argument("--seed", type=int, default=1)
    each.add_argument("--shapes", type=Path, help="folder of meshes (*.ply), another kind of shape")
    each.add_argument("--merl", type=Path, help="merl_nbrdf.npz, measured materials")
    each.add_argument("--part", default="1/1")
    each.set_defaults(run=render_all)
    each = commands.add_parser("measure")
    each.add_argument("folder", type=Path)
    each.add_argument("out", type=Path)
    each.add_argument("--method", default="spline-net")
    each.add_argument("--part", default="1/1")
    each.set_defaults(run=measure_all)
    each = commands.add_parser("report")
    each.add_argument("out", type=Path)
    each.add_argument("before", type=Path, nargs="?")
    each.add_argument("--degrees", action="store_true", help="a row for each degree of a fault")
    each.set_defaults(run=report)
    options = parser.parse_args(arguments)
    options.run(options)


if __name__ == "__main__":
    main()
