// The charts, as plain SVG: they follow the theme by themselves, print, and have names of cameras as text.

let WIDTH = 560; // of the column that they stand in
const niceStep = (span, most) => {
  const power = 10 ** Math.floor(Math.log10(span / most));
  return [1, 2, 5, 10].map((part) => part * power).find((step) => span / step <= most);
};
// A scale maps values to pixels; its ticks are values with their text.
const linear = (low, high, from, to) => {
  const place = (value) => from + ((value - low) / (high - low || 1)) * (to - from);
  const step = niceStep(high - low || 1, 5);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    ticks.push([k * step, count(Number((k * step).toPrecision(6)))]);
  }
  return { place, ticks };
};
const logarithmic = (low, high, from, to, unit = "") => {
  const first = Math.floor(Math.log10(low) + 1e-9);
  const powers = Math.ceil(Math.log10(high) - 1e-9);
  const last = unit === "°" ? Math.min(powers, Math.log10(180)) : powers; // no angle is larger
  const place = (value) => from + ((Math.log10(value) - first) / (last - first || 1)) * (to - from);
  const value = (where) => 10 ** (first + ((where - from) / (to - from)) * (last - first || 1));
  const every = last - first > 7 ? 2 : 1;
  const ticks = [];
  for (let power = first; power <= last; power += every) {
    const text = power < -4 || power > 4 ? `1e${power}` : power < 0 ? (10 ** power).toFixed(-power) : count(10 ** power);
    ticks.push([10 ** power, text + unit]);
  }
  return { place, ticks, value };
};
const chart = (height, label) => shape("svg", { viewBox: `0 0 ${WIDTH} ${height}`, role: "img", "aria-label": label });
const drawAxes = (svg, box, x, y, titles) => {
  for (const [value, text] of y.ticks) {
    const where = y.place(value);
    svg.append(shape("line", { x1: box.left, x2: box.right, y1: where, y2: where, class: "grid" }));
    svg.append(shape("text", { x: box.left - 6, y: where + 4, "text-anchor": "end" }, text));
  }
  for (const [value, text] of x.ticks) {
    const where = x.place(value);
    svg.append(shape("line", { x1: where, x2: where, y1: box.bottom, y2: box.bottom + 4, class: "tick" }));
    svg.append(shape("text", { x: where, y: box.bottom + 17, "text-anchor": "middle" }, text));
  }
  svg.append(shape("line", { x1: box.left, x2: box.right, y1: box.bottom, y2: box.bottom, class: "tick" }));
  svg.append(shape("text", { x: (box.left + box.right) / 2, y: box.bottom + 35, "text-anchor": "middle", class: "title" }, titles[0]));
  const middle = (box.top + box.bottom) / 2;
  svg.append(shape("text", { x: 12, y: middle, transform: `rotate(-90 12 ${middle})`, "text-anchor": "middle", class: "title" }, titles[1]));
};
// Entries [text, paint] of a key in rows that fit the width, and what the rows below the first one take.
const layOutKey = (entries) => {
  let [x, y] = [60, 0];
  const places = entries.map(([text, paint]) => {
    const width = 34 + 6.2 * text.length;
    if (x > 60 && x + width - 15 > WIDTH) [x, y] = [60, y + 16];
    x += width;
    return { text, paint, x: x - width, y };
  });
  return { places, more: y };
};
const drawKey = (svg, { places }) => {
  for (const { text, paint, x, y } of places) {
    svg.append(shape("rect", { x, y: y + 4, width: 14, height: 4, rx: 2, fill: paint }));
    svg.append(shape("text", { x: x + 19, y: y + 10 }, text));
  }
};
// What lies at a place of the chart, in its own coordinates, is told, and chosen by a press.
const listen = (svg, find, onChoice) => {
  const found = (event) => {
    const { left, top, width } = svg.getBoundingClientRect();
    const ratio = WIDTH / width;
    return find((event.clientX - left) * ratio, (event.clientY - top) * ratio);
  };
  svg.addEventListener("pointermove", (event) => {
    const item = found(event);
    svg.style.cursor = item && item[0] !== "text" ? "pointer" : "";
    tell(event, item);
  });
  svg.addEventListener("pointerleave", hideTooltip);
  svg.addEventListener("click", (event) => {
    const item = found(event);
    if (item && item[0] !== "text") onChoice(...item);
  });
};

