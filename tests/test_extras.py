"""Optional packages: what the message says when one is not installed."""

import sys
from pathlib import Path

import pytest

from splinecli.errors import InputError, UsageError
from splinecli.system.extras import import_extra


@pytest.mark.parametrize(
    ("module", "extra", "named"),
    [
        ("embreex.rtcore_scene", "render", "embreex and scikit-image"),
        ("OpenEXR", "exr", "OpenEXR"),
        ("fast_simplification", "mesh", "fast-simplification"),
        ("torch.utils.tensorboard", "tensorboard", "tensorboard"),
    ],
)
def test_the_message_names_the_packages_and_the_command(
    module: str, extra: str, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"{named}.*Run pip install 'splinecli\[{extra}\]'"):
        import_extra(module, extra)


def test_another_error_with_a_file_and_another_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(InputError) as caught:
        import_extra("rawpy", "raw", error=InputError, path=Path("a.nef"), otherwise="export it")
    assert str(caught.value) == (
        "a.nef: camera RAW files need rawpy, which is not installed. Run pip install 'splinecli[raw]', or export it."
    )
