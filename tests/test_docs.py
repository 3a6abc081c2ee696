"""The documentation agrees with the code: links, commands, constants and tables of figures."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from splinecli.capture import capture_warnings
from splinecli.cli.app import app
from splinecli.errors import InputError, ModelError, OutputError, UsageError
from test_imports import ROOMS

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PAGES = sorted([*REPOSITORY.glob("*.md"), *DOCS.glob("*.md"), REPOSITORY / "examples/README.md"])
FIGURES = json.loads((DOCS / "diligent.json").read_text("utf-8"))
OBJECTS = {"Ball": "ballPNG", "Cat": "catPNG", "Reading": "readingPNG"}


def text_of(name: str) -> str:
    return (REPOSITORY / name).read_text("utf-8")


def by_name(path: Path) -> str:
    return str(path.relative_to(REPOSITORY))


def anchors(page: Path) -> set[str]:
    """The anchors of the headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=by_name)
def test_links_resolve(page):
    """Each relative link leads to a file, and its anchor to a heading."""
    text = page.read_text("utf-8")
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for link in links:
        if link.startswith(("http://", "https://")):
            continue
        place, _, anchor = link.partition("#")
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def test_every_page_is_linked_from_the_readme():
    readme = text_of("README.md")
    assert [page.name for page in DOCS.glob("*.md") if f"(docs/{page.name})" not in readme] == []


def test_source_names_pages_that_exist():
    for path in (REPOSITORY / "src").rglob("*.py"):
        for name in re.findall(r"docs/[\w-]+\.md", path.read_text("utf-8")):
            assert (REPOSITORY / name).is_file(), (path.name, name)


def commands() -> Iterator[tuple[str, str]]:
    """Page and command line of every splinecli command in the code blocks and tables of the documentation."""
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", " ")
        blocks = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
        blocks += re.findall(r"^ {4,}(splinecli .*)$", text, re.MULTILINE)
        blocks += re.findall(r"`(splinecli [^`]*)`", text)
        for line in "\n".join(blocks).splitlines():
            for part in re.split(r"&&|;", line):
                words = part.strip()
                if words.startswith(("splinecli ", ".venv/bin/splinecli ")):
                    yield by_name(page), words.removeprefix(".venv/bin/")


@pytest.mark.parametrize(("page", "command"), sorted(set(commands())))
def test_commands_have_options_that_exist(page, command):
    group: Any = typer.main.get_command(app)
    _, *words = shlex.split(command, comments=True)
    if words[0].startswith("-"):
        known = group.params
    else:
        if words[0] == "COMMAND":
            return
        known = group.commands[words[0]].params
    options = {option for parameter in known for option in (*parameter.opts, *parameter.secondary_opts)}
    options |= {"--help", "-h", "--install-completion", "--show-completion", "--version"}
    for word in words:
        if re.match(r"--?[a-z]", word):
            assert word in options


def test_exit_codes():
    codes = dict(re.findall(r"^\| (\d+) \| (.*) \|$", text_of("docs/files-and-frames.md"), re.MULTILINE))
    assert codes.keys() == {"0", "1", "2", "3", "4", "5", "130"}
    for error, word in (
        (UsageError, "usage"),
        (InputError, "input"),
        (ModelError, "weights"),
        (OutputError, "output"),
    ):
        assert word in codes[str(error.exit_code)]