const STATES = { input: "at the input's positions", optimum: "at the solver's optimum", output: "as delivered" };
const drawHistogram = () => {
  const { edges, counts } = data.histogram;
  const states = Object.keys(counts);
  if (!states.length) return null;
  const paint = { input: "var(--nodirection)", optimum: "var(--undetermined)", output: "var(--agrees)" };
  const key = layOutKey(states.map((state) => [STATES[state], paint[state]]));
  const box = { left: 56, right: WIDTH - 16, top: 24 + key.more, bottom: 226 + key.more };
  const svg = chart(270 + key.more, "Errors of the pairs");
  let [first, last] = [edges.length, 0];
  for (const values of Object.values(counts)) {
    values.forEach((value, k) => { if (value) [first, last] = [Math.min(first, k), Math.max(last, k + 1)]; });
  }
  const top = Math.max(...Object.values(counts).flat());
  const x = logarithmic(edges[first], edges[last], box.left, box.right, "°");
  const y = linear(0, top, box.bottom, box.top);
  drawAxes(svg, box, x, y, ["error, log scale", "pairs"]);
  for (const state of states) {
    let path = `M${x.place(edges[first])} ${box.bottom}`;
    for (let k = first; k < last; k++) path += `V${y.place(counts[state][k])}H${x.place(edges[k + 1])}`;
    svg.append(shape("path", {
      d: `${path}V${box.bottom}`, class: state === "output" ? "area" : "line", stroke: paint[state], fill: state === "output" ? paint[state] : "none",
    }));
  }
  drawKey(svg, key);
  listen(svg, (u) => {
    const k = edges.findIndex((edge, i) => i < edges.length - 1 && x.place(edge) <= u && u < x.place(edges[i + 1]));
    if (k < first || k >= last) return null;
    return ["text", `${number(edges[k])}° to ${number(edges[k + 1])}°`, states.map((s) => [STATES[s], counted(counts[s][k], "pair")])];
  });
  return svg;
};

const drawBars = (name, title, label) => {
  if (!data[name]) return null;
  const { counts, texts, ticks } = data[name];
  const [svg, box] = [chart(220, title), { left: 64, right: WIDTH - 16, top: 10, bottom: 176 }];
  const width = (box.right - box.left) / counts.length;
  const x = { place: (value) => box.left + value * width, ticks };
  const y = linear(0, Math.max(...counts), box.bottom, box.top);
  drawAxes(svg, box, x, y, [label, "3D points"]);
  counts.forEach((value, k) => {
    const top = y.place(value);
    svg.append(shape("rect", { x: x.place(k) + 1, y: top, width: width - 2, height: box.bottom - top, fill: "var(--agrees)" }));
  });
  listen(svg, (u) => {
    const k = Math.floor((u - box.left) / width);
    return k in counts ? ["text", texts[k], [["3D points", count(counts[k])]]] : null;
  });
  return svg;
};

