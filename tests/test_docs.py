"""The documentation agrees with the code: links, commands, constants and tables of figures."""

import doctest
import re
import shlex
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import typer

import figure_plots
import figure_tables
import splinecli
from scenes import names_in, parametrize, read_json
from splinecli.cli.main import app
from splinecli.errors import InputError, ModelError, OutputError, UsageError

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
PACKAGE = Path(splinecli.__file__).parent
PAGES = sorted([*REPOSITORY.glob("*.md"), *DOCS.glob("*.md"), REPOSITORY / "examples/README.md"])


def text_of(name):
    return (REPOSITORY / name).read_text("utf-8")


def by_name(path):
    return str(path.relative_to(REPOSITORY))


def anchors(page):
    """The anchors of the headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@parametrize("page", PAGES, ids=by_name)
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


def test_every_page_is_in_the_site():
    """mkdocs.yml lists each page of the documentation and each command once, and nothing else."""
    names = [by_name(page).removeprefix("docs/") for page in PAGES if page.name != "README.md"]
    group: Any = typer.main.get_command(app)
    names += [
        "index.md",
        "examples/README.md",
        *(f"commands/{command}.md" for command in group.commands),
    ]
    assert sorted(
        re.findall(r"^ +- .*: (\S+\.md)$", text_of("mkdocs.yml"), re.MULTILINE)
    ) == sorted(names)


def test_pages_are_short():
    """No page has more than 1,500 words; cells and rules of tables are not words."""
    words = {by_name(page): len(re.findall(r"\S*\w\S*", page.read_text("utf-8"))) for page in PAGES}
    del words["CHANGELOG.md"]
    assert {name: number for name, number in words.items() if number > 1500} == {}


def commands():
    """Page and command line of every splinecli command in the code blocks and tables of the
    documentation.
    """
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


@parametrize("page, command", sorted(set(commands())))
def test_commands_have_options_that_exist(page, command):
    group: Any = typer.main.get_command(app)
    _, *words = shlex.split(command, comments=True)
    if words[0] == "COMMAND":
        return
    if words[0].startswith("-"):
        known = group.params
    else:
        known = [
            *group.commands[words[0]].params,
            *(group.commands["infer"].params if "--" in words else ()),
        ]
    options = {
        option for parameter in known for option in (*parameter.opts, *parameter.secondary_opts)
    }
    options |= {"--help", "-h", "--install-completion", "--show-completion", "--version"}
    for word in words:
        if re.match(r"--?[a-z]", word):
            assert word in options


def test_the_version_is_the_same_everywhere():
    """The README and CITATION.cff cite the version of the package."""
    version = re.search(r'^version = "(.*)"$', text_of("pyproject.toml"), re.MULTILINE)[1]
    assert f"version: {version}\n" in text_of("CITATION.cff")
    assert f"version = {{{version}}}" in text_of("README.md")


def test_exit_codes():
    codes = dict(re.findall(r"^\| (\d+) \| (.*) \|$", text_of("docs/warnings.md"), re.MULTILINE))
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
    names = {}
    exec(code, names)
    assert names["heights"].shape == names["capture"].mask.shape
    assert names["estimate"].errors.mean < 7
    assert names["report"]["capture"] == "medallion"
    assert (tmp_path / "results/medallion/albedo.png").is_file()


def test_examples_of_docstrings(tmp_path, monkeypatch):
    """Each function of the Python pages has an example, and all examples of the package print what
    they show.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(REPOSITORY / "examples")
    imports = re.findall(
        r"^from (splinecli\S*) import ([a-z]\w*)$", text_of("docs/python.md"), re.MULTILINE
    )
    documented = {".".join(names) for names in imports} | {
        f"splinecli.{name}" for name in splinecli.__all__[1:]
    }
    assert [name for name in sorted(documented) if ">>>" not in resolve_name(name).__doc__] == []
    sources = (path for path in PACKAGE.rglob("*.py") if ">>> " in path.read_text("utf-8"))
    modules = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in sources]
    results = {
        name: doctest.testmod(resolve_name(name.removesuffix(".__init__"))) for name in modules
    }
    assert {name: result.failed for name, result in results.items() if result.failed} == {}


def test_fields_of_the_report():
    """The table of report.json names each of its fields, and no other."""
    golden = text_of("tests/golden/report_ls.json")
    fields = set(re.findall(r'^  "(\w+)":', golden, re.MULTILINE))
    _, _, section = text_of("docs/results.md").partition("## The report")
    cells = re.findall(r"^\| (`[^|]*`) \|", section.partition("\n## ")[0], re.MULTILINE)
    assert {name for cell in cells for name in re.findall(r"`(\w+)`", cell)} == fields


def test_places_of_the_contributing_page():
    """Each path that CONTRIBUTING.md names exists."""
    paths = re.findall(r"`([\w/.]+(?:\.(?:py|md|html)|/))`", text_of("CONTRIBUTING.md"))
    roots = (REPOSITORY, REPOSITORY / "src/splinecli", *(REPOSITORY / "src/splinecli").glob("*/"))
    roots += tuple((REPOSITORY / "src/splinecli/capture").glob("*/"))
    assert [path for path in paths if not any((r / path).exists() for r in roots)] == []


@parametrize("name", figure_tables.PAGES)
def test_tables_of_figures(name):
    """Each table says what docs/figures.json says. `python benchmarks/figure_tables.py` writes
    them.
    """
    measured = read_json(figure_tables.FIGURES)
    text = text_of(name)
    assert text == figure_tables.fill(text, measured, figure_tables.shipped_weights())
    assert text.count("<!-- figures: ") == text.count("<!-- end -->") > 0


def test_every_table_of_figures_is_shown():
    shown = [
        found
        for name in figure_tables.PAGES
        for found in re.findall(r"<!-- figures: (\S+) -->", text_of(name))
    ]
    assert sorted(shown) == sorted(figure_tables.TABLES)


def test_plots_of_figures(tmp_path):
    """The plots have a curve or a bar for each method that they name."""
    figure_plots.main(tmp_path)
    for name, methods in (
        ("accuracy_lights.svg", figure_plots.COLOURS),
        ("accuracy_published.svg", ("PX-Net", "LS")),
    ):
        drawn = (tmp_path / name).read_text("utf-8")
        assert all(f">{method}</text>" in drawn for method in methods)
    assert names_in(tmp_path) == {path.name for path in DOCS.glob("pictures/accuracy_*.svg")}


def test_figures_of_other_weights_are_marked():
    """New weights never leave old figures unmarked."""
    rows = {row: dict.fromkeys(("4", "10"), 1.0) for row in ("ls",)}
    table = figure_tables.Table(
        ("lights",), "method", {"least squares": "ls"}, {"4": "4", "10": "10", "20": "20"}
    )
    measured = {"lights": {"version": "0.2.0", "weights": "old", "machine": "", "rows": rows}}
    shown = table.text(measured, "old").splitlines()[2:]
    assert shown == ["| least squares | 1.00 | 1.00 | - |", "", "(version 0.2.0, weights old)"]
    assert table.text(measured, "new").endswith(
        "(**not measured with these weights**: version 0.2.0, weights old)"
    )
    assert table.text({}, "new") == "(not measured with these weights)"
