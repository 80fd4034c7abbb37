// What the scene shows of this result: layers, colors, sizes, what a press chooses, and flights to it.

const MANY_PAIRS = 200; // with more, agreeing pairs are not drawn until asked for
const MANY_WITHOUT_POINTS = 1000; // where they hide nothing
const MANY_WRONG = 100; // contradicting pairs, long lines across the scene
const MANY_SET_ASIDE = 20; // the same where the verdict is good
const MANY_REJECTED = 20;
const MOST_PAIRS = 4000;
const FAR_DEG = 1; // pairs that contradict by less are not drawn either
const PICK_CAMERA_PX = 11;
const PICK_PAIR_PX = 5;
const LEAST_ON_DARK = 120; // brightest channel of a point on a dark ground, of 255; the ground has 47
const SLOW_FRAME_MS = 50;
const REST_MS = 200; // the scene rests so long after the last move, and the time of two frames
const COARSEST = 3; // levels of detail while the scene moves
const SHARES = [1, 1, 0.25, 0.06]; // of points and pairs, by level
const MOST_AWAY = 3; // distance of the first view over that from which the cameras alone fill it
const LEAST_FRUSTUM_PX = 12; // at first sight, frusta are at least so deep,
const FRUSTUM_STEPS = 2.5; // but not more than so many times as far as the next camera is

