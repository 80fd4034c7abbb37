// The scene in WebGL 2. All that is drawn is of three kinds: round points, straight lines of constant width, and
// pictures. A line belongs to a shape, whose template is drawn once per camera: a frustum, an ellipsoid, or, with
// one segment, a pair. Sizes are uniforms, so that a slider costs nothing.

const LINES_VERTEX = `#version 300 es
in vec3 from, to; in vec2 corner;
in vec3 center, u, v, w; in vec4 color;
uniform mat4 matrix; uniform vec2 viewport; uniform float scale, width, near;
uniform vec4 tint;
out vec4 shade;
void main() {
  vec4 a = matrix * vec4(center + scale * (from.x * u + from.y * v + from.z * w), 1.0);
  vec4 b = matrix * vec4(center + scale * (to.x * u + to.y * v + to.z * w), 1.0);
  shade = vec4(mix(color.rgb, tint.rgb, step(0.0, tint.r)), tint.a);
  if (max(a.w, b.w) < near) { gl_Position = vec4(0.0, 0.0, 2.0, 1.0); return; }
  if (a.w < near) a = mix(a, b, (near - a.w) / (b.w - a.w));
  if (b.w < near) b = mix(b, a, (near - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * viewport;
  vec2 side = length(along) > 0.0 ? normalize(vec2(-along.y, along.x)) : vec2(0.0);
  gl_Position = corner.x < 0.5 ? a : b;
  gl_Position.xy += side * corner.y * width / viewport * gl_Position.w;
}`;
const FLAT_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade; out vec4 seen;
void main() { seen = shade; }`;
const POINTS_VERTEX = `#version 300 es
in vec3 center; in vec4 color;
uniform mat4 matrix; uniform float size, least, most; uniform vec4 tint;
out vec4 shade;
void main() {
  gl_Position = matrix * vec4(center, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, least, most);
  shade = vec4(mix(color.rgb, tint.rgb, step(0.0, tint.r)), tint.a);
}`;
const POINTS_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade; out vec4 seen;
void main() {
  vec2 away = gl_PointCoord - 0.5;
  if (dot(away, away) > 0.25) discard;
  seen = shade;
}`;
const PICTURES_VERTEX = `#version 300 es
in vec2 corner; in vec3 center, u, v, w; in vec4 color, cell;
uniform mat4 matrix; uniform float scale;
out vec2 where; out vec4 shade; out float hasPicture;
void main() {
  gl_Position = matrix * vec4(center + scale * (corner.x * u + corner.y * v + w), 1.0);
  where = cell.xy + (0.5 + 0.5 * corner) * cell.zw;
  hasPicture = step(1e-6, cell.z);
  shade = color;
}`;
const PICTURES_FRAGMENT = `#version 300 es
precision mediump float;
in vec2 where; in vec4 shade; in float hasPicture;
uniform sampler2D atlas; uniform float opacity;
out vec4 seen;
void main() {
  seen = mix(vec4(shade.rgb, 0.16), vec4(texture(atlas, where).rgb, opacity), hasPicture);
}`;
const ATTRIBUTES = ["from", "to", "corner", "center", "u", "v", "w", "color", "cell"];

// Segments as from, to; in units of half the picture's width, half its height, and the depth.
const FRUSTUM = (() => {
  const corners = [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]];
  const segments = corners.flatMap((c, k) => [[[0, 0, 0], c], [c, corners[(k + 1) % 4]]]);
  return [...segments, [[-0.5, -1, 1], [0, -1.5, 1]], [[0, -1.5, 1], [0.5, -1, 1]]];
})();
const SPHERE = [[0, 1], [0, 2], [1, 2]].flatMap(([a, b]) => Array.from({ length: 24 }, (_, k) => {
  const ends = [k, k + 1].map((step) => {
    const end = [0, 0, 0];
    end[a] = Math.cos((step * Math.PI) / 12);
    end[b] = Math.sin((step * Math.PI) / 12);
    return end;
  });
  return ends;
}));
const SEGMENT = [[[0, 0, 0], [1, 0, 0]]];

const MANY_SHAPES = 3000; // more are drawn by lines of one pixel, which are a third of the work

const HALF_FIELD = Math.tan((20 * Math.PI) / 180);
const FRAMED = 1.1; // of the canvas, what is framed leaves this margin
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

