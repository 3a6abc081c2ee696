"""Images read by a second thread while the first one works on the image before."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from splinecli.capture.formats.native_stderr import stderr_is_apart

Item = TypeVar("Item")
Image = TypeVar("Image")


def read_ahead(read: Callable[[Item], Image], items: Sequence[Item]) -> Iterator[Image]:
    """Yield read(item) of each item, in order. While one result is used, a thread reads the next.

    An error is raised when the turn of its item comes. Decoders catch what is printed to file descriptor 2. Where
    Python's stderr is the same, one item is read after the other, so that no message is lost.
    """
    if len(items) < 2 or not stderr_is_apart():
        yield from map(read, items)
        return
    with ThreadPoolExecutor(1, "read") as pool:
        waiting = pool.submit(read, items[0])
        for item in items[1:]:
            found = waiting.result()
            waiting = pool.submit(read, item)
            yield found
            del found  # so that no more than two are in memory
        yield waiting.result()
