"""The page in a browser: it lights the normals by Lambert's law, and obeys mouse, keys and fingers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from browser import OpenPage
from result_page import REPORT, SIDE, sphere
from splinecli.normals import unit
from splinecli.pictures.maps import albedo_picture
from splinecli.results import page as page_module
from splinecli.results.page import result_page
from splinecli.transfer import decode_transfer, encode_srgb

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
