"""The page loads nothing, escapes names, stores the normals exactly, and lights them by Lambert's
law.

The pages share one head, one set of colours and one list of terms, and open without errors in a
browser.
"""

import base64
import re
import zlib
from unittest import mock

import cv2
import numpy as np
import tifffile
import torch

from html_page import REPORT, SIDE, HtmlPage, ball, light_at
from scenes import decode_rgb, halfway, parametrize, square_grid, write_image
from splinecli.evaluation.document import html_report
from splinecli.evaluation.protocol import Evaluation, Protocol, Result
from splinecli.materials.lobes import GGX, Geometry, diffuse_lobe, facet_lobe
from splinecli.maths.normals import angle_between_deg, unit
from splinecli.maths.transfer import decode_transfer, encode_srgb
from splinecli.pictures.maps import albedo_picture
from splinecli.records.output_files import NORMALS
from splinecli.results import pages as page_module
from splinecli.results.pages import IndexEntry, IndexRow, index_page, result_page

HOSTILE = (
    '</script><script>document.title = "x"</script>'
    """'"<img src=x onerror=alert(1)>{{ 7 * 7 }}&amp;"""
)
LONGEST_SIDE = 1600  # of a reduced map


class Page(HtmlPage):
    """The text of a page and its pictures."""

    @property
    def facts(self):
        return dict(zip(self.text["dt"], self.text["dd"], strict=True))

    @property
    def alternative_texts(self):
        return [attributes["alt"] for tag, attributes in self.tags if tag == "img"]

    def picture(self, alternative_text):
        """RGB of the image with this alternative text."""
        (source,) = (
            a["src"] for tag, a in self.tags if tag == "img" and a["alt"] == alternative_text
        )
        png = base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True)
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        if picture.ndim == 2:
            return np.repeat(picture[..., None], 3, axis=2)
        assert picture.shape[2] == 3  # alpha would be multiplied into the rest
        return np.asarray(picture[..., ::-1], np.uint8)

    def normals(self):
        """Normals (H, W, 3) as the page's script decodes them, zero outside the mask."""
        high, low = self.picture("Normal map").astype(int), self.picture("").astype(int)
        return unit(((high * 32 + low % 32) / 8191 * 2 - 1) * high.any(axis=2, keepdims=True))


def test_it_stands_alone():
    normals, mask = ball(40)
    html = result_page(
        REPORT, normals, mask, values={"albedo": normals + 1}, error_map_deg=normals[..., 0] * 40
    )
    outside = (
        r"""(src|href)\s*=\s*["']?(?!["']?data:)|url\((?!#)|@import|//\w+\.|https?:|fetch\("""
        r"|import\("
    )
    assert not re.search(outside, html)
    policy = next(a["content"] for tag, a in Page(html).tags if tag == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'; img-src data:;")


def test_figures_and_pictures():
    normals, mask = ball(40)
    errors = np.float32(np.where(mask, 90 * normals[..., 2], np.nan))
    report = {**REPORT, "warnings": [{"code": "eight_bit", "text": "The images are 8-bit."}]}
    maps = {
        "albedo": np.full_like(normals, 0.3) * mask[..., None],
        "confidence": np.float32(mask) * 0.6,
    }
    page = Page(result_page(report, normals, mask, values=maps, error_map_deg=errors))
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
        "Seconds": "read 0.6",
        "Device": "cpu, float32",
    }
    assert page.text["li"] == ["The images are 8-bit."]
    assert page.alternative_texts == ["Normal map", "Albedo map", "Confidence map", "Error map", ""]
    assert (page.picture("Albedo map")[20, 20] == 255).all()  # the brightest hundredth is white
    assert (page.picture("Confidence map")[20, 20] == 153).all()
    assert (page.picture("Error map")[~mask] == 255).all()
    assert {"0°", "30° or more"} <= set(page.text["span"])


