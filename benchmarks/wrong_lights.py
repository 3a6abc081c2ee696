"""How often wrong light files are recognised, and how often right ones are doubted.

python benchmarks/wrong_lights.py CAPTURE... [--scenes 20] [--draws 20] [--lights 12]

Of each capture, draws of lights are checked (all lights where it has no more). Each draw is checked
as it is and in every wrong way. Scenes that no default seed uses are rendered in all classes of
materials. Prints a table in Markdown: how many are named / how many get the right mend, of how
many.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splinecli.capture import open_capture
from splinecli.capture.light_rows import parse_light_frame
from splinecli.capture.sample import sample_observations
from splinecli.judge.light_check import LightCheck, check_lights, mirror_twin
from splinecli.judge.light_order import UNKNOWN_ORDER
from splinecli.lights.draws import draw_lights
from splinecli.lights.light_fit import find_factors
from splinecli.recipe import RecipeOptions, prepare_capture
from splinecli.workshop.synthesis.scenes import SceneConfig, draw_scene, render_scene

Array = NDArray[np.floating]
FRAMES = {
    "x negated": "x-left",
    "y negated": "y-down",
    "x and y exchanged": "swap-xy",
    "turned by 90 degrees": "swap-xy,y-down",
    "x and y negated": "x-left,y-down",
}
FIRST_SCENE, SEED = 5000, 71
Lit = tuple[str, Array, Array, NDArray[np.bool_], bool]
"""Name, observations (P, F), lights (F, 3), mask (H, W), and whether a file gives the intensities
of the lights.
"""


def wrong_files(
    lights: Array, rng: np.random.Generator
) -> Iterator[tuple[str, Array, Callable[[LightCheck], bool]]]:
    """Yield the name of each kind of file, the lights as it gives them, and whether a check's mend
    is the right one.
    """
    n_lights = len(lights)
    yield "right", lights, lambda check: True
    for name, frame in FRAMES.items():
        inverse = np.linalg.inv(parse_light_frame(frame).matrix)
        yield name, lights @ inverse.T, lambda check, frame=frame: mends(check, frame)  # type: ignore[misc]
    yield (
        "shifted by one",
        np.roll(lights, 1, axis=0),
        lambda check: words(check).startswith("if image 1 belongs to light 2"),
    )
    last = f"in reversed order, beginning with light {n_lights}"
    yield "reversed", lights[::-1], lambda check: words(check) == last
    yield "shuffled", lights[rng.permutation(n_lights)], lambda check: check.order == UNKNOWN_ORDER
    one, other = sorted(rng.choice(n_lights, 2, replace=False).tolist())
    swapped = np.arange(n_lights)
    swapped[[one, other]] = other, one
    mend = f"with the lights of {one + 1} and {other + 1} exchanged"
    yield "two exchanged", lights[swapped], lambda check: words(check) == mend


def mends(check: LightCheck, frame: str) -> bool:
    if check.order is not None or check.best is None:
        return False
    proposed = (check.best, mirror_twin(check, check.best))
    return parse_light_frame(frame) in [
        candidate.frame for candidate in proposed if candidate is not None
    ]


def words(check: LightCheck) -> str:
    return check.order or (check.best.name if check.best is not None else "")


def rendered(count: int, n_lights: int) -> Iterator[Lit]:
    """Yield rendered scenes, by their class of material, with lights up to 60 degrees from the
    view.
    """
    config = SceneConfig(size=80, lights=4, samples=2, directions=48, bounces=2)
    for index in range(FIRST_SCENE, FIRST_SCENE + count):
        scene = draw_scene(SEED, index, config)
        rng = np.random.default_rng([SEED, index])
        z, azimuth = rng.uniform(0.5, 0.99, n_lights), rng.uniform(0, 2 * np.pi, n_lights)
        radius = np.sqrt(1 - z * z)
        lights = np.stack((radius * np.cos(azimuth), radius * np.sin(azimuth), z), axis=1).astype(
            np.float32
        )
        result = render_scene(dataclasses.replace(scene, lights=lights), config)
        for name, observations in result.observations.items():
            yield f"rendered, {name}", observations, lights.astype(np.float64), result.mask, True


def real(folders: Sequence[Path], n_lights: int, draws: int) -> Iterator[Lit]:
    for folder in folders:
        source = open_capture(folder)
        # As the check of infer, it sees no intensities that were estimated under the lights in
        # question.
        capture, known = (
            prepare_capture(source, options=RecipeOptions(as_stored=True)),
            source.intensities_measured,
        )
        wanted = n_lights if n_lights < capture.n_lights else None
        for draw in draw_lights(capture.light_directions, wanted, trials=draws, seed=SEED):
            chosen = list(draw)
            lights = capture.light_directions[chosen]
            yield folder.name, capture.observations[:, chosen], lights, capture.mask, known


def count(
    captures: Sequence[Path], scenes: int, *, draws: int, n_lights: int
) -> dict[str, dict[str, tuple[int, int, int]]]:
    """Return for each kind of file and each capture or class: how many are named, get the right
    mend, there are.
    """
    counts: dict[str, dict[str, tuple[int, int, int]]] = {}
    rng = np.random.default_rng(SEED)
    for source in (real(captures, n_lights, draws), rendered(scenes, n_lights)):
        for name, observations, lights, mask, known in source:
            sample = sample_observations(observations, mask)
            for kind, given, is_right in wrong_files(lights, rng):
                factors = find_factors(sample.observations, intensities_known=known)
                check = check_lights(sample.observations, sample.mask, given, factors=factors)
                doubted = (
                    check.order is not None or check.best is not None or check.odd_image is not None
                )
                named, mended, total = counts.setdefault(kind, {}).get(name, (0, 0, 0))
                mended += doubted and is_right(check)
                counts[kind][name] = named + doubted, mended, total + 1
    return counts


def cell(kind: str, named: int, mended: int, total: int) -> str:
    return f"{named}" + ("" if kind == "right" else f" / {mended}") + f" of {total}"


def grouped(kind: str, by_name: Mapping[str, tuple[int, int, int]]) -> dict[str, float | str]:
    """Return one kind of file for all photographs, for metal, and for all other rendered scenes
    together.
    """
    sums: dict[str, NDArray[np.integer]] = {}
    for name, found in by_name.items():
        group = "diffuse, specular" if name.startswith("rendered") else "photographs"
        group = "metal" if name == "rendered, metallic" else group
        sums[group] = np.add(sums.get(group, np.zeros(3, int)), found)
    return {group: cell(kind, *found.tolist()) for group, found in sums.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--lights", type=int, default=12)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    counts = count(options.captures, options.scenes, draws=options.draws, n_lights=options.lights)
    print(
        "| light file |", " | ".join(counts["right"]), "|\n|---|" + "---:|" * len(counts["right"])
    )
    for kind, by_name in counts.items():
        print(f"| {kind} |", " | ".join(cell(kind, *found) for found in by_name.values()), "|")


if __name__ == "__main__":
    main()
