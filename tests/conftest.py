"""Fixtures for all tests."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write tests/golden/ anew; then read the diff"
    )


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real captures that lie beside the repository on the authors' machines; none of them is part of it."""
    folder = Path(__file__).resolve().parents[1] / "../shared/data"
    if not folder.is_dir():
        pytest.skip(f"no real captures in {folder}")
    return folder.resolve()
