// Drawing with WebGL. Two pictures store the normals: the normal map has the upper 8 bits of each component, the lower
// bits of a hidden picture the rest. A component is (LOW_SCALE * high + low) / LARGEST_CODE * 2 - 1. The upper bits of the
// hidden picture, 3 of red, 3 of green and 2 of blue, are a blurred mask, whose level of 1/2 is a smooth outline.
const LOW_SCALE = {{ low_scale }}, LARGEST_CODE = {{ largest_code }};
const MATERIAL = {{ "true" if maps.gloss is defined else "false" }};  // whether the page has the maps of a material
const VIEWS = ["shaded", "specular", "normals"];
const MOST_SAMPLES = 8;  // along a side of a pixel of the screen
const HASTY_SIDE = 400;  // pixels of the longer side of a hasty drawing
const DIFFUSE_SHARE = 0.4, SPECULAR_SHARE = 0.7;  // of specular enhancement
const SLOPE = {{ edge_slope }}, ENLARGED = 0.75;  // of the blurred mask, per pixel; pixels of the map for one of an enlarged view
const LEAST_Z = 0.05;  // of a normal in the BRDF
const DOUBTFUL = [0.9, 0.25, 0.1], STRONGEST_DOUBT = 0.8;  // linear RGB of the overlay; its share where confidence is 0
const VERTEX = `
attribute vec2 corner;
uniform vec4 region;
varying vec2 place;  // in pixels of the map, from its upper left corner
void main() {
  place = region.xy + (vec2(corner.x, -corner.y) + 1.0) / 2.0 * region.zw;
  gl_Position = vec4(corner, 0.0, 1.0);
}`;
const FRAGMENT = `
precision highp float;
uniform sampler2D high, low, albedo, confidence, gloss;
uniform vec2 size, pixel;  // of the map, and of a pixel of the screen, in pixels of the map
uniform vec3 light, tint;  // the direction and the linear colour of the light
uniform float softness;  // of the light: 0 is a point, 1 the half of the sky around its direction
uniform float gain, shininess, ambient, coloured, doubt, exposure;
uniform int kind, samples;  // samples along a side of a pixel of the screen, 0 to interpolate
varying vec2 place;

vec3 decode(vec3 s) { return mix(s / 12.92, pow((s + 0.055) / 1.055, vec3(2.4)), step(0.04045, s)); }
vec3 encode(vec3 v) { return mix(12.92 * v, 1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, v)); }

// Add a pixel of the map with a weight: its normal, its albedo and confidence, its reflectance, roughness and metalness, and
// the blurred mask.
void gather(vec2 texel, float weight, inout vec4 normal, inout vec4 base, inout vec3 facets, inout float blurred) {
  vec2 at = (clamp(texel, vec2(0.0), size - 1.0) + 0.5) / size;
  vec3 upper = floor(texture2D(high, at).rgb * 255.0 + 0.5), lower = floor(texture2D(low, at).rgb * 255.0 + 0.5);
  vec3 bits = floor(lower / float(${LOW_SCALE}));
  lower -= float(${LOW_SCALE}) * bits;
  blurred += weight * dot(bits, vec3(32.0, 4.0, 1.0)) / 255.0;
  if (upper == vec3(0.0)) return;  // outside the mask
  normal += weight * vec4((upper * float(${LOW_SCALE}) + lower) / float(${LARGEST_CODE}) * 2.0 - 1.0, 1.0);
  base += weight * vec4(decode(texture2D(albedo, at).rgb), texture2D(confidence, at).r);
  vec3 stored = texture2D(gloss, at).rgb;
  facets += weight * vec3(decode(stored).r, stored.gb);
}

float lit_from(float cosine) { return max((cosine + softness) / (1.0 + softness), 0.0); }
float smith(float cosine, float square) { return 1.0 / (cosine + sqrt(square + (1.0 - square) * cosine * cosine)); }

// The BRDF of the estimate, GGX facets above diffuse light, times pi n.l (synthesis/principled.py).
vec3 reflected(vec3 n, vec3 base, vec3 facets) {
  float lit = lit_from(dot(n, light)), z = max(n.z, float(${LEAST_Z})), half2 = (1.0 + light.z) / 2.0;
  float peak = clamp((dot(n, light) + z) / (2.0 * sqrt(half2)), 0.0, 1.0), width = min(facets.g * facets.g + softness / 2.0, 1.0);
  float square = max(width * width, 1e-4);
  float spread = peak * peak * (square - 1.0) + 1.0, grazing = (half2 - 1.0) / 2.0;
  float lobe = square / (spread * spread) * smith(lit, square) * smith(z, square);
  float diffuse = (1.0 + grazing * pow(1.0 - lit, 5.0)) * (1.0 + grazing * pow(1.0 - z, 5.0));
  return lit * mix(base * diffuse + facets.r * lobe, base * lobe, facets.b);
}

vec3 shade(vec3 n, vec3 base, vec3 facets) {
  if (kind == 2) return decode((n + 1.0) / 2.0);
  float cosine = lit_from(dot(n, light)), sharp = shininess / (1.0 + softness * shininess / 8.0);
  float peak = pow(max(dot(n, normalize(light + vec3(0.0, 0.0, 1.0))), 0.0), sharp);  // Blinn-Phong
  vec3 direct = kind == 1 ? float(${DIFFUSE_SHARE}) * base * cosine + float(${SPECULAR_SHARE}) * peak
    : ${MATERIAL ? "reflected(n, base, facets)" : "mix(base, vec3((sharp + 8.0) / 8.0 * peak), gain) * cosine"};
  return exposure * mix(direct * tint, base * (1.0 + n.z) / 2.0, ambient);  // the light of an even sky around the camera
}

vec3 seen(vec4 normal, vec4 base, vec3 facets) {
  vec3 colour = shade(normalize(normal.xyz), mix(vec3(1.0), base.rgb / normal.w, coloured), facets / normal.w);
  colour = mix(colour, vec3(${DOUBTFUL}), doubt * float(${STRONGEST_DOUBT}) * (1.0 - base.a / normal.w));
  return clamp(colour, 0.0, 1.0);
}

void main() {
  vec3 sum = vec3(0.0);
  float blurred = 0.0;
  if (samples == 0) {
    // The shader interpolates normals itself: the sampler would interpolate the upper and the lower bits separately.
    vec2 first = floor(place - 0.5), part = place - 0.5 - first;
    vec4 normal = vec4(0.0), base = vec4(0.0);
    vec3 facets = vec3(0.0);
    gather(first, (1.0 - part.x) * (1.0 - part.y), normal, base, facets, blurred);
    gather(first + vec2(1.0, 0.0), part.x * (1.0 - part.y), normal, base, facets, blurred);
    gather(first + vec2(0.0, 1.0), (1.0 - part.x) * part.y, normal, base, facets, blurred);
    gather(first + vec2(1.0, 1.0), part.x * part.y, normal, base, facets, blurred);
    float covered = clamp((blurred - 0.5) / (float(${SLOPE}) * pixel.x) + 0.5, 0.0, 1.0);
    if (normal.w > 0.001) sum = seen(normal, base, facets) * (pixel.x < float(${ENLARGED}) ? covered : normal.w);
  } else {
    // A smaller view is a reduced picture, not one of reduced normals.
    for (int i = 0; i < ${MOST_SAMPLES ** 2}; i++) {
      if (i >= samples * samples) break;
      vec2 at = (vec2(mod(float(i), float(samples)), floor(float(i) / float(samples))) + 0.5) / float(samples) - 0.5;
      vec4 normal = vec4(0.0), base = vec4(0.0);
      vec3 facets = vec3(0.0);
      gather(floor(place + at * pixel), 1.0, normal, base, facets, blurred);
      if (normal.w > 0.0) sum += seen(normal, base, facets);
    }
    sum /= float(samples * samples);
  }
  gl_FragColor = vec4(encode(sum), 1.0);
}`;