def test_names_are_text():
    normals, mask = ball(40)
    hostile = dict.fromkeys(("capture", "method", "device", "version"), HOSTILE)
    hostile |= {
        "weights": {"name": HOSTILE, "sha256": ""},
        "warnings": [{"code": "", "text": HOSTILE}],
    }
    page = Page(result_page({**REPORT, **hostile}, normals, mask))
    plain = Page(result_page({**REPORT, "warnings": [{"code": "", "text": "w"}]}, normals, mask))
    assert [tag for tag, _ in page.tags] == [tag for tag, _ in plain.tags]
    assert page.text["script"] == plain.text["script"]
    assert page.text["title"] == [f"Photometric stereo: {HOSTILE}"]
    assert page.facts["Method"] == page.facts["Weights"] == page.text["li"][0] == HOSTILE


def test_the_normals_survive(rng):
    # all round, those seen from behind, too
    normals = np.float32(unit(rng.normal(size=(70, 90, 3))))
    mask = rng.random((70, 90)) < 0.8
    decoded = Page(result_page(REPORT, normals * mask[..., None], mask)).normals()
    assert (decoded.any(axis=2) == mask).all()
    assert angle_between_deg(decoded, normals)[mask].max() < 0.02


def test_large_maps_are_reduced(monkeypatch):
    """Two flat faces side by side keep their normals and colours: the background does not change
    the means.
    """
    monkeypatch.setattr(page_module, "LARGEST_MAP", LONGEST_SIDE * 150)
    width, height = 2 * LONGEST_SIDE, 300
    faces = unit(np.array([[0.6, 0.2, 0.5], [-0.9, 0.1, 0.3]], np.float32))
    mask = np.ones((height, width), bool)
    mask[:101] = False
    normals = (
        faces[(np.arange(width) >= LONGEST_SIDE).astype(int)][None].repeat(height, 0)
        * mask[..., None]
    )
    albedo = np.float32([0.5, 0.25, 0.125]) * mask[..., None]
    errors = np.where(mask, np.float32(12), np.nan)
    material = np.float32([0.5, 0.25, 0.125, 0.4, 0, 0.5, 1]) * mask[..., None]
    html = result_page(
        REPORT, normals, mask, values={"albedo": albedo}, material=material, error_map_deg=errors
    )
    page = Page(html)
    decoded = page.normals()
    assert decoded.shape == (150, LONGEST_SIDE, 3)
    assert page.facts["Size on this page"] == "1600 × 150"
    assert "This page shows 1600 × 150 of the 3200 × 300 pixels." in " ".join(page.text["p"])
    for face, half in zip(faces, np.split(decoded, 2, axis=1), strict=True):
        shown = half.any(axis=2)
        assert shown[51:].all()  # type: ignore[index]
        assert not shown[:50].any()  # type: ignore[index]
        assert angle_between_deg(half[shown], np.broadcast_to(face, half[shown].shape)).max() < 0.02
    shown = decoded.any(axis=2)
    for name in ("Albedo map", "Base colour map", "Roughness map", "Error map"):
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


def views(open_page, html, fragments, *, webgl=True):
    """Screenshots of the view, (SIDE, SIDE, 3) RGB, one screen pixel for each pixel of the map.

    Without ambient light, unless a fragment has it.
    """
    fragments = [each if "ambient" in each else f"{each}&ambient=0" for each in fragments]
    # At the window's edge the view would be under the place where a headless browser's pointer
    # rests.
    edge = 64
    style = (
        f".surface {{ position: fixed !important; left: {edge}px; top: {edge}px; width: {SIDE}px"
        " !important }#view { border-radius: 0 }"
    )
    page = open_page(
        html.replace("</head>", f"<style>{style}</style></head>"), fragments[0], webgl=webgl
    )
    page.evaluate("splinecli.ready")
    assert page.evaluate("document.getElementById('view').dataset.renderer") == (
        "webgl" if webgl else "software"
    )
    seen = []
    for fragment in fragments:
        if fragment != fragments[0]:
            page.evaluate(CHANGE, fragment)
        png = page.screenshot(clip={"x": edge, "y": edge, "width": SIDE, "height": SIDE})
        seen.append(np.int64(decode_rgb(png)))
    return seen


