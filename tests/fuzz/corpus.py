"""Small whole inputs of every kind that splinecli reads, and the commands that read them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tifffile
import trimesh
from PIL import Image, ImageCms
from scipy.io import savemat

from scenes import (
    ball,
    pinhole,
    put,
    shade,
    spiral_lights,
    tilted,
    to_uint16,
    write_capture,
    write_image,
    write_mirror_ball,
)

SHAPE = (16, 18)
LIGHTS = spiral_lights(6, 30, 0)
OUT = "out"
"""The folder that commands write into. An earlier run has filled it."""


@dataclass(frozen=True)
class Target:
    """A kind of input."""

    name: str  # for people, and the name of its folder
    write: Callable  # writes its files into an empty folder
    patterns: str  # of the files that are mutated
    lines: str  # the arguments of each command that reads them, a command a line
    # the commands whose output is there before; the first of `lines` if there is none
    earlier_lines: str = ""
    grows: bool = False  # whether a command that fails late has already added to the earlier output

    @property
    def files(self):
        return self.patterns.split()

    @property
    def commands(self):
        return self.lines.strip().splitlines()

    @property
    def earlier(self):
        return self.earlier_lines.strip().splitlines() or self.commands[:1]


def normals():
    """Normals (H, W, 3) of a flat sphere."""
    y, x = np.indices(SHAPE)
    return tilted((x - 8.5) / 22.5, (7.5 - y) / 20)


PICTURES = to_uint16(np.moveaxis(shade(normals(), LIGHTS), 2, 0) * 50_000)
GRAY = (PICTURES // 257).astype(np.uint8)


def png_capture(folder):
    """DiLiGenT's layout, with every optional file."""
    mask = np.indices(SHAPE).sum(axis=0) > 3
    write_capture(folder, PICTURES, LIGHTS, mask=mask, intensities=np.ones((len(LIGHTS), 3)))
    put(folder / "filenames.txt", "".join(f"{number:03}.png\n" for number in range(len(LIGHTS))))
    write_image(folder / "ambient.png", np.full(SHAPE, 20, np.uint16))
    savemat(folder / "Normal_gt.mat", {"Normal_gt": normals()}, do_compression=True)


def jpeg_capture(folder):
    write_capture(folder, np.repeat(GRAY[..., None], 3, axis=3), None, names="{}.jpg")
    lines = [f"C:\\rti\\{n}.jpg {x} {y} {z}" for n, (x, y, z) in enumerate(LIGHTS)]
    put(folder / "rti.lp", "\n".join([str(len(LIGHTS)), *lines]))
    alpha = np.dstack([np.full(SHAPE, 200)] * 3 + [np.tri(*SHAPE, k=8) * 255])
    write_image(folder / "mask.png", np.uint8(alpha))
    np.save(folder / "normal_gt.npy", np.float32(normals()))


def tiff_capture(folder):
    for number, value in enumerate(PICTURES):
        path, rgb = folder / f"{number}.tif", np.dstack([value] * 3)
        if number == 3:
            tifffile.imwrite(path, np.float32(value) / 65_535)
        elif number == 4:
            write_image(path, value)  # LZW
        else:
            packed = "zlib" if number in (1, 2) else None
            tifffile.imwrite(path, rgb, photometric="rgb", compression=packed)
    known = {"type": "directional", "intensity": [1.0, 1.0, 1.0]}
    lights = [
        {"viewId": number, "direction": [x, -y, -z], **known}
        for number, (x, y, z) in enumerate(LIGHTS)
    ]
    put(folder / "lights.json", json.dumps({"lights": lights}))
    np.savetxt(folder / "normal_gt.txt", normals().reshape(-1, 3))
    tifffile.imwrite(folder / "mask.tif", np.full(SHAPE, 255, np.uint8))
    put(folder / "draws.txt", "0 1 2 3\n1 2 3 4\n")


def pgm_and_stack_captures(folder):
    write_capture(folder / "pgm", PICTURES, LIGHTS, names="{}.pgm")
    write_capture(folder / "stack", [], LIGHTS)
    tifffile.imwrite(folder / "stack/stack.tif", PICTURES, photometric="minisblack")


