"""The methods by name. A new method is one new file and one entry here, imported when it is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

from splinecli.errors import UsageError
from splinecli.methods.estimator import Estimator

__all__ = ["DEFAULT_METHOD", "Estimator", "MethodOptions", "check_method", "make_estimator", "method_names"]

DEFAULT_METHOD = "spline-net"


@dataclass(frozen=True)
class MethodOptions:
    """What a user may choose about a method; each method takes what means something to it.

    weights: a shipped name or a file; None there, as for rotations and batch_size, for the method's own.
    """

    weights: str | None = None
    rotations: int | None = None
    batch_size: int | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"


def make_estimator(name: str, options: MethodOptions = MethodOptions()) -> Estimator:
    """An estimator ready to run. Raises UsageError (unknown name or device), ModelError (weights)."""
    check_method(name)
    return _METHODS[name](name, options)


def check_method(name: str) -> None:
    """Raise UsageError for an unknown name, before anything heavy is loaded."""
    if name not in _METHODS:
        raise UsageError(f"no method named {name!r}; expected one of {', '.join(_METHODS)}")


def method_names() -> list[str]:
    """Names of all methods."""
    return list(_METHODS)


def _least_squares(*_: object) -> Estimator:
    from splinecli.methods.least_squares import LeastSquares

    return LeastSquares()


@dataclass(frozen=True)
class _Solver:
    """In which file of `fits` a BatchedEstimator's `solve` lies, and how many pixels it takes at a time."""

    module: str
    batch_size: int

    def __call__(self, name: str, options: MethodOptions) -> Estimator:
        from splinecli.devices import choose_device
        from splinecli.methods.batched import BatchedEstimator

        solve = import_module(f"splinecli.fits.{self.module}").solve
        size = self.batch_size if options.batch_size is None else options.batch_size
        return BatchedEstimator(name, solve, str(choose_device(options.device)), size)


@dataclass(frozen=True)
class _Network:
    """The views that a network averages and the pixels it takes at a time, unless the user says otherwise."""

    rotations: int
    batch_size: int

    def __call__(self, name: str, options: MethodOptions) -> Estimator:
        from splinecli.devices import choose_device, choose_precision
        from splinecli.methods.networks import NetworkEstimator
        from splinecli.networks.weights import resolve_weights

        device = choose_device(options.device)
        return NetworkEstimator(
            name,
            resolve_weights(options.weights or name),
            device=device,
            precision=choose_precision(options.precision, device),
            rotations=self.rotations if options.rotations is None else options.rotations,
            batch_size=self.batch_size if options.batch_size is None else options.batch_size,
        )


_METHODS: dict[str, Callable[[str, MethodOptions], Estimator]] = {
    "spline-net": _Network(rotations=1, batch_size=1024),
    "cnn-ps": _Network(rotations=10, batch_size=512),
    "ls": _least_squares,
    "ls-trimmed": _Solver("trimmed_least_squares", 8192),
    "l1": _Solver("least_absolute", 8192),
    "iw12": _Solver("iw12", 8192),
    "st14": _Solver("st14", 1024),
    "ia14": _Solver("ia14", 1024),
}