def test_a_glossy_sphere_of_two_colours(open_page):
    """The view shows Blinn and Phong's normalised lobe, and the albedo as its picture stores it."""
    normals, mask = ball()
    albedo = np.where(
        np.arange(SIDE)[:, None] < 100, np.float32([0.8, 0.2, 0.1]), np.float32([0.1, 0.3, 0.5])
    )
    albedo = albedo[:, None].repeat(SIDE, 1).reshape(SIDE, SIDE, 3) * mask[..., None]
    gain, shininess, light = 0.2, 64, light_at(-0.5, 0.4)
    cosine = np.maximum(normals @ light, 0)[..., None]
    lobe = (shininess + 8) / 8 * glossy(normals, light, shininess)[..., None]
    stored = decode_transfer(np.float32(albedo_picture(albedo, mask)) / 255, None)

    html = result_page(REPORT, normals, mask, values={"albedo": albedo})
    fragment = f"light=-0.5,0.4&specular={gain}&shininess={shininess}"
    for base, seen in zip(
        (stored, 1), views(open_page, html, [fragment, f"{fragment}&albedo=0"]), strict=True
    ):
        expected = encode_srgb(((1 - gain) * base + gain * lobe) * cosine)  # type: ignore[operator]
        assert np.abs(seen - expected).max() <= 3


def glossy(n, light, exponent):
    return np.maximum(n @ halfway(light), 0) ** exponent