def mat_captures(folder):
    """Photographs, mask and lights in one .mat file, and lamps of near_ps."""
    pictures = np.moveaxis(PICTURES, 0, -1)
    mask = np.ones(SHAPE, np.uint8)
    for name, arrays in (
        ("array", {"I": pictures, "S": LIGHTS.T, "mask": mask}),
        ("numbered", {f"im{number}": pictures[..., number] for number in range(len(LIGHTS))}),
    ):
        (folder / name).mkdir()
        savemat(folder / name / "a.mat", arrays, do_compression=name == "array")
    np.savetxt(folder / "numbered/lights.txt", LIGHTS)
    write_capture(folder / "lamps", PICTURES, None, names="{}.png")
    count = (len(LIGHTS), 1)
    lamps = {"S": 100 * LIGHTS * (1, -1, -1) + (0, 0, 500), "Dir": -LIGHTS * (1, -1, -1)}
    savemat(folder / "lamps/light.mat", lamps | {"mu": np.ones(count), "Phi": np.full(count, 9e3)})
    savemat(folder / "lamps/camera.mat", {"K": pinhole(500, 9, 8)})


def light_files(folder):
    """Light files of every form, and near lamps."""
    write_capture(folder, PICTURES, None, names="{}.png")
    azimuth = np.degrees(np.arctan2(LIGHTS[:, 1], LIGHTS[:, 0]))
    np.savetxt(
        folder / "azel.txt",
        np.stack((azimuth, np.degrees(np.arcsin(LIGHTS[:, 2]))), axis=1),
        fmt="%.3f",
    )
    np.save(folder / "vectors.npy", LIGHTS)
    rows = [" ".join(f"{value:.6f}" for value in light) for light in LIGHTS]
    put(folder / "utf16.txt", "x y z\n" + "\n".join(rows), "utf-16")
    put(folder / "commas.txt", "\n".join(rows).replace(".", ",").replace(" ", ";"))
    put(folder / "named.csv", "\n".join(f"{number}.png;{row}" for number, row in enumerate(rows)))
    put(folder / "list.json", json.dumps(LIGHTS.tolist()))
    lights = [dict(zip("xyz", light, strict=True)) for light in LIGHTS.tolist()]
    objects = [{"file": f"{n}.png", "light_dir": light} for n, light in enumerate(LIGHTS.tolist())]
    put(folder / "objects.json", json.dumps({"version": 1, "images": objects}))
    put(folder / "rig.dome", json.dumps({"directions": lights, "positionsSphere": lights}))
    np.savetxt(folder / "positions.txt", 60 * LIGHTS)
    np.savetxt(folder / "light_lobes.txt", np.column_stack((-LIGHTS, np.full(len(LIGHTS), 2))))
    put(folder / "camera.txt", "500 0 9\n0 500 8\n0 0 1\n")


def normal_maps(folder):
    write_image(folder / "n.png", np.uint16(np.rint((normals()[..., ::-1] + 1) / 2 * 65_535)))
    tifffile.imwrite(folder / "n.tif", np.float32(normals()), photometric="rgb")
    np.save(folder / "n.npy", normals())
    savemat(folder / "n.mat", {"n": normals()})
    savemat(folder / "packed.mat", {"words": "text", "n": normals()}, do_compression=True)
    write_image(folder / "mask.png", np.full(SHAPE, 255, np.uint8))
    write_image(folder / "colours.jpg", np.full((*SHAPE, 3), 90, np.uint8))
    put(folder / "camera.txt", "500 0 9\n0 500 8\n0 0 1\n")


