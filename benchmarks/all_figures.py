"""Measure every figure of the documentation with the shipped weights, and fill its tables.

    python benchmarks/all_figures.py DATA [--results runs/figures] [--only NAME ...] [--again]

DATA has the folders DiLiGenT/pmsData, depth, synth/L17, statues, uw, psbox and merl_nbrdf. All of
it takes hours on two cores. Each row is stored in docs/figures.json when it is done, with the
version and the weights. Rows of the shipped weights, and of fits, which earlier versions may have
measured, are not measured again. A stopped evaluation goes on in --results. --only names
measurements, or a row of one, as in noise/iw12. "speed" and "sizes" run only if they are named,
because they need a quiet machine.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

import figure_tables as tables
from figure_tables import FITS, NETWORKS, OBJECTS, RESTORED, SYNTH, Measured
from splinecli import __version__

if TYPE_CHECKING:
    from splinecli.estimate.inference import NormalEstimate

Cells = dict[str, float | str]
Rows = dict[str, Callable[[], Cells]]
"""What measures each row."""

# do not depend on the weights of spline-net
WITHOUT_WEIGHTS = ("calibration", "wrong-lights", "cnn-ps")
NEED_QUIET = ("speed", "sizes")
ONE_DRAW = {"trials": 1, "seed": 3, "n_lights": (10,), "max_pixels": None}


@dataclass(frozen=True)
class Bench:
    """The captures, and a folder that keeps unfinished evaluations."""

    data: Path
    results: Path
    trials: int = 10

    @property
    def objects(self) -> dict[str, Path]:
        return {label: self.data / "DiLiGenT/pmsData" / name for label, name in OBJECTS.items()}

    @property
    def synth(self) -> dict[str, Path]:
        return {name: self.data / "synth/L17" / name.replace(" ", "_") for name in SYNTH}

    @property
    def statues(self) -> dict[str, Path]:
        return {name: self.data / "statues" / name for name in tables.STATUES}

    def errors(
        self, folder: str, captures: Mapping[str, Path], method: str, **options: Any
    ) -> list[Cells]:
        """Return {"label", "n_lights", "light_noise_deg", "mae_deg"} of each evaluation of a
        method.
        """
        from splinecli.pipeline.evaluate import evaluate_captures
        from splinecli.pipeline.options import EvaluateOptions

        chosen = {"trials": self.trials, "max_pixels": 2000, "as_stored": True, **options}
        chosen |= {
            "methods": (method,),
            "output": str(self.results / folder),
            "datasets": tuple(captures.values()),
        }
        document = evaluate_captures(EvaluateOptions(**chosen)).document
        labels = {path.name: label for label, path in captures.items()}
        # mae_deg has four decimals; rounding it again may differ from what evaluate prints.
        return [
            {
                **result,
                "label": labels[result["capture"]],
                "mae_deg": round(fmean(result["maes_deg"]), 4),
            }
            for result in document["results"]
        ]

    def lights(self, row: str, count: int) -> Cells:
        restored = row == RESTORED
        found = self.errors(
            "lights-restored" if restored else "lights",
            self.objects,
            "spline-net" if restored else row,
            n_lights=(None if count == 96 else count,),
            as_stored=not restored,
        )
        return {f"{r['label']} {count}": r["mae_deg"] for r in found}

    def noise(self, method: str) -> Cells:
        found = self.errors("lights", self.objects, method, n_lights=(10,))
        found += self.errors("noise", self.objects, method, light_noise_deg=tables.NOISE_DEG)
        return means(found, lambda r: f"{r['light_noise_deg']:g}")

    def refined_lights(self, method: str) -> Cells:
        found = self.errors(
            "refined", self.objects, method, light_noise_deg=(0.0, 4.0, 8.0), refine_lights=True
        )
        refined, given = means(found, lambda r: f"{r['light_noise_deg']:g}"), self.noise(method)
        return {f"{deg} given": given[deg] for deg in refined} | {
            f"{deg} refined": error for deg, error in refined.items()
        }

    def eight_bits(self, convert: Callable[[Any], Any], name: str) -> Cells:
        """Score copies of the captures whose images have other bits, on all pixels under two
        draws.
        """
        copies = {
            label: rewritten(path, self.results / name, convert)
            for label, path in self.objects.items()
        }
        cells: Cells = {}
        for method, word in zip(NETWORKS, ("pixelwise", "refined"), strict=True):
            found = self.errors(f"{name} errors", copies, method, trials=2, max_pixels=None)
            cells |= {f"{r['label']} {word}": r["mae_deg"] for r in found}
        return cells

    def range_of_8_bits(self, convert: Callable[[Any], Any]) -> Cells:
        """Return the largest increase of an error if the brightest hundredth of the pixels of a
        capture's brightest image is at shares of the range of 8 bits, on all pixels under one draw
        of ten lights.
        """
        captures = {**self.objects, **self.synth, **self.statues}
        brightest = {label: brightness(path) for label, path in captures.items()}

        def errors(folder: str, captures: Mapping[str, Path]) -> dict[str, float]:
            found: list[dict[str, Any]] = self.errors(folder, captures, "spline-net", **ONE_DRAW)
            return {each["label"]: each["mae_deg"] for each in found}

        cells: Cells = {}
        given = errors("given", captures)
        for share in tables.RANGES:
            name = f"{convert.__name__} at {share}"
            copies = {
                label: rewritten(
                    path, self.results / name, partial(scaled, share / brightest[label], convert)
                )
                for label, path in captures.items()
            }
            found = errors(f"{name} errors", copies)
            cells[f"{share} %"] = round(max(found[label] - given[label] for label in found), 4)
        return cells

    def optics(self, convert: Callable[[Any], Any], name: str) -> Cells:
        """Score the statues after a camera, on all pixels under one draw of ten lights, restored as
        `infer` does.
        """
        copies = {
            label: rewritten(path, self.results / name, convert)
            for label, path in self.statues.items()
        }
        cells: Cells = {}
        for method, word in zip(NETWORKS, ("pixelwise", "refined"), strict=True):
            found = self.errors(f"{name} errors", copies, method, **ONE_DRAW, as_stored=False)
            cells |= {f"{r['label']} {word}": r["mae_deg"] for r in found}
        return cells

    def relighting(self, label: str) -> Cells:
        """Compare renderings under the lights that a draw of ten leaves out with the photographs,
        in decibels.
        """
        from splinecli.pipeline.evaluate import evaluate_captures
        from splinecli.pipeline.options import EvaluateOptions

        output = str(self.results / "relighting" / label)
        options = EvaluateOptions(
            datasets=(self.objects[label],),
            n_lights=(10,),
            trials=1,
            max_pixels=2000,
            relight=True,
            output=output,
        )
        [found] = evaluate_captures(options).document["relighting"]
        return {kind: found[kind]["psnr_db"] for kind in tables.PICTURES.values()}

    def depths(self, label: str) -> Cells:
        import surfaces

        errors = surfaces.measured_depths(self.data, label, 2)
        return {name: round(error, 4) for name, error in errors.items()}

    def flat_things(self) -> dict[str, Cells]:
        import surfaces

        rows = surfaces.flat_things("spline-net", 64)
        return {
            scene: {name: round(error, 4) for name, error in cells.items()} for scene, cells in rows
        }

    def slants(self, label: str) -> Cells:
        """Mean errors of the pixels of each range of true slants, under ten lights."""
        cells: Cells = {}
        for method, word in zip(NETWORKS, ("pixelwise", "refined"), strict=True):
            found: dict[str, list[float]] = {}
            for estimate in self.estimates(self.objects[label], method, trials=2):
                truth, errors = estimate.capture.ground_truth, estimate.error_map_deg
                assert truth is not None and errors is not None
                slant = np.degrees(np.arccos(np.clip(truth[..., 2], -1, 1)))
                for name, (low, high) in tables.SLANTS.items():
                    within = (slant >= low) & (slant < high)
                    found.setdefault(name, []).append(float(np.nanmean(errors[within])))
            cells |= {f"{name}, {word}": round(fmean(values), 4) for name, values in found.items()}
        return cells

    def estimates(self, folder: Path, method: str, *, trials: int) -> Iterator[NormalEstimate]:
        """Yield the estimates of a capture under draws of ten lights."""
        from splinecli.capture import open_capture
        from splinecli.estimate.inference import estimate_normals
        from splinecli.estimate.methods import make_estimator
        from splinecli.lights.draws import draw_lights
        from splinecli.recipe import RecipeOptions, prepare_capture

        stored = RecipeOptions(as_stored=True)
        source, estimator = open_capture(folder), make_estimator(method)
        for draw in draw_lights(source.light_directions, 10, trials=trials, seed=0):
            yield estimate_normals(prepare_capture(source, draw, stored), estimator)

    def synth_errors(self, capture: str) -> Cells:
        return {
            method: self.errors("synth", {capture: self.synth[capture]}, method)[0]["mae_deg"]
            for method in ("ls", "iw12", *NETWORKS)
        }

    def photographs(self, capture: str) -> Cells:
        """Mean errors of overexposed pixels, and of all under intensities that no file gives."""
        import photographs
        from splinecli.estimate.networks.weights import resolve_weights

        network = resolve_weights("spline-net").network
        draws = photographs.read_draws({**self.objects, **self.synth}[capture], 2, 1500)
        exposed = np.mean([photographs.overexposed(network, draw) for draw in draws], axis=0)
        unknown = np.mean(
            [photographs.without_intensities(network, draw)[1] for draw in draws], axis=0
        )
        return {
            name: round(float(value), 4)
            for name, value in zip(
                (*tables.EXPOSED, *tables.INTENSITIES), (*exposed, *unknown[2:]), strict=True
            )
            if np.isfinite(value)  # without its saturated values, a pixel may have too few
        }

    def confidence(self, capture: str) -> Cells:
        """In percent: pixels within 5 degrees as expected and found; the worst tenth's share in the
        least sure.
        """
        shares = []
        for estimate in self.estimates(
            {**self.objects, **self.synth}[capture], "spline-net", trials=self.trials
        ):
            assert estimate.errors is not None and estimate.error_map_deg is not None
            assert estimate.confidence_map is not None and estimate.expected_under_5 is not None
            known = np.isfinite(estimate.error_map_deg)
            errors, sure = estimate.error_map_deg[known], estimate.confidence_map[known]
            worst = errors > np.quantile(errors, 0.9)
            caught = (worst & (sure <= np.quantile(sure, 0.1))).sum() / worst.sum()
            shares.append((estimate.expected_under_5, estimate.errors.under_5, caught))
        return {
            name: round(100 * float(share), 2)
            for name, share in zip(
                ("expected", "found", "worst tenth"), np.mean(shares, axis=0), strict=True
            )
        }

    def wrong_lights(self) -> dict[str, Cells]:
        import wrong_lights

        captures = [
            *self.objects.values(),
            *(self.data / name for name in ("uw/gray", "uw/horse", "psbox")),
        ]
        counts = wrong_lights.count(captures, 12, draws=4, n_lights=12)
        return {kind: wrong_lights.grouped(kind, found) for kind, found in counts.items()}

    def near_lamps(self) -> dict[str, Cells]:
        import near_lamps

        rows = near_lamps.measure("spline-net-pixelwise", 40, (2, 4, 8), ())
        return {
            scene: {name: round(error, 4) for name, (error, _) in cells} for scene, cells in rows
        }

    def calibration(self) -> dict[str, Cells]:
        from splinecli.capture.light_files import read_light_directions
        from splinecli.lights.calibration.balls import (
            calibrate_ball,
            combine_balls,
            find_ball_files,
        )
        from splinecli.maths.normals import angle_between_deg

        probes = [self.data / f"psbox/LightProbe-{number}" for number in (1, 2)]
        examples = tables.ROOT / "examples"
        cases = (
            ([self.data / "uw/chrome"], self.data / "uw/gray/light_directions.txt"),
            (probes, self.data / "psbox/light_directions.txt"),
            ([examples / "mirror_ball"], examples / "medallion/light_directions.txt"),
        )
        rows: dict[str, Cells] = {}
        for name, (balls, lights) in zip(tables.MIRROR_BALLS, cases, strict=True):
            found = combine_balls(
                [calibrate_ball(find_ball_files(ball)) for ball in balls]
            ).directions
            angles = angle_between_deg(read_light_directions(lights, len(found)), found)
            rows[name] = {
                "mean": round(float(angles.mean()), 4),
                "largest": round(float(angles.max()), 4),
            }
        return rows

    def distilled(self, label: str) -> Cells:
        """Mean errors of the whole of `infer` under ten lights: every pixel by the network, or most
        by a small one.
        """
        from splinecli.pipeline.infer import infer_capture
        from splinecli.pipeline.infer_options import InferOptions

        cells: Cells = {}
        for name, distils in (("network", False), ("distilled", True)):
            options = InferOptions(n_lights=10, distil=distils, output=str(self.results / name))
            cells[name] = round(
                infer_capture(self.objects[label], options)["angular_error_deg"]["mean"], 4
            )
        return cells

    def speed(self) -> dict[str, Cells]:
        import inference_speed

        speeds = inference_speed.speeds(16_384, 3)
        paper = speeds["layers of the paper, float32"]
        return {
            name: {"pixels/s": speed, "relative": speed / paper} for name, speed in speeds.items()
        }

    def size(self, megapixels: str) -> Cells:
        import large_captures

        seconds, report = large_captures.measure(float(megapixels), "spline-net", "png,npy")
        names = ("processor s", "memory MiB", "processor s a megapixel")
        return dict(
            zip(
                names,
                (seconds, report["peak_memory_mib"], seconds / float(megapixels)),
                strict=True,
            )
        )

    def measurements(self) -> dict[str, Rows]:
        """Return what measures each row of each measurement."""
        captures = (*OBJECTS, *SYNTH)
        cameras = {"as rendered": lambda image: image, "Bayer pattern, interpolated": mosaic}
        cameras |= {f"blurred, sigma {sigma}": partial(blur, sigma) for sigma in (0.5, 0.7, 1.0)}
        bits = {"16 bits": lambda image: image, "rounded to 8 bits": rounded, "cut to 8 bits": cut}
        return {
            "calibration": each(self.calibration, tables.MIRROR_BALLS),
            **{
                f"lights-{count}": {
                    m: partial(self.lights, m, count) for m in (*FITS, *NETWORKS, RESTORED)
                }
                for count in (10, 96, 4, 20)
            },
            "cnn-ps": {"cnn-ps": partial(self.lights, "cnn-ps", 10)},
            "synth": {name: partial(self.synth_errors, name) for name in SYNTH},
            "noise": {m: partial(self.noise, m) for m in (*FITS, *NETWORKS)},
            "eight-bits": {
                name: partial(self.eight_bits, convert, name) for name, convert in bits.items()
            },
            "eight-bits-range": {
                "rounded to 8 bits": partial(self.range_of_8_bits, rounded),
                "cut to 8 bits": partial(self.range_of_8_bits, cut),
            },
            "optics": {
                name: partial(self.optics, camera, name) for name, camera in cameras.items()
            },
            "slants": {label: partial(self.slants, label) for label in OBJECTS},
            "photographs": {name: partial(self.photographs, name) for name in captures},
            "confidence": {name: partial(self.confidence, name) for name in captures},
            "refined-lights": {m: partial(self.refined_lights, m) for m in ("iw12", *NETWORKS)},
            "depths": {label: partial(self.depths, label) for label in tables.DEPTHS},
            "flat-things": each(self.flat_things, tables.FLAT_THINGS),
            "relighting": {label: partial(self.relighting, label) for label in OBJECTS},
            "distilled": {label: partial(self.distilled, label) for label in OBJECTS},
            "wrong-lights": each(self.wrong_lights, tables.WRONG_FILES),
            "near-lamps": each(self.near_lamps, tables.SCENES),
            "speed": each(self.speed, tables.SPEEDS),
            "sizes": {size: partial(self.size, size) for size in tables.SIZES},
        }


def each(measure: Callable[[], dict[str, Cells]], names: Sequence[str]) -> Rows:
    """Return rows that come from one measurement, which is made once."""
    once = cache(measure)
    return {name: lambda name=name: once()[name] for name in names}


def means(
    results: Sequence[Mapping[str, Any]], column: Callable[[Mapping[str, Any]], str]
) -> Cells:
    """Return the mean error over the captures of each column."""
    values: dict[str, list[float]] = {}
    for result in results:
        values.setdefault(column(result), []).append(result["mae_deg"])
    return {name: round(fmean(errors), 4) for name, errors in values.items()}


def images_of(folder: Path) -> list[Path]:
    named = folder / "filenames.txt"
    names = named.read_text("utf-8").split() if named.exists() else None
    return [folder / name for name in names] if names else list(folder.glob("0*.png"))


def brightness(folder: Path) -> float:
    """Return the 99th percentile of the object's brightest image, in percent of the range."""
    import cv2

    inside = cv2.imread(str(folder / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    images = (cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in images_of(folder))
    return max(float(np.quantile(image[inside], 0.99)) for image in images) / 655.35


def scaled(factor: float, convert: Callable[[Any], Any], image: Any) -> Any:
    return convert(factor * image)


def rounded(image: Any) -> Any:
    return np.clip(np.round(image / 257), 0, 255).astype("u1")


def cut(image: Any) -> Any:
    return np.clip(image // 256, 0, 255).astype("u1")


def rewritten(folder: Path, place: Path, convert: Callable[[Any], Any]) -> Path:
    """Return a copy of a capture in `place` with converted images."""
    import cv2

    copy = place / folder.name
    if not copy.is_dir():
        draft = place / f"{folder.name}.part"
        shutil.copytree(folder, draft, dirs_exist_ok=True)
        for path in images_of(folder):
            cv2.imwrite(
                str(draft / path.name), convert(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            )
        draft.rename(copy)
    return copy


def blur(sigma: float, image: Any) -> Any:
    """Return a gray image behind a lens that blurs it."""
    import cv2

    return cv2.GaussianBlur(image, (0, 0), sigma)


def mosaic(image: Any) -> Any:
    """Return a gray image from a sensor with a Bayer pattern that is interpolated."""
    import cv2

    return cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BayerRG2RGB), cv2.COLOR_RGB2GRAY)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--results", type=Path, default=tables.ROOT / "runs/figures")
    parser.add_argument("--figures", type=Path, default=tables.FIGURES)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--only", nargs="+", default=[])
    parser.add_argument("--again", action="store_true", help="measure rows again that are done")
    parser.add_argument(
        "--machine", default="unnamed machine", help="as in 'two cores of an AMD EPYC'"
    )
    options = parser.parse_args(arguments)
    measured: Measured = (
        json.loads(options.figures.read_text("utf-8")) if options.figures.exists() else {}
    )
    measurements = Bench(options.data, options.results, options.trials).measurements()
    weights = tables.shipped_weights()
    for chosen in options.only or [name for name in measurements if name not in NEED_QUIET]:
        name, _, wanted = chosen.partition("/")
        used = None if name in WITHOUT_WEIGHTS else weights
        stored = measured.get(name, {})
        if options.again or stored.get("weights") != used:
            # Fits do not depend on the weights.
            kept = {} if options.again else stored.get("rows", {})
            stored = {"rows": {row: cells for row, cells in kept.items() if row in FITS}}
        machine = options.machine if name in NEED_QUIET else ""
        measured[name] = {
            "version": __version__,
            "weights": used,
            "machine": machine,
            "rows": {},
            **stored,
        }
        for row, measure in measurements[name].items():
            if row in measured[name]["rows"] or wanted not in ("", row):
                continue
            measured[name]["rows"][row] = measure()
            measured[name]["version"] = __version__
            options.figures.write_text(json.dumps(measured, indent=1) + "\n", "utf-8")
            print(f"{name}, {row}: {measured[name]['rows'][row]}", flush=True)
    if options.figures == tables.FIGURES:
        tables.main()


if __name__ == "__main__":
    main()
