// The page as a whole: the verdict, what to look at, what is chosen, and all the parts put together.

const drawHead = () => {
  const { banner } = data;
  $("title").textContent = data.title;
  $("subtitle").textContent = [data.subtitle, data.day].filter(Boolean).join(", ");
  $("banner").dataset.grade = banner.grade;
  $("h-cameras").textContent = `${capital(data.noun)}s`;
  $("h-matrix").textContent = `Overlap: which ${data.noun}s are paired`;
  $("mark").textContent = { good: "✓", look: "!", "cannot be judged": "?", "do not use": "✕" }[banner.grade] ?? "";
  $("verdict").textContent = banner.headline;
  $("why").textContent = banner.sentence;
  if (banner.command) {
    $("next").hidden = false;
    $("next-text").textContent = banner.next;
    $("command").textContent = banner.command;
    $("copy").onclick = copyCommand;
  }
};
const copyCommand = async () => {
  const text = $("command").textContent;
  try {
    await navigator.clipboard.writeText(text);
  } catch { // pages from a file may not; a selection they may copy
    getSelection().selectAllChildren($("command"));
    document.execCommand("copy");
  }
  $("copy").textContent = "Copied";
  setTimeout(() => { $("copy").textContent = "Copy"; }, 1500);
};

const factTable = (rows) => {
  const table = element("table", "", "facts");
  for (const [label, value] of rows) {
    const row = table.insertRow();
    row.append(element("td", label), element("td", value));
  }
  return table;
};
const folded = (text, content) => {
  const made = element("details");
  made.append(element("summary", text), content);
  return made;
};
const drawFacts = () => {
  fill("tiles", ...data.tiles.map(({ value, label, hint, mood }) => {
    const tile = element("div", "", `tile ${mood}`);
    tile.title = hint;
    tile.append(element("b", value), element("span", label));
    return tile;
  }));
  fill("summary", ...data.summary.map((text) => element("li", text)));
  fill("expert-facts", ...data.expertFacts.map((text) => element("li", text)));
  if (isGood) $("looks-title").textContent = "Of note";
  const looks = data.looks.map(({ text, camera, pair }) => {
    const item = element("li");
    const target = camera ?? pair;
    if (target === null) item.append(element("span", text));
    else item.append(button(text, "link", () => select(camera === null ? "pair" : "camera", target)));
    return item;
  });
  if (!looks.length) looks.push(element("li", "Nothing stands out.", "fine"));
  fill("looks", ...looks);
  fill("timings", factTable(data.timings));
  fill("versions", factTable(data.versions));
  const { changed, unchanged } = data.options;
  const rest = folded(`${counted(unchanged.length, "option")} as by default`, factTable(unchanged));
  fill("options", changed.length ? factTable(changed) : element("p", "None.", "muted"), rest);
};
// In narrow windows a row becomes a list of its cells; or, if `minor` ones are named, only these are hidden.
const plainTable = (names, rows, minor) => {
  const table = element("table", "", minor ? "" : "plain");
  const look = (name) => (minor?.includes(name) ? "minor" : "");
  const head = table.createTHead().insertRow();
  for (const name of names) head.append(element("th", name, look(name)));
  const body = table.createTBody();
  for (const texts of rows) {
    const row = body.insertRow();
    row.append(...texts.map((text, k) => element("td", text, look(names[k]))));
    names.forEach((name, k) => { row.cells[k].dataset.label = name; }); // narrow windows show it beside the text
  }
  const scroll = element("div", "", "scroll");
  scroll.append(table);
  return scroll;
};
const drawPieces = () => {
  $("pieces-card").hidden = data.pieces.length < 2;
  const rows = data.pieces.map((piece) => {
    const where = piece.folder === "." ? "this folder" : piece.folder || "not written";
    return [String(piece.number), count(piece.cameras), count(piece.placed), piece.hinges || "none", piece.scale, where];
  });
  fill("pieces", plainTable(["Piece", "Cameras", "Placed", "Shared with others", "Scale", "Where"], rows));
  $("pieces-note").textContent = data.notes.pieces;
};
const drawControl = () => {
  $("lenses-card").hidden = !data.lenses.length;
  fill("lenses", plainTable(["Camera id", "Model", "Images", "Picture (px)", "Focal length (px)", "Principal point (px)", "Distortion"], data.lenses));
  $("intrinsics-card").hidden = !data.intrinsics.length;
  fill("intrinsics", plainTable(["Camera", "Model", "Images", "Focal length given (px)", "Found (px)", "Change", "Distortion"], data.intrinsics));
  $("control-card").hidden = !data.control.length;
  fill("control", plainTable(["Name", "Use", "Off by (units)", "Along the axes (units)", "Off by (px)", "Marks"], data.control, ["Along the axes (units)", "Off by (px)"]));
  $("control-note").textContent = data.notes.control;
  $("bars-card").hidden = !data.bars.length;
  fill("bars", plainTable(["Name", "Use", "Known (units)", "In the model (units)", "Off by (units)", "(σ)", "Off by (px)", "Marks"], data.bars, ["(σ)", "Off by (px)", "Marks"]));
};
const drawLoops = () => {
  $("loops-card").hidden = !data.loops.length;
  fill("loops", plainTable(["From", "To", "Pairs", "Matches", "Off the images between (°)", "What became of it"], data.loops));
  $("loops-note").textContent = data.notes.loops;
};

