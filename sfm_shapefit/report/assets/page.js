"use strict";
// Draws the report from the JSON in #data. Names come from strangers: they reach the page through textContent
// only, and Plotly, which reads some HTML in its texts, never gets one; hover boxes are our own.
(() => {
  const TYPES = {
    f8: Float64Array, f4: Float32Array, i4: Int32Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array,
  };
  const VERDICTS = ["agrees", "contradicts", "undetermined", "no direction"];
  const PAIRS = ["Pairs that agree", "that contradict", "that cannot be judged", "without a direction"];
  const VARIABLES = ["--agrees", "--contradicts", "--undetermined", "--nodirection"];
  const RAMP = [[0, "#b3202c"], [0.4, "#e8743b"], [0.7, "#e9c54a"], [1, "#2a9d8f"]];
  const STATES = {
    input: "at the input's centers", optimum: "at the convex optimum", output: "at the output's centers",
  };
  const ROWS_PER_PAGE = 12;
  const MANY_PAIRS = 4000; // agreeing pairs from here on are not drawn until asked for
  const $ = (id) => document.getElementById(id);

  const decode = (value) => {
    if (Array.isArray(value)) return value.map(decode);
    if (value === null || typeof value !== "object") return value;
    if (!("bytes" in value)) {
      return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, decode(item)]));
    }
    const text = atob(value.bytes);
    const bytes = Uint8Array.from(text, (character) => character.charCodeAt(0));
    return new TYPES[value.type](bytes.buffer);
  };
  const data = decode(JSON.parse($("data").textContent));
  const { cameras, pairs, points } = data;
  const numCameras = cameras.names.length;
  const numPairs = pairs.first.length;

  // --- small helpers --------------------------------------------------------------------------------

  const element = (tag, text = "", className = "") => {
    const made = document.createElement(tag);
    if (text !== "") made.textContent = text;
    if (className) made.className = className;
    return made;
  };
  const fill = (id, ...children) => $(id).replaceChildren(...children);
  const number = (value, digits = 3) => {
    if (!Number.isFinite(value)) return "";
    if (value === 0) return "0";
    const size = Math.abs(value);
    if (size < 1e-3 || size >= 1e6) return value.toExponential(Math.max(digits - 1, 0));
    return Number(value.toPrecision(digits)).toString();
  };
  const count = (value) => value.toLocaleString("en");
  const reason = (code) => data.reasons[code];
  const at = (positions, k) => [positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]];
  const isPlaced = (k) => cameras.placed[k] === 1;
  const isDrawn = (p) => isPlaced(pairs.first[p]) && isPlaced(pairs.second[p]);
  const probe = document.body.appendChild(element("i"));
  probe.hidden = true;
  const color = (variable) => {
    probe.style.color = `var(${variable})`;
    return getComputedStyle(probe).color;
  };

  // --- what is said of a camera or a pair ----------------------------------------------------------

  const cameraFacts = (k) => [
    ["placed", isPlaced(k) ? "yes" : "no"],
    ["trust", number(cameras.trust[k], 2)],
    ["std. deviation", number(cameras.sigma[k]) && `${number(cameras.sigma[k])} units`],
    ["center", isPlaced(k) ? at(cameras.world, k).slice(0, data.shownAxes).map((x) => number(x, 5)).join(", ") : ""],
    ["pairs", String(cameras.degree[k])],
    ["piece", cameras.piece[k] < 0 ? "none" : String(cameras.piece[k])],
    ["why", reason(cameras.reason[k])],
  ];
  const pairFacts = (p) => [
    ["verdict", VERDICTS[pairs.verdict[p]]],
    ["residual", number(pairs.residual[p]) && `${number(pairs.residual[p])}°`],
    ["at the optimum", number(pairs.certified[p]) && `${number(pairs.certified[p])}°`],
    ["at the input", number(pairs.input[p]) && `${number(pairs.input[p])}°`],
    ["matches", pairs.support[p] ? count(pairs.support[p]) : ""],
    ["weight", number(pairs.weight[p])],
    ["leverage", number(pairs.leverage[p], 2)],
    ["dual norm", number(pairs.dual[p])],
    ["why", reason(pairs.reason[p])],
  ];
  const known = (facts) => facts.filter(([, value]) => value !== "");
  const pairTitle = (p) => `${cameras.names[pairs.first[p]]} – ${cameras.names[pairs.second[p]]}`;

  const tooltip = $("tooltip");
  let pointer = [0, 0];
  document.addEventListener("mousemove", (event) => {
    pointer = [event.clientX, event.clientY];
  });
  const showTooltip = (title, facts) => {
    tooltip.replaceChildren(element("strong", title));
    for (const [label, value] of known(facts)) tooltip.append(`\n${label}: ${value}`);
    tooltip.hidden = false;
    const [x, y] = pointer;
    tooltip.style.left = `${Math.max(Math.min(x + 14, innerWidth - tooltip.offsetWidth - 8), 4)}px`;
    tooltip.style.top = `${Math.max(Math.min(y + 14, innerHeight - tooltip.offsetHeight - 8), 4)}px`;
  };
  const hideTooltip = () => {
    tooltip.hidden = true;
  };

  // --- summary --------------------------------------------------------------------------------------

  const drawSummary = () => {
    $("title").textContent = data.title;
    $("subtitle").textContent = data.subtitle;
    fill("tiles", ...data.tiles.map(([value, label]) => {
      const tile = element("div", "", "tile");
      tile.append(element("b", value), element("span", label));
      return tile;
    }));
    fill("summary", ...data.summary.map((text) => element("li", text)));
    const looks = data.looks.map(({ text, camera, pair }) => {
      const item = element("li");
      const target = camera ?? pair;
      if (target === null) item.append(element("span", text));
      else {
        const button = element("button", text, "link");
        button.type = "button";
        button.onclick = () => select(camera === null ? "pair" : "camera", target, true);
        item.append(button);
      }
      return item;
    });
    if (!looks.length) looks.push(element("li", "Nothing stands out.", "fine"));
    fill("looks", ...looks);
  };

  const factTable = (rows) => {
    const table = element("table", "", "facts");
    for (const [label, value] of rows) {
      const row = table.insertRow();
      row.append(element("td", label), element("td", value, typeof value === "number" ? "number" : ""));
    }
    return table;
  };

  // --- the scene ------------------------------------------------------------------------------------

  const plot = $("scene");
  const trustColors = Float32Array.from(cameras.trust, (t) => (Number.isFinite(t) ? t : 1));
  const frustumLines = (chosen) => {
    // apex-corner-corner of each side, so that one line draws the pyramid; a mark shows the upper edge.
    const order = [-1, 0, 1, -1, 2, 3, -1, null, 0, 3, null, 1, 2, null];
    const lines = { x: [], y: [], z: [], camera: [] };
    for (const k of chosen) {
      if (!isPlaced(k) || !Number.isFinite(cameras.corners[12 * k])) continue;
      for (const corner of order) {
        const from = corner === -1 ? cameras.center : cameras.corners;
        const base = corner === -1 ? 3 * k : 12 * k + 3 * corner;
        lines.x.push(corner === null ? null : from[base]);
        lines.y.push(corner === null ? null : from[base + 1]);
        lines.z.push(corner === null ? null : from[base + 2]);
        lines.camera.push(k);
      }
    }
    return lines;
  };
  const pairLines = (chosen) => {
    const lines = { x: [], y: [], z: [], pair: [] };
    for (const p of chosen) {
      const a = at(cameras.center, pairs.first[p]);
      const b = at(cameras.center, pairs.second[p]);
      lines.x.push(a[0], (a[0] + b[0]) / 2, b[0], null);
      lines.y.push(a[1], (a[1] + b[1]) / 2, b[1], null);
      lines.z.push(a[2], (a[2] + b[2]) / 2, b[2], null);
      lines.pair.push(p, p, p, p);
    }
    return lines;
  };
  const trace = (extra) => ({ type: "scatter3d", mode: "lines", hoverinfo: "none", showlegend: false, ...extra });
  const pairsOf = [0, 1, 2, 3].map((verdict) => {
    const found = [];
    for (let p = 0; p < numPairs; p++) if (pairs.verdict[p] === verdict && isDrawn(p)) found.push(p);
    return found;
  });
  const placedCameras = Array.from(cameras.names.keys()).filter(isPlaced);
  const axis = (positions, component) => {
    const values = new Float32Array(positions.length / 3);
    for (let k = 0; k < values.length; k++) values[k] = positions[3 * k + component];
    return values;
  };
  const nothing = () => ({ x: [null], y: [null], z: [null] });

  // Dark points would vanish on a dark page and light ones on a light page; points without colors are gray.
  const pointColors = () => {
    const { colors } = points;
    if (colors.every((part) => part === 0)) return new Array(colors.length / 3).fill(color("--soft"));
    const isDark = getComputedStyle(document.documentElement).colorScheme === "dark"
      || (!document.documentElement.dataset.theme && matchMedia("(prefers-color-scheme: dark)").matches);
    const shade = (part) => Math.round(isDark ? 64 + 0.75 * part : 0.8 * part);
    const shades = [];
    for (let k = 0; k < colors.length; k += 3) {
      shades.push(`rgb(${shade(colors[k])},${shade(colors[k + 1])},${shade(colors[k + 2])})`);
    }
    return shades;
  };

  const LAYERS = []; // name, label, color variable or null, traces, whether it is shown at first
  const traces = [];
  const addLayer = (name, label, variable, shown, made) => {
    LAYERS.push({ name, label, variable, shown, indices: made.map((item) => traces.push(item) - 1) });
    for (const item of made) item.visible = shown;
  };
  const buildScene = () => {
    const frusta = frustumLines(placedCameras);
    const centers = placedCameras.map((k) => at(cameras.center, k));
    const size = placedCameras.length > 2000 ? 2.5 : 4;
    addLayer("cameras", `Cameras (${count(placedCameras.length)})`, null, true, [
      trace({
        x: frusta.x, y: frusta.y, z: frusta.z, customdata: frusta.camera, kind: "camera",
        line: { color: frusta.camera.map((k) => trustColors[k]), colorscale: RAMP, cmin: 0, cmax: 1, width: 2 },
      }),
      trace({
        mode: "markers", customdata: placedCameras, kind: "camera",
        x: centers.map((c) => c[0]), y: centers.map((c) => c[1]), z: centers.map((c) => c[2]),
        marker: { size, color: placedCameras.map((k) => trustColors[k]), colorscale: RAMP, cmin: 0, cmax: 1, line: { width: 0 } },
      }),
    ]);
    if (points.positions.length) {
      const shades = pointColors();
      addLayer("points", `Points (${count(shades.length)})`, null, true, [trace({
        mode: "markers", hoverinfo: "skip", marker: { size: 1.6, color: shades, line: { width: 0 } },
        x: axis(points.positions, 0), y: axis(points.positions, 1), z: axis(points.positions, 2),
      })]);
    }
    VERDICTS.forEach((verdict, code) => {
      if (!pairsOf[code].length) return;
      const lines = pairLines(pairsOf[code]);
      const shown = code === 3 ? false : pairsOf[code].length <= MANY_PAIRS;
      addLayer(verdict, `${PAIRS[code]} (${count(pairsOf[code].length)})`, VARIABLES[code], shown, [trace({
        x: lines.x, y: lines.y, z: lines.z, customdata: lines.pair, kind: "pair",
        opacity: code === 0 ? Math.max(Math.min(6 / Math.sqrt(pairsOf[code].length + 1), 0.6), 0.15) : 0.75,
        line: { color: color(VARIABLES[code]), width: code === 0 ? 1.5 : 2 },
      })]);
    });
    if (cameras.inputCenter) {
      const moved = { x: [], y: [], z: [], camera: [] };
      for (const k of placedCameras) {
        const before = at(cameras.inputCenter, k);
        const now = at(cameras.center, k);
        ["x", "y", "z"].forEach((name, c) => moved[name].push(now[c], before[c], null));
        moved.camera.push(k, k, k);
      }
      addLayer("input", "From here to the input's centers", "--soft", false, [trace({
        ...moved, customdata: moved.camera, kind: "camera", line: { color: color("--soft"), width: 2 },
      })]);
    }
    for (const mode of ["lines", "markers"]) {
      traces.push(trace({
        ...nothing(), mode, kind: "selection",
        line: { color: color("--chosen"), width: 6 },
        marker: { size: 9, symbol: "circle-open", color: color("--chosen"), line: { width: 2, color: color("--chosen") } },
      }));
    }
  };

  const box = data.box; // low x y z, high x y z in display axes
  const spans = [0, 1, 2].map((c) => box[3 + c] - box[c]);
  const largest = Math.max(...spans);
  const normal = (p) => p.map((x, c) => (x - (box[c] + box[3 + c]) / 2) / largest);
  // The view starts around the cameras; points may reach far beyond them.
  const reach = Math.max(...placedCameras.map((k) => Math.hypot(...at(cameras.center, k))), 0.5 * data.frustum) / largest;
  const startCamera = () => {
    const [x, y, z] = normal([0, 0, 0]);
    const distance = 2.1 * Math.max(reach, 0.15);
    const from = data.dimension === 2 ? [0, -0.01, 1] : [0.35, -0.84, 0.42];
    const [u, v, w] = from.map((part) => part * distance);
    return { up: { x: 0, y: 0, z: 1 }, center: { x, y, z }, eye: { x: x + u, y: y + v, z: z + w } };
  };
  const sceneLayout = () => {
    const hidden = (c) => ({ visible: false, showspikes: false, range: [box[c], box[3 + c]], autorange: false });
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: color("--card"), uirevision: "keep", showlegend: false,
      scene: {
        xaxis: hidden(0), yaxis: hidden(1), zaxis: hidden(2), bgcolor: color("--card"), dragmode: "turntable",
        aspectmode: "manual", aspectratio: { x: spans[0] / largest, y: spans[1] / largest, z: spans[2] / largest },
        camera: startCamera(),
      },
    };
  };
  const drawLayerControls = () => {
    const controls = LAYERS.map((layer) => {
      const label = element("label");
      const input = element("input");
      input.type = "checkbox";
      input.checked = layer.shown;
      input.dataset.layer = layer.name;
      input.onchange = () => Plotly.restyle(plot, { visible: input.checked }, layer.indices);
      label.append(input);
      if (layer.variable) {
        const swatch = element("span", "", "swatch");
        swatch.style.background = `var(${layer.variable})`;
        label.append(swatch);
      }
      label.append(layer.label);
      return label;
    });
    const key = element("span", "", "key");
    key.append("trust 0 ", element("span", "", "ramp"), " 1");
    const reset = element("button", "Whole scene", "quiet");
    reset.type = "button";
    reset.onclick = () => Plotly.relayout(plot, { "scene.camera": startCamera() });
    fill("layers", ...controls, key, reset);
  };
  const customOf = (event) => {
    const point = event.points[0];
    const source = traces[point.curveNumber];
    if (!source || !source.kind) return null;
    if (source.kind === "selection") { // it lies over what it marks
      return source.mode === "markers" ? ["camera", placedEnds(selected)[point.pointNumber]] : selected;
    }
    return [source.kind, source.customdata[point.pointNumber]];
  };
  const listen = (target, find) => {
    target.on("plotly_hover", (event) => {
      const found = find(event);
      if (!found) return;
      if (found[0] === "text") showTooltip(found[1], found[2]);
      else if (found[0] === "camera") showTooltip(cameras.names[found[1]], cameraFacts(found[1]));
      else showTooltip(pairTitle(found[1]), pairFacts(found[1]));
    });
    target.on("plotly_unhover", hideTooltip);
    if (target !== plot) {
      target.on("plotly_click", (event) => {
        const found = find(event);
        if (found && found[0] !== "text") select(found[0], found[1], true, true);
      });
    }
    target.addEventListener("mouseleave", hideTooltip);
  };
  // Plotly tells of a click in 3D while it draws, if the button is still down then: it misses quick clicks, and
  // drawing the choice from within would start over without end. So the pointer itself is watched.
  const listenToPresses = () => {
    let [under, pressed] = [null, null];
    plot.on("plotly_hover", (event) => { under = customOf(event); });
    plot.on("plotly_unhover", () => { under = null; });
    plot.addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; }, true);
    plot.addEventListener("pointerup", (event) => {
      const still = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 4;
      if (still && under && event.button === 0) select(under[0], under[1], false, true);
    }, true);
  };
  const CONFIG = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["tableRotation", "resetCameraLastSave3d", "hoverClosest3d", "select2d", "lasso2d", "autoScale2d"] };
  const hasWebgl = () => {
    try {
      return Boolean(document.createElement("canvas").getContext("webgl"));
    } catch {
      return false;
    }
  };
  const drawScene = async () => {
    buildScene();
    $("scene-note").textContent = data.sceneNote;
    if (!hasWebgl()) {
      fill("scene", element("p", "This browser offers no WebGL, so the 3D view is left out. Tables and charts work.", "notice"));
      return;
    }
    drawLayerControls();
    await Plotly.newPlot(plot, traces, sceneLayout(), CONFIG);
    listen(plot, customOf);
    listenToPresses();
  };

  // --- selection ------------------------------------------------------------------------------------

  let selected = null; // "camera" or "pair", and its row
  const placedEnds = ([kind, k]) => (kind === "camera" ? [k] : [pairs.first[k], pairs.second[k]]).filter(isPlaced);
  const select = (kind, k, scroll = false, turn = false) => {
    selected = [kind, k];
    plot.dataset.selected = `${kind}:${k}`;
    if (kind === "camera") cameraTable.show(k);
    else pairTable.show(k);
    (kind === "camera" ? pairTable : cameraTable).clear();
    drawDetails();
    highlight(!turn || scroll);
    if (scroll) $("h-scene").scrollIntoView({ block: "start", behavior: "smooth" });
  };
  const highlight = (centered) => {
    if (!plot.data) return;
    const [kind, k] = selected;
    const ends = placedEnds(selected);
    const lines = frustumLines(ends);
    if (kind === "pair" && ends.length === 2) {
      const baseline = pairLines([k]);
      for (const c of ["x", "y", "z"]) lines[c].push(...baseline[c]);
    }
    const marks = ends.map((end) => at(cameras.center, end));
    const indices = [traces.length - 2, traces.length - 1];
    const coordinate = (c) => [
      lines["xyz"[c]].length ? lines["xyz"[c]] : [null], marks.length ? marks.map((p) => p[c]) : [null],
    ];
    const style = { x: coordinate(0), y: coordinate(1), z: coordinate(2) };
    const layout = {};
    if (centered && marks.length) {
      const middle = normal([0, 1, 2].map((c) => marks.reduce((sum, p) => sum + p[c], 0) / marks.length));
      const view = plot.layout.scene.camera;
      const keep = kind === "camera" ? 0.7 : 0.85; // of the distance, down to a limit
      const offset = ["x", "y", "z"].map((c) => view.eye[c] - view.center[c]);
      const distance = Math.hypot(...offset);
      const wanted = Math.min(distance, Math.max(distance * keep, 1.3 * Math.max(reach, 0.15)));
      const [x, y, z] = offset.map((v, c) => middle[c] + (v * wanted) / distance);
      layout["scene.camera"] = { up: view.up, center: { x: middle[0], y: middle[1], z: middle[2] }, eye: { x, y, z } };
    }
    Plotly.update(plot, style, layout, indices);
  };
  const drawDetails = () => {
    if (!selected) {
      fill("details", element("h3", "Nothing chosen"), element("p", "Click a camera or a pair in the scene, a row of a table or a mark of a chart. Drag turns the scene, the wheel zooms, the right button shifts.", "muted"));
      return;
    }
    const [kind, k] = selected;
    const list = element("dl");
    for (const [label, value] of known(kind === "camera" ? cameraFacts(k) : pairFacts(k))) {
      list.append(element("dt", label), element("dd", value));
    }
    const others = element("ul");
    const item = (verdict, text, note, action) => {
      const line = element("li");
      const dot = element("span", "", "dot");
      if (verdict !== null) {
        dot.style.background = `var(${VARIABLES[verdict]})`;
        dot.title = VERDICTS[verdict];
      }
      const button = element("button", text, "link");
      button.type = "button";
      button.onclick = action;
      line.append(dot, button, element("span", note, "number"));
      others.append(line);
    };
    if (kind === "pair") {
      for (const end of [pairs.first[k], pairs.second[k]]) item(null, cameras.names[end], "", () => select("camera", end));
      fill("details", element("h3", "Pair"), others, list);
      return;
    }
    const own = [];
    for (let p = 0; p < numPairs; p++) if (pairs.first[p] === k || pairs.second[p] === k) own.push(p);
    for (const p of own.slice(0, 60)) {
      const other = pairs.first[p] === k ? pairs.second[p] : pairs.first[p];
      const off = number(pairs.residual[p], 2);
      item(pairs.verdict[p], cameras.names[other], off && `${off}°`, () => select("pair", p));
    }
    const title = own.length > 60 ? `Its pairs, the worst 60 of ${count(own.length)}` : `Its pairs (${own.length})`;
    fill("details", element("h3", cameras.names[k]), list, element("h3", title), others);
  };

  // --- tables ---------------------------------------------------------------------------------------

  const makeTable = (id, kind, total, columns, text) => {
    let order = Array.from({ length: total }, (_, k) => k);
    let page = 0;
    let sorted = null;
    let chosen = null;
    const search = element("input");
    search.type = "search";
    search.placeholder = "Filter by name";
    search.setAttribute("aria-label", `Filter ${kind}s by name`);
    const back = element("button", "Back", "quiet");
    const next = element("button", "Next", "quiet");
    back.type = next.type = "button";
    const shown = element("span", "", "count");
    const tools = element("div", "", "tools");
    tools.append(search, shown, back, next);
    const table = element("table");
    const head = table.createTHead().insertRow();
    const body = table.createTBody();
    const headings = columns.map((column) => {
      const cell = element("th", "", column.number ? "number" : "");
      const button = element("button", column.title);
      button.type = "button";
      if (column.hint) button.title = column.hint;
      button.onclick = () => sortBy(column);
      cell.scope = "col";
      cell.append(button);
      head.append(cell);
      return cell;
    });
    const draw = () => {
      const first = page * ROWS_PER_PAGE;
      const rows = order.slice(first, first + ROWS_PER_PAGE).map((k) => {
        const row = element("tr");
        row.tabIndex = 0;
        row.dataset.row = k;
        row.setAttribute("aria-selected", String(k === chosen));
        for (const column of columns) row.append(column.cell(k));
        const choose = () => select(kind, k);
        row.onclick = choose;
        row.onkeydown = (event) => {
          if (event.key !== "Enter" && event.key !== " ") return;
          event.preventDefault();
          choose();
          body.querySelector(`[data-row="${k}"]`)?.focus();
        };
        return row;
      });
      body.replaceChildren(...rows);
      const last = Math.min(first + ROWS_PER_PAGE, order.length);
      shown.textContent = order.length ? `${count(first + 1)}–${count(last)} of ${count(order.length)}` : "none";
      back.disabled = page === 0;
      next.disabled = last >= order.length;
    };
    const sortBy = (column) => {
      const down = sorted && sorted.column === column ? !sorted.down : Boolean(column.number);
      sorted = { column, down };
      const sign = down ? -1 : 1;
      const compare = (a, b) => {
        const [u, v] = [column.value(a), column.value(b)];
        const [lostA, lostB] = [Number.isNaN(u), Number.isNaN(v)];
        if (lostA || lostB) return lostA - lostB || a - b;
        return u < v ? -sign : u > v ? sign : a - b;
      };
      order.sort(compare);
      headings.forEach((cell, c) => {
        if (columns[c] === column) cell.setAttribute("aria-sort", down ? "descending" : "ascending");
        else cell.removeAttribute("aria-sort");
      });
      page = 0;
      draw();
    };
    const filter = () => {
      const wanted = search.value.toLowerCase();
      order = [];
      for (let k = 0; k < total; k++) if (!wanted || text(k).toLowerCase().includes(wanted)) order.push(k);
      page = 0;
      if (sorted) {
        sorted.down = !sorted.down;
        sortBy(sorted.column);
      } else draw();
    };
    search.oninput = filter;
    back.onclick = () => { page -= 1; draw(); };
    next.onclick = () => { page += 1; draw(); };
    const scroll = element("div", "", "scroll");
    scroll.append(table);
    fill(id, tools, scroll);
    draw();
    return {
      show: (k) => {
        chosen = k;
        if (!order.includes(k)) {
          search.value = "";
          filter();
        }
        page = Math.floor(order.indexOf(k) / ROWS_PER_PAGE);
        draw();
      },
      clear: () => {
        chosen = null;
        draw();
      },
    };
  };
  const numeric = (title, value, digits, hint) => ({
    title, hint, number: true, value, cell: (k) => element("td", number(value(k), digits), "number"),
  });
  const textual = (title, value, className = "") => ({
    title, value, cell: (k) => element("td", value(k), className),
  });
  const verdictCell = (p) => {
    const cell = element("td", "", "verdict");
    const dot = element("span", "", "dot");
    dot.style.background = `var(${VARIABLES[pairs.verdict[p]]})`;
    cell.append(dot, ` ${VERDICTS[pairs.verdict[p]]}`);
    return cell;
  };
  let cameraTable;
  let pairTable;
  const drawTables = () => {
    // Rows arrive worst first: the cameras by trust, the pairs by verdict and residual.
    cameraTable = makeTable("cameras", "camera", numCameras, [
      textual("Camera", (k) => cameras.names[k], "name"),
      { title: "Placed", value: (k) => cameras.placed[k], cell: (k) => element("td", isPlaced(k) ? "yes" : "no") },
      numeric("Trust", (k) => cameras.trust[k], 2, "From 0 to 1; see the README"),
      numeric("Std. dev. (units)", (k) => cameras.sigma[k], 3, "Largest over the axes"),
      numeric("Pairs", (k) => cameras.degree[k], 6),
      numeric("Piece", (k) => (cameras.piece[k] < 0 ? NaN : cameras.piece[k]), 6),
      textual("Why", (k) => reason(cameras.reason[k]), "wide"),
    ], (k) => cameras.names[k]);
    pairTable = makeTable("pairs", "pair", numPairs, [
      textual("Camera 1", (p) => cameras.names[pairs.first[p]], "name"),
      textual("Camera 2", (p) => cameras.names[pairs.second[p]], "name"),
      { title: "Verdict", value: (p) => VERDICTS[pairs.verdict[p]], cell: verdictCell },
      numeric("Residual (°)", (p) => pairs.residual[p]),
      numeric("Matches", (p) => pairs.support[p], 9),
      numeric("Leverage", (p) => pairs.leverage[p], 2, "Share of its own fitted direction that it decides itself"),
      numeric("Weight", (p) => pairs.weight[p], 3),
      textual("Why", (p) => reason(pairs.reason[p]), "wide"),
    ], pairTitle);
    $("pairs-note").textContent = data.pairsNote;
  };

  // --- charts ---------------------------------------------------------------------------------------

  const charts = [];
  const chart = (id, make, find = null) => charts.push({ id, make, find });
  const layout = (extra) => {
    const base = { gridcolor: color("--grid"), linecolor: color("--line"), zerolinecolor: color("--line"), automargin: true };
    const { xaxis = {}, yaxis = {}, ...rest } = extra;
    return {
      margin: { l: 60, r: 12, t: 8, b: 48 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: color("--ink"), size: 12, family: getComputedStyle(document.body).fontFamily },
      hovermode: "closest", legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, bargap: 0.05,
      xaxis: { ...base, ...xaxis }, yaxis: { ...base, ...yaxis }, ...rest,
    };
  };
  const title = (text) => ({ text });

  chart("histogram", () => {
    const { edges, counts } = data.histogram;
    const colors = { input: color("--nodirection"), optimum: color("--undetermined"), output: color("--agrees") };
    const made = Object.entries(counts).map(([state, values]) => ({
      type: "scatter", mode: "lines", line: { shape: "hv", width: 2, color: colors[state] }, name: STATES[state],
      x: edges, y: [...values, values[values.length - 1]], hoverinfo: "none",
      fill: state === "output" ? "tozeroy" : "none",
    }));
    return [made, layout({
      xaxis: { type: "log", title: title("residual (degrees)"), dtick: 1 }, yaxis: { title: title("pairs"), rangemode: "tozero" },
    })];
  }, (event) => {
    const { edges, counts } = data.histogram;
    const k = Math.min(event.points[0].pointNumber, edges.length - 2);
    return ["text", `${number(edges[k])}° to ${number(edges[k + 1])}°`, Object.keys(counts).map((s) => [STATES[s], count(counts[s][k])])];
  });

  const worst = data.trustOrder;
  chart("trust", () => [[{
    type: "bar", x: Array.from(worst, (_, rank) => rank + 1), y: Array.from(worst, (k) => cameras.trust[k]), hoverinfo: "none",
    marker: { color: Array.from(worst, (k) => cameras.trust[k]), colorscale: RAMP, cmin: 0, cmax: 1, line: { width: 0 } },
  }], layout({ xaxis: { title: title("cameras, worst first") }, yaxis: { title: title("trust"), range: [0, 1.02] }, bargap: worst.length > 150 ? 0 : 0.15 })],
  (event) => ["camera", worst[event.points[0].pointNumber]]);

  chart("matrix", () => {
    const { cells, side, perCell } = data.matrix;
    const z = Array.from({ length: side }, (_, r) => Array.from(cells.subarray(r * side, (r + 1) * side), (v) => (Number.isNaN(v) ? null : v)));
    const steps = [color("--agrees"), color("--undetermined"), color("--nodirection"), color("--contradicts")];
    const discrete = steps.flatMap((shade, k) => [[k / 4, shade], [(k + 1) / 4, shade]]);
    const scale = perCell === 1
      ? { colorscale: discrete, zmin: 0.5, zmax: 4.5, showscale: false }
      : { colorscale: [[0, color("--agrees")], [0.5, color("--undetermined")], [1, color("--contradicts")]], zmin: 0, zmax: 1, colorbar: { thickness: 10, title: title("share"), outlinewidth: 0 } };
    const where = Array.from({ length: side }, (_, r) => r * perCell + (perCell + 1) / 2);
    return [[{ type: "heatmap", x: where, y: where, z, hoverinfo: "none", xgap: side <= 60 ? 1 : 0, ygap: side <= 60 ? 1 : 0, ...scale }], layout({
      xaxis: { title: title("camera, in the order of cameras.csv"), constrain: "domain", showgrid: false, zeroline: false },
      yaxis: { title: title("camera"), autorange: "reversed", scaleanchor: "x", constrain: "domain", showgrid: false, zeroline: false },
    })];
  }, (event) => {
    const { perCell, counts, cells, side, rowOf, pairOf } = data.matrix;
    const [r, c] = event.points[0].pointNumber;
    if (perCell === 1) {
      const [a, b] = [rowOf[r], rowOf[c]];
      const p = pairOf.get(a < b ? `${a} ${b}` : `${b} ${a}`);
      if (p !== undefined) return ["pair", p];
      return ["text", `${cameras.names[a]} – ${cameras.names[b]}`, [["pair", "see pairs.csv"]]];
    }
    const range = (k) => `${k * perCell + 1} to ${Math.min((k + 1) * perCell, numCameras)}`;
    const k = r * side + c;
    return ["text", `Cameras ${range(r)} with ${range(c)}`, [["pairs", count(counts[k])], ["contradict", `${number(100 * cells[k], 2)} %`]]];
  });

  chart("support", () => {
    const made = [0, 2, 1].flatMap((code) => {
      const chosen = [];
      for (let p = 0; p < numPairs; p++) if (pairs.verdict[p] === code && pairs.residual[p] > 0) chosen.push(p);
      if (!chosen.length) return [];
      return [{
        type: numPairs > 3000 ? "scattergl" : "scatter", mode: "markers", name: VERDICTS[code], customdata: chosen, hoverinfo: "none",
        x: chosen.map((p) => Math.max(pairs.support[p], 0.8)), y: chosen.map((p) => Math.max(pairs.residual[p], 1e-6)),
        marker: { size: 5, opacity: 0.6, color: color(VARIABLES[code]), line: { width: 0 } },
      }];
    });
    return [made, layout({ xaxis: { type: "log", title: title("inlier matches") }, yaxis: { type: "log", title: title("residual (degrees)"), exponentformat: "power" } })];
  }, (event) => ["pair", event.points[0].customdata]);

  chart("convergence", () => {
    const { iterations, objectives, bounds } = data.convergence;
    const made = [{ type: "scatter", mode: "lines+markers", name: "objective", x: iterations, y: objectives, line: { color: color("--agrees"), width: 2 }, marker: { size: 5 }, hoverinfo: "none" }];
    if (bounds.some((b) => b !== null)) {
      made.push({ type: "scatter", mode: "lines+markers", name: "lower bound", x: iterations, y: bounds, line: { color: color("--undetermined"), width: 2, dash: "dot" }, marker: { size: 5 }, hoverinfo: "none" });
    }
    return [made, layout({ xaxis: { title: title("iteration") }, yaxis: { title: title("objective"), ...(data.convergence.range ? { range: data.convergence.range } : {}) } })];
  }, (event) => {
    const { iterations, objectives, bounds } = data.convergence;
    const k = event.points[0].pointNumber;
    const bound = bounds[k] === null ? [] : [["bound", number(bounds[k], 6)], ["gap", number(objectives[k] - bounds[k], 2)]];
    return ["text", `Iteration ${iterations[k]}`, [["objective", number(objectives[k], 6)], ...bound]];
  });

  const isEmpty = {
    histogram: () => !Object.keys(data.histogram.counts).length,
    support: () => !data.hasSupport,
    convergence: () => !data.convergence.iterations.length,
    trust: () => !worst.length,
    matrix: () => !numPairs,
  };
  const drawChart = async ({ id, make, find }) => {
    $(`${id}-note`).textContent = data.notes[id];
    if (isEmpty[id]()) {
      $(id).hidden = true;
      return;
    }
    const first = !$(id).data;
    const [made, form] = make();
    await Plotly.react($(id), made, form, { ...CONFIG, displayModeBar: false });
    if (first && find) listen($(id), find);
  };
  const prepareMatrix = () => {
    const { matrix } = data;
    matrix.pairOf = new Map();
    if (matrix.perCell === 1) for (let p = 0; p < numPairs; p++) {
      const [a, b] = [pairs.first[p], pairs.second[p]];
      matrix.pairOf.set(a < b ? `${a} ${b}` : `${b} ${a}`, p);
    }
  };

  // --- the rest -------------------------------------------------------------------------------------

  const drawPieces = () => {
    const table = element("table");
    const head = table.createTHead().insertRow();
    for (const name of ["Piece", "Cameras", "Placed", "Hinges", "Scale", "Where"]) head.append(element("th", name));
    const body = table.createTBody();
    data.pieces.forEach((piece) => {
      const row = body.insertRow();
      row.append(element("td", String(piece.number)), element("td", count(piece.cameras)), element("td", count(piece.placed)), element("td", piece.hinges || "none"), element("td", piece.scale), element("td", piece.folder === "." ? "this folder" : piece.folder || "not written"));
    });
    const scroll = element("div", "", "scroll");
    scroll.append(table);
    fill("pieces", scroll);
    $("pieces-note").textContent = data.notes.pieces;
    for (const id of ["timings", "options", "versions"]) fill(id, factTable(data[id]));
  };
  const recolor = () => {
    if (plot.data) {
      const style = LAYERS.filter((layer) => layer.variable);
      const cloud = LAYERS.find((layer) => layer.name === "points");
      if (cloud) Plotly.restyle(plot, { "marker.color": [pointColors()] }, cloud.indices);
      for (const layer of style) Plotly.restyle(plot, { "line.color": color(layer.variable) }, layer.indices);
      Plotly.update(plot, { "line.color": color("--chosen"), "marker.color": color("--chosen"), "marker.line.color": color("--chosen") }, { paper_bgcolor: color("--card"), "scene.bgcolor": color("--card") }, [traces.length - 2, traces.length - 1]);
    }
    charts.forEach(drawChart);
  };
  $("theme").onclick = () => {
    const dark = document.documentElement.dataset.theme
      ? document.documentElement.dataset.theme === "dark"
      : matchMedia("(prefers-color-scheme: dark)").matches;
    document.documentElement.dataset.theme = dark ? "light" : "dark";
    recolor();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);

  drawSummary();
  drawTables();
  drawDetails();
  drawPieces();
  prepareMatrix();
  // The charts wait for the scene, each for a pause, so that the page answers from the start.
  (async () => {
    await drawScene();
    for (const item of charts) {
      await new Promise((resume) => setTimeout(resume));
      await drawChart(item);
    }
    document.documentElement.dataset.ready = "yes";
  })();
})();
