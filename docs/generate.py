"""Write every generated file anew: `python docs/generate.py`. Then read the diff.

Man pages and the JSON Schema follow from the commands and documents, tables of the documentation
from the tables of the source and from docs/figures.json, and the example captures from their
script. Golden files are the output of the commands: `--no-golden` leaves them as they are, because
their tests take minutes.
"""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GENERATORS = (
    "man/make_pages.py",
    "docs/make_tables.py",
    "benchmarks/figure_tables.py",
    "benchmarks/figure_plots.py",
    "examples/render_capture.py",
)


def golden_tests() -> list[str]:
    """Return the test files that compare output with tests/golden/."""
    words = ("golden", "refuse")  # fixtures
    files = sorted((ROOT / "tests").rglob("test_*.py"))
    return [str(path) for path in files if any(word in path.read_text("utf-8") for word in words)]


def main() -> None:
    for script in GENERATORS:
        subprocess.run([sys.executable, ROOT / script], check=True)
    if "--no-golden" not in sys.argv:
        command = [sys.executable, "-m", "pytest", "--update-golden", *golden_tests()]
        subprocess.run(command, cwd=ROOT, check=True)


if __name__ == "__main__":
    main()
