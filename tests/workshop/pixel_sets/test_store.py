"""Pixel sets are read as they were written, and damaged ones are refused."""

import json
import os
from typing import Any

import numpy as np

from kills import content, killed_at_every_step
from scenes import names_in, parametrize, put, read_json, refuses
from small_pixel_sets import matte_pixels
from splinecli.errors import OutputError
from splinecli.system.publishing import held_folder
from splinecli.workshop.pixel_sets.store import (
    ARRAYS,
    FORMAT,
    MANIFEST,
    PixelSetWriter,
    open_pixel_set,
)

RECIPE = {"scenes": {"lights": 30}, "seed": 1}


def read_manifest(folder):
    return read_json(folder / MANIFEST)


@parametrize("dtype", [np.float16, np.float32])
def test_round_trip(tmp_path, dtype):
    folder = tmp_path / "new" / "set"
    writer = PixelSetWriter(folder)
    written = {
        name: matte_pixels(7, 5 + seed, seed=seed, dtype=dtype) for seed, name in enumerate("ab")
    }
    for name, pixels in written.items():
        writer.add(name, f"scene {name}", "a test", RECIPE, pixels)
        assert name in writer
    assert writer.describe("b") == "b: 7 pixels, 6 lights, a test"
    finished = writer.finish()
    opened = open_pixel_set(folder)
    assert opened == finished
    assert [entry.scene for entry in opened.entries] == ["scene a", "scene b"]
    assert [(entry.n_pixels, entry.n_lights) for entry in opened.entries] == [(7, 5), (7, 6)]
    for entry in opened.entries:
        loaded = opened.load(entry)
        for array in ARRAYS:
            found, expected = getattr(loaded, array), getattr(written[entry.name], array)
            assert found.dtype == expected.dtype and isinstance(found.base, np.memmap)
            np.testing.assert_array_equal(found, expected)
    assert opened.load(opened.entries[0]).observations.dtype == dtype
    manifest = read_manifest(folder)
    assert manifest["format"] == FORMAT
    assert [entry["recipe"] for entry in manifest["entries"]] == [RECIPE, RECIPE]
    assert (manifest["n_pixels"], manifest["complete"]) == (14, True)
    assert names_in(folder) == {"a", "b", MANIFEST}


def test_continuing_keeps_existing_entries(tmp_path):
    PixelSetWriter(tmp_path).add("a", "a", "a test", RECIPE, matte_pixels(7, 5))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "a").iterdir()}
    again = PixelSetWriter(tmp_path)
    assert "a" in again
    again.add("b", "b", "a test", RECIPE, matte_pixels(3, 5))
    assert again.finish() == open_pixel_set(tmp_path)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "a").iterdir()} == before
    # Entries may be added to a finished set. Until that is finished, training refuses the set.
    more = PixelSetWriter(tmp_path)
    assert len(open_pixel_set(tmp_path).entries) == 2
    more.add("c", "c", "a test", RECIPE, matte_pixels(3, 5))
    with refuses("not finished"):
        open_pixel_set(tmp_path)
    assert len(more.finish().entries) == 3


def test_recipes_are_compared(tmp_path):
    PixelSetWriter(tmp_path).add("a", "a", "a test", RECIPE, matte_pixels(7, 5))
    writer = PixelSetWriter(tmp_path)
    assert writer.difference("a", dict(reversed(RECIPE.items()))) is None
    assert writer.difference("a", {**RECIPE, "seed": 2}) == "seed = 1, not 2"
    assert writer.difference("a", {"seed": 1}) == "scenes = {'lights': 30}, not None"


def test_a_replacement_killed_at_any_step_leaves_the_old_set_or_an_unfinished_one(tmp_path):
    old, new, kept = matte_pixels(7, 5), matte_pixels(9, 4), []

    def make(folder):
        writer = PixelSetWriter(folder)
        writer.add("a", "a", "a test", RECIPE, old)
        writer.finish()

    def replace(folder):
        PixelSetWriter(folder).add("a", "a", "a test", {"seed": 2}, new)

    for folder in killed_at_every_step(tmp_path, make, replace):
        with held_folder(folder):
            again = PixelSetWriter(folder)
        kept.append(again.recipe_of("a") if "a" in again else None)
        if kept[-1] == RECIPE:
            assert [entry.n_pixels for entry in open_pixel_set(folder).entries] == [7]
        else:
            with refuses("not finished"):
                open_pixel_set(folder)
            if kept[-1] is None:  # while its files changed, the set did not have the entry
                replace(folder)
                again = PixelSetWriter(folder)
            (entry,) = again.finish().entries
            assert entry.n_pixels == 9
            assert entry.recipe == {"seed": 2}
            assert open_pixel_set(folder).entries == (entry,)
    assert all(recipe in kept for recipe in (RECIPE, None, {"seed": 2}))


