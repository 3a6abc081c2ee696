"""One headless Chromium for all tests of a session, driven by Playwright; tests skip where there is
none.
"""

import shutil
import warnings

import pytest

from scenes import put

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
"""Names of the system's Chromium on the path."""

PATIENCE_MS = 180_000
"""Limit for one step of the browser: far more than a busy machine needs, so that only a hang fails.
"""

FLAGS = (
    "--disable-dev-shm-usage",
    "--force-color-profile=srgb",
    # WebGL on the processor, the same on every machine.
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)

WITHOUT_WEBGL = """
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : getContext.call(this, kind, ...rest);
};
"""


def find_chromium():
    """Return the path of the system's Chromium, or None."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


@pytest.fixture(scope="session")
def browser():
    """A running browser."""
    program = find_chromium()
    if program is None:
        pytest.skip(f"no Chromium: none of {', '.join(PROGRAMS)} is on the path")
    with warnings.catch_warnings():
        # The tests turn warnings into errors; those of Playwright's own code are not ours.
        warnings.simplefilter("ignore")
        api = pytest.importorskip(
            "playwright.sync_api", reason="no Playwright: it is in the extra 'test'"
        )
        driver = api.sync_playwright().start()
    try:
        running = driver.chromium.launch(
            executable_path=program,
            args=list(FLAGS),
            chromium_sandbox=False,  # Chromium refuses to run as root with it; the pages are ours
            timeout=PATIENCE_MS,
        )
    except api.Error as error:
        # Some systems install a program of this name that only asks for a download.
        driver.stop()
        pytest.skip(f"{program} does not start: {error.message.splitlines()[0]}")
    yield running
    running.close()
    driver.stop()


@pytest.fixture
def open_page(browser, tmp_path):
    """open_page(html, fragment="", *, width=800, height=600, webgl=True) opens HTML from a file, as
    a reader does; errors of the page's script fail the test.
    """
    opened, problems = [], []

    def open_html(html, fragment="", *, width=800, height=600, webgl=True):
        path = tmp_path / f"page{len(opened)}.html"
        put(path, html)
        context = browser.new_context(viewport={"width": width, "height": height})
        opened.append(context)
        context.set_default_timeout(PATIENCE_MS)
        if not webgl:
            context.add_init_script(WITHOUT_WEBGL)
        page = context.new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda asked: check_request(asked.url))
        page.goto(f"{path.as_uri()}#{fragment}")
        return page

    def check_request(url):
        if not url.startswith(("file:", "data:")):
            problems.append(f"the page asks for {url}")

    yield open_html
    for context in opened:
        context.close()
    assert not problems
