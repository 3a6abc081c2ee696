"""Write the tables of the documentation that follow from tables of the source: warnings, methods
and maps.

    .venv/bin/python docs/make_tables.py

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. A test checks that it is up to
date.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from splinecli.estimate.methods import METHODS
from splinecli.records.capture_warnings import WARNINGS
from splinecli.records.output_files import MAPS

DOCS = Path(__file__).resolve().parent
PAGES = ("warnings.md", "compared_methods.md", "results.md")


def warnings_table() -> list[str]:
    """Return the rows of all warnings."""
    kinds = [WARNINGS[code] for code in sorted(WARNINGS)]
    rows = [
        (f"`{kind.code}`", kind.meaning, kind.remedy, "error" * kind.is_error) for kind in kinds
    ]
    return table(("code", "meaning", "remedy", "`--strict`"), rows)


def methods_table() -> list[str]:
    """Return the rows of all methods."""
    rows = [(f"`{name}`", method.principle, method.source) for name, method in METHODS.items()]
    return table(("name", "principle", "source"), rows)


def maps_table() -> list[str]:
    """Return the rows of all maps that --maps adds."""
    rows = [
        (f"`{m.name}`", ", ".join(f"`{name}`" for name in m.files.values()), m.content)
        for m in MAPS.values()
    ]
    return table(("map", "files", "content"), rows)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = [f"| {' | '.join(cells)} |".replace("|  |", "| |") for cells in (head, *rows)]
    return [lines[0], "|---" * len(head) + "|", *lines[1:]]


TABLES = {"warnings": warnings_table, "methods": methods_table, "maps": maps_table}


def fill(text: str) -> str:
    """Return a page with its tables as the source has them."""

    def write(found: re.Match[str]) -> str:
        return "\n".join([found[1], *TABLES[found[2]](), "<!-- end -->"])

    return re.sub(r"(<!-- table: (\w+) -->)\n.*?<!-- end -->", write, text, flags=re.DOTALL)


def main() -> None:
    for name in PAGES:
        page = DOCS / name
        page.write_text(fill(page.read_text("utf-8")), "utf-8")


if __name__ == "__main__":
    main()
