// What the reader moves: the light, the region that is shown, the settings, the ruler.
const LARGEST_RADIUS = 0.995;  // of the light on the disc, so that it stays a little above the horizon
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const LIGHT_STEP = 0.05, PAN_STEP = 0.1, ZOOM_STEP = 1.25;
const WHEEL_TO_ZOOM = 1 / 300;  // octaves a pixel of the wheel
const LARGEST_PIXEL = 32;  // of the map, on the screen
const STILL = 4;  // pixels that a click may move
const WRITE_MS = 300;  // the address follows when nothing has moved for this time
const SLOW_MS = 30, REST_MS = 400;  // drawings that take longer are hasty until nothing has moved for this time

const find = (id) => document.getElementById(id);
const PICTURES = { high: "high", low: "low", albedo: MATERIAL ? "base_colour" : "albedo", confidence: "confidence", gloss: "gloss" };
const findMaps = (prefix) => Object.fromEntries(Object.entries(PICTURES).map(([name, id]) => [name, find(prefix + id)]));
const SETTINGS = ["exposure", "gain", "shininess", "softness", "tint", "ambient", "coloured", "doubt"];
const [exposure, gain, shininess, softness, tint, ambient, coloured, doubt] = SETTINGS.map(find);
const [hold, measure, bar] = ["hold", "measure", "bar"].map(find);
const views = [...document.querySelectorAll("input[name=view]")], ruler = find("ruler");
const pointers = new Map();  // the fingers or the button that are down: their last places on the screen
let canvas = find("view"), maps = findMaps("first-"), drawing = null, awaited = false, slow = true, rest = 0, writing = 0, wholeDrawn;
let light = [0, 0, 1], isWhole = false;  // whether the maps are those in full resolution
let clicked = null, ends = null;  // where the button went down, while it did not move; the ends of the ruler on the map
const wholeDrawing = new Promise((resolve) => { wholeDrawn = resolve; });
const { width, height } = canvas;
const shown = { zoom: 1, x: width / 2, y: height / 2 };  // the middle of the region, in pixels of the map

/** Return left, top, width and height of the region that is shown, in pixels of the map. */
function region() {
  const [across, down] = [width / shown.zoom, height / shown.zoom];
  return [shown.x - across / 2, shown.y - down / 2, across, down];
}

const decodeLevel = (s) => s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4;

function redraw() {
  if (!drawing || awaited) return;
  awaited = true;
  requestAnimationFrame(() => {
    awaited = false;
    drawNow(slow);
  });
}

function drawNow(hasty) {
  const surface = {
    view: views.find((input) => input.checked).value, exposure: 2 ** (exposure?.value ?? 0), gain: +(gain?.value ?? 0), shininess: 2 ** shininess.value,
    softness: +softness.value, tint: [1, 3, 5].map((at) => decodeLevel(parseInt(tint.value.slice(at, at + 2), 16) / 255)),
    ambient: +ambient.value, coloured: +Boolean(coloured?.checked), doubt: +Boolean(doubt?.checked),
  };
  const took = drawing.draw(region(), surface, hasty);
  clearTimeout(rest);
  if (hasty) rest = setTimeout(() => drawNow(false), REST_MS);
  else {
    slow = took > SLOW_MS;
    if (isWhole) wholeDrawn();
  }
  showRuler();
  showScale();
  clearTimeout(writing);
  writing = setTimeout(writeAddress, WRITE_MS);
  canvas.removeAttribute("aria-busy");
  find("loading").hidden = isWhole;
  find("loading").textContent = "Loading the full resolution\u00a0\u2026";
}

/** Move the light to (x, y) on the disc: x right, y up, the camera at the centre. Points outside move to the rim. */
function setLight(x, y) {
  const radius = Math.hypot(x, y);
  if (!Number.isFinite(radius)) return;
  const share = Math.min(1, LARGEST_RADIUS / (radius || 1));
  light = [x * share, y * share, Math.sqrt(1 - Math.min(radius, LARGEST_RADIUS) ** 2)];
  find("dot").setAttribute("cx", light[0]);
  find("dot").setAttribute("cy", -light[1]);
  find("direction").textContent = light.map((value) => value.toFixed(2).replace("-", "\u2212")).join(", ");
  redraw();
}

