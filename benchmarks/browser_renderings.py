"""Compare renderings of mesh.glb in three.js with photographs: docs/materials.md, In a browser.

    npm install three
    python benchmarks/browser_renderings.py node_modules/three CAPTURE...

The material of each capture is estimated from the first draw of ten lights. The mesh is rendered
in a headless Chromium under four of the other lights, or of the ten if there are no others, and
reduced to the size of the photographs. Each rendering has one brightness, fitted to its photograph.
"""

import argparse
import base64
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from playwright.sync_api import Page, Route, sync_playwright

from splinecli.capture import open_capture
from splinecli.evaluation.figures import likeness
from splinecli.maths import Float32Array
from splinecli.maths.transfer import SRGB, decode_transfer
from splinecli.recipe import RecipeOptions, prepare_capture

COMPARED = 4  # lights
ENLARGED = 4  # the rendering, in each direction
SITE = "http://localhost"
PAGE = """
<script type="importmap">
{"imports": {"three": "/build/three.module.js", "three/addons/": "/examples/jsm/"}}
</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.shadowMap.enabled = true;
window.ready = new GLTFLoader().loadAsync("/mesh.glb").then(({ scene }) => {
  const world = new THREE.Scene(), light = new THREE.DirectionalLight(0xffffff, 2);
  const box = new THREE.Box3().setFromObject(scene);
  const { center, radius } = box.getBoundingSphere(new THREE.Sphere());
  scene.traverse((part) => { part.castShadow = part.receiveShadow = true; });
  const seen = light.shadow.camera;
  [seen.right, seen.top, seen.near, seen.far] = [radius, radius, radius, 3 * radius];
  [seen.left, seen.bottom] = [-radius, -radius];
  light.castShadow = true;
  light.shadow.mapSize.set(2048, 2048);
  light.shadow.normalBias = 5e-4;  // half a pixel
  light.target.position.copy(center);
  world.add(scene, light, light.target);
  window.draw = (width, height, direction) => {
    const [x, y] = [width / 2000, height / 2000];  // half the size in metres; pixels of 1 mm
    const camera = new THREE.OrthographicCamera(-x, x, y, -y, 0, 4 * radius);
    camera.position.z = center.z + 2 * radius;
    light.position.copy(center).addScaledVector(new THREE.Vector3(...direction), 2 * radius);
    renderer.setSize(width * ENLARGED, height * ENLARGED, false);
    renderer.render(world, camera);
    return renderer.domElement.toDataURL();
  };
});
</script>
""".replace("ENLARGED", str(ENLARGED))


def compare(page: Page, path: Path, output: Path) -> str:
    """Return a row of the table. The page has loaded the mesh in the folder."""
    report = json.loads((output / "report.json").read_text())
    capture = prepare_capture(open_capture(path), options=RecipeOptions(as_stored=True))
    every, used = range(len(capture.light_directions)), report["light_indices"]
    others = [light for light in every if light not in used]
    candidates = others or used
    chosen = [candidates[n] for n in np.linspace(0, len(candidates) - 1, COMPARED).astype(int)]
    height, width = capture.mask.shape
    found = []
    for light in chosen:
        direction = [*map(float, capture.light_directions[light])]
        url = page.evaluate(f"draw({width}, {height}, {direction})")
        shown = decode_picture(url, (width, height))[capture.mask]
        photograph = capture.observations[:, light]
        shown *= (shown * photograph).sum() / np.square(shown).sum()
        correlation = float(np.corrcoef(shown, photograph)[0, 1])
        found.append((correlation, likeness(photograph[:, None], shown[:, None]).psnr_db))
    (low, least), (high, most) = np.min(found, axis=0), np.max(found, axis=0)
    lights = "not used" if others else "used for the estimate"
    return f"| {path.name} | {lights} | {low:.2f} to {high:.2f} | {least:.1f} to {most:.1f} |"


def decode_picture(url: str, size: tuple[int, int]) -> Float32Array:
    """Return the linear gray picture (H, W) of a data URL, reduced to this width and height."""
    data = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    colours = decode_transfer(cv2.imdecode(data, cv2.IMREAD_COLOR) / np.float32(255), SRGB)
    return cv2.resize(colours.mean(axis=2), size, interpolation=cv2.INTER_AREA)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("three", type=Path)
    parser.add_argument("captures", type=Path, nargs="+")
    given = parser.parse_args(arguments)
    with TemporaryDirectory() as folder, sync_playwright() as playwright:

        def serve(route: Route) -> None:
            asked = route.request.url.removeprefix(SITE)
            if asked == "/":
                route.fulfill(body=PAGE, content_type="text/html")
            else:
                root = output if asked == "/mesh.glb" else given.three
                route.fulfill(path=root / asked[1:])

        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"),  # or else Playwright's own
            args=["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
            chromium_sandbox=False,
        )
        for path in given.captures:
            output = Path(folder, path.name)
            options = "--n-lights", "10", "--maps", "material", "--surface", "-o", folder
            subprocess.run([sys.executable, "-m", "splinecli", "infer", *options, path], check=True)
            page = browser.new_page()
            page.route("**/*", serve)
            page.goto(SITE)
            page.evaluate("ready")
            print(compare(page, path, output), flush=True)
            page.close()


if __name__ == "__main__":
    main()
