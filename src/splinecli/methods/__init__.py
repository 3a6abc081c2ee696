"""The methods by name. To add a method, write one file and add one entry here.

The file is imported when the method is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module

from splinecli.errors import check_one_of
from splinecli.methods.estimator import Estimator
from splinecli.system.machine import Device, Precision

__all__ = ["DEFAULT_METHOD", "Estimator", "MethodOptions", "check_method", "make_estimator", "method_names"]

DEFAULT_METHOD = "spline-net"


@dataclass(frozen=True)
class MethodOptions:
    """Settings of a method, None for its default. Each method ignores those that do not apply to it.

    weights: a shipped name or a file.
    rotations: number of rotations of the lights whose normals a network averages.
    batch_size: pixels per batch. A processor computes a batch on each core.
    device: where to compute; "auto" is a CUDA GPU if there is one.
    precision: number format of a network; "auto" is bfloat16 where the device computes natively in it.
    """

    weights: str | None = None
    rotations: int | None = None
    batch_size: int | None = None
    device: Device = "auto"
    precision: Precision = "auto"


def make_estimator(name: str, options: MethodOptions = MethodOptions()) -> Estimator:
    """Return the estimator of this name.

    Methods that run in PyTorch (all but "ls") limit its threads to the cores that the process may use; see
    splinecli.system.machine.use_available_cores.

    Raises:
        UsageError: the name, the device or a number is not valid.
        ModelError: the weights cannot be used.
    """
    check_method(name)
    return _METHODS[name](name, options)


def check_method(name: str) -> None:
    """Raise UsageError if no method has this name. Loads nothing heavy."""
    check_one_of("method", name, _METHODS)


def method_names() -> list[str]:
    """Return the names of all methods."""
    return list(_METHODS)


def _least_squares(*_: object) -> Estimator:
    from splinecli.methods.estimator import LeastSquares

    return LeastSquares()


def _solver(name: str, options: MethodOptions, *, fit: str, batch_size: int) -> Estimator:
    from splinecli.methods.batched import BatchedEstimator
    from splinecli.system.machine import choose_device, use_available_cores

    use_available_cores()
    module, function = fit.split(".")
    solve = getattr(import_module(f"splinecli.fits.{module}"), function)
    size = batch_size if options.batch_size is None else options.batch_size
    return BatchedEstimator(name, solve, str(choose_device(options.device)), size)


def _network(name: str, options: MethodOptions, *, weights: str, rotations: int, refines: bool = True) -> Estimator:
    from splinecli.methods.batched import NetworkEstimator
    from splinecli.networks.weights import resolve_weights
    from splinecli.system.machine import choose_device, choose_precision, use_available_cores

    use_available_cores()
    device = choose_device(options.device)
    return NetworkEstimator(
        name,
        resolve_weights(options.weights or weights),
        device=device,
        precision=choose_precision(options.precision, device),
        refines=refines,
        rotations=rotations if options.rotations is None else options.rotations,
        batch_size=_BATCH[device.type] if options.batch_size is None else options.batch_size,
    )


_BATCH = {"cpu": 256, "cuda": 1024}  # Pixels in a network's batch. Processors compute a batch on each core.

_METHODS: dict[str, Callable[[str, MethodOptions], Estimator]] = {
    "spline-net": partial(_network, weights="spline-net", rotations=1),
    "cnn-ps": partial(_network, weights="cnn-ps", rotations=10),
    "ls": _least_squares,
    "ls-trimmed": partial(_solver, fit="least_squares.solve_trimmed", batch_size=8192),
    "l1": partial(_solver, fit="least_squares.solve_l1", batch_size=8192),
    "iw12": partial(_solver, fit="least_squares.solve_iw12", batch_size=8192),
    "st14": partial(_solver, fit="st14.solve_st14", batch_size=1024),
    "ia14": partial(_solver, fit="ia14.solve_ia14", batch_size=1024),
    "spline-net-pixelwise": partial(_network, weights="spline-net", rotations=1, refines=False),
}
