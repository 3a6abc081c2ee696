"""Record what the commands make of a corpus of small captures, and compare two recordings.

    python benchmarks/command_corpus.py record FOLDER [--captures DIR] [--only NAME]...
    python benchmarks/command_corpus.py compare BEFORE AFTER [--only NAME]...

Each capture goes through `infer`, `infer --align`, `info`, `evaluate` and `estimate_normals` of
Python, with methods of each family. A recording holds arrays, JSON documents, printed texts and
exit codes, without what differs from run to run. After a change that must keep results, `compare`
shows no difference; it lists each one and ends with exit code 1 otherwise.

The captures are rendered once into DIR (by default `captures` beside FOLDER), and both recordings
should use the same ones. Networks give other bits on other processors and with other versions of
PyTorch, so record on one machine, in environments with the same versions.
"""

import argparse
import contextlib
import difflib
import hashlib
import io
import json
import os
import re
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

# Read once, when NumPy and PyTorch are imported. With several threads, the order of additions, and
# with it the last bits, could depend on the number of cores; and each process has one core here.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
os.environ.update(COLUMNS="100", TERMINAL_WIDTH="100")  # of printed tables

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy.io import savemat

Array = NDArray[np.float64]
Function = Callable[[Array, Array], Array]

MEDALLION = Path(__file__).resolve().parents[1] / "examples/medallion"
METHODS = ("ls", "iw12", "spline-net")
PROCESSES = 2
SIZE = 72
"""Pixels along a side of the rendered images."""

FULL, EXPOSURE = 65535, 0.85
"""White of 16 bits, and the share of it that the brightest observation reaches."""

PIXEL_MM = 1.5
MEASURED = "seconds|seconds_.*|peak_memory_mib|version|folder|inputs_sha256"
"""Fields of documents that depend on the machine, the time or the place of the files."""

SECONDS, PROGRESS = r"\d[\d,.]* s\b", r"(?m)^(?!splinecli: ).*: \d+ %(, .*)?\n"
"""Parts of printed texts that do; a busy machine prints a line of progress every half minute."""


def directions(azimuth: NDArray[Any], zenith_deg: NDArray[Any] | float) -> Array:
    """Return the unit vectors (F, 3) at these angles from x and from the viewing axis."""
    zenith = np.broadcast_to(np.radians(zenith_deg), azimuth.shape)
    x, y = np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth)
    return np.stack((x, y, np.cos(zenith)), axis=1)


LIGHTS = directions(2.4 * np.arange(12), np.linspace(12, 48, 12))


def grid(shift: tuple[float, float] = (0.0, 0.0)) -> tuple[Array, Array]:
    """Return x and y (SIZE, SIZE) from -1 to 1, right and up, of images shifted by some pixels."""
    centre = (np.arange(SIZE) + 0.5) * 2 / SIZE - 1
    x, y = np.meshgrid(centre, -centre)
    return x + shift[0] * 2 / SIZE, y + shift[1] * 2 / SIZE


def ball(x: Array, y: Array) -> Array:
    return np.sqrt(np.maximum(1 - x**2 - y**2, 1e-4))


def carved(x: Array, y: Array) -> Array:
    """Return the heights of a dome with waves and dents of several sizes."""
    waves = 0.03 * np.sin(7 * x + 1) * np.cos(6 * y) + 0.012 * np.sin(17 * x) * np.sin(15 * y + 2)
    return np.asarray(np.sqrt(np.maximum(1.7 - x**2 - y**2, 1e-4)) + waves)


def plain(x: Array, y: Array) -> Array:
    return np.full_like(x, 0.8)


def speckled(x: Array, y: Array) -> Array:
    """Return the albedo of a surface with fine paint."""
    fine = np.sin(31 * x + 4 * np.sin(9 * y)) * np.sin(27 * y + 3 * np.cos(11 * x))
    paint = 0.2 * np.sign(fine) * np.abs(fine) ** 0.5
    return np.asarray(0.65 + 0.15 * np.sin(5 * x - 2 * y) + paint)