/** Show a region of the map around (x, y), which is moved into the map. Return whether anything changed. */
function show(zoom, x, y) {
  if (![zoom, x, y].every(Number.isFinite)) return false;
  const before = region().join();
  shown.zoom = Math.min(Math.max(zoom, 1), Math.max(1, LARGEST_PIXEL * width / canvas.clientWidth));
  const [, , across, down] = region();
  shown.x = Math.min(Math.max(x, across / 2), width - across / 2);
  shown.y = Math.min(Math.max(y, down / 2), height - down / 2);
  find("zoom").textContent = `${shown.zoom.toFixed(1)}\u00d7`;
  redraw();
  return region().join() !== before;
}

/** Return the place of a point of the screen on the map. */
function onMap([x, y]) {
  const box = canvas.getBoundingClientRect(), [left, top, across, down] = region();
  return [left + (x - box.left) / box.width * across, top + (y - box.top) / box.height * down];
}

/** Zoom by a factor; what is under the point `from` of the screen comes to the point `to`. */
function zoomAt(factor, from, to = from) {
  const box = canvas.getBoundingClientRect(), [x, y] = onMap(from);
  const zoom = Math.min(Math.max(shown.zoom * factor, 1), Math.max(1, LARGEST_PIXEL * width / canvas.clientWidth));
  const shares = [(to[0] - box.left) / box.width - 0.5, (to[1] - box.top) / box.height - 0.5];
  return show(zoom, x - shares[0] * width / zoom, y - shares[1] * height / zoom);
}

function showRuler() {
  ruler.hidden = !ends;
  if (!ends) return;
  const [left, top, across, down] = region(), [[x0, y0], [x1, y1]] = ends, lines = ruler.querySelectorAll("line");
  const place = (x, y) => [100 * (x - left) / across, 100 * (y - top) / down];
  [["x1", "y1"], ["x2", "y2"]].forEach((names, end) => {
    place(...ends[end]).forEach((share, axis) => lines.forEach((line) => line.setAttribute(names[axis], `${share}%`)));
  });
  const length = Math.hypot(x1 - x0, y1 - y0) * canvas.dataset.unitsPerPixel;
  const label = find("length");
  label.textContent = `${+length.toPrecision(4)} ${canvas.dataset.unit}`;
  [label.style.left, label.style.top] = place((x0 + x1) / 2, (y0 + y1) / 2).map((share) => `${Math.min(Math.max(share, 5), 85)}%`);
}

/** Show a bar of a round length, at most a quarter of the view, if the size of a pixel is known. */
function showScale() {
  if (!bar) return;
  const across = region()[2] * canvas.dataset.unitsPerPixel, power = 10 ** Math.floor(Math.log10(across / 4));
  const length = [5, 2, 1].find((digit) => digit * power <= across / 4) * power;
  bar.style.width = `${100 * length / across}%`;
  bar.textContent = `${+length.toPrecision(1)} ${canvas.dataset.unit}`;
}

function showSettings() {
  const texts = [[exposure, 1], [gain, 2], [softness, 2], [ambient, 2]].filter(([input]) => input)
    .map(([input, digits]) => [input, (+input.value).toFixed(digits)]);
  for (const [input, text] of [...texts, [shininess, Math.round(2 ** shininess.value)]])
    document.querySelector(`output[for=${input.id}]`).textContent = text;
  const view = views.find((input) => input.checked).value, row = (input) => input.parentElement;
  if (gain) row(gain).hidden = view !== "shaded";  // specular enhancement has fixed shares
  row(shininess).hidden = view === "normals" || (MATERIAL && view === "shaded");
  for (const input of [exposure, softness, tint, ambient, coloured]) if (input) row(input).hidden = view === "normals";
  redraw();
}

