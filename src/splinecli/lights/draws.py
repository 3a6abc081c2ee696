"""Random draws of lights, identical for all captures with the same number of lights."""

import numpy as np

from splinecli.capture.record import in_one_plane
from splinecli.errors import InputError, UsageError
from splinecli.maths import Float64Array
from splinecli.maths.robust import MIN_LIGHTS

DRAWS_STREAM = 1  # stream of the seed; evaluations use two others, so that all are independent
Draw = tuple[int, ...]  # zero-based indices of lights in the whole capture


def draw_lights(
    light_directions: Float64Array, n_lights: int | None, *, trials: int = 1, seed: int = 0
) -> list[Draw]:
    """Return random draws of lights without replacement, each in ascending order.

    Trial t depends only on the seed, the number of lights, `n_lights` and t. Therefore, captures
    with the same number of lights get the same draws, and additional trials extend the same list. A
    draw is repeated only if its lights are coplanar, because no method can solve it. If `n_lights`
    is None or the number of all lights, there is a single draw.

    Raises UsageError for settings that are out of range, and InputError if the lights of every draw
    are coplanar.
    """
    available = len(light_directions)
    check_draw_settings(n_lights, trials, seed)
    if n_lights is not None and n_lights > available:
        raise UsageError(
            f"the capture has only {available} lights, but --n-lights is {n_lights}",
            hint=f"Use --n-lights {available}, or fewer",
        )
    if n_lights is None or n_lights == available:
        return [tuple(range(available))]
    return [_draw(light_directions, n_lights, trial, seed) for trial in range(trials)]


def check_draw_settings(n_lights: int | None, trials: int, seed: int) -> None:
    """Raise UsageError for settings that are invalid for any capture."""
    if n_lights is not None and n_lights < MIN_LIGHTS:
        raise UsageError(f"--n-lights is {n_lights}; expected at least {MIN_LIGHTS}")
    if trials < 1:
        raise UsageError(f"--trials is {trials}; expected at least 1")
    if seed < 0:
        raise UsageError(f"--seed is {seed}; expected a whole number of at least 0")


def _draw(light_directions: Float64Array, n_lights: int, trial: int, seed: int) -> Draw:
    generator = np.random.default_rng([DRAWS_STREAM, seed, len(light_directions), n_lights, trial])
    for _ in range(1000):
        # Unlike Generator.choice, uniform numbers are likely to stay the same in later versions of
        # NumPy.
        chosen = np.sort(np.argsort(generator.random(len(light_directions)))[:n_lights])
        if not in_one_plane(light_directions[chosen]):
            return tuple(chosen.tolist())
    raise InputError(
        f"in all 1000 draws of {n_lights} lights, the lights are coplanar",
        hint="Choose more lights, or lights all around the viewing direction",
    )
