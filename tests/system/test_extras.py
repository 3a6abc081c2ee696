"""Optional packages: what the message says when one is not installed."""

import sys

import pytest

from splinecli.errors import UsageError
from splinecli.system.machine import import_extra


@pytest.mark.parametrize(
    ("module", "extra", "named"),
    [
        ("embreex.rtcore_scene", "render", "embreex and scikit-image"),
        ("fast_simplification", "mesh", "fast-simplification"),
    ],
)
def test_the_message_names_the_packages_and_the_command(module, extra, named, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"{named}.*Run pip install 'splinecli\[{extra}\]'"):
        import_extra(module, extra)