const makeScene = (onChoice) => {
  const canvas = $("canvas");
  const painter = makePainter(canvas);
  if (!painter) return null;
  const eye = makeEye(canvas);
  const { view } = eye;
  const modes = colorModes();
  const placed = Array.from(cameras.names.keys()).filter(isPlaced);
  const ghosts = Array.from(cameras.names.keys()).filter((k) => Number.isFinite(cameras.ghost[3 * k]));
  const elsewhere = placed.filter((k) => Number.isFinite(cameras.other[3 * k]));
  const positionOf = (k) => at(isPlaced(k) ? cameras.center : cameras.ghost, k);
  const hasPose = (k) => Number.isFinite(cameras.frusta[9 * k]);
  const hasPosition = (k) => Number.isFinite(positionOf(k)[0]);
  const hasFrusta = placed.some(hasPose);
  // Few points are drawn larger.
  const density = Math.min(Math.max(Math.sqrt(6000 / (points.positions.length / 3 || 1)), 1), 1.7);
  const sizes = { frustum: data.frustum, point: density, ellipsoid: 1 };
  let mode = modes[0];
  let selected = null;
  let pictures = null;

  // --- things to be drawn ---

  // An order in which any first part is spread evenly over the whole.
  const spread = (total) => {
    let step = Math.max(Math.round(0.618 * total), 1);
    const common = (a, b) => (b ? common(b, a % b) : a);
    while (common(step, total) > 1) step += 1;
    return Array.from({ length: total }, (_, k) => (k * step) % total);
  };
  const gather = (chosen, values, width) => {
    const found = new values.constructor(width * chosen.length);
    chosen.forEach((k, row) => found.set(values.subarray(width * k, width * (k + 1)), width * row));
    return found;
  };
  // Three vectors per camera, nine numbers, as u, v and w.
  const vectorsOf = (chosen, values) => {
    const [u, v, w] = [0, 3, 6].map((first) => {
      const found = new Float32Array(3 * chosen.length);
      chosen.forEach((k, row) => found.set(values.subarray(9 * k + first, 9 * k + first + 3), 3 * row));
      return found;
    });
    return { u, v, w };
  };
  const frustumColumns = (chosen) => {
    return { center: new Float32Array(chosen.flatMap(positionOf)), ...vectorsOf(chosen, cameras.frusta) };
  };
  const cameraColors = (chosen) => {
    const gray = rgbOf("--nodirection").map((part) => Math.round(255 * part));
    const found = new Uint8Array(4 * chosen.length);
    chosen.forEach((k, row) => found.set([...(mode.color(k) || gray), 255], 4 * row));
    return found;
  };
  const pairColumns = (chosen) => {
    const [center, u] = [new Float32Array(3 * chosen.length), new Float32Array(3 * chosen.length)];
    chosen.forEach((p, row) => {
      for (let c = 0; c < 3; c++) {
        center[3 * row + c] = cameras.center[3 * pairs.first[p] + c];
        u[3 * row + c] = cameras.center[3 * pairs.second[p] + c] - center[3 * row + c];
      }
    });
    return { center, u };
  };
  const shiftColumns = (chosen) => {
    const [center, u] = [gather(chosen, cameras.center, 3), gather(chosen, cameras.inputCenter, 3)];
    return { center, u: u.map((part, k) => part - center[k]) };
  };
  const ellipsoidColumns = (chosen) => ({ center: gather(chosen, cameras.center, 3), ...vectorsOf(chosen, cameras.ellipsoids) });
  // Light points would vanish on a light ground: theirs is always dark. On a dark ground, dark points are lifted.
  // Points without colors are gray.
  const pointOrder = spread(points.positions.length / 3);
  const isGray = points.colors.every((part) => part === 0);
  if (!isGray && quantile(points.colors, 0.5) >= 128) $("scene").dataset.ground = "dark";
  const pointColors = () => {
    const colors = gather(pointOrder, points.colors, 3);
    const gray = rgbOf("--soft").map((part) => 255 * part);
    const least = rgbOf("--ground")[0] < 0.5 ? LEAST_ON_DARK : 0;
    const found = new Uint8Array((4 * colors.length) / 3);
    for (let k = 0, to = 0; k < colors.length; k += 3, to += 4) {
      const lift = Math.max(least - Math.max(colors[k], colors[k + 1], colors[k + 2]), 0);
      for (let c = 0; c < 3; c++) {
        found[to + c] = isGray ? gray[c] : colors[k + c] + lift;
      }
      found[to + 3] = 255;
    }
    return found;
  };
  const withoutFar = (all, share) => {
    if (!all.length) return all;
    const center = [0, 1, 2].map((c) => quantile(all.map((p) => p[c]), 0.5));
    const away = all.map((p) => Math.hypot(...p.map((part, c) => part - center[c])));
    const limit = 3 * quantile(away, share);
    return all.filter((_, k) => away[k] <= limit);
  };
  // Cameras and points, without the few that are far out.
  const nearCameras = withoutFar(placed.map((k) => positionOf(k)), 0.75);
  // The first view may leave out more, so that a statue is seen although some photographs of it are from far away. On a
  // line, a ring or an area the farthest camera is at twice the median distance, or less.
  const mainCameras = (() => {
    const center = [0, 1, 2].map((c) => quantile(nearCameras.map((p) => p[c]), 0.5));
    const away = nearCameras.map((p) => Math.hypot(...p.map((part, c) => part - center[c])));
    const limit = Math.max(2.2 * quantile(away, 0.5), quantile(away, 0.7));
    return nearCameras.filter((_, k) => away[k] <= limit);
  })();
  const nearPoints = (() => {
    const all = [];
    const step = Math.max(Math.floor(points.positions.length / 3 / 4000), 1);
    for (let k = 0; k < points.positions.length / 3; k += step) all.push(at(points.positions, k));
    return withoutFar(all, 0.5); // points have longer tails: what is far behind a scene would make it a dot
  })();
  const robust = [...nearCameras, ...nearPoints, ...(nearCameras.length ? [] : [[0, 0, 0]])];
  const bounds = [0, 1, 2].map((c) => {
    const [all, near] = [robust, nearCameras].map((some) => some.map((p) => p[c]));
    return [Math.min(quantile(all, 0.03), ...near), Math.max(quantile(all, 0.97), ...near)];
  });
  const middle = bounds.map(([low, high]) => (low + high) / 2);
  const radius = Math.max(Math.hypot(...bounds.map(([low, high]) => high - low)) / 2, 2 * data.frustum, 1e-9);
  const reach = (() => {
    let far = radius;
    for (const values of [points.positions, cameras.center]) {
      for (let k = 0; k < values.length; k += 3) {
        const away = Math.hypot(values[k] - middle[0], values[k + 1] - middle[1], values[k + 2] - middle[2]);
        if (away > far) far = away;
      }
    }
    return far;
  })();
  view.far = 2.5 * reach;

  const grid = (() => {
    const rough = radius / 4;
    const power = 10 ** Math.floor(Math.log10(rough));
    const square = power * [1, 2, 5, 10].filter((part) => part * power <= rough).pop();
    const floor = data.dimension === 2 ? 0 : quantile(robust.map((p) => p[2]), 0.02);
    const [center, u] = [[], []];
    const [low, high] = [0, 1].map((side) => [0, 1].map((c) => {
      const out = middle[c] + (side ? 1 : -1) * 1.1 * radius;
      return square * (side ? Math.ceil(out / square) : Math.floor(out / square));
    }));
    for (let c = 0; c < 2; c++) {
      for (let where = low[c]; where <= high[c] + square / 2; where += square) {
        const [start, along] = [[low[0], low[1], floor], [0, 0, 0]];
        start[c] = where;
        along[1 - c] = high[1 - c] - low[1 - c];
        center.push(...start);
        u.push(...along);
      }
    }
    return { square, columns: { center: new Float32Array(center), u: new Float32Array(u) } };
  })();

  // A layer: its label, whether it is shown, and how it is drawn; pairs have their verdict's color.
  const layers = [];
  const addLayer = (name, label, shown, extra) => layers.push({ name, label, shown, ...extra });
  addLayer("cameras", `${hasFrusta ? "Cameras" : "Nodes"} (${count(placed.length)})`, true, {
    lines: painter.shapes(FRUSTUM, { ...frustumColumns(placed), color: cameraColors(placed) }),
    dots: painter.cloud({ center: gather(placed, cameras.center, 3), color: cameraColors(placed) }),
  });
  if (points.positions.length) {
    addLayer("points", `Points (${count(points.positions.length / 3)})`, true, {
      cloud: painter.cloud({ center: gather(pointOrder, points.positions, 3), color: pointColors() }),
    });
  }
  LAYER_OF.forEach((name, verdict) => {
    const drawn = [];
    let total = 0;
    for (let p = 0; p < numPairs; p++) {
      if (pairs.verdict[p] !== verdict) continue;
      total += 1;
      if (isDrawn(p)) drawn.push(p);
    }
    if (!drawn.length) return;
    const said = `Pairs ${["that agree", "that contradict", "that cannot be judged", "without a direction", "rejected"][verdict]}`;
    const amount = drawn.length === total ? count(total) : `${count(drawn.length)} of ${count(total)}`;
    const limit = verdict === 0 ? (points.positions.length ? MANY_PAIRS : MANY_WITHOUT_POINTS)
      : verdict === 1 ? (isGood ? MANY_SET_ASIDE : MANY_WRONG) : verdict === 4 ? MANY_REJECTED : MOST_PAIRS;
    const shown = drawn.length <= limit && verdict !== 3 && (verdict !== 4 || !isGood) && (verdict !== 1 || drawn.some((p) => pairs.residual[p] >= FAR_DEG));
    const order = spread(drawn.length).map((k) => drawn[k]);
    addLayer(name, `${said} (${amount})`, shown, {
      variable: VARIABLES[verdict], pairs: order, segments: painter.shapes(SEGMENT, pairColumns(order)),
      alpha: verdict === 0 ? Math.max(Math.min(6 / Math.sqrt(drawn.length + 1), 0.6), 0.15) : 0.6,
    });
  });
  if (cameras.inputCenter) {
    const moved = placed.filter((k) => Number.isFinite(cameras.inputCenter[3 * k]));
    addLayer("input", "Shift from the input", false, {
      variable: "--soft", segments: painter.shapes(SEGMENT, shiftColumns(moved)), alpha: 0.9,
    });
  }
  const certain = placed.filter((k) => Number.isFinite(cameras.sigma[k]) && cameras.sigma[k] > 0);
  if (certain.length) {
    addLayer("ellipsoids", "Uncertainty", false, {
      ellipsoids: painter.shapes(SPHERE, { ...ellipsoidColumns(certain), color: cameraColors(certain) }), members: certain,
    });
  }
  if (ghosts.length) {
    addLayer("ghosts", `Left out (${count(ghosts.length)})`, true, {
      variable: "--contradicts",
      ghosts: painter.shapes(FRUSTUM, frustumColumns(ghosts.filter(hasPose))),
      dots: painter.cloud({ center: gather(ghosts, cameras.ghost, 3) }),
    });
  }
  if (elsewhere.length) {
    const columns = frustumColumns(elsewhere);
    const [center, ends] = [columns.center, gather(elsewhere, cameras.other, 3)];
    addLayer("elsewhere", `Another place (${count(elsewhere.length)})`, true, {
      variable: "--ink", alpha: 0.8,
      ghosts: painter.shapes(FRUSTUM, { ...columns, center: ends }),
      segments: painter.shapes(SEGMENT, { center, u: ends.map((part, k) => part - center[k]) }),
    });
  }
  addLayer("grid", `Grid of ${number(grid.square)} ${data.unit}`, true, {
    variable: "--line", segments: painter.shapes(SEGMENT, grid.columns), alpha: 0.8, isGrid: true,
  });
  const layer = (name) => layers.find((one) => one.name === name);
  let highlight = null;

  // --- drawing ---

  const detail = () => (isMoving ? coarse : 0);
  const pixelRatio = () => devicePixelRatio * (detail() ? 0.5 : 1);
  const cameraSize = () => (hasFrusta ? 5 : 9) * pixelRatio() * (placed.length > 2000 ? 0.7 : 1);
  const dots = (thing, common, size, tint) => painter.paint(thing, {
    ...common, size: 0, least: size, most: size, ...(tint ? { tint } : {}),
  });
  const drawHighlight = (common, chosen) => {
    if (!highlight) return;
    painter.inFront();
    for (const [verdict, thing] of highlight.pairs) {
      painter.paint(thing, { ...common, scale: 1, width: 1.8 * pixelRatio(), tint: [...rgbOf(VARIABLES[verdict]), 0.9] });
    }
    if (highlight.frusta) {
      painter.paint(highlight.frusta, { ...common, scale: sizes.frustum, width: 3 * pixelRatio(), tint: [...chosen, 1] });
    }
    if (highlight.dots) dots(highlight.dots, common, 1.9 * cameraSize(), [...chosen, 1]);
  };
  const drawLayer = (one, common, tint) => {
    const ratio = pixelRatio();
    if (one.cloud) {
      const size = 0.003 * radius * sizes.point * eye.pixelsPerUnit() * view.distance * ratio;
      const limits = { least: 1.8 * ratio * Math.min(sizes.point, 2), most: 2.5 * ratio * sizes.point };
      painter.paint(one.cloud, { ...common, size, ...limits }, SHARES[detail()]);
    }
    if (one.lines && (!detail() || placed.length < 300)) painter.paint(one.lines, { ...common, scale: sizes.frustum, width: 1.6 * ratio });
    if (one.ghosts) painter.paint(one.ghosts, { ...common, scale: sizes.frustum, width: 1.2 * ratio, tint: [...tint, one.alpha ?? 0.55] });
    if (one.dots) dots(one.dots, common, cameraSize(), one.lines ? null : [...tint, 0.8]);
    if (one.ellipsoids) painter.paint(one.ellipsoids, { ...common, scale: sizes.ellipsoid, width: 1.2 * ratio });
    if (one.segments) {
      painter.seeThrough();
      painter.paint(one.segments, { ...common, scale: 1, width: (one.isGrid ? 1 : 1.5) * ratio, tint: [...tint, one.alpha] }, one.pairs ? SHARES[detail()] : 1);
    }
  };
  const ORDER = ["grid", "points", "cameras", "ghosts", "elsewhere", "ellipsoids", "input", "agrees", "nodirection", "rejected", "undetermined", "contradicts"];
  const draw = () => {
    const ratio = pixelRatio();
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.round(side * ratio));
    if (!width || !height) return;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    painter.begin(rgbOf("--ground"));
    const common = { matrix: eye.matrix(), viewport: [width, height], near: eye.near() };
    for (const name of ORDER) {
      const one = layer(name);
      if (!one || !one.shown) continue;
      if (name === "agrees" || name === "input") painter.seeThrough();
      drawLayer(one, common, one.variable ? rgbOf(one.variable) : null);
      if (name === "grid") painter.opaque();
      if (name === "cameras" && pictures) {
        painter.paint(pictures, { ...common, scale: sizes.frustum, opacity: 0.95 });
      }
    }
    drawHighlight(common, rgbOf("--chosen"));
    drawOverlay();
  };
  let waits = false;
  const redraw = () => {
    if (waits) return;
    waits = true;
    requestAnimationFrame((now) => {
      waits = false;
      clockFrame(now);
      draw();
    });
  };
  // Where frames take long while the scene moves, it is drawn more coarsely: at half the resolution and many
  // cameras as dots, then with part of the points and pairs only. When it rests, all is drawn again.
  let [isMoving, coarse, lastFrame, frameTime, rest] = [false, 0, 0, 0, 0];
  const clockFrame = (now) => {
    frameTime = isMoving && lastFrame ? now - lastFrame : 0;
    if (frameTime > SLOW_FRAME_MS) coarse = Math.min(coarse + 1, COARSEST);
    lastFrame = isMoving ? now : 0;
  };
  const moved = () => {
    isMoving = true;
    clearTimeout(rest);
    rest = setTimeout(() => {
      isMoving = false;
      redraw();
    }, REST_MS + 2 * frameTime);
    redraw();
  };

  // Axes of the model in the corner, and the name beside what is chosen.
  const drawOverlay = () => {
    const { right, up } = eye.axes();
    const [x0, y0, length] = [38, canvas.clientHeight - 38, 24];
    const made = [0, 1, 2].slice(0, data.shownAxes).flatMap((axis) => {
      const along = at(data.axes, axis);
      const [x, y] = [x0 + length * dot(right, along), y0 - length * dot(up, along)];
      const stroke = ["#d9483b", "#3f9b4f", "#3b7dd8"][axis];
      const label = shape("text", {
        x: x0 + 1.4 * (x - x0), y: y0 + 1.4 * (y - y0) + 4, fill: stroke, "text-anchor": "middle", "font-size": 11,
      }, "xyz"[axis]);
      return [shape("line", { x1: x0, y1: y0, x2: x, y2: y, stroke, "stroke-width": 2 }), label];
    });
    const project = eye.projection();
    for (const k of selected ? endsOf(selected) : []) {
      const [x, y, depth] = project(...positionOf(k));
      if (!(depth > 0)) continue;
      made.push(shape("text", { x: x + 10, y: y - 8, class: "label" }, middleOfName(cameras.names[k], 40)));
    }
    $("overlay").replaceChildren(...made);
  };

  // --- what lies under the pointer ---

  const endsOf = ([kind, k]) => (kind === "camera" ? [k] : [pairs.first[k], pairs.second[k]]).filter(hasPosition);
  const isInside = (x, y, corners) => {
    let side = 0;
    for (let k = 0; k < 4; k++) {
      const [[ax, ay], [bx, by]] = [corners[k], corners[(k + 1) % 4]];
      const turn = Math.sign((bx - ax) * (y - ay) - (by - ay) * (x - ax));
      if (side && turn && turn !== side) return false;
      side = turn || side;
    }
    return side !== 0;
  };
  const cameraUnder = (x, y, project) => {
    const listed = [layer("cameras").shown ? placed : [], layer("ghosts")?.shown ? ghosts : []].flat();
    let [best, least] = [null, PICK_CAMERA_PX];
    let [behind, nearest] = [null, Infinity];
    for (const k of listed) {
      const center = positionOf(k);
      const [u, v, depth] = project(...center);
      if (!(depth > 0)) continue;
      const away = Math.hypot(u - x, v - y);
      if (away < least) [best, least] = [k, away];
      if (best !== null || depth >= nearest || !hasPose(k)) continue;
      if (away > 3 * sizes.frustum * eye.pixelsPerUnit() * (view.distance / depth)) continue;
      const f = cameras.frusta.subarray(9 * k, 9 * k + 9);
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => project(
        ...[0, 1, 2].map((c) => center[c] + sizes.frustum * (a * f[c] + b * f[3 + c] + f[6 + c])),
      ));
      if (corners.every((corner) => corner[2] > 0) && isInside(x, y, corners)) [behind, nearest] = [k, depth];
    }
    return best ?? behind;
  };
  const pairUnder = (x, y, project) => {
    const listed = layers.filter((one) => one.pairs && one.shown).flatMap((one) => one.pairs);
    if (highlight) for (const [, , rows] of highlight.pairs) listed.push(...rows);
    const seen = new Map();
    const where = (k) => {
      if (!seen.has(k)) seen.set(k, project(...at(cameras.center, k)));
      return seen.get(k);
    };
    let [best, least] = [null, PICK_PAIR_PX];
    for (const p of listed) {
      const [[ax, ay, aw], [bx, by, bw]] = [where(pairs.first[p]), where(pairs.second[p])];
      if (!(aw > 0 && bw > 0)) continue;
      const [dx, dy] = [bx - ax, by - ay];
      const part = Math.max(Math.min(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1), 1), 0);
      const away = Math.hypot(ax + part * dx - x, ay + part * dy - y);
      if (away < least) [best, least] = [p, away];
    }
    return best;
  };
  // A camera wins over any pair drawn across it.
  const under = (event) => {
    const box = canvas.getBoundingClientRect();
    const [x, y, project] = [event.clientX - box.left, event.clientY - box.top, eye.projection()];
    const camera = cameraUnder(x, y, project);
    if (camera !== null) return ["camera", camera];
    const pair = pairUnder(x, y, project);
    return pair === null ? null : ["pair", pair];
  };
  let hovering = null;
  const hovered = (event) => {
    if (!hovering) {
      requestAnimationFrame(() => {
        const found = under(hovering);
        canvas.style.cursor = found ? "pointer" : "grab";
        tell(hovering, found);
        hovering = null;
      });
    }
    hovering = event;
  };

  // --- flights ---

  let flight = 0;
  const fly = (target, distance) => {
    const [from, before] = [view.target, view.distance];
    const mine = ++flight;
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const start = performance.now();
    const step = (now) => {
      if (mine !== flight) return;
      const time = still ? 1 : Math.min(Math.max(now - start, 0) / 450, 1);
      const part = time * time * (3 - 2 * time);
      view.target = from.map((value, c) => value + part * (target[c] - value));
      view.distance = before * (distance / before) ** part;
      draw();
      if (time < 1) requestAnimationFrame(step);
      else canvas.dataset.settled = String(mine);
    };
    if (still) step(start);
    else requestAnimationFrame(step);
  };
  const whole = () => {
    Object.assign(view, { yaw: Math.atan2(-0.84, 0.35), pitch: 0.43 });
    if (data.dimension === 2) Object.assign(view, { yaw: -Math.PI / 2, pitch: 1.57 });
    const own = [{ positions: mainCameras, outside: 0 }];
    const groups = [...own, { positions: nearPoints, outside: 0.03 }].filter(({ positions }) => positions.length);
    const [target, distance] = eye.framing(groups, middle);
    if (distance <= 0.5 * radius) return [middle, 4 * radius];
    const [among, close] = mainCameras.length > 2 ? eye.framing(own, middle) : [target, distance];
    return close > 0 && distance > MOST_AWAY * close ? [among, MOST_AWAY * close] : [target, distance];
  };
  // Along a street, frusta that are deeper than a few steps between cameras would be one band.
  const roomOfFrusta = () => {
    if (placed.length < 3 || placed.length > 1000) return Infinity;
    const project = eye.projection();
    const seen = placed.map((k) => project(...positionOf(k)));
    const nearest = seen.map(([x, y], k) => {
      let least = Infinity;
      for (let j = 0; j < seen.length; j++) if (j !== k) least = Math.min(least, Math.hypot(x - seen[j][0], y - seen[j][1]));
      return least;
    });
    return Math.max(FRUSTUM_STEPS * quantile(nearest, 0.5), LEAST_FRUSTUM_PX / 3);
  };
  const show = (choice) => {
    selected = choice;
    if (highlight) {
      for (const thing of [highlight.frusta, highlight.dots, ...highlight.pairs.map(([, made]) => made)]) if (thing) painter.drop(thing);
    }
    const ends = endsOf(choice);
    const posed = ends.filter(hasPose);
    const own = [];
    if (choice[0] === "pair") own.push(choice[1]);
    else for (let p = 0; p < numPairs; p++) if (pairs.first[p] === choice[1] || pairs.second[p] === choice[1]) own.push(p);
    highlight = {
      frusta: posed.length ? painter.shapes(FRUSTUM, frustumColumns(posed)) : null,
      dots: ends.length ? painter.cloud({ center: new Float32Array(ends.flatMap(positionOf)) }) : null,
      pairs: (choice[0] === "pair" ? [0, 1, 2, 3, 4] : [0, 2, 1]).map((verdict) => {
        const rows = own.filter((p) => pairs.verdict[p] === verdict && isDrawn(p));
        return [verdict, rows.length ? painter.shapes(SEGMENT, pairColumns(rows)) : null, rows];
      }).filter(([, made]) => made),
    };
    if (!ends.length) redraw();
    return ends;
  };
  const flyTo = (ends) => {
    if (!ends.length) return;
    const positions = ends.map(positionOf);
    const target = [0, 1, 2].map((c) => positions.reduce((sum, p) => sum + p[c], 0) / positions.length);
    const spread = Math.max(...positions.map((p) => Math.hypot(...p.map((part, c) => part - target[c]))));
    fly(target, Math.min(Math.max(16 * sizes.frustum, 4 * spread), Math.max(2.2 * radius, view.distance)));
  };

  // --- thumbnails in the frusta ---

  const showPictures = async () => {
    const rows = placed.filter((k) => data.pictures[k] && hasPose(k));
    if (!rows.length) return;
    const side = Math.ceil(Math.sqrt(rows.length));
    const cell = Math.max(Math.min(Math.floor(4096 / side), 192), 16);
    const atlas = element("canvas");
    [atlas.width, atlas.height] = [side * cell, Math.ceil(rows.length / side) * cell];
    const pen = atlas.getContext("2d");
    const cells = new Float32Array(4 * rows.length);
    await Promise.all(rows.map(async (k, place) => {
      const image = new Image();
      image.src = data.pictures[k];
      try {
        await image.decode();
      } catch {
        return;
      }
      const [x, y] = [(place % side) * cell, Math.floor(place / side) * cell];
      pen.drawImage(image, x, y, cell, cell);
      cells.set([x / atlas.width, y / atlas.height, cell / atlas.width, cell / atlas.height], 4 * place);
    }));
    pictures = painter.pictures({ ...frustumColumns(rows), color: cameraColors(rows), cell: cells }, atlas);
    canvas.dataset.pictures = String(rows.length);
    redraw();
  };

  // --- controls ---

  const recolor = () => {
    const colors = cameraColors(placed);
    painter.recolor(layer("cameras").lines, colors);
    painter.recolor(layer("cameras").dots, colors);
    const uncertain = layer("ellipsoids");
    if (uncertain) painter.recolor(uncertain.ellipsoids, cameraColors(uncertain.members));
    if (layer("points")) painter.recolor(layer("points").cloud, pointColors());
    redraw();
  };
  const drawLegend = () => {
    const colored = (background, className) => {
      const made = element("span", "", className);
      made.style.background = background;
      return made;
    };
    if (mode.keys) fill("legend", ...mode.keys.flatMap(([color, text]) => [colored(color, "dot"), element("span", text)]));
    else fill("legend", element("span", mode.low), colored(mode.gradient, "ramp"), element("span", mode.high));
  };
  const drawLayerControls = () => {
    const boxes = layers.map((one) => {
      const label = element("label");
      const input = element("input");
      input.type = "checkbox";
      input.checked = one.shown;
      input.dataset.layer = one.name;
      input.onchange = () => {
        one.shown = input.checked;
        if (one.slider) one.slider.hidden = !one.shown;
        redraw();
      };
      label.append(input);
      if (one.variable) {
        const swatch = element("span", "", "swatch");
        swatch.style.background = `var(${one.variable})`;
        label.append(swatch);
      }
      label.append(one.label);
      return label;
    });
    const slider = (text, name) => {
      const label = element("label", "", "slider");
      const input = element("input");
      Object.assign(input, { type: "range", min: -1, max: 1, step: 0.02, value: 0 });
      input.dataset.size = name;
      const start = sizes[name];
      input.oninput = () => {
        sizes[name] = start * 10 ** Number(input.value);
        redraw();
      };
      label.append(text, input);
      return label;
    };
    const sliders = hasFrusta ? [slider("Frustum size", "frustum")] : [];
    if (layer("points")) sliders.push(slider("Point size", "point"));
    if (certain.length) {
      const uncertainty = layer("ellipsoids");
      uncertainty.slider = slider(`Uncertainty, ${number(sizes.ellipsoid, 1)} times as large`, "ellipsoid");
      uncertainty.slider.hidden = true;
      sliders.push(uncertainty.slider);
    }
    fill("layers", ...boxes, ...sliders);
    modes.forEach(({ label }, k) => {
      const made = element("option", label);
      made.value = String(k);
      $("mode").append(made);
    });
    $("mode").onchange = () => {
      mode = modes[Number($("mode").value)];
      drawLegend();
      recolor();
    };
    $("whole").onclick = () => fly(...whole());
  };

  [view.target, view.distance] = whole();
  const leastPixels = Math.min(LEAST_FRUSTUM_PX * Math.min(Math.sqrt(400 / Math.max(placed.length, 1)), 1), roomOfFrusta());
  sizes.frustum = Math.max(data.frustum, leastPixels / eye.pixelsPerUnit());
  if (certain.length) {
    const size = quantile(certain.map((k) => Math.hypot(...cameras.ellipsoids.subarray(9 * k, 9 * k + 9))), 0.5);
    const power = 10 ** Math.floor(Math.log10(sizes.frustum / size));
    sizes.ellipsoid = Math.max(Math.floor(sizes.frustum / size / power) * power, 1);
  }
  drawLayerControls();
  drawLegend();
  steer(canvas, eye, () => { flight += 1; moved(); }, (event) => {
    const found = under(event);
    if (found) onChoice(...found);
  }, hovered);
  new ResizeObserver(redraw).observe(canvas);
  draw();
  if (data.pictures) showPictures();
  const project = (k) => eye.projection()(...positionOf(k));
  return { show, flyTo, recolor, redraw, draw, moved, detail, layers, sizes, view, project, endsOf: (p) => endsOf(["pair", p]) };
};
