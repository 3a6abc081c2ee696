"""The options of `infer`, as one frozen record that can be written as JSON and pickled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import inf, isfinite
from typing import Any, Literal, get_args

from splinecli.capture.lights.draws import check_draw_settings
from splinecli.capture.record import check_light_indices
from splinecli.errors import UsageError, check_one_of
from splinecli.maths.normals import Convention
from splinecli.methods import DEFAULT_METHOD, MethodOptions, check_method
from splinecli.pictures.maps import CURVATURE_SCALE, RELIEF_SCALE
from splinecli.pipeline.reading import Reading
from splinecli.pipeline.surface import check_pixel_size
from splinecli.results.files import MAPS, NORMALS, SCALED_MAPS
from splinecli.surface.bilateral_equations import STIFFNESS
from splinecli.system.exr import check_exr

Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]


@dataclass(frozen=True, kw_only=True)
class InferOptions(Reading):
    """The options of `infer`, as its help describes them.

    Two records are equal if they give the same results. `output` and `device` do not count. Raises UsageError if a
    value is unknown, or two options contradict each other.

    Args:
        n_lights: None for all. light_indices: counted from 0.
        distil: False for the method on every pixel, None for the faster way.
        formats, maps: names of `splinecli.results.files.NORMALS` and MAPS.
        curvature_scale, relief_scale: the value that is white in the picture; see `splinecli.pictures.maps`.
    """

    refine_lights: bool = False
    auto_mask: bool = False
    as_stored: bool = False
    n_lights: int | None = None
    seed: int = 0
    light_indices: tuple[int, ...] | None = None
    method: str = DEFAULT_METHOD
    weights: str | None = None
    distil: bool | None = None
    device: Device = field(default="auto", compare=False)
    precision: Precision = "auto"
    output: str = field(default="out", compare=False)
    formats: tuple[str, ...] = ("png", "npy")
    maps: tuple[str, ...] = ()
    curvature_scale: float = CURVATURE_SCALE
    relief_scale: float = RELIEF_SCALE
    html: bool = False
    surface: bool = False
    stiffness: float = STIFFNESS
    convention: Convention = "opengl"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_lights is not None and self.light_indices is not None:
            raise UsageError("--n-lights and --light-indices contradict each other", hint="Leave one out")
        if self.mask is not None and self.auto_mask:
            raise UsageError("--mask and --auto-mask contradict each other", hint="Leave one out")
        if self.finds_lights and self.refine_lights:
            raise UsageError("--lights estimate refines the lights that it finds", hint="Leave --refine-lights out")
        check_method(self.method)
        check_pixel_size(self.pixel_size if self.surface else None)
        if not (isfinite(self.stiffness) and self.stiffness >= 0):
            raise UsageError(f"the stiffness is {self.stiffness:g}, expected a number of at least 0")
        if self.n_lights is not None:
            check_draw_settings(self.n_lights, 1, self.seed)
        if self.light_indices is not None:
            check_light_indices(self.light_indices, max(self.light_indices, default=0) + 1)
        check_one_of("precision", self.precision, get_args(Precision))
        check_one_of("device", self.device, get_args(Device))
        check_one_of("convention", self.convention, get_args(Convention))
        for name in self.formats:
            check_one_of("format", name, NORMALS)
        for name in self.maps:
            check_one_of("map", name, MAPS)
        for name in SCALED_MAPS:
            scale = getattr(self, f"{name}_scale")
            if not 0 < scale < inf:
                raise UsageError(f"the scale of the map {name} is {scale:g}, expected a number above 0")

    def as_dict(self) -> dict[str, Any]:
        """Return the options as JSON values."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> InferOptions:
        """Return the options that `as_dict` wrote. Raises TypeError for an unknown name, UsageError as above."""
        given: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in values.items()
        }
        return cls(**given)

    @property
    def method_options(self) -> MethodOptions:
        """The part of the options that concerns the method."""
        return MethodOptions(self.weights, device=self.device, precision=self.precision)

    def check_files(self) -> None:
        """See Reading. Raise UsageError, too, if a package that the options need is not installed."""
        super().check_files()
        check_exr(self.formats)