def profiles(folder):
    """Images with a colour profile, in each format that has one."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for ending in ("png", "tif", "jpg"):
        write_capture(folder / ending, [], LIGHTS[:4])
        for number, gray in enumerate(GRAY[:4]):
            picture = Image.fromarray(np.dstack([gray] * 3))
            picture.save(folder / ending / f"{number}.{ending}", icc_profile=profile)


def mirror_ball(folder):
    normals, inside = ball((40, 50), 25, 20, 16)
    write_mirror_ball(folder / "ball", normals, inside, LIGHTS[:4], width_deg=4)
    gray = to_uint16(0.5 * np.moveaxis(shade(normals, LIGHTS[:4]), 2, 0) * inside * 65_535)
    write_capture(folder / "gray", gray, None, mask=inside, names="{}.png")
    shutil.copy(folder / "gray/mask.png", folder / "ball")
    np.savetxt(folder / "known.txt", LIGHTS[:4])
    put(folder / "camera.txt", "500 0 25\n0 500 20\n0 0 1\n")


def thin(folder):
    """Images one pixel wide, and crops of one pixel."""
    for name, shape in (("column", (40, 1)), ("row", (1, 40))):
        write_capture(folder / name, [np.resize(p, shape) for p in PICTURES], LIGHTS)


def meshes(folder):
    """A tetrahedron in every format."""
    shape = trimesh.creation.cone(1, 1, sections=3)
    for ending in ("ply", "obj", "stl", "stl_ascii", "off"):
        shape.export(folder / f"m.{ending}", file_type=ending)


def two_captures(folder):
    """Captures whose results are read again: reports, thumbnails, finished trials, pixel sets."""
    for name in ("capture", "second"):
        png_capture(folder / name)
    write_settings(folder)


def weights(folder):
    import torch

    from splinecli.estimate.networks.config import NetworkConfig
    from splinecli.estimate.networks.spline_net import SplineNet
    from splinecli.workshop.save_weights import save_weights

    torch.manual_seed(0)
    config = NetworkConfig(
        map_size=8, width=2, li_blocks=1, ne_blocks=1, head_width=4, fits=("ls",)
    )
    save_weights(SplineNet(config), folder / "w.safetensors")
    torch.save({"a": torch.zeros(3)}, folder / "g.ckpt")
    torch.save({"a": torch.zeros(3)}, folder / "old.ckpt", _use_new_zipfile_serialization=False)
    png_capture(folder / "capture")


def training(folder):
    """A finished run, a pixel set, and settings: reading them takes no training step."""
    from small_pixel_sets import matte_pixels
    from splinecli.workshop.pixel_sets.store import PixelSetWriter

    writer = PixelSetWriter(folder / "set")
    for name in "ab":
        writer.add(name, name, "a test", {"by": "hand"}, matte_pixels(12, 6))
    writer.finish()
    write_settings(folder)


def write_settings(folder):
    put(
        folder / "a.toml",
        "steps = 1\nbatch_size = 4\nseed = 3\nlearning_rate = 1e-3\nschedule ="
        " 'cosine'\nheld_share = 0.0\n[pixels]\nmin_lights = 4\nmax_lights = 6\nusual_lights ="
        " 5\n[network]\nmap_size = 8\nwidth = 2\nli_blocks = 1\nne_blocks = 1\nhead_width = 4\n",
    )


LS = "--method ls -o out --overwrite"
ON_IMAGES = "--mask mask.png --colours colours.jpg --camera-matrix camera.txt -o out --overwrite"
TARGETS = (
    Target(
        "png",
        png_capture,
        "*",
        f"""
infer . {LS} --maps albedo
info . --plot plots/lights.png --overwrite
evaluate . --method ls --n-lights 4 --trials 1 -o out --overwrite
prepare . -o out/set
""",
    ),
    Target("jpeg", jpeg_capture, "*", f"infer . {LS}\ninfo ."),
    Target(
        "tiff",
        tiff_capture,
        "*",
        f"""
infer . {LS}
evaluate . --method ls --draws draws.txt -o out --overwrite
""",
    ),
    Target(
        "pgm and stack",
        pgm_and_stack_captures,
        "*/*.pgm */*.tif",
        f"""
infer pgm {LS}
infer stack {LS}
info stack
""",
    ),
    Target(
        "mat",
        mat_captures,
        "*/*.mat",
        f"""
infer array {LS}
infer numbered {LS}
infer lamps --pixel-size 1 {LS}
info array
""",
    ),
    Target(
        "lights",
        light_files,
        "*.txt *.npy *.csv *.json *.dome",
        f"""