/** Return a function that draws with WebGL, or null if the browser has none, or none for maps of this size. */
function withWebGL() {
  const gl = canvas.getContext("webgl", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true });
  if (!gl) return null;
  let place;
  function prepare() {
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "corner");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false;
    gl.useProgram(program);
    place = (name) => gl.getUniformLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    Object.entries(maps).forEach(([name, image], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      for (const [setting, value] of [
        [gl.TEXTURE_MIN_FILTER, gl.NEAREST], [gl.TEXTURE_MAG_FILTER, gl.NEAREST],
        [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
      ]) gl.texParameteri(gl.TEXTURE_2D, setting, value);
      if (image) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
      else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array(3).fill(255));
      gl.uniform1i(place(name), unit);
    });
    gl.uniform2f(place("size"), maps.high.naturalWidth, maps.high.naturalHeight);
    return gl.getError() === gl.NO_ERROR;
  }
  if (!prepare()) return null;
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => prepare() && redraw());
  const last = new Uint8Array(4);
  /** Draw a region of the map and return the milliseconds that this took. `hasty` is coarser, and does not wait. */
  function draw([left, top, across, down], surface, hasty) {
    const box = [canvas.clientWidth, canvas.clientHeight], fine = devicePixelRatio;
    const scale = hasty ? Math.min(fine, HASTY_SIDE / Math.max(...box)) : fine;
    const drawn = box.map((side) => Math.max(1, Math.round(side * scale)));
    if (canvas.width !== drawn[0] || canvas.height !== drawn[1]) [canvas.width, canvas.height] = drawn;
    const began = performance.now(), { naturalWidth: columns, naturalHeight: rows } = maps.high;
    const part = [left / width * columns, top / height * rows, across / width * columns, down / height * rows];
    const pixel = [part[2] / drawn[0], part[3] / drawn[1]];
    gl.viewport(0, 0, ...drawn);
    gl.uniform4f(place("region"), ...part);
    gl.uniform2f(place("pixel"), ...pixel);
    const samples = pixel[0] < 1.01 ? 0 : Math.min(MOST_SAMPLES, Math.ceil(pixel[0]));
    gl.uniform1i(place("samples"), hasty ? 1 : samples);
    gl.uniform3f(place("light"), ...light);
    gl.uniform3f(place("tint"), ...surface.tint);
    gl.uniform1i(place("kind"), VIEWS.indexOf(surface.view));
    for (const name of ["softness", "gain", "shininess", "ambient", "coloured", "doubt", "exposure"]) gl.uniform1f(place(name), surface[name]);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (!hasty) gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, last);  // waits for the drawing
    return performance.now() - began;
  }
  return { draw, load: prepare };
}