def test_a_folder_with_other_files_is_left_alone(tmp_path):
    put(tmp_path / "thesis.tex", "\\begin")
    with refuses("has files in it but is not a pixel set", OutputError):
        PixelSetWriter(tmp_path)
    assert content(tmp_path) == {"thesis.tex": b"\\begin"}
    with refuses("found a file, expected a folder", OutputError):
        PixelSetWriter(tmp_path / "thesis.tex")


@parametrize(
    "manifest, message",
    [
        ({"name": "an app"}, "not the manifest of a pixel set: found format None"),
        (
            {"format": FORMAT, "recipe": RECIPE, "entries": [{"name": "a"}]},
            "the manifest is damaged",
        ),
    ],
)
def test_other_and_damaged_manifests_are_left_alone(tmp_path, manifest, message):
    text = json.dumps(manifest)
    put(tmp_path / MANIFEST, text)
    with refuses(message):
        PixelSetWriter(tmp_path)
    assert content(tmp_path) == {MANIFEST: text.encode()}


def test_a_set_without_entries_is_refused(tmp_path):
    with refuses(r"manifest\.json: the pixel set has no entries"):
        PixelSetWriter(tmp_path / "empty").finish()
        open_pixel_set(tmp_path / "empty")


@parametrize("array", ARRAYS)
@parametrize("entry", "a b")
def test_no_changed_byte_goes_unnoticed(make_set, array, entry):
    folder = make_set().folder
    path = folder / entry / f"{array}.npy"
    whole = path.read_bytes()
    for position in (8, 127, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        with refuses("does not match the manifest") as caught:
            open_pixel_set(folder)
        assert caught.value.path == path
    path.write_bytes(whole)
    open_pixel_set(folder)
    path.unlink()
    with refuses(f"{entry}/{array}.npy: .*found no plain file"):
        open_pixel_set(folder)


DAMAGED: dict[str, Any] = {
    "pipe": os.mkfifo,
    "link to nothing": lambda path: path.symlink_to("nothing"),
    "text": lambda path: put(path, "no array"),
    "header": lambda path: path.write_bytes(b"\x93NUMPY\x01\x00\x10\x00{'descr': '<f4',"),
    "archive": lambda path: np.savez(path.with_suffix(".npz"), 1),
    "too long": lambda path: np.save(path, np.ones((41, 30), np.float32)),
    "complex": lambda path: np.save(path, np.ones((40, 3), np.complex64)),
    "another mask": lambda path: np.save(path, np.ones((3, 5), bool)),
}


@parametrize("damage", DAMAGED)
@parametrize("array", ARRAYS)
def test_a_damaged_array_is_named(make_set, array, damage):
    """`prepare` loads the arrays of a set to draw its overview,
    without looking at the checksums.
    """
    pixel_set = make_set()
    path = pixel_set.folder / "a" / f"{array}.npy"
    path.unlink()
    DAMAGED[damage](path)
    with refuses("does not match the manifest") as caught:
        pixel_set.load(pixel_set.entries[0])
    assert caught.value.path == path


@parametrize(
    "key, value, message",
    [
        (
            "n_pixels",
            41,
            r"observations\.npy: does not match the manifest: found an array of shape \(40, 30\)",
        ),
        ("n_lights", 29, r"observations\.npy: .* expected \(40, 29\)"),
        (
            "name",
            2.5,
            r"manifest\.json: .*Expected `str`, got `float` - at `\$\.entries\[0\]\.name`",
        ),
        ("name", "../b", r"manifest\.json: '\.\./b' is not the name of a folder"),
        (
            "sha256",
            {"observations": "0" * 64},
            r"manifest\.json: .* \(the entry 'a' lacks a checksum\)",
        ),
        (
            "sha256",
            None,
            r"manifest\.json: .*Expected `object`, got `null` - at `\$\.entries\[0\]\.sha256`",
        ),
        ("n_pixels", 0, r"manifest\.json: .*Expected `int` >= 1 - at"),
        ("name", "d", r"d/observations\.npy: does not match the manifest: found no plain file"),
    ],
)
def test_a_changed_manifest(make_set, key, value, message):
    folder = make_set().folder
    manifest = read_manifest(folder)
    manifest["entries"][0][key] = value
    put(folder / MANIFEST, json.dumps(manifest))
    with refuses(message):
        open_pixel_set(folder)


@parametrize(
    "text, message",
    [
        ("{", "not JSON"),
        (
            "[]",
            "not the manifest of a pixel set: found format None, expected 'splinecli-pixel-set-1'",
        ),
        ('{"format": "splinecli-pixel-set-2"}', "found format 'splinecli-pixel-set-2', expected"),
        (f'{{"format": "{FORMAT}", "complete": true}}', "Object missing required field"),
    ],
)
def test_no_manifest(make_set, text, message):
    folder = make_set().folder
    put(folder / MANIFEST, text)
    with refuses(message) as caught:
        open_pixel_set(folder)
    assert caught.value.path == folder / MANIFEST
