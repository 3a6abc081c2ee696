"""Light files that name the image of each light: RTI's .lp, the JSON of AliceVision (Meshroom), and text.

The names often come from another machine, with folders that do not exist here, or are only numbers. So the images of
the folder are matched to them by base name, then by name without suffix, then by order.
"""

import io
import json
import reprlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from splinecli.capture.formats.text import parse_number, read_lines, split_words, uses_decimal_commas
from splinecli.capture.lights.array_files import SUFFIXES as ARRAY_SUFFIXES
from splinecli.capture.lights.light_files import lights_of, read_light_table, rows_text, unit_directions
from splinecli.capture.lights.light_frames import USUAL_FRAME, LightFrame
from splinecli.capture.lights.light_rows import RowForm, image_name
from splinecli.errors import InputError, UsageError
from splinecli.maths import Doubles
from splinecli.system.files import parse_json

SUFFIXES = (".lp", ".json")
_MOST_DIGITS = 9  # of the number of lights


@dataclass(frozen=True, eq=False)
class NamedLights:
    """F lights, each with the name of its image."""

    path: Path
    names: tuple[str, ...]  # names of the images, without folders
    lines: tuple[int | None, ...]  # the line of each light in the file; None for each where the file has no lines
    directions: Doubles  # (F, 3) float64, unit; x right, y up, z to the camera
    intensities: Doubles | None = None  # (F, 3) float64, RGB, or None where the file has none

    def match(self, images: Sequence[Path]) -> tuple[tuple[Path, ...], str]:
        """Return the image of each light, and how it was matched: "name", "name without suffix" or "order".

        Images that no light names are left out, unless they are matched by order. Raises InputError where two lights
        have one name, or neither the names nor the number of images fit.
        """
        lines: dict[str, int | None] = {}
        for name, line in zip(self.names, self.lines, strict=True):
            if name.casefold() in lines:
                raise InputError(f'a second light for the image "{name}"', path=self.path, line=line)
            lines[name.casefold()] = line
        for how, part in (("name", "name"), ("name without suffix", "stem")):
            by_key = {getattr(image, part).casefold(): image for image in reversed(images)}
            wanted = [getattr(Path(name), part).casefold() for name in self.names]
            if len(set(wanted)) == len(wanted) and all(name in by_key for name in wanted):
                return tuple(by_key[name] for name in wanted), how
        if len(images) == len(self.names):
            return tuple(images), "order"
        present = {image.name.casefold() for image in images}
        missing = next((i for i, name in enumerate(self.names) if name.casefold() not in present), 0)
        raise InputError(
            f"found {len(self.names)} lights but {len(images)} images;"
            f' the image "{self.names[missing]}" is not among them',
            path=self.path,
            line=self.lines[missing],
            hint="Correct the names in the file, or give as many images as lights, in the same order",
        )


def read_lights(
    path: Path, n_images: int, frame: LightFrame = USUAL_FRAME, form: RowForm = "xyz"
) -> NamedLights | Doubles:
    """Return the lights of any light file: directions (F, 3) in the order of the images, or lights that name theirs.

    The frame of a JSON file is relative to AliceVision's, which has y down and z away. Raises InputError; see
    read_light_directions.
    """
    if path.suffix.lower() in SUFFIXES:
        return _read_json(path, frame) if path.suffix.lower() == ".json" else _read_lp(path, frame)
    table = read_light_table(path, n_images, form)
    _, directions = lights_of(table, n_images if table.names is None else None, frame, form)
    if table.names is None:
        return directions
    return NamedLights(path, table.names, tuple(row.line for row in table.rows), directions)


def check_writable(path: Path) -> None:
    """Raise UsageError for a light file whose format is only read."""
    suffix = path.suffix.lower()
    if suffix not in (".lp", ".npy") and suffix in (*SUFFIXES, *ARRAY_SUFFIXES):
        raise UsageError(f"{path}: light files of the type {suffix} are only read", hint="Write .txt, .lp or .npy")


def encode_lights(path: Path, directions: Doubles, images: Sequence[Path]) -> bytes:
    """Return a light file of directions (F, 3) of images, in the format that its suffix names; see check_writable."""
    suffix, text = path.suffix.lower(), rows_text(directions)
    if suffix == ".npy":
        np.save(file := io.BytesIO(), directions)
        return file.getvalue()
    if suffix == ".lp":
        rows = zip(images, text.splitlines(), strict=True)
        text = f"{len(images)}\n" + "".join(f"{image.name} {row}\n" for image, row in rows)
    return text.encode(errors="surrogateescape")


