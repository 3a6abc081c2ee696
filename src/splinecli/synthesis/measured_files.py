"""Read files of measured materials, check them, and leave out materials that are not plausible."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splinecli.capture.paths import check_file
from splinecli.errors import InputError
from splinecli.synthesis.measured import MeasuredLibrary, evaluate, half_and_difference

# Limits that a fitted network may exceed only if its fit failed. The MERL networks that pass stay well below: they
# reflect at most 89 % (at 88 degrees), differ from reciprocity by at most 4 %, and are black nowhere.
BRIGHTEST = 1.1
MOST_ASYMMETRIC = 0.05
MOST_BLACK = 0.01

_VIEWS = 16
_HALF_TILTS, _HALF_AZIMUTHS = 48, 12
_PAIRS = 2000
_LAYERS = ("W1", "b1", "W2", "b2", "W3", "b3")


def read_measured(path: str | Path, device: torch.device | str = "cpu") -> MeasuredLibrary:
    """Read the plausible materials of a file (docs/files-and-frames.md), in float32 on `device`.

    A material is left out, and named in `dropped`, if one of these is true:

    - It reflects more than BRIGHTEST of the light from one direction, or a value is not finite.
    - Exchanging light and view changes the BRDF, |a - b| / (a + b), by more than MOST_ASYMMETRIC. This is the median
      over pairs of directions, uniform by projected area.
    - The BRDF is zero for more than MOST_BLACK of these pairs.

    Raises:
        InputError: the file is missing, damaged or of another form, or has no plausible material.
    """
    path = Path(path)
    arrays = _read_arrays(path)
    names = _check_form(arrays, path)
    layers = _fold_biases([torch.from_numpy(arrays[key].astype(np.float32)) for key in _LAYERS])
    reflected = directional_albedos(layers)
    faults = _faults(layers, reflected)
    kept = [number for number, fault in enumerate(faults) if not fault]
    dropped = {name: fault for name, fault in zip(names, faults, strict=True) if fault}
    if not kept:
        raise InputError(
            f"none of its {len(names)} materials is plausible; {names[0]!r} is {faults[0]}", path=path
        )
    first, second, last = (layer[kept].to(device) for layer in layers)
    return MeasuredLibrary(
        tuple(names[number] for number in kept),
        (first, second, last),
        reflected.mean(dim=1)[kept].to(device),
        reflected.amax(dim=1)[kept].to(device),
        dropped,
    )


def directional_albedos(layers: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Return the reflected share of the light from each of 16 directions, (M, 16, 3).

    The directions are uniform by projected area, so that their plain mean is the albedo under diffuse light. By
    reciprocity, each direction is used as the view, and the light is integrated. The integral is over half vectors,
    d omega_l = 4 (l.h) d omega_h, and denser near the normal, where highlights are narrow.
    """
    cosine_v = (1 - (torch.arange(_VIEWS) + 0.5) / _VIEWS).sqrt()[:, None]
    root = (torch.arange(_HALF_TILTS) + 0.5) / _HALF_TILTS
    tilt = root.square() * math.pi / 2
    azimuth = (torch.arange(_HALF_AZIMUTHS) + 0.5) / _HALF_AZIMUTHS * math.pi
    # Azimuths from 0 to 180 degrees suffice, by symmetry.
    area = tilt.sin() * root * math.pi / _HALF_TILTS * 2 * math.pi / _HALF_AZIMUTHS
    area = area[:, None].expand(-1, _HALF_AZIMUTHS).reshape(1, -1)
    cosine_h = tilt.cos()[:, None].expand(-1, _HALF_AZIMUTHS).reshape(1, -1)
    across = (tilt.sin()[:, None] * azimuth.cos()).reshape(1, -1)
    v_dot_h = (1 - cosine_v * cosine_v).sqrt() * across + cosine_v * cosine_h
    cosine_l = 2 * v_dot_h * cosine_h - cosine_v
    seen = (v_dot_h > 0) & (cosine_l > 0)
    weight = (4 * v_dot_h * area * cosine_l) * seen
    brdf = _evaluate_all(
        layers, cosine_l.clamp(min=0), cosine_v.expand_as(cosine_l), 2 * v_dot_h * v_dot_h - 1
    )
    return (brdf.view(len(brdf), 3, *weight.shape) * weight).sum(dim=-1).transpose(1, 2)


