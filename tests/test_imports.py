"""Imports only point downwards through the rooms of the house, as the table of CONTRIBUTING.md
ranks them.
"""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import splinecli

CONTRIBUTING = Path(__file__).resolve().parents[1] / "CONTRIBUTING.md"
TABLE = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", CONTRIBUTING.read_text("utf-8"), re.MULTILINE)
# From the top; a room may import from those below it, and its own files from each other.
ROOMS = [{"__main__", "__init__"}, *(set(re.findall(r"\w+", cell)) for cell in TABLE)]
ROOMS[-1].add("_version")
HEIGHT = {room: -level for level, rooms in enumerate(ROOMS) for room in rooms}
SOURCE = Path(splinecli.__file__).parent


def imported_rooms(tree):
    modules = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("splinecli"):
            modules += (
                [f"{node.module}.{alias.name}" for alias in node.names]
                if node.module == "splinecli"
                else [node.module]
            )
        elif isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names if alias.name.startswith("splinecli")]
    names = {[*module.split("."), "__init__"][1] for module in modules}
    return {name if name in HEIGHT else "__init__" for name in names}


def test_every_room_is_ranked():
    names = {
        path.stem
        for path in SOURCE.iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    assert names == set(HEIGHT)


def test_imports_point_downwards():
    upwards = []
    for path in SOURCE.rglob("*.py"):
        room = path.relative_to(SOURCE).parts[0].removesuffix(".py")
        for target in imported_rooms(ast.parse(path.read_text("utf-8"))):
            if target != room and HEIGHT[target] >= HEIGHT[room]:
                upwards.append(f"{path.relative_to(SOURCE)} -> {target}")
    assert not upwards


def test_no_circles():
    """Modules do not import each other in circles, neither inside functions nor for types alone."""
    modules = {
        ".".join(["splinecli", *path.relative_to(SOURCE).with_suffix("").parts]): path
        for path in SOURCE.rglob("*.py")
    }
    imports = {}
    for module, path in modules.items():
        if path.stem in (
            "__init__",
            "__main__",
        ):  # doors: nothing inside the house needs them to be imported first
            continue
        nodes = [
            node
            for node in ast.walk(ast.parse(path.read_text("utf-8")))
            if isinstance(node, ast.ImportFrom)
        ]
        named = {f"{node.module}.{alias.name}" for node in nodes for alias in node.names} | {
            node.module for node in nodes
        }
        imports[module] = named & set(modules)
    assert list(TopologicalSorter(imports).static_order())  # or CycleError, which names the modules
