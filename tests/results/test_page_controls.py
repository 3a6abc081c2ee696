"""A page under the user's hands: mouse, keys, fingers and the ruler, in a browser."""

import numpy as np
from numpy.testing import assert_allclose

from html_page import REPORT, SIDE, ball, light_at
from scenes import parametrize
from splinecli.results import pages as page_module
from splinecli.results.pages import result_page


def wait_until(page, condition):
    """Wait in the page; its policy refuses the polling of Playwright."""
    page.evaluate(
        f"async () => {{ while (!({condition})) await new Promise(requestAnimationFrame); }}"
    )


def lights_are(page, x, y, note):
    assert_allclose(page.evaluate("splinecli.light"), light_at(x, y), atol=0.02, err_msg=note)


@parametrize("webgl", [True, False])
def test_mouse_keys_and_a_narrow_screen(open_page, webgl):
    normals, mask = ball()
    report = {**REPORT, "capture": "x" * 300, "warnings": [{"code": "", "text": "y" * 300}]}
    values = {"albedo": normals + 1, "confidence": np.float32(mask)}
    html = result_page(
        report, normals, mask, values=values, error_map_deg=np.where(mask, np.float32(3), np.nan)
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
    radius = box["width"] / 2

    def at(x, y):
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
    assert_allclose((left, top, width, height), (32, 64, 128, 128), atol=1)
    # The picture follows the drag, an eighth of the view to the left and a quarter up; the light
    # stays.
    page.mouse.down()
    page.mouse.move(*at(-0.75, 0.5), steps=3)
    page.mouse.up()
    assert_allclose(page.evaluate("splinecli.region"), (32 + 16, 64 + 32, 128, 128), atol=2)
    lights_are(page, 0.3, 0.3, "dragged")
    page.keyboard.press("Shift+ArrowLeft")
    assert_allclose(page.evaluate("splinecli.region")[0], 48 - 12.8, atol=2)
    page.keyboard.press("+")
    assert_allclose(page.evaluate("splinecli.region")[2], 128 / 1.25, atol=1)
    page.keyboard.press("0")
    assert page.evaluate("splinecli.region") == [0, 0, SIDE, SIDE]
    page.evaluate("splinecli.show(1e9, -50, 1e9)")
    left, top, width, height = page.evaluate("splinecli.region")
    assert left == 0 and width > 1 and abs(top + height - SIDE) < 1e-9  # never outside the map


def test_the_address_leads_to_the_same_view(open_page):
    html = result_page(REPORT, *ball(), values={"albedo": ball()[0] + 1})
    page = open_page(html, width=800, height=600)
    page.evaluate("splinecli.ready")
    assert page.evaluate("location.hash") == ""
    page.locator("input[value=specular]").check()
    page.locator("#coloured").uncheck()
    page.evaluate("splinecli.setLight(0.5, -0.25)")
    page.evaluate("splinecli.show(2, 80, 100)")
    page.evaluate("document.getElementById('tint').value = '#ffcc88'")
    wait_until(page, "location.hash.includes('zoom')")
    other = open_page(html, page.evaluate("location.hash")[1:], width=800, height=600)
    other.evaluate("splinecli.ready")
    lights_are(other, 0.5, -0.25, "light")
    assert_allclose(other.evaluate("splinecli.region"), page.evaluate("splinecli.region"), atol=0.1)
    assert other.locator("input[value=specular]").is_checked()
    assert not other.locator("#coloured").is_checked()
    assert other.locator("#tint").input_value() == "#ffcc88"


def test_a_scale_bar_if_the_size_of_a_pixel_is_known(open_page):
    """It is as long as it says, and at most a quarter of the view."""
    assert open_page(result_page(REPORT, *ball())).locator("#bar").count() == 0
    report = {**REPORT, "surface": {"pixel_size_mm": 0.25}}
    page = open_page(result_page(report, *ball()), width=800)
    page.evaluate("splinecli.ready")
    for zoom, text in ((1, "10 mm"), (4, "2 mm")):
        page.evaluate(f"splinecli.show({zoom}, 128, 128)")
        wait_until(page, f"document.getElementById('bar').textContent === '{text}'")
        length, view = (page.locator(name).bounding_box()["width"] for name in ("#bar", "#view"))
        assert abs(length / view - int(text.split()[0]) / (SIDE * 0.25 / zoom)) < 0.01


TOUCH = "Input.dispatchTouchEvent"


def test_fingers(open_page):
    """One finger moves the light, two move and zoom the picture about what they touch."""
    page = open_page(result_page(REPORT, *ball()), width=400, height=800)
    page.evaluate("splinecli.ready")
    page.locator("#view").scroll_into_view_if_needed()
    box = page.locator("#view").bounding_box()
    client = page.context.new_cdp_session(page)
    client.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})

    def touch(kind, *shares):
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
    # The fingers are twice as far apart, and what was between them, the middle, is a tenth of the
    # view higher.
    assert_allclose(page.evaluate("splinecli.region"), (64, 76.8, 128, 128), atol=2)
    touch("touchEnd")


@parametrize("millimetres", [None, 0.25])
def test_the_ruler_has_the_unit_of_the_surface(open_page, monkeypatch, millimetres):
    """A line over half the width of a reduced map is 128 pixels of the whole map, also where the
    view is zoomed.
    """
    monkeypatch.setattr(page_module, "LARGEST_MAP", (SIDE // 2) ** 2)
    report = {**REPORT, "surface": {"pixel_size_mm": millimetres}}
    page = open_page(result_page(report, *ball()), width=400, height=800)
    page.evaluate("splinecli.ready")
    page.locator("#measure").check()
    for zoom, share in ((1, 0.5), (2, 1)):
        page.evaluate(f"splinecli.show({zoom}, 64, 64)")
        page.locator("#view").scroll_into_view_if_needed()
        box = page.locator("#view").bounding_box()
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