// Drawing on a canvas: buffers, programs, and one function per kind of thing.
const makePainter = (canvas) => {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) return null;
  const compile = (type, source) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    return shader;
  };
  const makeProgram = (vertex, fragment) => {
    const program = gl.createProgram();
    gl.attachShader(program, compile(gl.VERTEX_SHADER, vertex));
    gl.attachShader(program, compile(gl.FRAGMENT_SHADER, fragment));
    ATTRIBUTES.forEach((name, k) => gl.bindAttribLocation(program, k, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const uniforms = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  };
  const programs = {
    lines: makeProgram(LINES_VERTEX, FLAT_FRAGMENT),
    points: makeProgram(POINTS_VERTEX, POINTS_FRAGMENT),
    pictures: makeProgram(PICTURES_VERTEX, PICTURES_FRAGMENT),
  };
  const bind = (name, values, size, perInstance) => {
    const index = ATTRIBUTES.indexOf(name);
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    const isBytes = values instanceof Uint8Array;
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, size, isBytes ? gl.UNSIGNED_BYTE : gl.FLOAT, isBytes, 0, 0);
    gl.vertexAttribDivisor(index, perInstance ? 1 : 0);
    return buffer;
  };
  const arranged = (columns, perInstance) => {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = {};
    for (const [name, values] of Object.entries(columns)) {
      const size = name === "color" || name === "cell" ? 4 : 3;
      buffers[name] = bind(name, values, size, perInstance);
    }
    return { array, buffers };
  };
  const use = ({ program, uniforms }, array, values) => {
    gl.useProgram(program);
    gl.bindVertexArray(array);
    for (const [name, value] of Object.entries(values)) {
      const where = uniforms[name];
      if (where === undefined) continue;
      if (typeof value === "number") gl.uniform1f(where, value);
      else if (value.length === 16) gl.uniformMatrix4fv(where, false, value);
      else if (value.length === 2) gl.uniform2fv(where, value);
      else gl.uniform4fv(where, value);
    }
  };
  // Columns are center and, as far as the template has them, u, v, w; and color, 4 bytes each.
  const shapes = (template, columns) => {
    const made = arranged(columns, true);
    const instances = columns.center.length / 3;
    const isThin = instances > MANY_SHAPES;
    const corners = isThin ? [[0, 0], [1, 0]] : [[0, -1], [1, -1], [1, 1], [0, -1], [1, 1], [0, 1]];
    const flat = { from: [], to: [], corner: [] };
    for (const [from, to] of template) {
      for (const corner of corners) {
        flat.from.push(...from);
        flat.to.push(...to);
        flat.corner.push(...corner);
      }
    }
    bind("from", new Float32Array(flat.from), 3, false);
    bind("to", new Float32Array(flat.to), 3, false);
    bind("corner", new Float32Array(flat.corner), 2, false);
    return { ...made, kind: "lines", mode: isThin ? gl.LINES : gl.TRIANGLES, vertices: flat.corner.length / 2, instances };
  };
  const cloud = (columns) => ({ ...arranged(columns, false), kind: "points", vertices: columns.center.length / 3 });
  const pictures = (columns, atlas) => {
    const made = arranged(columns, true);
    bind("corner", new Float32Array([-1, -1, 1, -1, 1, 1, -1, -1, 1, 1, -1, 1]), 2, false);
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, atlas);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    return { ...made, kind: "pictures", mode: gl.TRIANGLES, vertices: 6, instances: columns.center.length / 3, texture };
  };
  const recolor = (thing, colors) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, thing.buffers.color);
    gl.bufferData(gl.ARRAY_BUFFER, colors, gl.STATIC_DRAW);
  };
  // Of a thing a share of its instances or points may be drawn, the first ones.
  const paint = (thing, values, share = 1) => {
    if (thing.texture) gl.bindTexture(gl.TEXTURE_2D, thing.texture);
    use(programs[thing.kind], thing.array, { tint: [-1, 0, 0, 1], ...values });
    if (thing.instances === undefined) gl.drawArrays(gl.POINTS, 0, Math.ceil(share * thing.vertices));
    else gl.drawArraysInstanced(thing.mode, 0, thing.vertices, Math.ceil(share * thing.instances));
  };
  const drop = (thing) => {
    for (const buffer of Object.values(thing.buffers)) gl.deleteBuffer(buffer);
    gl.deleteVertexArray(thing.array);
  };
  const begin = (background) => {
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background, 1);
    gl.depthMask(true);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  };
  const inFront = () => gl.disable(gl.DEPTH_TEST);
  const seeThrough = () => gl.depthMask(false);
  const opaque = () => gl.depthMask(true);
  return { shapes, cloud, pictures, recolor, paint, drop, begin, inFront, seeThrough, opaque };
};

