"""The page loads nothing, escapes names, stores the normals exactly, and lights them by Lambert's law."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from browser import OpenPage
from html_page import HtmlPage
from splinecli.normals import angle_between_deg, unit
from splinecli.pictures.maps import albedo_picture
from splinecli.results import page as page_module
from splinecli.results.page import result_page
from splinecli.transfer import decode_transfer, encode_srgb

REPORT: dict[str, Any] = {
    "capture": "ball",
    "method": "spline-net",
    "weights": {"name": "blobby-7", "sha256": "0123456789ab" * 5},
    "n_lights": 10,
    "light_indices": list(range(10)),
    "n_pixels": 45200,
    "image_size": [296, 321],
    "device": "cpu",
    "precision": "float32",
    "seconds": {"read": 0.6, "estimate": 0.008, "surface": 0.0, "total": 0.608},
    "peak_memory_mib": 86,
    "warnings": [],
    "expected_under_5": 0.8123,
    "capture_judged": True,
    "angular_error_deg": {"mean": 9.063, "median": 6.24, "p90": 18.1, "under_5": 0.3725, "under_10": 0.75},
    "version": "0.1.0",
}
HOSTILE = """</script><script>document.title = "x"</script>'"<img src=x onerror=alert(1)>{{ 7 * 7 }}&amp;"""
SIDE = 256  # pixels, of the sphere
LONGEST_SIDE = 1600  # of a reduced map


def sphere(side: int = SIDE) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Normals (side, side, 3) and mask of a sphere that nearly fills the picture."""
    steps = (np.arange(side) + 0.5 - side / 2) / (0.47 * side)
    x, y = np.meshgrid(steps, -steps)
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 0))
    return (np.stack((x, y, z), axis=2) * mask[..., None]).astype(np.float32), mask


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


CHANGE = """
async (fragment) => {
  const changed = new Promise((resolve) => addEventListener("hashchange", resolve, { once: true }));
  location.hash = fragment;
  await changed;
  for (let frame = 0; frame < 2; frame++) await new Promise(requestAnimationFrame);
}
"""


def views(
    open_page: OpenPage, html: str, fragments: Sequence[str], *, webgl: bool = True
) -> list[NDArray[np.int64]]:
    """Screenshots of the view, (SIDE, SIDE, 3) RGB, one screen pixel for each pixel of the map."""
    # At the window's edge the view would be under the place where a headless browser's pointer rests.
    edge = 64
    style = (
        f".surface {{ position: fixed !important; left: {edge}px; top: {edge}px; width: {SIDE}px !important }}"
        "#view { border-radius: 0 }"
    )
    page = open_page(html.replace("</head>", f"<style>{style}</style></head>"), fragments[0], webgl=webgl)
    page.evaluate("splinecli.ready")
    assert page.evaluate("document.getElementById('view').dataset.renderer") == (
        "webgl" if webgl else "software"
    )
    seen = []
    for fragment in fragments:
        if fragment != fragments[0]:
            page.evaluate(CHANGE, fragment)
        png = page.screenshot(clip={"x": edge, "y": edge, "width": SIDE, "height": SIDE})
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        seen.append(np.asarray(picture[..., ::-1], np.int64))
    return seen


def light_at(x: float, y: float) -> NDArray[np.float64]:
    return np.array((x, y, np.sqrt(1 - x * x - y * y)))


@pytest.mark.parametrize("webgl", [True, False])
def test_a_matte_sphere_is_lit_by_the_cosine(open_page: OpenPage, webgl: bool) -> None:
    normals, mask = sphere()
    html = result_page(REPORT, normals, mask)
    lights = ((-0.7, 0.5), (0.6, -0.3), (0.1, 0.9))
    pictures = views(open_page, html, [f"light={x},{y}&specular=0" for x, y in lights], webgl=webgl)
    for (x, y), seen in zip(lights, pictures, strict=True):
        expected = encode_srgb(np.maximum(normals @ light_at(x, y), 0)).astype(int)
        # Half a level each for the screen and the picture, and one where sRGB is steep: 13 bits of the normal there.
        assert np.abs(seen - expected[..., None]).max() <= 2
        rows, columns = np.nonzero(seen[..., 0] > 250)
        assert np.sign(columns.mean() - SIDE / 2) == np.sign(x)  # the lit side follows the light
        assert np.sign(SIDE / 2 - rows.mean()) == np.sign(y)


def test_a_glossy_sphere_of_two_colours(open_page: OpenPage) -> None:
    """The view shows Blinn and Phong's normalised lobe, and the albedo as its picture stores it."""
    normals, mask = sphere()
    albedo = np.where(
        np.arange(SIDE)[:, None] < 100, np.float32([0.8, 0.2, 0.1]), np.float32([0.1, 0.3, 0.5])
    )
    albedo = albedo[:, None].repeat(SIDE, 1).reshape(SIDE, SIDE, 3) * mask[..., None]
    gain, shininess, light = 0.2, 64, light_at(-0.5, 0.4)
    cosine = np.maximum(normals @ light, 0)[..., None]
    lobe = (
        (shininess + 8)
        / 8
        * np.maximum(normals @ unit(light + np.array((0, 0, 1))), 0)[..., None] ** shininess
    )
    stored = decode_transfer(albedo_picture(albedo, mask).astype(np.float32) / 255, None)

    html = result_page(REPORT, normals, mask, albedo=albedo)
    fragment = f"light=-0.5,0.4&specular={gain}&shininess={shininess}"
    for base, seen in zip(
        (stored, 1), views(open_page, html, [fragment, f"{fragment}&albedo=0"]), strict=True
    ):
        expected = encode_srgb(((1 - gain) * base + gain * lobe) * cosine)
        assert np.abs(seen - expected).max() <= 3


