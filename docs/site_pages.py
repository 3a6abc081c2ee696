"""Add to the site the pages that are not in docs/: the README as the first page, other pages, one
page per command.

mkdocs.yml names this file as a hook. Links lead from file to file of the repository; here they get
the site's layout.
"""

import posixpath
import re
import textwrap
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    "README.md",
    "MODEL_CARD.md",
    "CREDITS.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "examples/README.md",
)
SCRIPTS = (
    "examples/python_api.py",
    "examples/train_shipped_weights.sh",
    "examples/quickstart.ipynb",
    "CITATION.cff",
)
COMMANDS = "commands"
LONG_ROWS = 30  # of a table that is folded on a phone


def on_files(files: Files, config: MkDocsConfig) -> Files:
    for name in (*PAGES, *SCRIPTS):
        files.append(
            File.generated(config, site_name(name), content=(ROOT / name).read_text("utf-8"))
        )
    for name, text in command_pages().items():
        files.append(File.generated(config, f"{COMMANDS}/{name}.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the text of a page with the links of the site."""
    here = page.file.src_uri
    if here == "CHANGELOG.md":
        markdown = fold_versions(markdown)
    if here.startswith(f"{COMMANDS}/"):
        return markdown
    named = {site_name(name): name for name in PAGES}
    folder = posixpath.dirname(named.get(here, f"docs/{here}"))

    def link(found: re.Match[str]) -> str:
        if "://" in found[1]:
            return found[0]
        target = site_name(posixpath.normpath(posixpath.join(folder, found[1])))
        return "](" + posixpath.relpath(target, posixpath.dirname(here) or ".")

    return re.sub(r"\]\(([^)\s#]+)", link, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page with marks on options and tables, which assets/site.css uses."""
    html = re.sub("<code>(?=--?[a-z][^ <]*( [^ <]+)?</code>)", '<code class="option">', html)
    return re.sub(r"<table>\n.*?</table>", words_table, html, flags=re.DOTALL)


def words_table(found: re.Match[str]) -> str:
    """Return an HTML table whose cells name their columns; one of numbers is not changed."""
    table = found[0]
    if "text-align: right" in table:
        return table
    head = [re.sub("<.*?>", "", cell) for cell in re.findall("<th>(.*?)</th>", table)]

    def row(cells: re.Match[str]) -> str:
        labels = iter(head)
        return re.sub("<td>", lambda _: f'<td data-label="{next(labels)}">', cells[0])

    table = re.sub(r"<tr>\n<td>.*?</tr>", row, table, flags=re.DOTALL)
    table = table.replace("<table>", "<table data-words>")
    rows = table.count("<tr>") - 1
    if rows < LONG_ROWS:
        return table
    return f'<details class="note long" open><summary>{rows} rows</summary>{table}</details>'


def fold_versions(changelog: str) -> str:
    """Return the changelog with the versions folded after the first section."""
    first, *versions = re.split(r"^## (?!Unreleased)", changelog, flags=re.MULTILINE)
    folded = (version.partition("\n") for version in versions)
    return first + "\n".join(
        f'??? note "{name}"\n\n{textwrap.indent(text, "    ")}' for name, _, text in folded
    )


def site_name(name: str) -> str:
    """Return the place in the site of a file of the repository."""
    return "index.md" if name == "README.md" else name.removeprefix("docs/")


def command_pages() -> dict[str, str]:
    """Return name -> Markdown of each command, from its options, as for the man pages."""
    import typer

    from splinecli.cli.help import examples_of, help_panels
    from splinecli.cli.main import app

    group: Any = typer.main.get_command(app)
    context = group.context_class(group, info_name="splinecli", **group.context_settings)
    pages = {}
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        own = command.context_class(command, info_name=name, parent=context)
        lines = [
            f"# splinecli {name}",
            "",
            "```text",
            own.command_path + " " + " ".join(command.collect_usage_pieces(own)),
        ]
        lines += ["```", "", plain(command.help), ""]
        lines += ["## Examples", ""]
        for line, words in examples_of(name).items():
            lines += [plain(words), "", "```sh", line, "```", ""]
        for title, rows in help_panels(command, own).items():
            lines += [f"## {title}", "", "| option | meaning |", "|---|---|"]
            lines += [
                f"| `{term}` | {plain(meaning)} |".replace("\n", " ") for term, meaning in rows
            ]
            lines.append("")
        pages[name] = "\n".join(lines)
    return pages


def plain(text: str) -> str:
    """Return text without a meaning in Markdown, and its options as code."""
    text = re.sub(r"([|*_\\])", r"\\\1", text).replace("<", "&lt;")
    return re.sub(r"(?<![\w`-])--?[a-z][\w-]*", r"`\g<0>`", text)
