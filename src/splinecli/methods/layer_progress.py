"""Progress of a network within a batch, by the multiplications of its layers.

Smaller batches would also give finer progress. But matrix products of other heights round differently, so they would
change the last bits of the results.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn

from splinecli.methods.estimator import Progress

STEPS = 128
"""Most calls for a batch. A batch of cnn-ps takes 10 seconds on one core."""


class LayerProgress:
    """Counts the multiplications of a network while it runs.

    Several threads may run the network at a time; each has its own count.

    Args:
        network: it gets a hook at each convolution and linear layer.
    """

    def __init__(self, network: nn.Module) -> None:
        self._of_thread = threading.local()
        for module in network.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
                module.register_forward_hook(self._count)

    @contextmanager
    def counting(self, on_work: Callable[[int], object]) -> Iterator[None]:
        """Call `on_work` in this thread after each layer, with the number of its multiplications."""
        self._of_thread.on_work = on_work
        try:
            yield
        finally:
            self._of_thread.on_work = None

    def _count(self, module: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        on_work = getattr(self._of_thread, "on_work", None)
        if on_work is not None:
            values = inputs[0] if isinstance(module, nn.ConvTranspose2d) else output
            on_work(values.numel() * module.weight[0].numel())

    def work_of(self, run: Callable[[], object]) -> int:
        """Return the multiplications of what `run` computes."""
        works: list[int] = []
        with self.counting(works.append):
            run()
        return sum(works)


class PixelSteps:
    """Translates work into finished pixels of a batch, in steps of at least a STEPS-th of it.

    Args:
        progress: called with numbers of pixels.
        n_pixels: the pixels of the batch.
        total: the work of the batch.
    """

    def __init__(self, progress: Progress, n_pixels: int, total: int) -> None:
        self._progress, self._n_pixels, self._total = progress, n_pixels, total
        self._work = self._reported = 0

    def add(self, work: int) -> None:
        """Add finished work."""
        self._work += work
        pixels = min(self._n_pixels, self._n_pixels * self._work // self._total) - self._reported
        if pixels and pixels * STEPS >= self._n_pixels:
            self._report(pixels)

    def finish(self) -> None:
        """Report the pixels that are left."""
        if self._reported < self._n_pixels:
            self._report(self._n_pixels - self._reported)

    def _report(self, pixels: int) -> None:
        self._reported += pixels
        self._progress(pixels)
