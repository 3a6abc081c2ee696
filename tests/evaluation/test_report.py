"""The report is valid HTML, loads nothing, shows what it was given, and escapes names."""

import base64
import re
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest

from evaluation.conftest import evaluation_of
from html_page import HtmlPage
from splinecli import __version__
from splinecli.evaluation.document import html_report
from splinecli.records.documents import SkippedCapture

PNG = cv2.imencode(".png", np.zeros((30, 40, 3), np.uint8))[1].tobytes()
WIDE_PNG = cv2.imencode(".png", np.zeros((30, 400, 3), np.uint8))[1].tobytes()


def all_of(page, tag):
    return [attributes for name, attributes in page.tags if name == tag]


def evaluated(methods, captures, *, trials=4, n_lights=10):
    generator = np.random.default_rng(3)
    maes_deg = {
        capture: {
            method: 5 + m + generator.normal(0, 0.1, trials) for m, method in enumerate(methods)
        }
        for capture in captures
    }
    skipped = (SkippedCapture(capture="bear", reason="bear: no images."),)
    return evaluation_of(maes_deg, n_lights, seconds=0.25, skipped=skipped, seed=7, max_pixels=500)


def test_one_evaluation():
    page = HtmlPage(
        html_report(
            [evaluated(["ls", "iw12"], ["ball", "cat"])], [("A plot", PNG)], ["Ball is round."]
        )
    )
    assert page.text["h1"] == ["Photometric stereo: 2 methods on 2 captures"]
    protocol = dict(zip(page.text["dt"], page.text["dd"], strict=True))
    assert protocol == {
        "Methods": "ls, iw12",
        "Captures": "ball, cat",
        "Lights": "10 lights",
        "Trials": "4",
        "Seed": "7",
        "Image values": "lens blur removed, saturated observations restored, unknown light"
        " intensities estimated, as infer does",
        "Draws of lights": "at random from the seed, the same for all methods",
        "Light noise": "none",
        "Pixels scored": "at most 500 of each capture, at random",
        "splinecli": __version__,
    }
    assert {"Notes", "Skipped captures", "Results with 10 lights", "Figures"} <= set(
        page.text["h2"]
    )
    assert {"Ball is round.", ": bear: no images."} <= set(page.text["li"])
    assert any(words.startswith("ls is better than iw12 by") for words in page.text["li"])
    assert page.text["figcaption"] == ["A plot"]
    assert page.text["small"][0].startswith("± 0.")
    best = [attributes for attributes in all_of(page, "td") if attributes.get("class") == "best"]
    assert len(best) == 3  # the first method on both captures and the average


def test_several_evaluations_begin_with_their_averages():
    evaluations = [evaluated(["ls", "iw12"], ["ball"], n_lights=k) for k in (4, 10)]
    evaluations.append(evaluated(["ls", "iw12"], ["ball"], trials=1, n_lights=None))
    page = HtmlPage(html_report(evaluations, [], []))
    headings = page.text["h2"]
    assert headings[-4:] == [
        "Averages over the captures",
        *(f"Results with {k} lights" for k in (4, 10, "all")),
    ]
    assert "Notes" not in headings
    assert "Figures" not in headings
    assert "4 or 1" in page.text["dd"]  # trials
    assert any("(not tested, one trial)" in words for words in page.text["li"])
    assert page.text["li"].count(": bear: no images.") == 1


def test_many_methods_have_a_matrix():
    methods = [f"m{i}" for i in range(5)]
    page = HtmlPage(html_report([evaluated(methods, ["ball"])], [], []))
    assert any(words.startswith("Average MAE of the row’s method") for words in page.text["span"])
    assert not any("is better than" in words for words in page.text["li"])
    # Every pair twice in the matrix, and on one capture and the average in the list.
    assert sum("−1." in words or "−0.9" in words for words in page.text["td"]) >= 4


def test_it_stands_alone():
    html = html_report([evaluated(["ls", "iw12"], ["ball"])], [("A", PNG), ("B", WIDE_PNG)], [])
    page = HtmlPage(html)
    assert not all_of(page, "script") + all_of(page, "link")
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|url\(|@import|https?:""", html)
    images = all_of(page, "img")
    for image, png in zip(images, (PNG, WIDE_PNG), strict=True):
        source = str(image["src"]).removeprefix("data:image/png;base64,")
        assert base64.b64decode(source, validate=True) == png
    shown = [(i["alt"], i["width"], i["height"], i.get("class")) for i in images]
    assert shown == [("A", "40", "30", None), ("B", "400", "30", "wide")]


@pytest.mark.parametrize("name", ["<b>&", '"><script>alert(1)</script>', "{{ 7 * 7 }}", "a'b"])
def test_names_are_text(name):
    evaluation = replace(
        evaluated([name, "ls"], [name + "1", "ball"]),
        skipped=(SkippedCapture(capture=name, reason=name),),
    )
    page = HtmlPage(html_report([evaluation], [(name, PNG)], [name]))
    assert all(name in page.text[tag] for tag in ("th", "strong", "figcaption"))
    assert all_of(page, "img")[0]["alt"] == name
    assert not all_of(page, "b") + all_of(page, "script")


def test_it_can_be_read_by_all():
    html = html_report([evaluated(["ls", "iw12"], ["ball"])], [("A", PNG)], [])
    page = HtmlPage(html)
    assert all_of(page, "html") == [{"lang": "en"}]
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in all_of(
        page, "meta"
    )
    assert html.startswith("<!DOCTYPE html>")
    assert "prefers-color-scheme: dark" in html
    assert "@media print" in html
    assert all(th.get("scope") in ("row", "col") for th in all_of(page, "th"))
    levels = [int(tag[1]) for tag, _ in page.tags if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))