def test_python_page(tmp_path, monkeypatch):
    """Its code runs, from top to bottom; here with least squares, which takes no time."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    code = "\n".join(re.findall(r"```python\n(.*?)```", text_of("docs/python.md"), re.DOTALL))
    for before, after in (
        ("light_intensities=light_intensities", 'light_intensities=light_intensities, method="ls"'),
        ('make_estimator("spline-net")', 'make_estimator("ls")'),
        ("InferOptions(", 'InferOptions(method="ls", '),
    ):
        assert code.count(before) == 1
        code = code.replace(before, after)
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["heights"].shape == names["capture"].mask.shape
    assert names["estimate"].errors.mean < 7
    assert names["report"]["capture"] == "medallion"
    assert (tmp_path / "results/medallion/albedo.png").is_file()


def test_fields_of_the_report():
    """The table of report.json names each of its fields, and no other."""
    golden = text_of("tests/golden/report_ls.json")
    fields = set(re.findall(r'^  "(\w+)":', golden, re.MULTILINE))
    _, _, section = text_of("docs/infer.md").partition("## The report")
    cells = re.findall(r"^\| (`[^|]*`) \|", section.partition("\n## ")[0], re.MULTILINE)
    assert {name for cell in cells for name in re.findall(r"`(\w+)`", cell)} == fields


def test_every_warning_is_explained():
    codes = {
        value for name, value in vars(capture_warnings).items() if name.isupper() and isinstance(value, str)
    }
    explained = re.findall(r"^\| `(\w+)` \|", text_of("docs/troubleshooting.md"), re.MULTILINE)
    assert sorted(codes) == explained


def test_rooms_of_the_contributing_page():
    """The table has the rooms of tests/test_imports.py in their order."""
    cells = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|", text_of("CONTRIBUTING.md"), re.MULTILINE)
    shown = [set(re.findall(r"\w+", cell)) for cell in cells]
    ranked = [rooms - {"__init__"} for rooms in ROOMS if rooms != {"__main__"}]
    assert shown == ranked


def test_places_of_the_contributing_page():
    """Each path that CONTRIBUTING.md names exists."""
    paths = re.findall(r"`([\w/.]+(?:\.(?:py|md|html)|/))`", text_of("CONTRIBUTING.md"))
    roots = (REPOSITORY, REPOSITORY / "src/splinecli", *(REPOSITORY / "src/splinecli").glob("*/"))
    roots += tuple((REPOSITORY / "src/splinecli/capture").glob("*/"))
    assert [path for path in paths if not any((r / path).exists() for r in roots)] == []


def rows(page: str, head: str) -> dict[str, list[str]]:
    """The cells of the table that has `head` in its first line, by their first cell without markup."""
    _, _, rest = text_of(page).partition(head)
    assert rest, f"{page} has no table {head}"
    table = rest.partition("\n\n")[0].splitlines()[2:]
    cells = [[cell.strip(" *`") for cell in line.strip("|").split("|")] for line in table]
    return {re.sub(r"[*`]", "", row[0]): row[1:] for row in cells}


def figure(method: str, capture: str, n_lights: int = 10, noise: float = 0) -> str:
    for entry in FIGURES["results"]:
        if (entry["method"], entry["capture"], entry["n_lights"], entry["light_noise_deg"]) == (
            method, capture, n_lights, noise,
        ):  # fmt: skip
            return f"{entry['mae_deg']:.2f}"
    raise KeyError((method, capture, n_lights, noise))


def average(method: str, n_lights: int = 10, noise: float = 0) -> str:
    mean = sum(float(figure(method, capture, n_lights, noise)) for capture in OBJECTS.values()) / len(OBJECTS)
    return f"{mean:.2f}"


METHODS = {
    "least squares (ls)": "ls",
    "splinecli (spline-net)": "spline-net",
    "without refinement (spline-net-pixelwise)": "spline-net-pixelwise",
}


@pytest.mark.parametrize("page", ["README.md", "docs/measurements.md"])
def test_table_of_quality(page):
    """All tables have the figures of one measurement, docs/diligent.json."""
    found = rows(page, "| method | Ball | Cat | Reading |")
    assert len(found) == 7
    for name, cells in found.items():
        if "published" not in name:
            method = METHODS.get(name, name)
            assert cells[:3] == [figure(method, capture) for capture in OBJECTS.values()]


def light_counts() -> list[int]:
    return sorted({entry["n_lights"] for entry in FIGURES["results"]})


def test_tables_of_the_number_of_lights():
    head = "| lights | " + " | ".join(map(str, light_counts())) + " |"
    for name, cells in rows("docs/measurements.md", head).items():
        label, _, method = name.rpartition(", ")
        assert cells == [figure(method, OBJECTS[label], n) for n in light_counts()]


def test_table_of_light_noise():
    noises = sorted({entry["light_noise_deg"] for entry in FIGURES["results"]})
    head = "| sigma in degrees | " + " | ".join(f"{noise:g}" for noise in noises) + " |"
    for method, cells in rows("docs/measurements.md", head).items():
        assert [float(cell) for cell in cells] == pytest.approx(
            [float(average(method, noise=noise)) for noise in noises], abs=0.011
        )


def test_table_of_the_model_card():
    for name, cells in rows("MODEL_CARD.md", "| lights | Ball | Cat | Reading |").items():
        assert cells == [figure("spline-net", capture, int(name)) for capture in OBJECTS.values()]