// --- what is chosen --------------------------------------------------------------------------------

const MOST_LISTED = 60;
const definitions = (facts) => {
  const list = element("dl");
  for (const [label, value] of known(facts)) list.append(element("dt", label), element("dd", value));
  return list;
};
const dotOf = (verdict, words = VERDICTS) => {
  const dotted = element("span", "", "dot");
  if (verdict === null) return dotted;
  dotted.style.background = `var(${VARIABLES[verdict]})`;
  dotted.title = words[verdict];
  return dotted;
};
const listItem = (verdict, text, note, action) => {
  const line = element("li");
  line.append(dotOf(verdict), button(text, "link", action), element("span", note, "number"));
  return line;
};
const otherEnd = (p, k) => (pairs.first[p] === k ? pairs.second[p] : pairs.first[p]);
const picturesOf = (ends) => (data.pictures ? ends.filter((end) => data.pictures[end]) : []);

// Pictures next to one another, each 100 wide, and the matches of a pair between two of them.
const GAP = 2;
const drawPictures = async (svg, shown, p) => {
  const images = await Promise.all(shown.map(async (k) => {
    const image = new Image();
    image.src = data.pictures[k];
    await image.decode();
    return image;
  }));
  const heights = images.map((image) => (100 * image.naturalHeight) / image.naturalWidth);
  svg.setAttribute("viewBox", `0 0 ${200 + GAP} ${Math.max(...heights)}`);
  images.forEach((image, side) => svg.append(shape("image", {
    href: image.src, x: side * (100 + GAP), width: 100, height: heights[side],
  })));
  const found = shown.length === 2 && matches.get(p);
  if (!found) return;
  const turned = pairs.first[p] === shown[0] ? 0 : 2;
  const place = (row, side) => {
    const from = 4 * row + ((2 * side + turned) % 4);
    const [x, y] = data.matches.places.subarray(from, from + 2);
    return `${(side * (100 + GAP) + x / 655.35).toFixed(1)} ${((heights[side] * y) / 65535).toFixed(1)}`;
  };
  ["--agrees", "--contradicts"].forEach((variable, kind) => {
    let path = "";
    const begin = found.first + kind * found.drawn[0];
    for (let row = begin; row < begin + found.drawn[kind]; row++) path += `M${place(row, 0)}L${place(row, 1)}`;
    if (path) svg.append(shape("path", { d: path, class: "match", stroke: `var(${variable})` }));
  });
};
const matchesSaid = (p) => {
  if (!data.matches) return [];
  if (!matches.has(p)) return ["The matches of this pair are not on the page."];
  const { counts, drawn } = matches.get(p);
  const all = counts[0] + counts[1];
  const few = drawn[0] + drawn[1] < all ? `${drawn[0] + drawn[1]} of ${counted(all, "match").replace("chs", "ches")} drawn: ` : "";
  return [few, dotOf(0, ["fits"]), ` ${count(counts[0])} fit, `, dotOf(1, ["", "misses"]), ` ${count(counts[1])} miss`];
};
const sideBySide = (k, p) => {
  const shown = picturesOf([k, otherEnd(p, k)]);
  const figure = element("figure", "", "beside");
  if (!shown.length) return figure;
  const svg = shape("svg", { viewBox: `0 0 ${200 + GAP} 75`, role: "img", "aria-label": `Pictures of ${pairTitle(p)}` });
  drawPictures(svg, shown, p);
  const caption = element("figcaption");
  const [other, error] = [otherEnd(p, k), off(pairs.residual[p])];
  const said = [`: ${VERDICTS[pairs.verdict[p]]}`, error && `off by ${error}`, reason(pairs.reason[p])].filter(Boolean).join(", ");
  caption.append("Beside ", button(cameras.names[other], "link", () => select("camera", other)), `${said}. `, ...matchesSaid(p));
  figure.append(svg, caption);
  return figure;
};
// The pair whose matches tell most of a camera: most of them contradict, or, failing that, they are most.
const mostTelling = (own) => {
  const weight = (p) => {
    const [fit, against] = matches.get(p)?.counts ?? [-1, -1];
    return against > fit ? 1e9 + against : fit;
  };
  return own.reduce((best, p) => (weight(p) > weight(best) ? p : best), own[0]);
};

