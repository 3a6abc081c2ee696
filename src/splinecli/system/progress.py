"""How a long computation tells its progress."""

from collections.abc import Callable

Progress = Callable[[int], object]  # a function that is called with the number of pixels that were just finished