// The viewer's eye: it turns about a target, the vertical stays vertical.
const makeEye = (canvas) => {
  const view = { target: [0, 0, 0], distance: 1, yaw: -Math.PI / 2, pitch: 0, far: 10 };
  const axes = () => {
    const [cosine, sine] = [Math.cos(view.pitch), Math.sin(view.pitch)];
    const back = [cosine * Math.cos(view.yaw), cosine * Math.sin(view.yaw), sine];
    const right = [-Math.sin(view.yaw), Math.cos(view.yaw), 0];
    return { right, up: cross(back, right), back };
  };
  const near = () => 0.01 * view.distance;
  const matrix = () => {
    const { right, up, back } = axes();
    const eye = view.target.map((part, c) => part + view.distance * back[c]);
    const [wide, high] = [canvas.clientHeight / canvas.clientWidth / HALF_FIELD, 1 / HALF_FIELD];
    const [close, far] = [near(), view.distance + view.far];
    const [depth, shift] = [(far + close) / (close - far), (2 * far * close) / (close - far)];
    const columns = [0, 1, 2].map((c) => [wide * right[c], high * up[c], depth * back[c], -back[c]]);
    return new Float32Array([
      ...columns.flat(),
      -wide * dot(right, eye), -high * dot(up, eye), -depth * dot(back, eye) + shift, dot(back, eye),
    ]);
  };
  // Where points are seen, as a function of the point: x, y in pixels, and the depth (not in front if not positive).
  const projection = () => {
    const m = matrix();
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    return (x, y, z) => {
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      return [
        width * (0.5 + (0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12])) / w),
        height * (0.5 - (0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13])) / w),
        w,
      ];
    };
  };
  // The target and the distance from which some groups of points fill the canvas, seen as the view is turned now; of each
  // group the given share may be outside on each side. With h the tangent of half the field of view, the point (x, y, z),
  // in the view's axes, is left of the right edge of an eye at e if x - e_x <= h (e_z - z), so if x + h z <= e_x + h e_z,
  // and likewise at the other three: four bounds, each a quantile, and an e_z that the wider of width and height decides.
  const framing = (groups, depth) => {
    const { right, up, back } = axes();
    const halves = [HALF_FIELD * (canvas.clientWidth / canvas.clientHeight), HALF_FIELD].map((half) => half / FRAMED);
    const bound = (axis, sign, half) => Math.max(...groups.map(({ positions, outside }) => (
      quantile(positions.map((p) => sign * dot(axis, p) + half * dot(back, p)), 1 - outside))));
    const sides = [right, up].map((axis, k) => [bound(axis, 1, halves[k]), bound(axis, -1, halves[k])]);
    const away = Math.max(...sides.map(([high, low], k) => (high + low) / (2 * halves[k])));
    const [x, y] = sides.map(([high, low]) => (high - low) / 2);
    return [[0, 1, 2].map((c) => x * right[c] + y * up[c] + dot(back, depth) * back[c]), away - dot(back, depth)];
  };
  const pixelsPerUnit = () => canvas.clientHeight / (2 * HALF_FIELD * view.distance);
  return { view, axes, near, matrix, projection, framing, pixelsPerUnit };
};

// What a press, a wheel and the keys do to the eye; `changed` is called after each, `pressed` for a press in place.
const steer = (canvas, eye, changed, pressed, hovered) => {
  const { view } = eye;
  const pointers = new Map();
  let travelled = 0;
  const turn = (dx, dy) => {
    view.yaw -= 0.008 * dx;
    view.pitch = Math.max(Math.min(view.pitch + 0.008 * dy, 1.57), -1.57);
  };
  const shift = (dx, dy) => {
    const { right, up } = eye.axes();
    const step = 1 / eye.pixelsPerUnit();
    view.target = view.target.map((part, c) => part - step * (dx * right[c] - dy * up[c]));
  };
  const zoom = (factor) => {
    view.distance = Math.max(Math.min(view.distance * factor, 20 * view.far), 1e-5 * view.far);
  };
  const apart = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (!pointers.size) travelled = 0;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.setPointerCapture(event.pointerId);
    hideTooltip();
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) {
      hovered(event);
      return;
    }
    const before = pointers.size === 2 ? apart() : 0;
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    travelled += Math.hypot(dx, dy);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) {
      zoom(before / Math.max(apart(), 1));
      shift(dx / 2, dy / 2);
    } else if (event.buttons & 6 || event.shiftKey || event.ctrlKey) shift(dx, dy);
    else turn(dx, dy);
    changed();
  });
  const release = (event) => {
    const wasDown = pointers.delete(event.pointerId);
    if (wasDown && event.type === "pointerup" && event.button === 0 && travelled < 4) pressed(event);
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", hideTooltip);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp((event.deltaMode ? 0.05 : 0.0015) * event.deltaY));
    changed();
  }, { passive: false });
  const KEYS = {
    ArrowLeft: () => turn(20, 0), ArrowRight: () => turn(-20, 0), ArrowUp: () => turn(0, 20), ArrowDown: () => turn(0, -20),
    "+": () => zoom(0.85), "-": () => zoom(1.18),
  };
  canvas.addEventListener("keydown", (event) => {
    if (!KEYS[event.key]) return;
    event.preventDefault();
    KEYS[event.key]();
    changed();
  });
};