/** Write what differs from the page as it opens into the address, which then opens the same view. */
function writeAddress() {
  const wanted = { light: light.slice(0, 2).map((value) => value.toFixed(3)).join() }, changed = (input) => input && input.value !== input.defaultValue;
  if (wanted.light === canvas.dataset.light.split(",").map((value) => (+value).toFixed(3)).join()) delete wanted.light;
  if (!views[0].checked) wanted.view = views.find((input) => input.checked).value;
  for (const [name, input] of Object.entries({ exposure, specular: gain, softness, ambient })) if (changed(input)) wanted[name] = input.value;
  if (changed(shininess)) wanted.shininess = (2 ** shininess.value).toFixed(1);
  if (changed(tint)) wanted.colour = tint.value.slice(1);
  if (coloured && !coloured.checked) wanted.albedo = 0;
  if (doubt?.checked) wanted.confidence = 1;
  if (shown.zoom > 1) wanted.zoom = [shown.zoom.toFixed(2), shown.x.toFixed(1), shown.y.toFixed(1)].join();
  if (ends) wanted.ruler = ends.flat().map((value) => value.toFixed(1)).join();
  const fragment = Object.entries(wanted).map((pair) => pair.join("=")).join("&");
  if (fragment !== location.hash.slice(1)) history.replaceState(null, "", `#${fragment}`);
}

/**
 * Read the address: light=x,y view=shaded|specular|normals specular=gain exposure=stops shininess=exponent softness=share
 * colour=rrggbb ambient=share albedo=0 confidence=1 zoom=factor,x,y ruler=x,y,x,y, the last two in pixels of the map. An
 * example: page.html#light=-0.7,0.5&specular=0
 */
function readAddress() {
  const wanted = new URLSearchParams(location.hash.slice(1)), numbers = (name) => wanted.get(name).split(",").map(Number);
  for (const input of [...views, exposure, gain, softness, ambient, shininess, tint, coloured, doubt].filter(Boolean)) {
    input.checked = input.defaultChecked;  // what the address leaves out is as on a new page
    input.value = input.defaultValue;
  }
  show(1, 0, 0);
  ends = null;
  for (const input of views) input.checked = input.value === wanted.get("view") || (input.checked && !wanted.has("view"));
  if (!views.some((input) => input.checked)) views[0].checked = true;
  for (const [name, input] of Object.entries({ exposure, specular: gain, softness, ambient }))
    if (wanted.has(name) && input) input.value = wanted.get(name);
  if (wanted.has("shininess")) shininess.value = Math.log2(wanted.get("shininess"));
  if (wanted.has("colour")) tint.value = `#${wanted.get("colour")}`;
  if (wanted.has("albedo") && coloured) coloured.checked = wanted.get("albedo") !== "0";
  if (wanted.has("confidence") && doubt) doubt.checked = wanted.get("confidence") !== "0";
  if (wanted.has("zoom")) show(...numbers("zoom"));
  if (wanted.has("ruler")) {
    const [x0, y0, x1, y1] = numbers("ruler");
    if (Number.isFinite(x0 + y0 + x1 + y1)) ends = [[x0, y0], [x1, y1]];
  }
  setLight(...(wanted.get("light") ?? canvas.dataset.light).split(",").map(Number));
  showSettings();
}

function follow([x, y]) {
  const box = canvas.getBoundingClientRect(), radius = Math.min(box.width, box.height) / 2;
  setLight((x - box.left - box.width / 2) / radius, (box.top + box.height / 2 - y) / radius);
}

/** Return the middle of the fingers, and their mean distance from it. */
function spread() {
  const places = [...pointers.values()], middle = [0, 1].map((axis) => places.reduce((sum, at) => sum + at[axis], 0) / places.length);
  return { middle, distance: places.reduce((sum, at) => sum + Math.hypot(at[0] - middle[0], at[1] - middle[1]), 0) / places.length };
}

function press(event) {
  if (event.button !== 0) return;
  const at = [event.clientX, event.clientY];
  pointers.set(event.pointerId, at);
  canvas.setPointerCapture(event.pointerId);
  clicked = pointers.size === 1 ? at : null;
  if (pointers.size > 1) return;
  if (measure.checked) ends = [onMap(at), onMap(at)];
  else if (event.pointerType !== "mouse") follow(at);
}

function move(event) {
  const at = [event.clientX, event.clientY], pressed = pointers.get(event.pointerId), mouse = event.pointerType === "mouse";
  if (!pressed) {
    if (mouse && !hold.checked && !measure.checked) follow(at);
    return;
  }
  if (clicked && Math.hypot(at[0] - clicked[0], at[1] - clicked[1]) > STILL) clicked = null;
  const before = spread();
  pointers.set(event.pointerId, at);
  if (pointers.size > 1) {
    const after = spread();
    zoomAt(after.distance / Math.max(before.distance, 1), before.middle, after.middle);
  } else if (measure.checked && ends) {
    ends[1] = onMap(at);
    redraw();
  } else if (!mouse) follow(at);
  else if (!clicked) zoomAt(1, pressed, at);
}