RED, BLUE = np.array((0.8, 0.2, 0.1)), np.array((0.1, 0.3, 0.8))


def striped(x: Array, y: Array) -> Array:
    """Return the RGB albedo (..., 3) of stripes of two colours."""
    return np.where((np.floor(4 * x) % 2 == 0)[..., None], RED, BLUE)


def softly_striped(x: Array, y: Array) -> Array:
    """Return the RGB albedo (..., 3) of slanting stripes of two colours that blend."""
    share = 0.5 + 0.5 * np.sin(4 * np.pi * (x + 0.6 * y))[..., None]
    return np.asarray(share * RED + (1 - share) * BLUE)


def disc(radius: float = 0.9, x_centre: float = 0.0) -> NDArray[np.bool_]:
    x, y = grid()
    return np.hypot(x - x_centre, y) < radius


def normals_of(height: Function, x: Array, y: Array) -> Array:
    """Return the unit normals (..., 3) of a height field, by central differences."""
    step = 1e-5
    slope_x = (height(x + step, y) - height(x - step, y)) / (2 * step)
    slope_y = (height(x, y + step) - height(x, y - step)) / (2 * step)
    normals = np.stack((-slope_x, -slope_y, np.ones_like(x)), axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def photograph(
    lamp: Array,
    height: Function = carved,
    albedo: Function = plain,
    *,
    gloss: float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
    near: bool = False,
) -> Array:
    """Return a linear image (SIZE, SIZE) or (SIZE, SIZE, 3): Lambert and a Blinn-Phong lobe.

    `lamp` (3,) is a direction or, if `near`, a position in half widths of the image.
    """
    x, y = grid(shift)
    normals, heights = normals_of(height, x, y), height(x, y)
    points = np.stack((x, y, heights - heights.mean()), axis=-1)
    towards = lamp - points if near else np.broadcast_to(lamp, points.shape)
    distance = np.linalg.norm(towards, axis=-1, keepdims=True)
    towards = towards / distance
    cosine = np.clip((normals * towards).sum(axis=-1, keepdims=True), 0, None)
    half = towards + np.array((0.0, 0.0, 1.0))
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    lobe = gloss * np.clip((normals * half).sum(axis=-1, keepdims=True), 0, None) ** 40
    colour = albedo(x, y)
    image = (colour.reshape(*x.shape, -1) + lobe) * cosine
    if near:
        image /= distance**2
    return np.asarray(image.reshape(colour.shape))


def photographs(lamps: Array = LIGHTS, *scene: Function, noise: float = 5e-4, **how: Any) -> Array:
    """Return images (F, ...) of a scene, scaled so that the object's largest value is EXPOSURE."""
    images = np.stack([photograph(lamp, *scene, **how) for lamp in lamps])
    images *= EXPOSURE / images[:, disc()].max()
    return np.clip(images + noise * np.random.default_rng(7).normal(size=images.shape), 0, None)


def sixteen_bits(images: Array) -> NDArray[np.uint16]:
    return np.rint(FULL * np.clip(images, 0, 1)).astype(np.uint16)


def write(
    folder: Path,
    images: NDArray[Any],
    lights: Array | None = LIGHTS,
    *,
    height: Function | None = carved,
    mask: NDArray[np.bool_] | None = None,
    suffix: str = "png",
    **numbers: Any,
) -> None:
    """Write images (F, H, W) or (F, H, W, 3) RGB, lights, mask, true normals and text files."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, image in enumerate(images, start=1):
        path = folder / f"{number:03}.{suffix}"
        cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)
    if mask is not None:
        cv2.imwrite(str(folder / "mask.png"), mask.astype(np.uint8) * 255)
    if height is not None:
        np.save(folder / "normals_gt.npy", normals_of(height, *grid()).astype(np.float32))
    if lights is not None:
        numbers["light_directions"] = lights
    for name, values in numbers.items():
        np.savetxt(folder / f"{name}.txt", np.atleast_1d(values), fmt="%.9f")


def make_medallion(folder: Path) -> None:
    shutil.copytree(MEDALLION, folder)


def make_near_lamps(folder: Path) -> None:
    lamps = LIGHTS * np.linspace(4.5, 6, len(LIGHTS))[:, None]
    images = sixteen_bits(photographs(lamps, carved, speckled, near=True))
    lamps_mm = lamps * SIZE / 2 * PIXEL_MM
    write(folder, images, None, mask=disc(), light_positions=lamps_mm, pixel_size=PIXEL_MM)


def make_film(folder: Path) -> None:
    """Write a film of a lamp that is carried around, and some of its frames with their lights."""
    lamps = directions(np.linspace(0, 6 * np.pi, 120), np.linspace(15, 50, 120))
    images = photographs(lamps, ball, speckled) * disc()
    write(folder / "frames", sixteen_bits(images[5::10]), lamps[5::10], height=ball, mask=disc())
    write(folder, np.zeros((0,)), None, height=ball, mask=disc())
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    film = cv2.VideoWriter(str(folder / "clip.avi"), codec, 25, (SIZE, SIZE))
    for image in images:
        curve = np.where(image < 0.018, 4.5 * image, 1.099 * image**0.45 - 0.099)  # BT.709
        film.write(np.repeat(np.rint(255 * curve.clip(0, 1)).astype(np.uint8)[..., None], 3, 2))
    film.release()


def make_channels(folder: Path) -> None:
    gray = photographs(LIGHTS, gloss=0.1)
    colour = np.moveaxis(gray.reshape(-1, 3, SIZE, SIZE), 1, 3)
    write(folder, sixteen_bits(colour), mask=disc())


def make_saturated(folder: Path) -> None:
    """Write values of 12 bits in files of 16, of which some are clipped."""
    images = 1.5 * photographs(LIGHTS, carved, speckled, gloss=0.5)
    write(folder, np.rint(4095 * images.clip(0, 1)).astype(np.uint16), mask=disc())


def make_eight_bits(folder: Path) -> None:
    linear = photographs(LIGHTS, carved, striped)
    curve = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    write(folder, np.rint(255 * curve.clip(0, 1)).astype(np.uint8), mask=disc(), suffix="jpg")


def make_blurred(folder: Path) -> None:
    images = photographs(LIGHTS, carved, speckled, gloss=0.3) * disc()
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), 0.8) for image in images])
    write(folder, sixteen_bits(blurred), mask=disc())


def make_coloured(folder: Path) -> None:
    write_coloured(folder, softly_striped, (1.0, 0.75, 0.5), disc(0.9))


def make_coloured_strongly(folder: Path) -> None:
    write_coloured(folder, striped, (1.0, 0.4, 0.15), disc(0.8))


def write_coloured(
    folder: Path, albedo: Function, colour: Sequence[float], mask: NDArray[np.bool_]
) -> None:
    """Write a still ball in a ring of lamps that are white and of this colour in turn."""
    lights = directions(np.arange(12) * np.pi / 6, 33)
    lamps = np.where(np.arange(12)[:, None] % 2, colour, 1.0)
    images = photographs(lights, ball, albedo, noise=0) * lamps[:, None, None]
    write(folder, sixteen_bits(images), lights, height=ball, mask=mask)


def make_moved(folder: Path) -> None:
    shifts = np.random.default_rng(3).uniform(-4, 4, (len(LIGHTS), 2)) * (LIGHTS[:, :1] > 0)
    shifts[0] = 0
    pairs = zip(LIGHTS, shifts, strict=True)
    images = [photograph(lamp, carved, speckled, shift=(dx, dy)) for lamp, (dx, dy) in pairs]
    write(folder, sixteen_bits(np.stack(images)), mask=disc(0.8))


def make_arrays(folder: Path) -> None:
    """Write floating-point images as one TIFF, and lights and true normals as .npy."""
    images = photographs(LIGHTS, carved, speckled, gloss=0.2)
    intensities = np.linspace(0.7, 1.3, len(LIGHTS))
    write(folder, images[:0], None, mask=disc())
    tifffile.imwrite(folder / "stack.tif", (images * intensities[:, None, None]).astype("f4"))
    np.save(folder / "light_directions.npy", LIGHTS)


def make_diligent(folder: Path) -> None:
    """Write a capture in the layout of DiLiGenT, with intensities of each channel."""
    capture = folder / "pmsData/carvedPNG"
    rng = np.random.default_rng(5)
    intensities = rng.uniform(0.8, 1.2, (len(LIGHTS), 1)) * rng.uniform(0.9, 1.1, (len(LIGHTS), 3))
    images = photographs(LIGHTS, carved, striped, gloss=0.2) * intensities[:, None, None] / 1.4
    write(capture, sixteen_bits(images), height=None, mask=disc(), light_intensities=intensities)
    names = sorted(path.name for path in capture.glob("0*.png"))
    (capture / "filenames.txt").write_text("\n".join(names) + "\n")
    savemat(capture / "Normal_gt.mat", {"Normal_gt": normals_of(carved, *grid())})


def make_auto_mask(folder: Path) -> None:
    """Write an object without a mask in front of a darker background."""
    dimmed = np.where(disc(0.85), 1, 0.03)
    images = photographs(LIGHTS, carved, speckled, gloss=0.1) * dimmed
    write(folder, sixteen_bits(images))


def make_two_parts(folder: Path) -> None:
    parts = disc(0.4, -0.45) | disc(0.35, 0.5)
    write(folder, sixteen_bits(photographs(LIGHTS, carved, gloss=0.3)), mask=parts)


@dataclass(frozen=True)
class Case:
    """A capture: what makes it, the paths that commands get, and options of reading it."""

    make: Callable[[Path], None]
    capture: str = ""
    dataset: str = ""
    options: tuple[str, ...] = ()
    evaluate_options: tuple[str, ...] = ()


FOUND = ("--lights", "estimate")
FILM_FILES = ("--mask", "film/mask.png", "--ground-truth", "film/normals_gt.npy")
CASES = {
    "medallion": Case(make_medallion),
    "near-lamps": Case(make_near_lamps),
    "film": Case(make_film, "clip.avi", "frames", (*FOUND, *FILM_FILES), FOUND),
    "channels": Case(make_channels, options=("--lights-in-channels",)),
    "saturated": Case(make_saturated),
    "eight-bits": Case(make_eight_bits),
    "blurred": Case(make_blurred),
    "coloured": Case(make_coloured),
    "coloured-strongly": Case(make_coloured_strongly),
    "moved": Case(make_moved),
    "arrays": Case(make_arrays),
    "diligent": Case(make_diligent, "pmsData/carvedPNG", "pmsData"),
    "auto-mask": Case(make_auto_mask, options=("--auto-mask",)),
    "two-parts": Case(make_two_parts),
}


def record(name: str, captures: Path, recording: Path) -> str:
    """Run everything on the capture of this name, and store the results in recording/name."""
    warnings.simplefilter("ignore")  # from libraries, as the console script does
    case, made, results = CASES[name], captures / name, recording / name
    if not made.exists():
        with tempfile.TemporaryDirectory(dir=captures) as part:
            case.make(Path(part) / name)
            (Path(part) / name).rename(made)
    shutil.rmtree(results, ignore_errors=True)
    results.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as work, contextlib.chdir(work):
        shutil.copytree(made, name)
        write_text(results / "capture.sha256", f"{fingerprint(Path(name))}\n")
        run_commands(name, case, results)
        run_python(name, case, results)
    return name


def run_commands(name: str, case: Case, results: Path) -> None:
    """Run the command line in the working folder, which holds a copy of the capture."""
    capture, dataset = str(Path(name, case.capture)), str(Path(name, case.dataset))
    network = ("--precision", "float32")
    for method in METHODS:
        # The material takes longest, and does not depend on the method.
        maps = {"ls": "albedo,material", "spline-net": "albedo,confidence"}.get(method, "albedo")
        for suffix, align in (("", ()), ("-align", ("--align",))):
            label = f"infer{suffix}-{method}"
            options = (*case.options, *align, "--method", method, *network, "--maps", maps)
            run(results / label, "infer", capture, *options, "-o", label)
            keep_files(Path(label), results / label)
    run(results / "info", "info", capture, *case.options)
    run(results / "info-json", "info", capture, *case.options, "--strict", "--json")
    methods = [part for method in METHODS for part in ("--method", method)]
    trials = ("--n-lights", "8", "--trials", "1", "--jobs", "1", "-o", "evaluation")
    scored = (*case.evaluate_options, *methods, *network, *trials)
    run(results / "evaluate-json", "evaluate", dataset, *scored, "--json")
    run(results / "evaluate", "evaluate", dataset, *scored)  # prints the trials that are stored


def run(results: Path, *arguments: str) -> None:
    """Run `splinecli ARGUMENTS` in this process, and store what it prints and its exit code."""
    from splinecli.cli.main import main

    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        code = main(arguments)
    results.mkdir()
    printed, is_json = out.getvalue(), "--json" in arguments
    if is_json and printed:
        write_json(results / "stdout.json", json.loads(printed))
    else:
        write_text(results / "stdout.txt", printed)
    write_text(results / "stderr.txt", err.getvalue())
    write_text(results / "exit_code.txt", f"{code}\n")


def keep_files(output: Path, results: Path) -> None:
    """Store the report and the arrays that `infer` wrote."""
    for path in sorted(output.rglob("*")):
        if path.name == "report.json":
            write_json(results / path.name, json.loads(path.read_text("utf-8")))
        elif path.suffix == ".npy":
            shutil.copyfile(path, results / path.name)


def run_python(name: str, case: Case, results: Path) -> None:
    """Estimate normals from arrays with splinecli.estimate_normals."""
    import splinecli

    images, given = read_arrays(Path(name, case.dataset), case)
    for method in METHODS:
        folder = results / f"python-{method}"
        folder.mkdir()
        with warnings.catch_warnings(record=True) as issued:
            warnings.simplefilter("always", UserWarning)
            try:
                estimate = splinecli.estimate_normals(
                    images, method=method, precision="float32", **given
                )
            except Exception as error:  # a defect is a result, too
                write_text(folder / "error.txt", f"{type(error).__name__}: {error}\n")
                continue
        capture = estimate.capture
        arrays = {
            "normals": estimate.normal_map,
            "confidence": estimate.confidence_map,
            "observations": capture.observations,
            "restored": capture.restored,
            "light_directions": capture.light_directions,
            "estimated_intensities": capture.estimated_intensities,
            "light_errors_deg": capture.light_errors_deg,
        }
        if method == METHODS[0] and images.ndim == 4:
            material = splinecli.estimate_material(estimate, images)
            arrays |= {"base_colour": material.base_colour, "roughness": material.roughness}
        for key, array in arrays.items():
            if array is not None:
                np.save(folder / f"{key}.npy", np.asarray(array))
        codes = [{"code": found.code, "text": str(found)} for found in capture.warnings]
        told = {"warnings": codes, "issued": [str(each.message) for each in issued]}
        blur = capture.removed_blur
        write_json(folder / "estimate.json", told | {"removed_blur": blur and float(blur)})


def read_arrays(folder: Path, case: Case) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return the images as stored, and the other arguments that a user would give."""
    stacks = sorted(folder.glob("*.tif"))
    paths = sorted(path for path in folder.rglob("*") if re.fullmatch(r"\d+\.(png|jpg)", path.name))
    if stacks:
        images = tifffile.imread(stacks[0])
    else:
        bgr = [np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) for path in paths]
        images = np.stack([image[..., ::-1] if image.ndim == 3 else image for image in bgr])
    if "--lights-in-channels" in case.options:
        images = np.concatenate([np.moveaxis(image, 2, 0) for image in images])
    given: dict[str, Any] = {}
    keys = {"light_positions": "light_directions"}
    for path in sorted(folder.rglob("light_*.*")) + sorted(folder.rglob("pixel_size.txt")):
        values = np.load(path) if path.suffix == ".npy" else np.loadtxt(path)
        given[keys.get(path.stem, path.stem)] = values if values.ndim else float(values)
    if case.evaluate_options == FOUND:
        del given["light_directions"]
    for path in folder.rglob("mask.png"):
        given["mask"] = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return images, given


