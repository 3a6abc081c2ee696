"""The methods by name. Each method is one file and one row of METHODS.

The file is imported when the method is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pkgutil import resolve_name

from splinecli.errors import ModelError, check_one_of
from splinecli.estimate.methods.estimator import Estimator, LeastSquares
from splinecli.system.machine import Device, Precision

__all__ = [
    "METHODS",
    "Estimator",
    "Method",
    "MethodOptions",
    "check_method",
    "make_estimator",
    "method_names",
]
DEFAULT_METHOD = "spline-net"


@dataclass(frozen=True)
class MethodOptions:
    """Settings of a method; None selects the method's default. Settings that do not apply are
    ignored.
    """

    weights: str | None = None  # the name of shipped weights, or a file
    # number of rotations of the lights over which a network's normals are averaged
    rotations: int | None = None
    # most pixels per batch. On a CPU, each core computes one batch
    batch_size: int | None = None
    device: Device = "auto"  # where to compute; "auto" is a CUDA GPU if there is one
    # of a network; "auto" is bfloat16 if the device computes faster in it
    precision: Precision = "auto"


@dataclass(frozen=True)
class Method:
    """A row of METHODS."""

    # makes an estimator from the method's name and options, including heavy imports
    make: Callable[[str, MethodOptions], Estimator]
    # for the documentation; a method without a source is splinecli's own
    principle: str
    source: str = "-"
    observation_maps: bool = False  # whether evaluations can plot its observation maps


def make_estimator(name: str, options: MethodOptions = MethodOptions()) -> Estimator:
    """Return the estimator with this name.

    Methods that use PyTorch limit its threads to the cores that the process may use; see
    splinecli.system.machine.use_available_cores. Raises UsageError if the name, the device or a
    number is invalid, or ModelError if the weights cannot be used.

    Examples:
        >>> from splinecli.estimate.methods import make_estimator
        >>> make_estimator("ls").name
        'ls'
    """
    check_method(name)
    return METHODS[name].make(name, options)


def check_method(name: str) -> None:
    """Raise UsageError if no method has this name. Nothing heavy is imported."""
    check_one_of("method", name, METHODS)


def method_names() -> list[str]:
    """Return the names of all methods."""
    return list(METHODS)


def _fit(name: str, options: MethodOptions, *, solve: str, batch_size: int = 8192) -> Estimator:
    from splinecli.estimate.methods.batched import BatchedEstimator
    from splinecli.system.machine import choose_device, use_available_cores

    use_available_cores()
    size = batch_size if options.batch_size is None else options.batch_size
    device = str(choose_device(options.device))
    return BatchedEstimator(name, resolve_name(f"splinecli.estimate.fits.{solve}"), device, size)


def _network(
    name: str,
    options: MethodOptions,
    *,
    weights: str,
    rotations: int = 1,
    interpolates: bool = True,
    refines: bool = True,
) -> Estimator:
    """Return the estimator of a network, which has a LI-Net if it interpolates. Raises ModelError
    if the weights are of the other kind.
    """
    from splinecli.estimate.methods.batched import NetworkEstimator
    from splinecli.estimate.networks.weights import resolve_weights
    from splinecli.system.machine import choose_device, choose_precision, use_available_cores

    use_available_cores()
    device = choose_device(options.device)
    loaded = resolve_weights(options.weights or weights)
    if loaded.network.config.interpolates != interpolates:
        kind, fitting = ("CNN-PS", "cnn-ps") if interpolates else ("SPLINE-Net", "spline-net")
        raise ModelError(
            f"the weights {loaded.name!r} are for {kind}, so the method {name} cannot use them",
            hint=f"Use them with --method {fitting}",
        )
    return NetworkEstimator(
        name,
        loaded,
        device=device,
        precision=choose_precision(options.precision, device),
        refines=refines,
        rotations=rotations if options.rotations is None else options.rotations,
        batch_size=1024 if options.batch_size is None else options.batch_size,
    )


METHODS: dict[str, Method] = {
    "spline-net": Method(
        partial(_network, weights="spline-net"),
        "LI-Net and NE-Net, removal of indirect light, and the refinement nets",
        "Zheng et al., ICCV 2019, with [changes](method.md)",
        observation_maps=True,
    ),
    "cnn-ps": Method(
        partial(_network, weights="cnn-ps", rotations=10, interpolates=False),
        "NE-Net on the sparse observation map alone; the average of ten rotations",
        "Ikehata, ECCV 2018",
    ),
    "ls": Method(
        lambda *_: LeastSquares(),
        "sum of squared residuals of I = L b, shadows included",
        "Woodham, Optical Engineering 1980",
    ),
    "ls-trimmed": Method(
        partial(_fit, solve="least_squares:solve_trimmed"),
        "the same without the darkest and brightest fifth of each pixel's observations and"
        " without shadows",
    ),
    "l1": Method(
        partial(_fit, solve="least_squares:solve_l1"), "sum of absolute residuals of I = L b"
    ),
    "iw12": Method(
        partial(_fit, solve="least_squares:solve_iw12"),
        "I = L b + e with sparse e, by sparse Bayesian learning",
        "Ikehata et al., CVPR 2012",
    ),
    "st14": Method(
        partial(_fit, solve="st14:solve_st14", batch_size=1024),
        "a bi-polynomial reflectance in n.h and l.h, fitted to the low intensities",
        "Shi et al., TPAMI 2014",
    ),
    "ia14": Method(
        partial(_fit, solve="ia14:solve_ia14", batch_size=1024),
        "n.l as a monotone Bernstein polynomial of the observation and l.v; one quadratic"
        " programme for each pixel",
        "Ikehata and Aizawa, CVPR 2014",
    ),
    "spline-net-pixelwise": Method(
        partial(_network, weights="spline-net", refines=False),
        "`spline-net` without the refinement nets and without removal of indirect light",
        observation_maps=True,
    ),
}