def glossy(n: NDArray[np.floating], light: NDArray[np.floating], exponent: float) -> NDArray[np.floating]:
    return np.maximum(n @ unit(light + np.array((0, 0, 1))), 0) ** exponent


@pytest.mark.parametrize("webgl", [True, False])
def test_views_ambient_light_and_confidence(open_page: OpenPage, webgl: bool) -> None:
    normals, mask = sphere()
    light, ambient = light_at(0.8, -0.1), 0.4
    confidence = np.where(np.arange(SIDE) < SIDE // 2, np.float32(1), np.float32(0.2)) * mask
    html = result_page(REPORT, normals, mask, confidence_map=confidence)
    cosine = np.maximum(normals @ light, 0)
    sky = (1 + normals[..., 2]) / 2
    expected = {
        "view=shaded&specular=0": encode_srgb(cosine),
        "view=normals": np.rint(255 * (normals + 1) / 2) * mask[..., None],
        "view=specular&shininess=32": encode_srgb(0.4 * cosine + 0.7 * glossy(normals, light, 32)),
        f"view=shaded&ambient={ambient}": encode_srgb((1 - ambient) * cosine + ambient * sky),
        "ambient=0&confidence=1": encode_srgb(cosine),
    }
    pictures = views(open_page, html, [f"light=0.8,-0.1&{choice}" for choice in expected], webgl=webgl)
    sure = mask & (np.arange(SIDE) < SIDE // 2 - 1)
    for (choice, picture), seen in zip(expected.items(), pictures, strict=True):
        picture = picture if picture.ndim == 3 else picture[..., None]
        assert np.abs(seen - picture)[sure].max() <= 3, choice
        assert not seen[~mask].any()
    share = 0.8 * 0.8  # the strongest overlay, of which the pixels with a confidence of 0.2 get 0.8
    red = encode_srgb(cosine[..., None] * (1 - share) + np.array((0.9, 0.25, 0.1)) * share)
    doubtful = mask & (np.arange(SIDE) > SIDE // 2)
    assert np.abs(pictures[-1] - red)[doubtful].max() <= 3


@pytest.mark.parametrize("webgl", [True, False])
def test_zoom_shows_a_part_of_the_same_picture(open_page: OpenPage, webgl: bool) -> None:
    """Zoom 2 around (80, 100) shows the map's pixels 16 to 144 and 36 to 164; the sphere is known at any place."""
    html = result_page(REPORT, *sphere())
    [seen] = views(open_page, html, ["light=-0.7,0.5&specular=0&zoom=2,80,100"], webgl=webgl)
    whole, _ = sphere(2 * SIDE)
    normals = whole[2 * 36 : 2 * 164, 2 * 16 : 2 * 144]
    expected = encode_srgb(np.maximum(normals @ light_at(-0.7, 0.5), 0)).astype(int)
    smooth = (normals[..., 2] > 0.5) & (normals @ light_at(-0.7, 0.5) > 0.05)
    # Without WebGL, the nearest pixel of the map is shown: at most 1/4 of a pixel away, where shading has this slope.
    assert np.abs(seen - expected[..., None])[smooth].max() <= (3 if webgl else 6)


def wait_until(page: Any, condition: str) -> None:
    """Wait in the page; its policy refuses the polling of Playwright."""
    page.evaluate(f"async () => {{ while (!({condition})) await new Promise(requestAnimationFrame); }}")


def lights_are(page: Any, x: float, y: float, note: str) -> None:
    np.testing.assert_allclose(page.evaluate("splinecli.light"), light_at(x, y), atol=0.02, err_msg=note)


@pytest.mark.parametrize("webgl", [True, False])
def test_mouse_keys_and_a_narrow_screen(open_page: OpenPage, webgl: bool) -> None:
    normals, mask = sphere()
    report = {**REPORT, "capture": "x" * 300, "warnings": [{"code": "", "text": "y" * 300}]}
    errors = np.where(mask, np.float32(3), np.nan)
    confidence = mask.astype(np.float32)
    html = result_page(
        report, normals, mask, albedo=normals + 1, confidence_map=confidence, error_map_deg=errors
    )
    page = open_page(html, width=400, height=800, webgl=webgl)
    page.evaluate("splinecli.ready")
    canvas = page.locator("#view")
    assert canvas.get_attribute("data-renderer") == ("webgl" if webgl else "software")
    assert page.locator("#notice").is_visible() is not webgl
    assert not page.locator("#loading").is_visible()
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    lights_are(page, -0.72, 0.48, "the preview's raking light, from the upper left")

    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    radius = box["width"] / 2

    def at(x: float, y: float) -> tuple[float, float]:
        return box["x"] + radius * (1 + x), box["y"] + radius * (1 - y)

    page.mouse.move(*at(0, 0))
    lights_are(page, 0, 0, "centre")
    canvas.focus()
    for key in ("ArrowRight", "ArrowUp", "ArrowUp"):
        page.keyboard.press(key)
    lights_are(page, 0.05, 0.1, "arrows")
    page.mouse.move(*at(0.95, 0.95))
    lights_are(page, 0.995 * 0.5**0.5, 0.995 * 0.5**0.5, "beyond the disc")
    page.mouse.move(*at(0.3, 0.3))
    page.mouse.down()
    page.mouse.up()
    page.mouse.move(*at(-0.5, 0))
    lights_are(page, 0.3, 0.3, "held")
    page.evaluate("splinecli.setLight(NaN, 0)")
    lights_are(page, 0.3, 0.3, "nonsense")

    # The wheel zooms around the pointer, which is over a quarter of the map.
    page.mouse.wheel(0, -300)
    wait_until(page, "splinecli.region[2] < 200")
    left, top, width, height = page.evaluate("splinecli.region")
    np.testing.assert_allclose((left, top, width, height), (32, 64, 128, 128), atol=1)
    # The picture follows the drag, an eighth of the view to the left and a quarter up; the light stays.
    page.mouse.down()
    page.mouse.move(*at(-0.75, 0.5), steps=3)
    page.mouse.up()
    np.testing.assert_allclose(page.evaluate("splinecli.region"), (32 + 16, 64 + 32, 128, 128), atol=2)
    lights_are(page, 0.3, 0.3, "dragged")
    page.keyboard.press("Shift+ArrowLeft")
    np.testing.assert_allclose(page.evaluate("splinecli.region")[0], 48 - 12.8, atol=2)
    page.keyboard.press("+")
    np.testing.assert_allclose(page.evaluate("splinecli.region")[2], 128 / 1.25, atol=1)
    page.keyboard.press("0")
    assert page.evaluate("splinecli.region") == [0, 0, SIDE, SIDE]
    page.evaluate("splinecli.show(1e9, -50, 1e9)")
    left, top, width, height = page.evaluate("splinecli.region")
    assert left == 0 and width > 1 and abs(top + height - SIDE) < 1e-9  # never outside the map


TOUCH = "Input.dispatchTouchEvent"


def test_fingers(open_page: OpenPage) -> None:
    """One finger moves the light, two move and zoom the picture about what they touch."""
    page = open_page(result_page(REPORT, *sphere()), width=400, height=800)
    page.evaluate("splinecli.ready")
    page.locator("#view").scroll_into_view_if_needed()
    box = page.locator("#view").bounding_box()
    assert box is not None
    client = page.context.new_cdp_session(page)
    client.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})

    def touch(kind: str, *shares: tuple[float, float]) -> None:
        points = [
            {"x": box["x"] + x * box["width"], "y": box["y"] + y * box["height"], "id": number}
            for number, (x, y) in enumerate(shares)
        ]
        client.send(TOUCH, {"type": kind, "touchPoints": points})

    touch("touchStart", (0.4, 0.5))
    touch("touchMove", (0.6, 0.4))
    lights_are(page, 0.2, 0.2, "one finger")
    touch("touchEnd")
    touch("touchStart", (0.4, 0.5))
    touch("touchStart", (0.4, 0.5), (0.6, 0.5))
    lights = page.evaluate("splinecli.light")
    touch("touchMove", (0.3, 0.4), (0.7, 0.4))
    wait_until(page, "splinecli.region[2] < 200")
    assert page.evaluate("splinecli.light") == lights
    # The fingers are twice as far apart, and what was between them, the middle, is a tenth of the view higher.
    np.testing.assert_allclose(page.evaluate("splinecli.region"), (64, 76.8, 128, 128), atol=2)
    touch("touchEnd")


@pytest.mark.parametrize("millimetres", [None, 0.25])
def test_the_ruler_has_the_unit_of_the_surface(
    open_page: OpenPage, monkeypatch: pytest.MonkeyPatch, millimetres: float | None
) -> None:
    """A line over half the width of a reduced map is 128 pixels of the whole map, also where the view is zoomed."""
    monkeypatch.setattr(page_module, "LARGEST_MAP", (SIDE // 2) ** 2)
    report = {**REPORT, "surface": {"pixel_size_mm": millimetres}}
    page = open_page(result_page(report, *sphere()), width=400, height=800)
    page.evaluate("splinecli.ready")
    page.locator("#measure").check()
    for zoom, share in ((1, 0.5), (2, 1)):
        page.evaluate(f"splinecli.show({zoom}, 64, 64)")
        page.locator("#view").scroll_into_view_if_needed()
        box = page.locator("#view").bounding_box()
        assert box is not None
        start, end = (box["x"] + (1 + side * share) / 2 * box["width"] for side in (-1, 1))
        before = page.evaluate("splinecli.light")
        page.mouse.move(start + 0.5, box["y"] + 99)
        page.mouse.down()
        page.mouse.move(end - 0.5, box["y"] + 99, steps=2)
        page.mouse.up()
        wait_until(page, "!document.getElementById('ruler').hidden")
        length, unit_name = page.locator("#length").inner_text().split()
        assert unit_name == ("pixels" if millimetres is None else "mm")
        assert abs(float(length) - 128 * (millimetres or 1)) < 1.5 * (millimetres or 1)
        assert page.evaluate("splinecli.light") == before