// --- colors of cameras -----------------------------------------------------------------------------

const TRUST_RAMP = [[0, "#b3202c"], [0.4, "#e8743b"], [0.7, "#e9c54a"], [1, "#2a9d8f"]];
const VALUE_RAMP = [[0, "#3b6fc9"], [0.35, "#2fa79b"], [0.7, "#e2a52e"], [1, "#d23f2f"]];
const PIECES = ["#e07b39", "#2a9d6f", "#b455c4", "#c9a227", "#d2455b", "#4bb3c4", "#8d7b68", "#3b7dd8"];
const ALARMING_DEG = 1; // error of a pair; the worst of a sound model are not red
const MOST_KEYS = 5; // numbers that the key of groups and pieces names
const bytesOf = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
const ramp = (stops, value) => {
  const k = Math.max(stops.findIndex(([where]) => value <= where), 1);
  const [[low, first], [high, second]] = [stops[k - 1], stops[k]];
  const part = Math.max(Math.min((value - low) / (high - low), 1), 0);
  const [a, b] = [bytesOf(first), bytesOf(second)];
  return a.map((from, c) => Math.round(from + part * (b[c] - from)));
};
const gradient = (stops) => `linear-gradient(90deg, ${stops.map(([where, hex]) => `${hex} ${100 * where}%`).join(", ")})`;
// A mode: its label, the color of a camera as three bytes (or null for gray), and what its key says: the ends of a
// ramp, or a color and a text each.
const colorModes = () => {
  const logarithmic = (name, label, values, unit, alarming = 0) => {
    const shown = Array.from(values).filter((value, k) => isPlaced(k) && value > 0);
    if (!shown.length) return [];
    const [low, high] = [quantile(shown, 0.05), Math.max(quantile(shown, 0.95), alarming)];
    const span = Math.log(high / low) || 1;
    const color = (k) => (Number.isFinite(values[k])
      ? ramp(VALUE_RAMP, Math.max(Math.min(Math.log(Math.max(values[k], low) / low) / span, 1), 0)) : null);
    return [{ name, label, color, low: `${number(low, 2)}${unit}`, high: `${number(high, 2)}${unit}`, gradient: gradient(VALUE_RAMP) }];
  };
  const trust = (k) => (Number.isFinite(cameras.trust[k]) ? ramp(TRUST_RAMP, cameras.trust[k]) : null);
  const keyed = (name, label, values, said) => {
    const numbers = [...new Set(values)].sort((a, b) => a - b);
    const color = (k) => (values[k] < 0 ? null : bytesOf(PIECES[values[k] % PIECES.length]));
    const keys = numbers.slice(0, MOST_KEYS).map((value) => (
      [value < 0 ? "var(--nodirection)" : PIECES[value % PIECES.length], said(value)]));
    return { name, label, color, keys };
  };
  const modes = [];
  if (cameras.group.some((group) => group >= 0)) modes.push(keyed("group", "groups that stand apart", cameras.group, (group) => (group < 0 ? "the rest" : `group ${group + 1}`)));
  if (isKnown(cameras.trust)) modes.push({ name: "trust", label: "trust", color: trust, low: "0", high: "1", gradient: gradient(TRUST_RAMP) });
  modes.push(...logarithmic("sigma", "uncertainty", cameras.sigma, ""));
  modes.push(...logarithmic("residual", "error of its pairs", cameras.error, "°", ALARMING_DEG));
  if (cameras.shift) modes.push(...logarithmic("shift", "shift from the input", cameras.shift, ""));
  for (const { title, values } of cameras.further) modes.push(...logarithmic(title, title, values, ""));
  if (!modes.length) modes.push({ name: "none", label: "none", color: () => null, keys: [] });
  if (cameras.piece.some((piece) => piece > 0)) {
    modes.push(keyed("piece", "separate piece", cameras.piece, (piece) => (piece < 0 ? "none" : `piece ${piece}`)));
  }
  return modes;
};