def _read_lp(path: Path, frame: LightFrame) -> NamedLights:
    """Read RTI's format: the number of lights, then a line `file name x y z` for each. Names may contain spaces."""
    stored = read_lines(path, else_latin_1=True)
    content = [(line, text.strip()) for line, text in enumerate(stored, start=1) if text.strip()]
    if not content:
        raise InputError("the file is empty, expected the number of lights on the first line", path=path)
    (first, count), *rows = content
    if not count.isdecimal():
        raise InputError(f'found "{count[:40]}", expected the number of lights', path=path, line=first)
    if int(count[:_MOST_DIGITS]) != len(rows):
        problem = f"the first line says {count[:40]} lights, but {len(rows)} lines follow"
        raise InputError(problem, path=path, line=first, hint="Correct the number, or restore the missing lines")
    if not rows:
        raise InputError("the file contains no lights", path=path, line=first)
    names, vectors = [], []
    commas = uses_decimal_commas([text for _, text in rows], 3)
    for line, text in rows:
        words = text.rsplit(maxsplit=3)
        if len(words) < 4:
            raise InputError(f'found "{text[:40]}", expected a file name and x y z', path=path, line=line)
        names.append(image_name(words[0], []))
        numbers = split_words(" ".join(words[1:]), decimal_commas=commas)
        vectors.append([parse_number(word, path, line) for word in numbers[:3]])
    lines = tuple(line for line, _ in rows)
    directions = unit_directions(np.array(vectors) @ frame.matrix.T + 0.0, path, lines, [""] * len(lines))
    return NamedLights(path, tuple(names), lines, directions)


def _read_json(path: Path, frame: LightFrame) -> NamedLights:
    """Read AliceVision's lights: objects with viewId, type (directional), direction [x, y, z], intensity [r, g, b]."""
    try:
        document = parse_json("\n".join(read_lines(path)))
    except json.JSONDecodeError as error:
        raise InputError(f"is not JSON ({error.msg})", path=path, line=error.lineno) from None
    except ValueError as error:
        raise InputError(f"cannot be read as JSON ({error})", path=path) from None
    lights = document.get("lights") if isinstance(document, dict) else None
    if not isinstance(lights, list) or not lights:
        raise InputError('found no list "lights", expected lights as AliceVision writes them', path=path)
    names, vectors, intensities = [], [], []
    for number, light in enumerate(lights, start=1):
        if not isinstance(light, dict):
            raise InputError(f"light {number} is not an object", path=path)
        kind = light.get("type", "directional")
        if kind != "directional":
            problem = f"light {number} is of type {reprlib.repr(kind)}, expected 'directional'"
            raise InputError(problem, path=path, hint="Calibrate for distant lights, one direction a light")
        names.append(image_name(str(light.get("viewId", number)), []))
        vectors.append(_three_numbers(light, "direction", number, path))
        if "intensity" in light:
            intensities.append(_three_numbers(light, "intensity", number, path))
            if (least := min(intensities[-1])) <= 0:
                raise InputError(f"light {number} has the intensity {least:g}, expected above 0", path=path)
    if intensities and len(intensities) != len(lights):
        problem = f"{len(intensities)} of {len(lights)} lights have an intensity, expected all or none"
        raise InputError(problem, path=path)
    turned = np.array(vectors) * (1.0, -1.0, -1.0) @ frame.matrix.T + 0.0  # no -0
    lines, places = (None,) * len(lights), [f" as light {number}" for number in range(1, len(lights) + 1)]
    directions = unit_directions(turned, path, lines, places)
    return NamedLights(path, tuple(names), lines, directions, np.array(intensities) if intensities else None)


def _three_numbers(light: dict[str, Any], key: str, number: int, path: Path) -> list[float]:
    values = light.get(key)
    numbers = [
        float(value)
        for value in (values if isinstance(values, list) else ())
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    ]
    if len(numbers) != 3 or len(values or ()) != 3:
        raise InputError(f"light {number} has {key!r} {reprlib.repr(values)}, expected three numbers", path=path)
    return numbers