def fingerprint(folder: Path) -> str:
    """Return a digest of the files in a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def write_json(path: Path, document: Any) -> None:
    """Write a document without measurements, and with relative paths."""

    def lasting(value: Any) -> Any:
        if isinstance(value, dict):
            kept = (key for key in value if not re.fullmatch(MEASURED, key))
            return {key: lasting(value[key]) for key in kept}
        return [lasting(each) for each in value] if isinstance(value, list) else value

    write_text(path, json.dumps(lasting(document), indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text without seconds, lines of progress and the path of the working folder."""
    text = re.sub(SECONDS, "- s", re.sub(PROGRESS, "", text))
    path.write_text(text.replace(str(Path.cwd()), "."), "utf-8")


def compare(before: Path, after: Path, names: Sequence[str]) -> Iterator[str]:
    """Yield a line or more for each file that differs."""
    folders = [root / name for root in (before, after) for name in names]
    found = {
        path.relative_to(folder.parent)
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file()
    }
    for file in sorted(found):
        old, new = before / file, after / file
        if not (old.exists() and new.exists()):
            yield f"{file}: only in {before if old.exists() else after}"
        elif old.read_bytes() != new.read_bytes():
            how = array_difference if file.suffix == ".npy" else text_difference
            yield f"{file}: {how(old, new)}"