@parametrize("webgl", [True, False])
def test_views_ambient_light_and_confidence(open_page, webgl):
    normals, mask = ball()
    light, ambient = light_at(0.8, -0.1), 0.4
    confidence = np.where(np.arange(SIDE) < SIDE // 2, np.float32(1), np.float32(0.2)) * mask
    html = result_page(REPORT, normals, mask, values={"confidence": confidence})
    cosine = np.maximum(normals @ light, 0)
    sky = (1 + normals[..., 2]) / 2
    expected = {
        "view=shaded&specular=0": encode_srgb(cosine),
        "view=normals": np.rint(255 * (normals + 1) / 2) * mask[..., None],
        "view=specular&shininess=32": encode_srgb(0.4 * cosine + 0.7 * glossy(normals, light, 32)),
        f"specular=0&ambient={ambient}": encode_srgb((1 - ambient) * cosine + ambient * sky),
        "confidence=1&specular=0": encode_srgb(cosine),
    }
    pictures = views(
        open_page, html, [f"light=0.8,-0.1&{choice}" for choice in expected], webgl=webgl
    )
    sure = mask & (np.arange(SIDE) < SIDE // 2 - 1)
    for (choice, picture), seen in zip(expected.items(), pictures, strict=True):
        picture = picture if picture.ndim == 3 else picture[..., None]
        assert np.abs(seen - picture)[sure].max() <= 3, choice
        assert not seen[~mask].any()
    share = 0.8 * 0.8  # the strongest overlay, of which the pixels with a confidence of 0.2 get 0.8
    red = encode_srgb(cosine[..., None] * (1 - share) + np.array((0.9, 0.25, 0.1)) * share)
    doubtful = mask & (np.arange(SIDE) > SIDE // 2)
    assert np.abs(pictures[-1] - red)[doubtful].max() <= 3


@parametrize("webgl", [True, False])
def test_zoom_shows_a_part_of_the_same_picture(open_page, webgl):
    """Zoom 2 around (80, 100) shows the map's pixels 16 to 144 and 36 to 164; the sphere is known
    at any place.
    """
    html = result_page(REPORT, *ball())
    [seen] = views(open_page, html, ["light=-0.7,0.5&specular=0&zoom=2,80,100"], webgl=webgl)
    whole, _ = ball(2 * SIDE)
    normals = whole[2 * 36 : 2 * 164, 2 * 16 : 2 * 144]
    expected = encode_srgb(np.maximum(normals @ light_at(-0.7, 0.5), 0)).astype(int)
    smooth = (normals[..., 2] > 0.5) & (normals @ light_at(-0.7, 0.5) > 0.05)
    # Without WebGL, the nearest pixel of the map is shown: at most 1/4 of a pixel away, where
    # shading has this slope.
    assert np.abs(seen - expected[..., None])[smooth].max() <= (3 if webgl else 6)


@parametrize("webgl", [True, False])
def test_a_soft_and_coloured_light(open_page, webgl):
    """Softness 1 is the light of the half of the sky around the light's direction."""
    normals, mask = ball()
    light, colour = light_at(0.6, 0.3), np.array((255, 204, 136))
    html = result_page(REPORT, normals, mask)
    fragments = [f"light=0.6,0.3&specular=0&colour=ffcc88&softness={s}" for s in (0.3, 1)]
    for softness, seen in zip(
        (0.3, 1), views(open_page, html, fragments, webgl=webgl), strict=True
    ):
        lit = np.maximum((normals @ light + softness) / (1 + softness), 0)[..., None]
        tint = decode_transfer(np.float32(colour) / 255, None)
        assert np.abs(seen - encode_srgb(lit * tint) * mask[..., None]).max() <= 3


def test_the_outline_of_an_enlarged_view_is_smooth(open_page):
    """The outline of a disc of 20 pixels, enlarged eight times, stays within a fifth of a pixel of
    a circle; its pixels have corners 0.7 pixels apart.
    """
    normals, mask = ball(32)
    [seen] = views(open_page, result_page(REPORT, normals, mask), ["view=normals"])
    x, y = square_grid(SIDE, (SIDE - 1) / SIDE / 0.94)
    radius = np.hypot(x, y) * 0.94 * 16  # pixels of the map from its centre
    shown = seen.any(axis=2)
    assert radius[shown].max() - radius[~shown].min() < 0.5
    area = np.sqrt(mask.sum() / np.pi)
    assert abs(np.sqrt(shown.sum() / np.pi) / 8 - area) < 0.2


def material_of_ball(mask):
    """Painted on the left, metal on the right, rougher from the top to the bottom; as the pictures
    store it.
    """
    down, right = np.mgrid[:SIDE, :SIDE] / SIDE
    roughness = np.rint(255 * (0.25 + 0.5 * down)) / 255
    reflectance = decode_transfer(np.float32(encode_srgb(np.full((SIDE, SIDE), 0.04))) / 255, None)
    base = decode_transfer(np.full((SIDE, SIDE, 3), np.float32([200, 90, 60])) / 255, None)
    columns = roughness, (right > 0.5).astype(float), reflectance / 0.08, mask.astype(float)
    return np.float32(np.dstack((base, *columns)) * mask[..., None])


@parametrize("webgl", [True, False])
def test_a_material_reflects_as_in_the_estimate(open_page, webgl):
    normals, mask = ball()
    material = material_of_ball(mask)
    html = result_page(
        REPORT, normals, mask, values={"albedo": material[..., :3]}, material=material
    )
    tensor = torch.from_numpy(material[mask])
    base, (roughness, metal, specular) = tensor[:, :3], tensor[:, 3:6, None].unbind(1)
    lights = ((0.5, 0.4), (-0.6, -0.6))
    pictures = views(
        open_page, html, [f"light={x},{y}&exposure=-1" for x, y in lights], webgl=webgl
    )
    for (x, y), seen in zip(lights, pictures, strict=True):
        light = torch.from_numpy(np.float32(light_at(x, y)[None]))
        geometry = Geometry.of(torch.from_numpy(normals[mask]), light, torch.zeros(len(tensor)))
        facets = facet_lobe(geometry, roughness, torch.full_like(roughness, GGX))
        painted = base * diffuse_lobe(geometry, torch.ones(1, 1)) + 0.08 * specular * facets
        expected = np.zeros((SIDE, SIDE, 3))
        expected[mask] = encode_srgb(0.5 * torch.lerp(painted, base * facets, metal).numpy())
        # at the outline, 13 bits of a normal are too few for a sharp highlight
        inner = mask & (normals[..., 2] > 0.2)
        assert np.abs(seen - expected)[inner].max() <= 3
    assert pictures[0][mask].max() == 255  # the highlight of the metal


def test_controls_of_a_page_with_a_material(open_page):
    normals, mask = ball(40)
    material = np.full((40, 40, 7), np.float32(0.25)) * mask[..., None]
    page = open_page(result_page(REPORT, normals, mask, material=material))
    page.evaluate("splinecli.ready")
    assert page.locator("#exposure").input_value() == "2"  # a base colour of 0.25 is shown as white
    assert page.locator("output[for=exposure]").text_content() == "2.0"
    assert page.locator("#gain").count() == 0
    assert page.locator("#shininess").is_hidden()
    page.locator("input[value=specular]").check()
    assert page.locator("#shininess").is_visible()
    roughness, metalness = (
        page.locator(f"img[alt='{name} map']") for name in ("Roughness", "Metalness")
    )
    for picture in (roughness, metalness):
        picture.scroll_into_view_if_needed()
        shot = decode_rgb(picture.screenshot()).astype(int)
        assert np.ptp(shot, axis=2).max() <= 1  # gray
        assert abs(int(np.median(shot[100:-100, 100:-100])) - 64) <= 1


RED = np.full((6, 8, 3), (0, 0, 255), np.uint8)


def test_the_index_shows_small_pictures(open_page, tmp_path):
    """It contains them, also after the results have moved, and leaves out what cannot be read."""
    for name, content in (
        ("a & b", cv2.imencode(".png", np.tile(RED, (100, 100, 1)))[1]),
        ("cut", b"\x89PNG"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "normals.png").write_bytes(bytes(content))
    report = {
        "capture": "a & b",
        "n_lights": 10,
        "n_pixels": 48,
        "angular_error_deg": {"mean": 2.5},
        "expected_under_5": 0.9,
        "warnings": [{"code": "c", "text": "It is <dark>."}],
        "seconds": {"read": 1.0},
        "files": ["normals.png", "report.json"],
    }
    failed = {"capture": "x" * 200, "error": "y" * 200}
    html = index_page(
        [IndexEntry.of(part) for part in (report, {**report, "capture": "cut"}, failed)], tmp_path
    )
    (tmp_path / "a & b/normals.png").unlink()
    page = open_page(html, width=400)
    assert page.locator("img").evaluate("image => [image.naturalWidth, image.naturalHeight]") == [
        256,
        192,
    ]
    assert page.locator("td.words p").all_text_contents() == ["It is <dark>."] * 2
    picture = page.locator("img")
    picture.scroll_into_view_if_needed()
    shot = cv2.imdecode(np.frombuffer(picture.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert (np.abs(shot.astype(int) - RED[0, 0]).max(axis=2) <= 2).mean() > 0.5
    assert page.locator("th").all_inner_texts()[:3] == ["capture", "normals", "lights"]
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0


def test_the_report_fits_a_narrow_screen(open_page):
    png = cv2.imencode(".png", np.repeat(RED, 50, axis=1))[1].tobytes()
    results = tuple(
        Result(m, c, 10, (5.0, 5.5, 6.0), 0.1) for m in ("ls", "iw12") for c in ("x" * 60, "y" * 60)
    )
    page = open_page(
        html_report([Evaluation(Protocol(10, 3), results, ())], [("figure", png)], []), width=400
    )
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    assert (
        page.locator("img").evaluate("image => image.decode().then(() => image.naturalWidth)")
        == 400
    )


def test_pictures_of_earlier_results_that_are_none_of_ours_are_not_shown(tmp_path):
    folder = tmp_path / "other"
    folder.mkdir()
    entry = IndexEntry(IndexRow("other"), (NORMALS["png"],))
    picture = folder / NORMALS["png"]
    write_image(picture, np.full((9, 9, 3), 200, np.uint8))
    assert "data:image/jpeg" in index_page([entry], tmp_path)
    content = bytearray(picture.read_bytes())
    content[16:24] = (20_000).to_bytes(4, "big") * 2  # the size, in a file of few bytes
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    picture.write_bytes(content)
    with mock.patch("cv2.imdecode", side_effect=AssertionError):
        assert "data:image/jpeg" not in index_page([entry], tmp_path)
    tifffile.imwrite(picture, np.zeros((9, 9, 3), np.float32), photometric="rgb")
    assert "data:image/jpeg" not in index_page([entry], tmp_path)