def _faults(layers: tuple[Tensor, Tensor, Tensor], reflected: Tensor) -> list[str]:
    """Return why each of the materials is not plausible, an empty text for a plausible one."""
    # The sequence begins with zeros, where light, view and normal coincide.
    engine = torch.quasirandom.SobolEngine(3)  # type: ignore[no-untyped-call]
    spread = engine.draw(_PAIRS + 1)[1:]
    # Uniform by projected area up to 85 degrees, as the pixels of a sphere see lights and view.
    squared = spread[:, :2] * math.sin(math.radians(85)) ** 2
    n_dot_l, n_dot_v = (1 - squared).sqrt().T
    l_dot_v = squared.prod(dim=1).sqrt() * (math.pi * spread[:, 2]).cos() + n_dot_l * n_dot_v
    brdf = _evaluate_all(layers, n_dot_l, n_dot_v, l_dot_v).mean(dim=1)
    exchanged = _evaluate_all(layers, n_dot_l, n_dot_v, l_dot_v, exchanged=True).mean(dim=1)
    black = (brdf <= 1e-6).float().mean(dim=1)
    asymmetry = ((brdf - exchanged).abs() / (brdf + exchanged).clamp(min=1e-9)).median(dim=1).values
    brightest = reflected.mean(dim=2).amax(dim=1)
    faults = []
    for bright, dark, uneven in zip(brightest.tolist(), black.tolist(), asymmetry.tolist(), strict=True):
        # The comparisons are negated so that NaN counts as a fault.
        if not bright <= BRIGHTEST:
            faults.append(f"too bright: it reflects {100 * bright:.0f} % of the light")
        elif not dark <= MOST_BLACK:
            faults.append(f"black under {100 * dark:.0f} % of the lights above the surface")
        elif not uneven <= MOST_ASYMMETRIC:
            faults.append(f"not reciprocal: exchanging light and view changes it by {100 * uneven:.0f} %")
        else:
            faults.append("")
    return faults


def _evaluate_all(
    layers: tuple[Tensor, Tensor, Tensor],
    n_dot_l: Tensor,
    n_dot_v: Tensor,
    l_dot_v: Tensor,
    *,
    exchanged: bool = False,
) -> Tensor:
    """Return the BRDFs (M, 3, N) of all materials for cosines of N elements in any shape.

    `exchanged` takes the other direction as the light, which a reciprocal BRDF does not notice.
    """
    vectors = half_and_difference(*(cosine.reshape(1, -1) for cosine in (n_dot_l, n_dot_v, l_dot_v)))
    if exchanged:
        vectors[:, 3] *= -1
    # One material at a time, because the hidden layers of a hundred materials would fill gigabytes.
    return torch.cat(
        [evaluate([layer[m : m + 1] for layer in layers], vectors) for m in range(len(layers[0]))]
    )


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    check_file(path, "an .npz file of measured materials")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {key: archive[key] for key in ("names", *_LAYERS) if key in archive.files}
    except Exception:  # damaged archives and array headers raise many kinds of errors
        raise InputError("not an .npz file of plain arrays, or damaged", path=path) from None


def _check_form(arrays: dict[str, NDArray[Any]], path: Path) -> list[str]:
    """Return the names of the materials.

    Raises:
        InputError: an array is missing, is not of real numbers, or does not fit the others.
    """
    for key in ("names", *_LAYERS):
        if key not in arrays:
            raise InputError(
                f"found no array {key!r}", path=path, hint="docs/files-and-frames.md lists all seven"
            )
    names = arrays["names"]
    if names.ndim != 1 or names.dtype.kind != "U" or not len(names) or len(set(names.tolist())) < len(names):
        raise InputError(
            f"found names of type {names.dtype} and shape {names.shape}, expected a list of distinct texts",
            path=path,
        )
    first = arrays["b1"].shape[-1] if arrays["b1"].ndim else 0
    second = arrays["b2"].shape[-1] if arrays["b2"].ndim else 0
    shapes = ((6, first), (first,), (first, second), (second,), (second, 3), (3,))
    for key, shape in zip(_LAYERS, shapes, strict=True):
        array, expected = arrays[key], (len(names), *shape)
        if array.dtype.kind != "f" or array.shape != expected or not array.size:
            raise InputError(
                f"found {key} of type {array.dtype} and shape {array.shape}, expected floating-point {expected}",
                path=path,
            )
        if not np.isfinite(array).all():
            raise InputError(f"{key} has values that are not finite", path=path)
    return [str(name) for name in names]


def _fold_biases(arrays: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the layers of MeasuredLibrary, (M, out, in), from W1 (M, in, out), b1 (M, out) and so on."""
    w1, b1, w2, b2, w3, b3 = arrays
    first = w1.transpose(1, 2).clone()
    # In the file the half vector's y is 0. In half_and_difference it is 1, the factor of the biases.
    first[:, :, 1] = b1
    always = torch.zeros(len(w1), 1, 6)
    always[:, :, 1] = 1
    first = torch.cat((first, always), dim=1)
    second = torch.cat((w2.transpose(1, 2), b2[:, :, None]), dim=2)
    always = torch.zeros(len(w1), 1, second.shape[2])
    always[:, :, -1] = 1
    second = torch.cat((second, always), dim=1)
    return first, second, torch.cat((w3.transpose(1, 2), b3[:, :, None]), dim=2)