def array_difference(old: Path, new: Path) -> str:
    before, after = np.load(old), np.load(new)
    if (before.shape, before.dtype) != (after.shape, after.dtype):
        return f"{before.shape} {before.dtype}, now {after.shape} {after.dtype}"
    one, other = before.astype(np.float64), after.astype(np.float64)
    if old.stem == "normals":
        sine = np.linalg.norm(np.cross(one, other), axis=-1)
        angle = np.degrees(np.arctan2(sine, (one * other).sum(axis=-1)))
        count = int((before != after).any(axis=-1).sum())
        return f"{count} normals differ, by up to {angle.max():.3g} degrees"
    return f"differs by up to {np.nanmax(np.abs(one - other)):.3g}"


def text_difference(old: Path, new: Path, most: int = 12) -> str:
    """Return the first lines that differ."""
    before, after = (path.read_text("utf-8").splitlines() for path in (old, new))
    lines = difflib.unified_diff(before, after, n=0, lineterm="")
    changed = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
    more = [f"... {len(changed) - most} more"] if len(changed) > most else []
    return "\n    ".join(["", *changed[:most], *more])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    recorder, comparer = commands.add_parser("record"), commands.add_parser("compare")
    recorder.add_argument("folder", type=Path)
    recorder.add_argument("--captures", type=Path)
    for name in ("before", "after"):
        comparer.add_argument(name, type=Path)
    for each in (recorder, comparer):
        each.add_argument("--only", action="append", choices=CASES, metavar="NAME")
    given = parser.parse_args(arguments)
    names = given.only or list(CASES)
    if given.command == "compare":
        missing = [root for root in (given.before, given.after) if not root.is_dir()]
        if missing:
            parser.error(f"{missing[0]} is no folder")
        differences = list(compare(given.before, given.after, names))
        print(*differences, f"{len(differences)} files differ", sep="\n")
        return int(bool(differences))
    recording = given.folder.resolve()
    captures = given.captures.resolve() if given.captures else recording.parent / "captures"
    captures.mkdir(parents=True, exist_ok=True)
    # A process for each capture, so that none depends on what was done before it.
    with ProcessPoolExecutor(
        PROCESSES, mp_context=get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        running = [pool.submit(record, name, captures, recording) for name in names]
        for future in running:
            print(future.result(), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