infer . {LS} --lights vectors.npy
infer . {LS} --lights utf16.txt
infer . {LS} --lights commas.txt
infer . {LS} --lights named.csv
infer . {LS} --lights list.json
infer . {LS} --lights objects.json
infer . {LS} --lights rig.dome
infer . {LS} --lights azel.txt --light-format azel
infer . {LS} --light-positions positions.txt --pixel-size 1 --camera-matrix camera.txt
""",
    ),
    Target(
        "normals",
        normal_maps,
        "*",
        f"""
integrate n.png {ON_IMAGES}
integrate n.tif {ON_IMAGES}
integrate n.npy {ON_IMAGES}
integrate n.mat {ON_IMAGES}
integrate packed.mat {ON_IMAGES}
""",
    ),
    Target(
        "thin",
        thin,
        "*/*",
        f"""
infer column {LS}
infer row {LS}
""",
    ),
    Target(
        "meshes",
        meshes,
        "m.*",
        """
prepare --mesh m.ply --size 8 --n-lights 16 -o out/ply
prepare --mesh m.obj --size 8 --n-lights 16 -o out/obj
prepare --mesh m.stl --size 8 --n-lights 16 -o out/stl
prepare --mesh m.stl_ascii --size 8 --n-lights 16 -o out/stl_ascii
prepare --mesh m.off --size 8 --n-lights 16 -o out/off
""",
    ),
    Target(
        "ball",
        mirror_ball,
        "*/* known.txt",
        """
calibrate ball --gray-ball gray --compare known.txt -o out --overwrite
calibrate ball --camera-matrix camera.txt --gray-card gray -o out --overwrite
""",
    ),
    Target(
        "profiles",
        profiles,
        "*/*.*",
        f"""
infer png {LS}
info png
infer tif {LS}
info tif
infer jpg {LS}
info jpg
""",
    ),
    Target(
        "set",
        two_captures,
        "out/set/* out/set/*/*",
        """
prepare capture second -o out/set
prepare capture -o out/set --update
train out/set -o out/run -q --config a.toml
""",
        "prepare capture -o out/set",
        grows=True,
    ),
    Target(
        "earlier",
        two_captures,
        "out/*/*.json out/*.json out/*.jsonl out/*/*.npy out/*/*.png out/index.html",
        """
infer capture --method ls -o out
infer second --method ls -o out --html --surface
infer capture --method ls -o out --update
integrate out/capture -o out/capture --overwrite
evaluate capture --method ls --n-lights 4 --n-lights 5 --trials 1 -o out/new --figures --overwrite
prepare capture -o out/set
""",
        """
evaluate capture --method ls --n-lights 4 --trials 1 -o out
infer capture --method ls -o out
""",
    ),
    Target(
        "weights",
        weights,
        "w.safetensors *.ckpt",
        """
infer capture --weights w.safetensors -o out --overwrite
import-weights g.ckpt g.ckpt -o out/w.safetensors --overwrite
import-weights old.ckpt g.ckpt -o out/w.safetensors --overwrite
""",
    ),
    Target(
        "training",
        training,
        "set/* set/*/* a.toml out/run/*.safetensors out/run/metrics.csv",
        """
train set -o out/run -q --resume --config a.toml
train set -o out/new -q --config a.toml --steps 1
""",
        "train set -o out/run -q --config a.toml",
    ),
)


def write_corpus(folder, case, run, names=()):
    """Write the files of the targets into folders of their names, each with the output of an
    earlier run.

    Every command runs once on whole input, which also imports all that it needs. It runs in the
    folder `case`, where the commands will run, because reports and checkpoints name absolute paths.
    Without names, all targets are written.
    """
    targets = [target for target in TARGETS if not names or target.name in names]
    folder.mkdir()
    for target in targets:
        case.mkdir(parents=True)
        target.write(case)
        for command in target.earlier:
            assert run(case, command) == 0, command
        shutil.copytree(case, folder / target.name)
        for command in target.commands:
            if command not in target.earlier:
                assert run(case, command) == 0 or ".ckpt" in command, command
        shutil.rmtree(case)
    return targets
