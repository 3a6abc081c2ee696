"""The page loads nothing, escapes names, and stores the normals exactly."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from html_page import HtmlPage
from result_page import REPORT, sphere
from splinecli.normals import angle_between_deg, unit
from splinecli.results import page as page_module
from splinecli.results.page import result_page

HOSTILE = """</script><script>document.title = "x"</script>'"<img src=x onerror=alert(1)>{{ 7 * 7 }}&amp;"""
LONGEST_SIDE = 1600  # of a reduced map


class Page(HtmlPage):
    """The text of a page and its pictures."""

    @property
    def facts(self) -> dict[str, str]:
        return dict(zip(self.text["dt"], self.text["dd"], strict=True))

    @property
    def alternative_texts(self) -> list[str | None]:
        return [attributes["alt"] for tag, attributes in self.tags if tag == "img"]

    def picture(self, alternative_text: str) -> NDArray[np.uint8]:
        """RGB of the image with this alternative text."""
        (source,) = (a["src"] for tag, a in self.tags if tag == "img" and a["alt"] == alternative_text)
        assert source is not None
        png = base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True)
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        if picture.ndim == 2:
            return np.repeat(picture[..., None], 3, axis=2)
        assert picture.shape[2] == 3  # alpha would be multiplied into the rest
        return np.asarray(picture[..., ::-1], np.uint8)

    def normals(self) -> NDArray[np.float64]:
        """Normals (H, W, 3) as the page's script decodes them, zero outside the mask."""
        high, low = self.picture("Normal map").astype(int), self.picture("").astype(int)
        return unit(((high * 32 + low) / 8191 * 2 - 1) * high.any(axis=2, keepdims=True))


def test_it_stands_alone() -> None:
    normals, mask = sphere(40)
    html = result_page(REPORT, normals, mask, albedo=normals + 1, error_map_deg=normals[..., 0] * 40)
    page = Page(html)
    assert not re.search(
        r"""(src|href)\s*=\s*["']?(?!["']?data:)|url\(|@import|//\w+\.|https?:|fetch\(|import\(""", html
    )
    policy = next(a["content"] for tag, a in page.tags if tag == "meta" and "http-equiv" in a)
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:;")


def test_figures_and_pictures() -> None:
    normals, mask = sphere(40)
    errors = np.where(mask, 90 * normals[..., 2], np.nan).astype(np.float32)
    page = Page(
        result_page(
            {**REPORT, "warnings": [{"code": "eight_bit", "text": "The images are 8-bit."}]},
            normals,
            mask,
            albedo=np.full_like(normals, 0.3) * mask[..., None],
            confidence_map=mask.astype(np.float32) * 0.6,
            error_map_deg=errors,
        )
    )
    assert page.text["h1"] == page.text["title"] == ["Photometric stereo: ball"]
    assert page.facts == {
        "Mean": "9.06°",
        "Median": "6.24°",
        "90th percentile": "18.10°",
        "Under 5°": "37.2%",
        "Under 10°": "75.0%",
        "Method": "spline-net",
        "Weights": "blobby-7",
        "Lights": "10",
        "Pixels": "45,200",
        "Size": "296 × 321",
        "Likely within 5°": "81% of the pixels",
        "Seconds": "read 0.6, estimate 0.008",
        "Device": "cpu, float32",
    }
    assert page.text["li"] == ["The images are 8-bit."]
    assert page.alternative_texts == ["Normal map", "Albedo map", "Confidence map", "Error map", ""]
    assert (page.picture("Albedo map")[20, 20] == 255).all()  # the brightest hundredth is white
    assert (page.picture("Confidence map")[20, 20] == 153).all()
    assert (page.picture("Error map")[~mask] == 255).all()
    assert {"0°", "30° or more"} <= set(page.text["span"])


def test_what_is_not_given_is_absent() -> None:
    normals, mask = sphere(40)
    html = result_page(
        {**REPORT, "weights": None, "angular_error_deg": None, "expected_under_5": None}, normals, mask
    )
    page = Page(html)
    assert page.alternative_texts == ["Normal map", ""]
    assert not {"Weights", "Mean", "Likely within 5°", "Size on this page"} & set(page.facts)
    assert "Warnings" not in page.text["h2"]
    assert 'id="coloured"' not in html
    assert "or more" not in "".join(page.text["figcaption"])


def test_names_are_text() -> None:
    normals, mask = sphere(40)
    hostile = {"capture": HOSTILE, "method": HOSTILE, "device": HOSTILE, "version": HOSTILE}
    report = {
        **REPORT,
        **hostile,
        "weights": {"name": HOSTILE, "sha256": ""},
        "warnings": [{"code": "", "text": HOSTILE}],
    }
    page = Page(result_page(report, normals, mask))
    plain = Page(result_page({**REPORT, "warnings": [{"code": "", "text": "w"}]}, normals, mask))
    assert [tag for tag, _ in page.tags] == [tag for tag, _ in plain.tags]
    assert page.text["script"] == plain.text["script"]
    assert page.text["title"] == [f"Photometric stereo: {HOSTILE}"]
    assert page.facts["Method"] == page.facts["Weights"] == page.text["li"][0] == HOSTILE


def test_the_normals_survive() -> None:
    random = np.random.default_rng(0)
    normals = unit(random.normal(size=(70, 90, 3))).astype(
        np.float32
    )  # all round, those seen from behind, too
    mask = random.random((70, 90)) < 0.8
    decoded = Page(result_page(REPORT, normals * mask[..., None], mask)).normals()
    assert (decoded.any(axis=2) == mask).all()
    assert angle_between_deg(decoded, normals)[mask].max() < 0.02


def test_large_maps_are_reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two flat faces side by side keep their normals and colours: the background does not change the means."""
    monkeypatch.setattr(page_module, "LARGEST_MAP", LONGEST_SIDE * 150)
    width, height = 2 * LONGEST_SIDE, 300
    faces = unit(np.array([[0.6, 0.2, 0.5], [-0.9, 0.1, 0.3]], np.float32))
    mask = np.ones((height, width), bool)
    mask[:101] = False
    normals = faces[(np.arange(width) >= LONGEST_SIDE).astype(int)][None].repeat(height, 0) * mask[..., None]
    albedo = np.float32([0.5, 0.25, 0.125]) * mask[..., None]
    errors = np.where(mask, np.float32(12), np.nan)
    page = Page(result_page(REPORT, normals, mask, albedo=albedo, error_map_deg=errors))
    decoded = page.normals()
    assert decoded.shape == (150, LONGEST_SIDE, 3)
    assert page.facts["Size on this page"] == "1600 × 150"
    assert "This page shows 1600 × 150 of the 3200 × 300 pixels." in " ".join(page.text["p"])
    for face, half in zip(faces, np.split(decoded, 2, axis=1), strict=True):
        shown = half.any(axis=2)
        assert shown[51:].all()
        assert not shown[:50].any()
        assert angle_between_deg(half[shown], np.broadcast_to(face, half[shown].shape)).max() < 0.02
    shown = decoded.any(axis=2)
    for name in ("Albedo map", "Error map"):
        colours = page.picture(name)[shown].astype(int)
        assert np.ptp(colours, axis=0).max() <= 1  # rounding alone, no background