const LEAST_TRUSTED = 12;
const drawTrust = (onChoice) => {
  const shown = [];
  for (let k = 0; k < numCameras && shown.length < LEAST_TRUSTED; k++) if (cameras.trust[k] < data.highTrust) shown.push(k);
  if (!shown.length) return null;
  const [row, left] = [22, Math.min(230, 0.45 * WIDTH)];
  const svg = chart(28 + row * shown.length, "The least trusted cameras");
  const x = linear(0, 1, left, WIDTH - 40);
  shown.forEach((k, place) => {
    const y = 6 + row * place;
    const [r, g, b] = ramp(TRUST_RAMP, cameras.trust[k]);
    svg.append(shape("text", { x: left - 8, y: y + 13, "text-anchor": "end" }, middleOfName(cameras.names[k], Math.floor(left / 7.4))));
    svg.append(shape("rect", { x: left, y, width: x.place(cameras.trust[k]) - left, height: row - 6, rx: 2, fill: `rgb(${r},${g},${b})` }));
    svg.append(shape("text", { x: x.place(cameras.trust[k]) + 6, y: y + 13 }, number(cameras.trust[k], 2)));
  });
  const bottom = 6 + row * shown.length;
  for (const [value, text] of [[data.minTrust, number(data.minTrust, 2)], [1, "1"]]) {
    const where = x.place(value);
    svg.append(shape("line", { x1: where, x2: where, y1: 0, y2: bottom, class: "mark" }));
    const [anchor, words] = value < 1 ? ["end", `${text}: left out below`] : ["middle", text];
    svg.append(shape("text", { x: where, y: bottom + 14, "text-anchor": anchor }, words));
  }
  listen(svg, (u, v) => {
    const place = Math.floor((v - 3) / row);
    return place in shown ? ["camera", shown[place]] : null;
  }, onChoice);
  return svg;
};

// Cells of a single camera each have the color of their pair, the stronger the more matches fit it.
const STRENGTHS = [0.25, 0.5, 0.75, 1];
const drawMatrix = (onChoice) => {
  const { side, perCell, against, counts, rowOf } = data.matrix;
  if (!numPairs) return null;
  const pairIn = new Map();
  if (perCell === 1) {
    const places = new Map(Array.from(rowOf, (k, r) => [k, r]));
    for (let p = 0; p < numPairs; p++) {
      const [a, b] = [places.get(pairs.first[p]), places.get(pairs.second[p])];
      pairIn.set(a * side + b, p).set(b * side + a, p);
    }
  }
  const isEmpty = (k) => (perCell === 1 ? !pairIn.has(k) : counts[k] === 0);
  const [fewest, most] = [quantile(pairs.support, 0), quantile(pairs.support, 1)].map((value) => Math.log1p(value));
  const strength = (p) => STRENGTHS[Math.floor(3.99 * (most > fewest ? (Math.log1p(pairs.support[p]) - fewest) / (most - fewest) : 1))];
  const [left, top] = [104, 8];
  const size = Math.min((WIDTH - left - 8) / side, 40);
  const bottom = top + side * size;
  const named = Array.from(rowOf, (k) => middleOfName(cameras.names[k], 17));
  const longest = named.reduce((most, name) => Math.max(most, name.length), 0);
  const svg = chart(bottom + 12 + 5.4 * longest, "Which cameras are paired");
  const gap = size > 6 ? 0.8 : 0;
  const paths = new Map();
  for (let r = 0; r < side; r++) {
    for (let c = 0; c < side; c++) {
      const k = r * side + c;
      if (isEmpty(k)) continue;
      const p = pairIn.get(k);
      const share = Math.ceil((5 * against?.[k]) / counts?.[k]);
      const look = p === undefined ? `color-mix(in srgb, var(--contradicts) ${20 * share}%, var(--agrees))|1` : `var(${VARIABLES[pairs.verdict[p]]})|${strength(p)}`;
      const d = size - gap;
      if (!paths.has(look)) paths.set(look, []);
      paths.get(look).push(`M${(left + c * size).toFixed(2)} ${(top + r * size).toFixed(2)}h${d.toFixed(2)}v${d.toFixed(2)}h-${d.toFixed(2)}z`);
    }
  }
  for (const [look, path] of paths) {
    const [fill, opacity] = look.split("|");
    svg.append(shape("path", { d: path.join(""), fill, "fill-opacity": opacity }));
  }
  svg.append(shape("rect", { x: left, y: top, width: side * size, height: bottom - top, class: "frame" }));
  // Names, as many as are readable.
  const every = Math.max(Math.ceil(12 / size), 1);
  for (let k = 0; k < side; k += every) {
    const name = named[k * perCell];
    const where = (k + 0.5) * size;
    svg.append(shape("text", { x: left - 5, y: top + where + 3.5, "text-anchor": "end", class: "small" }, name));
    const [x, y] = [left + where + 3.5, bottom + 6];
    svg.append(shape("text", { x, y, transform: `rotate(-90 ${x} ${y})`, "text-anchor": "end", class: "small" }, name));
  }
  listen(svg, (u, v) => {
    const [r, c] = [Math.floor((v - top) / size), Math.floor((u - left) / size)];
    if (!(r >= 0 && r < side && c >= 0 && c < side) || isEmpty(r * side + c)) return null;
    if (perCell === 1) return ["pair", pairIn.get(r * side + c)];
    const range = (k) => `${cameras.names[rowOf[k * perCell]]} to ${cameras.names[rowOf[Math.min((k + 1) * perCell, numCameras) - 1]]}`;
    const share = ["contradict", `${number((100 * against[r * side + c]) / counts[r * side + c], 2)} %`];
    return ["text", `${range(r)}\nwith ${range(c)}`, [["pairs", count(counts[r * side + c])], share]];
  }, onChoice);
  return svg;
};

