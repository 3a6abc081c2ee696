"""Small whole inputs of every kind that splinecli reads, and the commands that read them."""

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile
import trimesh
from PIL import Image, ImageCms
from scipy.io import savemat

from scenes import write_image

SHAPE = (16, 18)
LIGHTS = np.array(
    [(0, 0, 1), (0.5, 0, 1), (-0.5, 0, 1), (0, 0.5, 1), (0.1, -0.5, 1), (0.4, 0.4, 1)], float
)
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)
OUT = "out"
"""The folder that commands write into. An earlier run has filled it."""


@dataclass(frozen=True)
class Target:
    """A kind of input."""

    name: str  # for people, and the name of its folder
    write: Callable[[Path], None]  # writes its files into an empty folder
    files: tuple[str, ...]  # patterns of the files that are mutated
    commands: tuple[str, ...]  # the arguments of each command that reads them
    earlier: tuple[
        str, ...
    ] = ()  # the commands whose output is there before; the first of `commands` if there is none
    grows: bool = False  # whether a command that fails late has already added to the earlier output


def normals() -> np.ndarray:
    """Normals (H, W, 3) of a flat sphere."""
    y, x = np.indices(SHAPE)
    vectors = np.stack(((x - 8.5) / 9, (7.5 - y) / 8, np.full(SHAPE, 2.5)), axis=-1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def shaded(light: np.ndarray) -> np.ndarray:
    return np.rint((normals() @ light).clip(0) * 50_000).astype(np.uint16)


def png_capture(folder: Path) -> None:
    """DiLiGenT's layout, with every optional file."""
    names = [f"{number:03}.png" for number in range(len(LIGHTS))]
    for name, light in zip(names, LIGHTS, strict=True):
        write_image(folder / name, shaded(light))
    (folder / "filenames.txt").write_text("\n".join(names) + "\n")
    np.savetxt(folder / "light_directions.txt", LIGHTS)
    np.savetxt(folder / "light_intensities.txt", np.ones((len(LIGHTS), 3)))
    cv2.imwrite(
        str(folder / "mask.png"), (np.indices(SHAPE).sum(axis=0) > 3).astype(np.uint8) * 255
    )
    write_image(folder / "ambient.png", np.full(SHAPE, 20, np.uint16))
    savemat(folder / "Normal_gt.mat", {"Normal_gt": normals()}, do_compression=True)


def jpeg_capture(folder: Path) -> None:
    for number, light in enumerate(LIGHTS):
        gray = (shaded(light) // 257).astype(np.uint8)
        write_image(folder / f"{number}.jpg", np.dstack([gray] * 3))
    lines = [f"C:\\rti\\{n}.jpg {x} {y} {z}" for n, (x, y, z) in enumerate(LIGHTS)]
    (folder / "rti.lp").write_text("\n".join([str(len(LIGHTS)), *lines]))
    alpha = np.dstack(
        [np.full(SHAPE, 200, np.uint8)] * 3 + [np.tri(*SHAPE, k=8, dtype=np.uint8) * 255]
    )
    write_image(folder / "mask.png", alpha)
    np.save(folder / "normal_gt.npy", normals().astype(np.float32))


def tiff_capture(folder: Path) -> None:
    for number, light in enumerate(LIGHTS):
        value = shaded(light)
        compression = (None, "zlib", "zlib", None, None, None)[number]
        if number == 3:
            tifffile.imwrite(folder / "3.tif", value.astype(np.float32) / 65_535)
        elif number == 4:
            write_image(folder / "4.tif", value)  # LZW
        else:
            rgb = np.dstack([value] * 3)
            tifffile.imwrite(
                folder / f"{number}.tif", rgb, photometric="rgb", compression=compression
            )
    lights = [
        {
            "viewId": number,
            "type": "directional",
            "direction": [x, -y, -z],
            "intensity": [1.0, 1.0, 1.0],
        }
        for number, (x, y, z) in enumerate(LIGHTS)
    ]
    (folder / "lights.json").write_text(json.dumps({"lights": lights}))
    np.savetxt(folder / "normal_gt.txt", normals().reshape(-1, 3))
    tifffile.imwrite(folder / "mask.tif", np.full(SHAPE, 255, np.uint8))
    (folder / "draws.txt").write_text("0 1 2 3\n1 2 3 4\n")


def pgm_and_stack_captures(folder: Path) -> None:
    for name in ("pgm", "stack"):
        (folder / name).mkdir()
        np.savetxt(folder / name / "lights.txt", LIGHTS)
    for number, light in enumerate(LIGHTS):
        write_image(folder / f"pgm/{number}.pgm", shaded(light))
    pictures = np.stack([shaded(light) for light in LIGHTS])
    tifffile.imwrite(folder / "stack/stack.tif", pictures, photometric="minisblack")


def mat_captures(folder: Path) -> None:
    """Photographs, mask and lights in one .mat file, and lamps of near_ps."""
    pictures = np.stack([shaded(light) for light in LIGHTS], axis=-1)
    mask = np.ones(SHAPE, np.uint8)
    for name, arrays in (
        ("array", {"I": pictures, "S": LIGHTS.T, "mask": mask}),
        ("numbered", {f"im{number}": pictures[..., number] for number in range(len(LIGHTS))}),
    ):
        (folder / name).mkdir()
        savemat(folder / name / "a.mat", arrays, do_compression=name == "array")
    np.savetxt(folder / "numbered/lights.txt", LIGHTS)
    (folder / "lamps").mkdir()
    for number, light in enumerate(LIGHTS):
        write_image(folder / f"lamps/{number}.png", shaded(light))
    count = (len(LIGHTS), 1)
    lamps = {"S": 100 * LIGHTS * (1, -1, -1) + (0, 0, 500), "Dir": -LIGHTS * (1, -1, -1)}
    savemat(folder / "lamps/light.mat", lamps | {"mu": np.ones(count), "Phi": np.full(count, 9e3)})
    savemat(folder / "lamps/camera.mat", {"K": np.array([[500, 0, 9], [0, 500, 8], [0, 0, 1.0]])})


def light_files(folder: Path) -> None:
    """Light files of every form, and near lamps."""
    for number, light in enumerate(LIGHTS):
        write_image(folder / f"{number}.png", shaded(light))
    azimuth = np.degrees(np.arctan2(LIGHTS[:, 1], LIGHTS[:, 0]))
    np.savetxt(
        folder / "azel.txt",
        np.stack((azimuth, np.degrees(np.arcsin(LIGHTS[:, 2]))), axis=1),
        fmt="%.3f",
    )
    np.save(folder / "vectors.npy", LIGHTS)
    rows = [" ".join(f"{value:.6f}" for value in light) for light in LIGHTS]
    (folder / "utf16.txt").write_text("x y z\n" + "\n".join(rows), "utf-16")
    (folder / "commas.txt").write_text("\n".join(rows).replace(".", ",").replace(" ", ";"))
    (folder / "named.csv").write_text(
        "\n".join(f"{number}.png;{row}" for number, row in enumerate(rows))
    )
    (folder / "list.json").write_text(json.dumps(LIGHTS.tolist()))
    lights = [dict(zip("xyz", light, strict=True)) for light in LIGHTS.tolist()]
    objects = [{"file": f"{n}.png", "light_dir": light} for n, light in enumerate(LIGHTS.tolist())]
    (folder / "objects.json").write_text(json.dumps({"version": 1, "images": objects}))
    (folder / "rig.dome").write_text(json.dumps({"directions": lights, "positionsSphere": lights}))
    np.savetxt(folder / "positions.txt", 60 * LIGHTS)
    np.savetxt(folder / "light_lobes.txt", np.column_stack((-LIGHTS, np.full(len(LIGHTS), 2))))
    (folder / "camera.txt").write_text("500 0 9\n0 500 8\n0 0 1\n")


def normal_maps(folder: Path) -> None:
    cv2.imwrite(
        str(folder / "n.png"), np.rint((normals()[..., ::-1] + 1) / 2 * 65_535).astype(np.uint16)
    )
    tifffile.imwrite(folder / "n.tif", normals().astype(np.float32), photometric="rgb")
    np.save(folder / "n.npy", normals())
    savemat(folder / "n.mat", {"n": normals()})
    savemat(folder / "packed.mat", {"words": "text", "n": normals()}, do_compression=True)
    write_image(folder / "mask.png", np.full(SHAPE, 255, np.uint8))
    write_image(folder / "colours.jpg", np.full((*SHAPE, 3), 90, np.uint8))
    (folder / "camera.txt").write_text("500 0 9\n0 500 8\n0 0 1\n")


def profiles(folder: Path) -> None:
    """Images with a colour profile, in each format that has one."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for ending in ("png", "tif", "jpg"):
        (folder / ending).mkdir()
        for number, light in enumerate(LIGHTS[:4]):
            gray = (shaded(light) // 257).astype(np.uint8)
            picture = Image.fromarray(np.dstack([gray] * 3))
            picture.save(folder / ending / f"{number}.{ending}", icc_profile=profile)
        np.savetxt(folder / ending / "light_directions.txt", LIGHTS[:4])


def mirror_ball(folder: Path) -> None:
    y, x = np.indices((40, 50))
    nx, ny = (x - 25) / 16, (20 - y) / 16
    inside = nx**2 + ny**2 < 1
    n = np.stack((nx, ny, np.sqrt(np.where(inside, 1 - nx**2 - ny**2, 0))), axis=-1)
    (folder / "ball").mkdir()
    (folder / "gray").mkdir()
    for number, light in enumerate(LIGHTS[:4]):
        half = light + np.array((0, 0, 1))
        spot = np.exp(
            -((np.degrees(np.arccos((n @ (half / np.linalg.norm(half))).clip(-1, 1))) / 4) ** 2)
        )
        ball = np.where(inside, 0.02 + 0.9 * spot, 0.2)
        gray = np.where(inside, 0.5 * (n @ light).clip(0), 0)
        for name, picture in (("ball", ball), ("gray", gray)):
            cv2.imwrite(
                str(folder / name / f"{number}.png"), np.rint(picture * 65_535).astype(np.uint16)
            )
    for name in ("ball", "gray"):
        write_image(folder / name / "mask.png", inside.astype(np.uint8) * 255)
    np.savetxt(folder / "known.txt", LIGHTS[:4])
    (folder / "camera.txt").write_text("500 0 25\n0 500 20\n0 0 1\n")


def thin(folder: Path) -> None:
    """Images one pixel wide, and crops of one pixel."""
    for name, shape in (("column", (40, 1)), ("row", (1, 40))):
        (folder / name).mkdir()
        for number, light in enumerate(LIGHTS):
            picture = np.resize(shaded(light), shape)
            write_image(folder / name / f"{number}.png", picture)
        np.savetxt(folder / name / "light_directions.txt", LIGHTS)


def meshes(folder: Path) -> None:
    """A tetrahedron in every format."""
    corners, faces = (
        ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)),
    )
    shape = trimesh.Trimesh(corners, faces)
    for ending in ("ply", "obj", "stl", "stl_ascii", "off"):
        shape.export(folder / f"m.{ending}", file_type=ending)


def two_captures(folder: Path) -> None:
    """Captures whose results are read again: reports, thumbnails, finished trials, pixel sets."""
    for name in ("capture", "second"):
        (folder / name).mkdir()
        png_capture(folder / name)
    write_settings(folder)


def weights(folder: Path) -> None:
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
    (folder / "capture").mkdir()
    png_capture(folder / "capture")


def training(folder: Path) -> None:
    """A finished run, a pixel set, and settings: reading them takes no training step."""
    from small_pixel_sets import matte_pixels
    from splinecli.workshop.pixel_sets.store import PixelSetWriter

    writer = PixelSetWriter(folder / "set")
    for name in "ab":
        writer.add(name, name, "a test", {"by": "hand"}, matte_pixels(12, 6))
    writer.finish()
    write_settings(folder)


def write_settings(folder: Path) -> None:
    (folder / "a.toml").write_text(
        "steps = 1\nbatch_size = 4\nseed = 3\nlearning_rate = 1e-3\nschedule ="
        " 'cosine'\nheld_share = 0.0\n[pixels]\nmin_lights = 4\nmax_lights = 6\nusual_lights ="
        " 5\n[network]\nmap_size = 8\nwidth = 2\nli_blocks = 1\nne_blocks = 1\nhead_width = 4\n"
    )


def each(command: str, words: str) -> tuple[str, ...]:
    """Return the command with each of the words in the place of {}."""
    return tuple(command.format(word) for word in words.split())


TRAIN = "train set -o out/run -q"
TARGETS = (
    Target(
        "png",
        png_capture,
        ("*",),
        (
            "infer . --method ls -o out --overwrite --maps albedo",
            "info . --plot plots/lights.png --overwrite",
            "evaluate . --method ls --n-lights 4 --trials 1 -o out --overwrite",
            "prepare . -o out/set",
        ),
    ),
    Target("jpeg", jpeg_capture, ("*",), ("infer . --method ls -o out --overwrite", "info .")),
    Target(
        "tiff",
        tiff_capture,
        ("*",),
        (
            "infer . --method ls -o out --overwrite",
            "evaluate . --method ls --draws draws.txt -o out --overwrite",
        ),
    ),
    Target(
        "pgm and stack",
        pgm_and_stack_captures,
        ("*/*.pgm", "*/*.tif"),
        (*each("infer {} --method ls -o out --overwrite", "pgm stack"), "info stack"),
    ),
    Target(
        "mat",
        mat_captures,
        ("*/*.mat",),
        (
            *each("infer {} --method ls -o out --overwrite", "array numbered"),
            "infer lamps --pixel-size 1 --method ls -o out --overwrite",
            "info array",
        ),
    ),
    Target(
        "lights",
        light_files,
        ("*.txt", "*.npy", "*.csv", "*.json", "*.dome"),
        (
            *each(
                "infer . --method ls --lights {} -o out --overwrite",
                "vectors.npy utf16.txt commas.txt named.csv list.json objects.json rig.dome",
            ),
            "infer . --method ls --lights azel.txt --light-format azel -o out --overwrite",
            "infer . --method ls --light-positions positions.txt --pixel-size 1 --camera-matrix"
            " camera.txt -o out --overwrite",
        ),
    ),
    Target(
        "normals",
        normal_maps,
        ("*",),
        each(
            "integrate {} --mask mask.png --colours colours.jpg --camera-matrix camera.txt -o out"
            " --overwrite",
            "n.png n.tif n.npy n.mat packed.mat",
        ),
    ),
    Target("thin", thin, ("*/*",), each("infer {} --method ls -o out --overwrite", "column row")),
    Target(
        "meshes",
        meshes,
        ("m.*",),
        each("prepare --mesh m.{0} --size 8 --n-lights 16 -o out/{0}", "ply obj stl stl_ascii off"),
    ),
    Target(
        "ball",
        mirror_ball,
        ("*/*", "known.txt"),
        (
            "calibrate ball --gray-ball gray --compare known.txt -o out --overwrite",
            "calibrate ball --camera-matrix camera.txt --gray-card gray -o out --overwrite",
        ),
    ),
    Target(
        "profiles",
        profiles,
        ("*/*.*",),
        tuple(
            f"{command} {ending}{options}"
            for ending in ("png", "tif", "jpg")
            for command, options in (("infer", " --method ls -o out --overwrite"), ("info", ""))
        ),
    ),
    Target(
        "set",
        two_captures,
        ("out/set/*", "out/set/*/*"),
        (
            "prepare capture second -o out/set",
            "prepare capture -o out/set --update",
            "train out/set -o out/run -q --config a.toml",
        ),
        earlier=("prepare capture -o out/set",),
        grows=True,
    ),
    Target(
        "earlier",
        two_captures,
        (
            "out/*/*.json",
            "out/*.json",
            "out/*.jsonl",
            "out/*/*.npy",
            "out/*/*.png",
            "out/index.html",
        ),
        (
            "infer capture --method ls -o out",
            "infer second --method ls -o out --html --surface",
            "infer capture --method ls -o out --update",
            "integrate out/capture -o out/capture --overwrite",
            "evaluate capture --method ls --n-lights 4 --n-lights 5 --trials 1 -o out/new"
            " --figures --overwrite",
            "prepare capture -o out/set",
        ),
        earlier=(
            "evaluate capture --method ls --n-lights 4 --trials 1 -o out",
            "infer capture --method ls -o out",
        ),
    ),
    Target(
        "weights",
        weights,
        ("w.safetensors", "*.ckpt"),
        (
            "infer capture --weights w.safetensors -o out --overwrite",
            *each("import-weights {} g.ckpt -o out/w.safetensors --overwrite", "g.ckpt old.ckpt"),
        ),
    ),
    Target(
        "training",
        training,
        ("set/*", "set/*/*", "a.toml", "out/run/*.safetensors", "out/run/metrics.csv"),
        (f"{TRAIN} --resume --config a.toml", "train set -o out/new -q --config a.toml --steps 1"),
        earlier=(f"{TRAIN} --config a.toml",),
    ),
)


def write_corpus(
    folder: Path, case: Path, run: Callable[[Path, str], int], names: tuple[str, ...] = ()
) -> list[Target]:
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
        earlier = target.earlier or target.commands[:1]
        for command in earlier:
            assert run(case, command) == 0, command
        shutil.copytree(case, folder / target.name)
        for command in target.commands:
            if command not in earlier:
                assert run(case, command) == 0 or ".ckpt" in command, command
        shutil.rmtree(case)
    return targets
