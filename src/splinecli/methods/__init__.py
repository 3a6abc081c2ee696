"""The methods by name. A new method is one new file and one entry here, imported when it is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from splinecli.errors import UsageError
from splinecli.methods.estimator import Estimator

__all__ = ["DEFAULT_METHOD", "Estimator", "MethodOptions", "check_method", "make_estimator", "method_names"]

DEFAULT_METHOD = "spline-net"


@dataclass(frozen=True)
class MethodOptions:
    """What a user may choose about a method; each method takes what means something to it.

    weights: a shipped name or a file, None for the method's own; batch_size: None for the method's own.
    """

    weights: str | None = None
    rotations: int = 1
    batch_size: int | None = None
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"


def make_estimator(name: str, options: MethodOptions = MethodOptions()) -> Estimator:
    """An estimator ready to run. Raises UsageError (unknown name or device), ModelError (weights)."""
    check_method(name)
    return _METHODS[name](options)


def check_method(name: str) -> None:
    """Raise UsageError for an unknown name, before anything heavy is loaded."""
    if name not in _METHODS:
        raise UsageError(f"no method named {name!r}; expected one of {', '.join(_METHODS)}")


def method_names() -> list[str]:
    """Names of all methods."""
    return list(_METHODS)


def _least_squares(_: MethodOptions) -> Estimator:
    from splinecli.methods.least_squares import LeastSquares

    return LeastSquares()


def _spline_net(options: MethodOptions) -> Estimator:
    from splinecli.devices import choose_device, choose_precision
    from splinecli.methods.spline_net import SplineNetEstimator
    from splinecli.networks.weights import resolve_weights

    device = choose_device(options.device)
    return SplineNetEstimator(
        resolve_weights(options.weights or "spline-net"),
        device=device,
        precision=choose_precision(options.precision, device),
        rotations=options.rotations,
        **({} if options.batch_size is None else {"batch_size": options.batch_size}),
    )


_METHODS: dict[str, Callable[[MethodOptions], Estimator]] = {
    "spline-net": _spline_net,
    "ls": _least_squares,
}