const drawSupport = (onChoice) => {
  const shown = [];
  for (let p = 0; p < numPairs; p++) if (pairs.residual[p] > 0 && pairs.support[p] > 0) shown.push(p);
  if (!shown.length) return null;
  const told = [0, 1, 2].filter((v) => shown.some((p) => pairs.verdict[p] === v));
  const key = layOutKey(told.map((v) => [VERDICTS[v], `var(${VARIABLES[v]})`]));
  const box = { left: 64, right: WIDTH - 24, top: 24 + key.more, bottom: 286 + key.more };
  const svg = chart(330 + key.more, "Matches against error");
  const least = 10 ** -5;
  const [xs, ys] = [shown.map((p) => pairs.support[p]), shown.map((p) => Math.max(pairs.residual[p], least))];
  const limits = (values) => values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, 0]);
  const x = logarithmic(...limits(xs), box.left, box.right);
  const y = logarithmic(...limits(ys), box.bottom, box.top, "°");
  drawAxes(svg, box, x, y, ["matches that fit the pair", "error, log scale"]);
  const places = shown.map((_, k) => [x.place(xs[k]), y.place(ys[k])]);
  for (const verdict of [0, 2, 1]) {
    const path = places.filter((_, k) => pairs.verdict[shown[k]] === verdict).map(([u, v]) => `M${u.toFixed(1)} ${v.toFixed(1)}h.01`);
    if (path.length) svg.append(shape("path", { d: path.join(""), class: "dots", stroke: `var(${VARIABLES[verdict]})` }));
  }
  drawKey(svg, key);
  listen(svg, (u, v) => {
    let [best, nearest] = [null, 10];
    places.forEach(([a, b], k) => {
      const away = Math.hypot(a - u, b - v);
      if (away < nearest) [best, nearest] = [shown[k], away];
    });
    return best === null ? null : ["pair", best];
  }, onChoice);
  return svg;
};

const drawConvergence = () => {
  const { iterations, objectives, bounds, range } = data.convergence;
  if (!iterations.length || !range) return null;
  const [svg, box] = [chart(250, "Convergence"), { left: 74, right: WIDTH - 12, top: 24, bottom: 206 }];
  const x = linear(Math.min(...iterations), Math.max(...iterations), box.left, box.right);
  const y = linear(...range, box.bottom, box.top);
  drawAxes(svg, box, x, y, ["iteration", "objective"]);
  const line = (values, paint, dash) => {
    const inside = values.map((value, k) => [iterations[k], value]).filter(([, v]) => v !== null && v >= range[0] && v <= range[1]);
    const path = inside.map(([k, v], place) => `${place ? "L" : "M"}${x.place(k)} ${y.place(v)}`).join("");
    if (path) svg.append(shape("path", { d: path, class: "line", stroke: paint, "stroke-dasharray": dash, fill: "none" }));
  };
  line(objectives, "var(--agrees)", "");
  line(bounds, "var(--undetermined)", "3 3");
  const hasBound = bounds.some((bound) => bound !== null);
  drawKey(svg, layOutKey([["objective", "var(--agrees)"], ...(hasBound ? [["lower bound", "var(--undetermined)"]] : [])]));
  listen(svg, (u) => {
    const near = iterations.map((k) => Math.abs(x.place(k) - u));
    const k = near.indexOf(Math.min(...near));
    const bound = bounds[k] === null ? [] : [["bound", number(bounds[k], 6)], ["gap", number(objectives[k] - bounds[k], 2)]];
    return ["text", `Iteration ${iterations[k]}`, [["objective", number(objectives[k], 6)], ...bound]];
  });
  return svg;
};

