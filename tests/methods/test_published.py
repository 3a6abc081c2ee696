"""The compared methods on two objects of DiLiGenT: our own errors, and those of their papers and of the benchmark."""

from pathlib import Path

import pytest

from scenes import evaluate
from splinecli.evaluation.protocol import Protocol
from splinecli.methods import make_estimator

# Mean angular errors in degrees, on Ball and Cat: ours, and the published ones. The published ones for all 96 lights
# are DiLiGenT's benchmark, those for ten lights are table 2 of Zheng et al. (ICCV 2019).
ALL_LIGHTS = {
    "ls": ((4.44, 8.00), (4.10, 8.41)),
    "iw12": ((2.11, 6.49), (2.54, 7.21)),
    "st14": ((1.76, 5.42), (1.74, 6.12)),
    "ia14": ((2.76, 4.82), (3.34, 6.74)),
}
TEN_LIGHTS = {
    "ls": ((4.75, 8.99), (4.41, 9.03)),
    "iw12": ((2.96, 7.77), (3.33, 8.13)),
    "st14": ((2.89, 6.63), (5.24, 9.34)),
    "ia14": ((3.19, 6.45), (12.94, 15.53)),
    "cnn-ps": ((9.91, 11.04), (17.86, 15.67)),
}

REPEATED_DEG = 0.1
"""Tolerance of our own errors. Draws and pixels are seeded, so only rounding differs between machines."""

PUBLISHED_DEG = 0.5
"""How much worse than the published errors ours may be: the images have 16 bits and one channel, and only some pixels
are scored. Ours may be better: ST14 and IA14 have priors here that ten lights need."""

OBJECTS = pytest.mark.parametrize(("place", "name"), [(0, "ballPNG"), (1, "catPNG")])


@OBJECTS
def test_all_lights(shared_data: Path, place: int, name: str) -> None:
    errors = mean_errors(
        shared_data / f"DiLiGenT/pmsData/{name}", [*ALL_LIGHTS], Protocol(max_pixels=1000, as_stored=True)
    )
    check(errors, ALL_LIGHTS, place)
    # Least squares must not pass as one of the robust methods.
    assert all(errors[method] < errors["ls"] - 1 for method in ("iw12", "st14", "ia14"))


@OBJECTS
def test_ten_lights(shared_data: Path, place: int, name: str) -> None:
    folder = shared_data / f"DiLiGenT/pmsData/{name}"
    fits = [method for method in TEN_LIGHTS if method != "cnn-ps"]
    errors = mean_errors(folder, fits, Protocol(10, trials=10, max_pixels=500, as_stored=True))
    # CNN-PS averages ten rotations of each pixel, so it gets fewer pixels.
    errors |= mean_errors(folder, ["cnn-ps"], Protocol(10, trials=3, max_pixels=150, as_stored=True))
    check(errors, TEN_LIGHTS, place)
    assert all(errors[method] < errors["ls"] - 1 for method in ("iw12", "st14", "ia14"))
    # With ten lights CNN-PS is worse than least squares, in its paper as here.
    assert errors["cnn-ps"] > errors["ls"] + 1


def mean_errors(folder: Path, methods: list[str], protocol: Protocol) -> dict[str, float]:
    """Return the mean angular errors in degrees, by method."""
    estimators = [make_estimator(method) for method in methods]
    results = evaluate([folder], estimators, protocol).results
    return {result.method: result.mae_deg for result in results}


def check(
    errors: dict[str, float], table: dict[str, tuple[tuple[float, float], tuple[float, float]]], place: int
) -> None:
    ours = {method: own[place] for method, (own, _) in table.items()}
    assert errors == pytest.approx(ours, abs=REPEATED_DEG)
    for method, (_, published) in table.items():
        assert errors[method] < published[place] + PUBLISHED_DEG, method
