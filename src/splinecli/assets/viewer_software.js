// The same drawing on the processor, for browsers without WebGL: coarser, without interpolation.
const SOFTWARE_SIDE = 400;  // pixels

function inSoftware() {
  const context = canvas.getContext("2d", { alpha: false });
  let high, low, albedo, confidence, gloss, across, down;  // the maps and their size
  function load() {
    [across, down] = [maps.high.naturalWidth, maps.high.naturalHeight];
    [high, low, albedo, confidence, gloss] = Object.values(maps).map((image) => {
      if (!image) return null;
      const whole = Object.assign(document.createElement("canvas"), { width: across, height: down }).getContext("2d");
      whole.drawImage(image, 0, 0);
      return whole.getImageData(0, 0, across, down).data;
    });
    return true;
  }
  const decode = (s) => s <= 0.04045 ? s / 12.92 : ((s + 0.055) / 1.055) ** 2.4;
  const encode = (v) => v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055;
  const linear = Float32Array.from({ length: 256 }, (_, level) => decode(level / 255));
  const stored = Uint8Array.from({ length: 4096 }, (_, share) => Math.round(255 * encode(share / 4095)));
  const normal = [0, 0, 0];
  const smith = (cosine, square) => 1 / (cosine + Math.sqrt(square + (1 - square) * cosine * cosine));
  function draw(part, surface) {
    const share = Math.min(1, SOFTWARE_SIDE / Math.max(canvas.clientWidth, canvas.clientHeight));
    const [columns, rows] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * share)));
    if (canvas.width !== columns || canvas.height !== rows) [canvas.width, canvas.height] = [columns, rows];
    const picture = context.createImageData(columns, rows), [x, y, z] = light, length = Math.hypot(x, y, z + 1);
    new Uint32Array(picture.data.buffer).fill(0xff000000);  // black
    for (let row = 0, to = 0; row < rows; row++) {
      const above = Math.min(Math.floor((part[1] + (row + 0.5) / rows * part[3]) / height * down), down - 1) * across;
      for (let column = 0; column < columns; column++, to += 4) {
        const from = 4 * (above + Math.min(Math.floor((part[0] + (column + 0.5) / columns * part[2]) / width * across), across - 1));
        if (!(high[from] || high[from + 1] || high[from + 2])) continue;  // outside the mask
        for (let c = 0; c < 3; c++) normal[c] = (high[from + c] * LOW_SCALE + low[from + c] % LOW_SCALE) / LARGEST_CODE * 2 - 1;
        const scale = 1 / Math.hypot(...normal);
        for (let c = 0; c < 3; c++) normal[c] *= scale;
        const cosine = Math.max((normal[0] * x + normal[1] * y + normal[2] * z + surface.softness) / (1 + surface.softness), 0);
        const sharp = surface.shininess / (1 + surface.softness * surface.shininess / 8);
        const peak = (Math.max(normal[0] * x + normal[1] * y + normal[2] * (z + 1), 0) / length) ** sharp;
        const doubt = confidence ? surface.doubt * STRONGEST_DOUBT * (1 - confidence[from] / 255) : 0;
        let diffuse, lobe, metal;  // of the BRDF, which the other viewer explains
        if (MATERIAL) {
          const facing = Math.max(normal[2], LEAST_Z), half = (1 + z) / 2, grazing = (half - 1) / 2;
          const aligned = Math.min(Math.max((normal[0] * x + normal[1] * y + normal[2] * z + facing) / (2 * Math.sqrt(half)), 0), 1);
          const square = Math.max(Math.min((gloss[from + 1] / 255) ** 2 + surface.softness / 2, 1) ** 2, 1e-4);
          lobe = square / (aligned * aligned * (square - 1) + 1) ** 2 * smith(cosine, square) * smith(facing, square);
          diffuse = (1 + grazing * (1 - cosine) ** 5) * (1 + grazing * (1 - facing) ** 5);
          metal = gloss[from + 2] / 255;
        }
        for (let c = 0; c < 3; c++) {
          const base = surface.coloured && albedo ? linear[albedo[from + c]] : 1;
          let value;
          if (surface.view === "normals") value = decode((normal[c] + 1) / 2);
          else {
            value = surface.view === "specular" ? DIFFUSE_SHARE * base * cosine + SPECULAR_SHARE * peak
              : MATERIAL ? cosine * ((base * diffuse + linear[gloss[from]] * lobe) * (1 - metal) + base * lobe * metal)
              : (base * (1 - surface.gain) + (sharp + 8) / 8 * peak * surface.gain) * cosine;
            value *= surface.tint[c];
            value = surface.exposure * (value + (base * (1 + normal[2]) / 2 - value) * surface.ambient);
          }
          value += (DOUBTFUL[c] - value) * doubt;
          picture.data[to + c] = stored[Math.round(4095 * Math.max(0, Math.min(value, 1)))];
        }
      }
    }
    context.putImageData(picture, 0, 0);
    return 0;
  }
  load();
  return { draw, load };
}