const BETWEEN = 12;
const widthOfColumn = () => {
  const { columnCount } = getComputedStyle($("more"));
  const columns = Number(columnCount) || 1;
  return Math.max(Math.min(($("more").clientWidth - BETWEEN * (columns - 1)) / columns - 34, 760), 280);
};

// Mean residuals over the picture of a lens, as arrows whose scale is written below.
const drawField = ({ aspect, places, means }) => {
  const [left, top] = [8, 8];
  const width = Math.min(WIDTH - 2 * left, 400, 300 * aspect);
  const height = width / aspect;
  const [all, down] = [width + 2 * left, height + top + 30];
  const svg = shape("svg", { viewBox: `0 0 ${all} ${down}`, role: "img", "aria-label": "Mean residuals over the picture" });
  svg.style.maxWidth = `${all}px`;
  const total = means.length / 2;
  const lengths = Array.from({ length: total }, (_, k) => Math.hypot(means[2 * k], means[2 * k + 1]));
  const longest = quantile(lengths, 0.95) || 1;
  const scale = (1.2 * Math.sqrt((width * height) / total)) / longest;
  let path = "";
  lengths.forEach((length, k) => {
    const [x, y] = [left + width * places[2 * k], top + height * places[2 * k + 1]];
    const [u, v] = [scale * means[2 * k], scale * means[2 * k + 1]];
    const [p, q] = [0.3 * u, 0.3 * v]; // the head turns back at either side
    path += `M${x.toFixed(1)} ${y.toFixed(1)}l${u.toFixed(1)} ${v.toFixed(1)}m${(-p - q / 2).toFixed(1)} ${(-q + p / 2).toFixed(1)}L${(x + u).toFixed(1)} ${(y + v).toFixed(1)}l${(-p + q / 2).toFixed(1)} ${(-q - p / 2).toFixed(1)}`;
  });
  svg.append(shape("rect", { x: left, y: top, width, height, class: "frame" }), shape("path", { d: path, class: "arrows" }));
  const said = 10 ** Math.floor(Math.log10(longest));
  const length = said * [1, 2, 5].filter((part) => part * said <= longest).pop();
  const y = top + height + 18;
  svg.append(shape("line", { x1: left, x2: left + scale * length, y1: y, y2: y, class: "scale" }));
  svg.append(shape("text", { x: left + scale * length + 8, y: y + 4 }, `${number(length)} px`));
  return svg;
};
const drawFields = () => {
  $("fields-card").hidden = !data.fields.length;
  fill("fields", ...data.fields.map((field) => {
    const made = element("div", "", "field");
    made.append(element("h4", field.label), drawField(field), element("p", field.statement));
    return made;
  }));
};
const drawCharts = (onChoice) => {
  WIDTH = widthOfColumn();
  drawFields();
  const made = {
    trust: drawTrust, histogram: drawHistogram,
    tracks: () => drawBars("tracks", "Track lengths", "images that see a point"),
    reprojection: () => drawBars("reprojection", "Reprojection errors", "mean error of a point, px"),
    matrix: drawMatrix, support: drawSupport, convergence: drawConvergence,
  };
  for (const [id, draw] of Object.entries(made)) {
    $(`${id}-note`).textContent = data.notes[id];
    const svg = draw(onChoice);
    if (svg) fill(id, svg);
    else $(id).hidden = true;
    $(id).closest("section").hidden = !svg && !data.notes[id];
  }
};
// Their texts keep their size when the window changes its own.
const watchWidth = (onChoice) => {
  new ResizeObserver(() => {
    if (Math.abs(widthOfColumn() - WIDTH) > 20) drawCharts(onChoice);
  }).observe($("more"));
};
