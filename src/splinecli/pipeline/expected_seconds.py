"""Predict the seconds of each stage of `infer`, for its progress bar and for `info`.

The costs were measured on two cores, with native bfloat16 and with AVX2 alone
(benchmarks/large_captures.py). On other processors, they may differ by a factor of two.
"""

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from splinecli.estimate.methods.estimator import student_sizes
from splinecli.images.alignment import MOST_VALUES
from splinecli.records.output_files import OutputMap
from splinecli.system.machine import count_available_cores

AUTOMATIC_FROM = 100_000
"""Pixels from which a capture is distilled by default.

For smaller captures, distillation would save little: a sample of 10,000 pixels takes the network
almost as long as all the normals. From this size on, it takes less than half of the network's time
on 1 to 16 cores and an H100."""


class _Costs(NamedTuple):
    """Seconds of one core. `learn` and `write` use one core only."""

    read: float  # per pixel of each image
    network: float  # network, student, refine_net, octave: per pixel
    student: float
    refine_net: float  # in four orientations
    octave: float
    learn: float  # per step
    write: float  # per pixel


_BFLOAT16 = _Costs(1.7e-7, 1.2e-4, 1.1e-6, 3.0e-5, 1.4e-6, 0.9e-3, 2e-7)
_FLOAT32 = _Costs(1.9e-7, 2.5e-4, 1.8e-6, 7.0e-5, 1.7e-6, 1.2e-3, 2e-7)  # AVX2
_OTHER_METHODS = 4e-5  # per pixel
_UNLIKE = 0.005  # share of the pixels that the network estimates despite distillation
_INDIRECT = 0.3  # share of the pixels that are usually estimated again
_ALIGN, _ALIGN_ROOT = 1.0, 7e-3  # seconds, and seconds per square root of the number of values


def expected_seconds(
    n_pixels: int,
    image_pixels: int,
    *,
    read_pixels: int | None = None,
    network: bool = True,
    distils: bool | None = None,
    align: bool = False,
    maps: Collection[OutputMap] = (),
) -> dict[str, float]:
    """Return the expected seconds of each stage on this machine; see `Clock`.

    Args:
        n_pixels: number of pixels of the mask.
        image_pixels: number of pixels of all images together.
        read_pixels: the same, counting an image each time it is read; None if each is read once.
        network: whether the method is spline-net rather than a fit.
        distils: whether a distilled estimator is used. None decides by AUTOMATIC_FROM.
        align: whether the images are aligned.
        maps: further maps that are written.
    """
    cores = min(count_available_cores(), 8)
    costs = _BFLOAT16 if _has_bfloat16() else _FLOAT32
    read = costs.read / min(cores, 2)
    pictures = read * image_pixels * any(row.reads_images for row in maps)
    pictures += sum(row.seconds + row.seconds_per_pixel * n_pixels for row in maps)
    found = {
        "read": read * (read_pixels or image_pixels),
        "check": 1.5,
        "write": costs.write * n_pixels,
        "pictures": pictures,
    }
    if align:
        found["read"] += _ALIGN + _ALIGN_ROOT * min(image_pixels, MOST_VALUES) ** 0.5
    if not network:
        return {**found, "estimate": _OTHER_METHODS * n_pixels / cores}
    if n_pixels >= AUTOMATIC_FROM if distils is None else distils:
        size = student_sizes(n_pixels)[0]
        learn = costs.network * size.sample / cores + costs.learn * size.steps
        unlike = min(_UNLIKE * n_pixels, size.sample)
        estimate = (costs.student * n_pixels + costs.network * unlike) / cores
        found |= {"distil": learn, "estimate": estimate, "indirect_light": _INDIRECT * learn}
    else:
        estimate = costs.network * n_pixels / cores
        found |= {"estimate": estimate, "indirect_light": _INDIRECT * estimate}
    refined, octaves = n_pixels, 0.0
    while refined > 150_000:  # MOST_PIXELS of estimate/refinement/refiner.py, which imports PyTorch
        octaves += costs.octave * refined
        refined //= 4
    return {**found, "refine": (costs.refine_net * refined + octaves) / cores}


def _has_bfloat16() -> bool:
    """Return whether the processor computes in bfloat16 as in `choose_precision`, without importing
    PyTorch, which takes longer than all of `info`.
    """
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8")
    except OSError:
        return False
    is_intel = "GenuineIntel" in text
    return "amx_bf16" in text or " bf16" in text or ("avx512_bf16" in text and not is_intel)
