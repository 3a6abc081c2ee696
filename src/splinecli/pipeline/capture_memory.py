"""The memory that `infer` takes for a capture, known before its images are read."""

from collections.abc import Callable, Sequence

import numpy as np

from splinecli.capture import CaptureSource
from splinecli.capture.formats.facts import StoredSize
from splinecli.capture.source import capture_bytes
from splinecli.errors import SplinecliError
from splinecli.pipeline.infer_options import InferOptions
from splinecli.pipeline.member import Member
from splinecli.system.machine import available_memory, choose_device, count_available_cores

BASE_BYTES = 500 * 2**20  # of Python, PyTorch and a batch of pixels; captures and their refinement take more
REFINED_PIXELS, REFINED_BYTES = 736**2, 1100  # at most refined at once, a tile with its margin; of each

INDIRECT_BYTES = 4  # of each pixel of the capture, for its indirect light
_WORTH_A_MASK = 10**9  # bytes from which the mask is read to find out how much of them is needed
_ASKED = 16  # captures that stand for a batch


def infer_bytes(largest: StoredSize, n_pixels: int, n_lights: int) -> int:
    """Return the bytes of memory that spline-net takes for a capture, beside BASE_BYTES.

    They follow from the size of the largest image, and the numbers of pixels in the mask and of images that are read.
    """
    of_pixels = INDIRECT_BYTES * n_pixels + REFINED_BYTES * min(n_pixels, REFINED_PIXELS)
    return capture_bytes(largest, n_pixels, n_lights) + of_pixels


def expected_bytes(member: Member, options: InferOptions) -> float:
    """Return about how many bytes `infer` takes for a capture; see source_bytes."""
    n_lights = options.n_lights or len(options.light_indices or ())
    return source_bytes(lambda: options.open(member.folder), n_lights)


def source_bytes(open_source: Callable[[], CaptureSource], n_lights: int = 0) -> float:
    """Return about how many bytes a capture takes, from the header of its first image, and its mask if it is large.

    A capture that cannot be read takes none: it will fail soon. `n_lights` images are read, or all for 0.
    """
    try:
        source = open_source()
        size = source.facts[0].size
        n_lights = n_lights or source.n_lights
        n_pixels = source.window.of(np.broadcast_to(np.True_, size[0][:2])).size
        n_bytes = infer_bytes(size, n_pixels, n_lights)
        if n_bytes > _WORTH_A_MASK and (source.files.mask is not None or source.files.boundaries):
            n_bytes = infer_bytes(size, int(np.count_nonzero(source.read_mask(size[0][:2]))), n_lights)
    except (SplinecliError, OSError, MemoryError):
        return 0.0
    return float(n_bytes)


def choose_workers(members: Sequence[Member], options: InferOptions) -> int:
    """Return how many captures this machine can compute side by side: by its cores, and by its memory.

    A GPU computes one at a time.
    """
    if choose_device(options.device).type == "cuda":
        return 1
    asked = members[:: max(1, len(members) // _ASKED)]
    each = BASE_BYTES + max((expected_bytes(member, options) for member in asked), default=0.0)
    return int(max(1, min(count_available_cores(), len(members), available_memory() / each)))