const cameraDetails = (k) => {
  const own = [];
  for (let p = 0; p < numPairs; p++) if (pairs.first[p] === k || pairs.second[p] === k) own.push(p);
  const others = element("ul");
  const title = own.length > MOST_LISTED ? `Its pairs, the worst ${MOST_LISTED} of ${count(own.length)}` : `Its pairs (${own.length})`;
  const right = element("div");
  right.append(element("h4", title), others);
  const listed = own.slice(0, MOST_LISTED);
  const seen = data.pictures ? listed.filter((p) => picturesOf([k, otherEnd(p, k)]).length === 2) : [];
  let figure = element("figure", "", "beside");
  const lay = (p) => {
    const made = sideBySide(k, p);
    figure.replaceWith(made);
    figure = made;
    [...others.children].forEach((item, row) => item.setAttribute("aria-current", String(listed[row] === p)));
  };
  for (const p of listed) {
    const choose = seen.includes(p) ? () => lay(p) : () => select("pair", p);
    others.append(listItem(pairs.verdict[p], cameras.names[otherEnd(p, k)], off(pairs.residual[p]), choose));
  }
  others.onkeydown = (event) => {
    const to = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key];
    const next = to && event.target.closest("li")?.[to]?.querySelector("button");
    if (!next) return;
    event.preventDefault();
    next.focus();
    if (seen.length) next.click();
  };
  const lead = () => (seen.length ? lay(mostTelling(seen)) : figure.replaceWith(...picturesOf([k]).map(picture)));
  return [cameras.names[k], cameraFacts(k), cameraExpertFacts(k), right, [figure, lead]];
};
const picture = (k) => {
  const image = element("img", "", "thumbnail");
  [image.src, image.alt] = [data.pictures[k], ""];
  return image;
};
const pairDetails = (p) => {
  const ends = [pairs.first[p], pairs.second[p]];
  const others = element("ul");
  for (const end of ends) others.append(listItem(null, cameras.names[end], "", () => select("camera", end)));
  const figure = sideBySide(ends[0], p);
  return [`Pair ${pairTitle(p)}`, pairFacts(p), pairExpertFacts(p), others, [figure, () => {}]];
};
const drawDetails = () => {
  $("details").classList.toggle("empty", !selected);
  $("stage").classList.toggle("chosen", Boolean(selected));
  $("stage").classList.toggle("pictured", Boolean(data.pictures));
  if (!selected) {
    fill("details", element("p", "Click a camera or a pair: in the scene, in a table or in a chart. Drag turns the scene, " + (matchMedia("(pointer: coarse)").matches ? "two fingers zoom and shift." : "the wheel zooms, the right button shifts."), "muted"));
    return;
  }
  const [kind, k] = selected;
  const [title, facts, expert, right, [figure, lead]] = kind === "camera" ? cameraDetails(k) : pairDetails(k);
  const left = element("div");
  left.append(definitions(facts), folded("For experts", definitions(expert)));
  fill("details", element("h3", title), figure, left, right);
  lead();
  $("details").scrollTop = 0;
};

let scene = null;
let tables = null;
let selected = null; // "camera" or "pair", and its row
// The scene is brought into view where it is not, and flies to what was chosen outside it.
const select = (kind, k, isInScene = false) => {
  selected = [kind, k];
  $("scene").dataset.selected = `${kind}:${k}`;
  tables[kind].show(k);
  tables[kind === "camera" ? "pair" : "camera"].clear();
  drawDetails();
  const ends = scene ? scene.show(selected) : [];
  if (isInScene) {
    if (scene) scene.redraw();
    return;
  }
  const { top, bottom } = $("scene").getBoundingClientRect();
  if (top < -40 || bottom > innerHeight + 40) {
    $("stage").scrollIntoView({ block: "start", behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
  }
  if (scene) scene.flyTo(ends);
};

const recolor = () => {
  shades.clear();
  if (scene) scene.recolor();
};
$("theme").onclick = () => {
  document.documentElement.dataset.theme = isDark() ? "light" : "dark";
  recolor();
};
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolor);

drawHead();
drawFacts();
drawPieces();
drawControl();
drawLoops();
tables = drawTables(select);
drawDetails();
$("pairs-note").textContent = data.pairsNote;
$("pairs-words").textContent = data.pairsWords;
$("scene-note").textContent = data.sceneNote;
scene = makeScene((kind, k) => select(kind, k, true));
$("scene").scene = scene;
if (!scene) {
  fill("scene", element("p", "This browser offers no WebGL 2, so the 3D view is left out. Tables and charts work.", "notice"));
  for (const id of ["layers", "mode", "whole"]) $(id).hidden = true;
}
// The charts wait until the scene is seen.
requestAnimationFrame(() => setTimeout(() => {
  drawCharts(select);
  watchWidth(select);
  document.documentElement.dataset.ready = "yes";
}));