function release(event) {
  if (!pointers.delete(event.pointerId) || event.type !== "pointerup") return;
  if (!clicked || event.pointerType !== "mouse" || measure.checked) return;
  follow(clicked);
  hold.checked = !hold.checked;
}

function turnWheel(event) {
  const pixels = event.deltaY * (event.deltaMode ? 30 : 1);
  // At the whole picture, the wheel scrolls the page.
  if (zoomAt(2 ** (-pixels * WHEEL_TO_ZOOM * (event.ctrlKey ? 5 : 1)), [event.clientX, event.clientY])) event.preventDefault();
}

function pressKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey) return;
  const step = KEYS[event.key], [, , across, down] = region();
  if (step && event.shiftKey) show(shown.zoom, shown.x + PAN_STEP * across * step[0], shown.y - PAN_STEP * down * step[1]);
  else if (step) setLight(light[0] + LIGHT_STEP * step[0], light[1] + LIGHT_STEP * step[1]);
  else if (event.key === "+" || event.key === "=") show(shown.zoom * ZOOM_STEP, shown.x, shown.y);
  else if (event.key === "-") show(shown.zoom / ZOOM_STEP, shown.x, shown.y);
  else if (event.key === "0") show(1, 0, 0);
  else return;
  event.preventDefault();
}

function drawInSoftware() {
  // A canvas that had a WebGL context gives no other context, so replace it.
  const fresh = canvas.cloneNode();
  canvas.replaceWith(fresh);
  canvas = fresh;
  drawing = inSoftware();
  find("notice").textContent = "This browser has no WebGL for this page. The surface is drawn without it, more coarsely and more slowly.";
  find("notice").hidden = false;
}

function start() {
  drawing = withWebGL();
  if (!drawing) drawInSoftware();
  const surface = canvas.parentElement;
  surface.addEventListener("pointerdown", press);
  surface.addEventListener("pointermove", move);
  for (const type of ["pointerup", "pointercancel"]) surface.addEventListener(type, release);
  surface.addEventListener("wheel", turnWheel, { passive: false });
  surface.addEventListener("keydown", pressKey);
  for (const input of [...SETTINGS.map(find), ...views]) input?.addEventListener("input", showSettings);
  measure.addEventListener("input", () => {
    ends = null;
    redraw();
  });
  find("whole").addEventListener("click", () => show(1, 0, 0));
  addEventListener("hashchange", readAddress);
  new ResizeObserver(redraw).observe(surface);
  readAddress();
}

/** Wait for the pictures of the maps; decoding them is left to what draws them. */
function loaded(images) {
  return Promise.all(Object.values(images).filter(Boolean).map((image) => new Promise((resolve, reject) => {
    if (image.complete) (image.naturalWidth ? resolve : reject)();
    else Object.assign(image, { onload: resolve, onerror: reject });
  })));
}

async function open() {
  // A page of large maps has small ones before them, which are drawn while the rest is read.
  if (maps.high) {
    await loaded(maps);
    start();
  }
  if (document.readyState === "loading") await new Promise((resolve) => addEventListener("DOMContentLoaded", resolve));
  const whole = findMaps("");
  for (const copy of document.querySelectorAll("img[data-of]")) copy.setAttribute("src", find(copy.dataset.of).src);
  await loaded(whole);
  [maps, isWhole] = [whole, true];
  if (!drawing) start();
  else if (!drawing.load()) drawInSoftware();
  canvas.dataset.renderer = find("notice").hidden ? "webgl" : "software";
  redraw();
  await wholeDrawing;
}

/** Resolved once the surface has been drawn in full resolution. */
const ready = open();
ready.catch(() => {
  find("loading").hidden = false;
  find("loading").textContent = "The maps of this page cannot be shown: the browser could not decode them.";
});
window.splinecli = { setLight, show, ready, get light() { return light; }, get region() { return region(); } };
