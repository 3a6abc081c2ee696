"""The pages share one head, one set of colours and one list of terms, and open without errors in a browser."""

import zlib
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import tifffile

from browser import OpenPage
from splinecli.evaluation.document import html_report
from splinecli.evaluation.protocol import Evaluation, Protocol, Result
from splinecli.output_files import NORMALS
from splinecli.results.pages import Entry, Row, index_page

RED = np.full((6, 8, 3), (0, 0, 255), np.uint8)


def test_the_index_shows_small_pictures(open_page: OpenPage, tmp_path):
    """It contains them, also after the results have moved, and leaves out what cannot be read."""
    for name, content in (("a & b", cv2.imencode(".png", np.tile(RED, (100, 100, 1)))[1]), ("cut", b"\x89PNG")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "normals.png").write_bytes(bytes(content))
    report = {
        "capture": "a & b", "n_lights": 10, "n_pixels": 48, "angular_error_deg": {"mean": 2.5},
        "expected_under_5": 0.9, "warnings": [{"code": "c", "text": "It is <dark>."}], "seconds": {"read": 1.0},
        "files": ["normals.png", "report.json"],
    }  # fmt: skip
    failed = {"capture": "x" * 200, "error": "y" * 200}
    html = index_page([Entry.of(part) for part in (report, {**report, "capture": "cut"}, failed)], tmp_path)
    (tmp_path / "a & b/normals.png").unlink()
    page = open_page(html, width=400)
    assert page.locator("img").evaluate("image => [image.naturalWidth, image.naturalHeight]") == [256, 192]
    assert page.locator("td.words p").all_text_contents() == ["It is <dark>."] * 2
    picture = page.locator("img")
    picture.scroll_into_view_if_needed()
    shot = cv2.imdecode(np.frombuffer(picture.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert (np.abs(shot.astype(int) - RED[0, 0]).max(axis=2) <= 2).mean() > 0.5
    assert page.locator("th").all_inner_texts()[:3] == ["capture", "normals", "lights"]
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


def test_the_report_fits_a_narrow_screen(open_page: OpenPage):
    png = cv2.imencode(".png", np.repeat(RED, 50, axis=1))[1].tobytes()
    results = tuple(Result(m, c, 10, (5.0, 5.5, 6.0), 0.1) for m in ("ls", "iw12") for c in ("x" * 60, "y" * 60))
    page = open_page(html_report([Evaluation(Protocol(10, 3), results, ())], [("figure", png)], []), width=400)
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    assert page.locator("img").evaluate("image => image.decode().then(() => image.naturalWidth)") == 400


def test_pictures_of_earlier_results_that_are_none_of_ours_are_not_shown(tmp_path: Path) -> None:
    folder = tmp_path / "other"
    folder.mkdir()
    entry = Entry(Row("other"), (NORMALS["png"],))
    picture = folder / NORMALS["png"]
    cv2.imwrite(str(picture), np.full((9, 9, 3), 200, np.uint8))
    assert "data:image/jpeg" in index_page([entry], tmp_path)
    content = bytearray(picture.read_bytes())
    content[16:24] = (20_000).to_bytes(4, "big") * 2  # the size, in a file of few bytes
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    picture.write_bytes(content)
    with mock.patch("splinecli.capture.formats.images._decode", side_effect=AssertionError):
        assert "data:image/jpeg" not in index_page([entry], tmp_path)
    tifffile.imwrite(picture, np.zeros((9, 9, 3), np.float32), photometric="rgb")
    assert "data:image/jpeg" not in index_page([entry], tmp_path)
