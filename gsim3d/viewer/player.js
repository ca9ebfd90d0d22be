"use strict";
// Plays Gaussians that gsim3d/viewer/player.py packed. Axes: world z up; camera x right, y down, z forward.

const $ = (id) => document.getElementById(id);
const header = JSON.parse($("header").textContent);

// ---- unpacking -----------------------------------------------------------------------------------------------------

async function inflated(index) {
  const text = atob($("blob" + index).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Float32Array [frames, width, count] of a channel; one frame where it never changes.
async function channel(name) {
  const { step, width, order, blob } = header.channels[name];
  const bytes = await inflated(blob), n = header.count * width, frames = order ? header.frames : 1;
  const total = n * frames, values = new Int32Array(total);
  for (let plane = 0; plane < bytes[0]; plane++) {
    const begin = 1 + plane * total;
    for (let i = 0; i < total; i++) values[i] |= bytes[begin + i] << (8 * plane);
  }
  for (let i = 0; i < total; i++) values[i] = (values[i] >>> 1) ^ -(values[i] & 1);
  for (let pass = 0; pass < order; pass++) for (let i = n; i < total; i++) values[i] += values[i - n];
  const out = new Float32Array(total);
  for (let i = 0; i < total; i++) out[i] = values[i] * step;
  return { width, order, data: out };
}

// ---- a worker that sorts by depth ------------------------------------------------------------------------------------

const SORTER = `
let x, y, z, count;
onmessage = ({ data }) => {
  if (data.means) { count = data.count; const m = data.means; x = m.subarray(0, count); y = m.subarray(count, 2 * count); z = m.subarray(2 * count); return; }
  const [a, b, c] = data.forward, depth = new Float32Array(count);
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < count; i++) { const d = a * x[i] + b * y[i] + c * z[i]; depth[i] = d; if (d < low) low = d; if (d > high) high = d; }
  const bins = 65536, scale = high > low ? (bins - 1) / (high - low) : 0, starts = new Uint32Array(bins + 1), order = new Uint32Array(count);
  const keys = new Uint16Array(count);
  for (let i = 0; i < count; i++) { const k = (high - depth[i]) * scale; keys[i] = k; starts[keys[i] + 1]++; }  // farthest first
  for (let k = 0; k < bins; k++) starts[k + 1] += starts[k];
  for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
  postMessage({ order, ticket: data.ticket }, [order.buffer]);
};`;

// ---- shaders ---------------------------------------------------------------------------------------------------------

const TEXTURE = 1024;  // texels in a row of all textures
const VERTEX = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D means, scales, quats, looks, harmonics;
uniform mat4 viewmat;
uniform vec4 lens;      // fx, fy, cx, cy in pixels of the canvas
uniform vec2 canvas;
uniform float nearPlane;
uniform int nHarmonics;
uniform bool antialiased;
in vec2 corner;
in uint index;
out vec3 color; out vec3 conic; out vec2 offset; out float opacity;
ivec2 at(int i) { return ivec2(i % ${TEXTURE}, i / ${TEXTURE}); }
vec3 sh(int k) { return texelFetch(harmonics, at(int(index) * nHarmonics + k), 0).rgb; }
void main() {
  int i = int(index);
  vec4 look = texelFetch(looks, at(i), 0);
  vec3 world = texelFetch(means, at(i), 0).xyz;
  vec3 p = (viewmat * vec4(world, 1.0)).xyz;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  opacity = look.a;
  if (p.z <= nearPlane) return;
  vec4 q = normalize(texelFetch(quats, at(i), 0));
  float w = q.x, x = q.y, y = q.z, z = q.w;
  mat3 turn = mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
                   2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
                   2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
  vec3 s = texelFetch(scales, at(i), 0).xyz;
  mat3 half_ = mat3(viewmat) * turn * mat3(s.x, 0, 0, 0, s.y, 0, 0, 0, s.z);
  vec3 rowX = vec3(lens.x / p.z, 0.0, -lens.x * p.x / (p.z * p.z));
  vec3 rowY = vec3(0.0, lens.y / p.z, -lens.y * p.y / (p.z * p.z));
  vec3 a = rowX * half_, b = rowY * half_;
  float xx = dot(a, a) + 0.3, xy = dot(a, b), yy = dot(b, b) + 0.3, det = xx * yy - xy * xy;
  if (!(det > 0.0)) return;
  if (antialiased) opacity *= sqrt(max(0.0, ((xx - 0.3) * (yy - 0.3) - xy * xy) / det));
  if (opacity < 1.0 / 255.0) return;
  conic = vec3(yy, -xy, xx) / det;
  float reach = sqrt(2.0 * log(255.0 * opacity));   // where alpha falls below 1 / 255
  vec2 size = min(reach * sqrt(vec2(xx, yy)), 4.0 * canvas);
  offset = corner * size;
  vec2 pixel = vec2(lens.x * p.x / p.z + lens.z, lens.y * p.y / p.z + lens.w) + offset;
  gl_Position = vec4(2.0 * pixel.x / canvas.x - 1.0, 1.0 - 2.0 * pixel.y / canvas.y, 0.0, 1.0);
  color = look.rgb;
  if (nHarmonics > 0) {
    vec3 d = normalize(transpose(mat3(viewmat)) * p);
    float dx = d.x, dy = d.y, dz = d.z;
    color += 0.4886025119 * (-dy * sh(0) + dz * sh(1) - dx * sh(2));
    if (nHarmonics > 3) {
      float x2 = dx * dx, y2 = dy * dy, z2 = dz * dz;
      color += 1.0925484306 * (dx * dy * sh(3) - dy * dz * sh(4) - dx * dz * sh(6))
             + 0.3153915653 * (2.0 * z2 - x2 - y2) * sh(5) + 0.5462742153 * (x2 - y2) * sh(7);
      if (nHarmonics > 8)
        color += -0.5900435899 * dy * (3.0 * x2 - y2) * sh(8) + 2.8906114426 * dx * dy * dz * sh(9)
               - 0.4570457995 * dy * (4.0 * z2 - x2 - y2) * sh(10) + 0.3731763326 * dz * (2.0 * z2 - 3.0 * x2 - 3.0 * y2) * sh(11)
               - 0.4570457995 * dx * (4.0 * z2 - x2 - y2) * sh(12) + 1.4453057213 * dz * (x2 - y2) * sh(13)
               - 0.5900435899 * dx * (x2 - 3.0 * y2) * sh(14);
    }
  }
  color = max(color, 0.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 color; in vec3 conic; in vec2 offset; in float opacity;
out vec4 result;
void main() {
  float power = 0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) + conic.y * offset.x * offset.y;
  float alpha = min(0.99, opacity * exp(-power));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(color * alpha, alpha);
}`;

function program(gl) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

// ---- vectors ---------------------------------------------------------------------------------------------------------

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };

// ---- the player ------------------------------------------------------------------------------------------------------

async function main() {
  const [means, scales, quats, opacities, colors] = await Promise.all(
    ["means", "scales", "quats", "opacities", "colors"].map(channel));
  const sh = header.channels.sh ? await channel("sh") : null;
  const { count, frames, fps, middle } = header, nHarmonics = header.n_sh - 1;
  for (let i = 0; i < scales.data.length; i++) scales.data[i] = Math.exp(scales.data[i]);
  const canvas = $("view");
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, preserveDrawingBuffer: true });
  if (!gl) throw new Error("this browser has no WebGL 2");
  const shaders = program(gl);
  gl.useProgram(shaders);
  const uniform = (name) => gl.getUniformLocation(shaders, name);

  // one texture a channel, RGBA32F, the texels of Gaussian i at i (harmonics: i * nHarmonics + k)
  const textures = {};
  ["means", "scales", "quats", "looks", "harmonics"].forEach((name, unit_) => {
    const texels = Math.max(1, count * (name === "harmonics" ? nHarmonics : 1)), rows = Math.ceil(texels / TEXTURE);
    const texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit_);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, TEXTURE, rows);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    gl.uniform1i(uniform(name), unit_);
    textures[name] = { unit: unit_, rows, data: new Float32Array(4 * TEXTURE * rows), shown: -1 };
  });
  function upload(name, frame, fill) {
    const texture = textures[name];
    if (texture.shown === frame) return;
    texture.shown = frame;
    fill(texture.data);
    gl.activeTexture(gl.TEXTURE0 + texture.unit);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE, texture.rows, gl.RGBA, gl.FLOAT, texture.data);
  }
  const part = ({ data, width, order }, frame) => data.subarray((order ? frame : 0) * count * width, ((order ? frame : 0) + 1) * count * width);
  const spread = (source, width) => (data) => {
    for (let c = 0; c < width; c++) for (let i = 0; i < count; i++) data[4 * i + c] = source[c * count + i];
  };

  const corners = gl.createBuffer(), order = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, corners);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  const corner = gl.getAttribLocation(shaders, "corner"), index = gl.getAttribLocation(shaders, "index");
  gl.enableVertexAttribArray(corner);
  gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.bufferData(gl.ARRAY_BUFFER, 4 * Math.max(1, count), gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(index);
  gl.vertexAttribIPointer(index, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(index, 1);
  gl.enable(gl.BLEND);
  gl.blendFuncSeparate(gl.ONE, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);

  const sorter = new Worker(URL.createObjectURL(new Blob([SORTER], { type: "text/javascript" })));
  let ticket = 0, sorting = false, sortedFor = "", inSorter = -1;

  // ---- camera: looks from `eye` at `target`; the first look is a given camera with its own lens ----
  const first = header.view, camera = {};
  function reset() {
    const m = first.viewmat, rotation = m.slice(0, 3).map((row) => row.slice(0, 3)), t = m.slice(0, 3).map((row) => row[3]);
    const eye = [0, 1, 2].map((c) => -(rotation[0][c] * t[0] + rotation[1][c] * t[1] + rotation[2][c] * t[2]) - middle[c]);
    const reach = Math.max(1e-3, -dot(eye, rotation[2])), back = rotation[2].map((v) => -v);
    Object.assign(camera, {
      target: eye.map((v, c) => v + reach * rotation[2][c]), distance: reach, given: true,
      azimuth: Math.atan2(back[1], back[0]), elevation: Math.asin(Math.max(-1, Math.min(1, back[2]))),
    });
    changed = true;
  }
  function pose(width, height) {
    const e = camera.elevation, a = camera.azimuth;
    if (camera.given) {
      const scale = Math.min(width / first.width, height / first.height), [[fx, , cx], [, fy, cy]] = first.K;
      const rotation = first.viewmat.slice(0, 3).map((row) => row.slice(0, 3));
      const shift = first.viewmat.slice(0, 3).map((row) => dot(row.slice(0, 3), middle) + row[3]);
      const margin = [(width - scale * first.width) / 2, (height - scale * first.height) / 2];
      return { rotation, shift, lens: [scale * fx, scale * fy, scale * cx + margin[0], scale * cy + margin[1]] };
    }
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const forward = back.map((v) => -v), right = unit(cross(forward, [0, 0, 1])), down = cross(forward, right);
    const eye = camera.target.map((v, c) => v + camera.distance * back[c]), rotation = [right, down, forward];
    const focal = Math.min(width / first.width, height / first.height) * first.K[0][0];
    return { rotation, shift: rotation.map((row) => -dot(row, eye)), lens: [focal, focal, width / 2, height / 2] };
  }

  // ---- drawing ----
  let changed = true, frame = 0, playing = false, clock = 0, last = 0;
  sorter.onmessage = ({ data }) => {
    sorting = false;
    gl.bindBuffer(gl.ARRAY_BUFFER, order);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, data.order);
    paint();
  };
  let wanted = null;
  function paint() {
    $("poster").hidden = true;
    const { rotation: r, shift: t, lens } = wanted, [width, height] = [canvas.width, canvas.height];
    gl.viewport(0, 0, width, height);
    const [red, green, blue] = header.background;
    gl.clearColor(red, green, blue, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (truth.length && player.painted?.[0] !== frame) $("truth").src = "data:image/jpeg;base64," + truth[frame];
    player.painted = [frame, ticket];
    if (!count) return;
    upload("means", means.order ? frame : 0, spread(part(means, frame), 3));
    upload("scales", scales.order ? frame : 0, spread(part(scales, frame), 3));
    upload("quats", quats.order ? frame : 0, spread(part(quats, frame), 4));
    upload("looks", frame, (data) => {
      spread(part(colors, frame), 3)(data);
      const seen = part(opacities, frame);
      for (let i = 0; i < count; i++) data[4 * i + 3] = seen[i];
    });
    if (sh) upload("harmonics", sh.order ? frame : 0, (data) => {
      const source = part(sh, frame);
      for (let k = 0; k < nHarmonics; k++) for (let c = 0; c < 3; c++) for (let i = 0; i < count; i++)
        data[4 * (i * nHarmonics + k) + c] = source[(3 * k + c) * count + i];
    });
    gl.uniformMatrix4fv(uniform("viewmat"), false, [r[0][0], r[1][0], r[2][0], 0, r[0][1], r[1][1], r[2][1], 0, r[0][2], r[1][2], r[2][2], 0, t[0], t[1], t[2], 1]);
    gl.uniform4fv(uniform("lens"), lens);
    gl.uniform2f(uniform("canvas"), width, height);
    gl.uniform1f(uniform("nearPlane"), Math.min(0.01, 0.01 * camera.distance));
    gl.uniform1i(uniform("nHarmonics"), nHarmonics);
    gl.uniform1i(uniform("antialiased"), header.antialiased);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }
  function draw(now) {
    if (playing) {
      clock += ((now - last) / 1000) * fps * Number($("speed").value);
      if (clock >= frames) { if (looping()) clock %= frames; else { clock = frames - 1; play(false); } }
      if (Math.floor(clock) !== frame) show(Math.floor(clock), false);
    }
    last = now;
    const ratio = Math.min(2, devicePixelRatio || 1), box = canvas.getBoundingClientRect();
    const size = [Math.max(1, Math.round(box.width * ratio)), Math.max(1, Math.round(box.height * ratio))];
    if (canvas.width !== size[0] || canvas.height !== size[1]) { [canvas.width, canvas.height] = size; changed = true; }
    if (changed && !sorting) {
      changed = false;
      wanted = pose(...size);
      const forward = wanted.rotation[2], key = [means.order ? frame : 0, ...forward].join();
      if (key !== sortedFor && count) {
        sortedFor = key;
        sorting = true;
        const now = means.order ? frame : 0;
        if (inSorter !== now) { inSorter = now; sorter.postMessage({ means: part(means, now).slice(), count }); }
        sorter.postMessage({ forward, ticket: ++ticket });
      } else paint();
    }
    requestAnimationFrame(draw);
  }

  // ---- controls ----
  const truth = header.truth;
  if (truth.length) $("true-pane").hidden = false;
  const looping = () => $("loop").getAttribute("aria-pressed") === "true";
  function show(number, seek = true) {
    frame = Math.max(0, Math.min(frames - 1, number));
    if (seek) clock = frame;
    $("scrub").value = frame;
    $("time").textContent = `${(frame / fps).toFixed(2)} s / ${((frames - 1) / fps).toFixed(2)} s`;
    $("label").textContent = frame < header.start ? "given" : header.start || header.truth.length ? "predicted" : "";
    changed = true;
  }
  function play(on) {
    if (on && frame === frames - 1 && !looping()) show(0);
    playing = on && frames > 1;
    $("play").querySelector("path").setAttribute("d", playing ? "M1 0h3v10H1zM6 0h3v10H6z" : "M1 0l9 5-9 5z");
    $("play").setAttribute("aria-label", playing ? "pause" : "play");
  }
  $("scrub").max = frames - 1;
  $("play").onclick = () => play(!playing);
  $("scrub").oninput = () => { play(false); show(Number($("scrub").value)); };
  $("loop").onclick = () => $("loop").setAttribute("aria-pressed", String(!looping()));
  $("reset").onclick = reset;
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const keys = {
      " ": () => play(!playing), k: () => play(!playing), l: () => $("loop").click(), r: reset,
      ArrowRight: () => { play(false); show(frame + 1); }, ArrowLeft: () => { play(false); show(frame - 1); },
      Home: () => show(0), End: () => { play(false); show(frames - 1); },
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  const fingers = new Map();
  let spread_ = 0;
  const turn = (dx, dy) => {
    camera.given = false;
    camera.azimuth -= 0.008 * dx;
    camera.elevation = Math.max(-1.5, Math.min(1.5, camera.elevation + 0.008 * dy));
    changed = true;
  };
  const slide = (dx, dy) => {
    const { rotation, lens } = pose(canvas.width, canvas.height), scale = (camera.distance / lens[0]) * (devicePixelRatio || 1);
    camera.given = false;
    camera.target = camera.target.map((v, c) => v - scale * (dx * rotation[0][c] + dy * rotation[1][c]));
    changed = true;
  };
  const zoom = (factor) => { camera.given = false; camera.distance = Math.max(0.02, camera.distance * factor); changed = true; };
  canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, [event.clientX, event.clientY]); spread_ = 0; };
  canvas.onpointerup = canvas.onpointercancel = (event) => { fingers.delete(event.pointerId); spread_ = 0; };
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before[0], dy = event.clientY - before[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size > 1) {
      const [a, b] = [...fingers.values()], apart = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (spread_) zoom(spread_ / Math.max(1, apart));
      spread_ = apart;
      slide(dx / 2, dy / 2);
    } else if (event.buttons & 2 || event.shiftKey) slide(dx, dy);
    else turn(dx, dy);
  };
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(0.0012 * event.deltaY)); }, { passive: false });

  const player = { show, play, reset, painted: null, get frame() { return frame; }, get playing() { return playing; }, get idle() { return !changed && !sorting; } };
  globalThis.player = player;
  reset();
  show(0);
  $("state").textContent = `${count.toLocaleString("en")} Gaussians`;
  requestAnimationFrame(draw);
  if (frames > 1 && !matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
}

main().catch((error) => {
  $("state").textContent = "";
  $("problem").hidden = false;
  $("poster").hidden = false;
  $("problem").textContent = `This scene cannot be shown: ${error.message}`;
  console.error(error);
});
