// What all parts of the page share: its data, and small helpers. Names come from strangers: they reach the
// page through textContent only.
const TYPES = { f4: Float32Array, i4: Int32Array, u2: Uint16Array, u1: Uint8Array };
const VERDICTS = ["agrees", "contradicts", "cannot be judged", "no direction", "rejected"];
const LAYER_OF = ["agrees", "contradicts", "undetermined", "nodirection", "rejected"];
const VARIABLES = LAYER_OF.map((name) => `--${name}`);
const $ = (id) => document.getElementById(id);

const decode = (value) => {
  if (Array.isArray(value)) return value.map(decode);
  if (value === null || typeof value !== "object") return value;
  if (!("bytes" in value)) {
    return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, decode(item)]));
  }
  const text = atob(value.bytes);
  const bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  return new TYPES[value.type](bytes.buffer);
};
const data = decode(JSON.parse($("data").textContent));
const { cameras, pairs, points } = data;
const numCameras = cameras.names.length;
const numPairs = pairs.first.length;
const isGood = data.banner.grade === "good";
// Of pairs: how many matches fit and contradict, how many of either are drawn, and the row of the first of these.
const matches = new Map();
if (data.matches) {
  let first = 0;
  data.matches.pair.forEach((p, k) => {
    const [counts, drawn] = [data.matches.counts, data.matches.drawn].map((all) => Array.from(all.subarray(2 * k, 2 * k + 2)));
    matches.set(p, { counts, drawn, first });
    first += drawn[0] + drawn[1];
  });
}

// Text breaks at blanks, a name after its folders, and elsewhere only where a part is very long.
const breakable = (text) => text.split(/(?<=[/ ])/).flatMap((part) => [element("span", part, part.length < 25 ? "whole" : ""), element("wbr")]);
const element = (tag, text = "", className = "") => {
  const made = document.createElement(tag);
  if (tag === "td" && text !== "") made.append(...breakable(String(text)));
  else if (text !== "") made.textContent = text;
  if (className) made.className = className;
  return made;
};
const button = (text, className, action) => {
  const made = element("button", text, className);
  made.type = "button";
  made.onclick = action;
  return made;
};
const SVG = "http://www.w3.org/2000/svg";
const shape = (tag, attributes, text = "") => {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  if (text !== "") made.textContent = text;
  return made;
};
const fill = (id, ...children) => $(id).replaceChildren(...children);
const number = (value, digits = 3) => {
  if (!Number.isFinite(value)) return "";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-3 || size >= 1e6) return value.toExponential(Math.max(digits - 1, 0));
  return size >= 10 ** digits ? count(Math.round(value)) : Number(value.toPrecision(digits)).toString();
};
const count = (value) => value.toLocaleString("en", { maximumFractionDigits: 9 });
const capital = (text) => text[0].toUpperCase() + text.slice(1);
const counted = (value, noun) => `${count(value)} ${noun}${value === 1 ? "" : "s"}`;
const reason = (code) => data.reasons[code];
// Where a camera stands in the output's axes.
const worldOf = (k) => {
  const own = at(cameras.center, k);
  return data.middle.map((from, c) => from + own.reduce((sum, part, axis) => sum + part * data.axes[3 * c + axis], 0));
};
const at = (positions, k) => [positions[3 * k], positions[3 * k + 1], positions[3 * k + 2]];
const isPlaced = (k) => cameras.placed[k] === 1;
const isDrawn = (p) => isPlaced(pairs.first[p]) && isPlaced(pairs.second[p]);
const quantile = (values, share) => {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  return sorted.length ? sorted[Math.min(Math.floor(share * sorted.length), sorted.length - 1)] : NaN;
};
const isKnown = (values) => values.some(Number.isFinite);
// What all names begin with tells none from another.
const [firstName, ...otherNames] = cameras.names;
const numCommon = otherNames.reduce((most, name) => {
  let k = 0;
  while (k < most && name[k] === firstName[k]) k++;
  return k;
}, otherNames.length ? firstName.length : 0);
const middleOfName = (whole, most) => {
  if (whole.length <= most) return whole;
  const name = numCommon > 1 ? `…${whole.slice(numCommon)}` : whole;
  if (name.length <= most) return name;
  const tail = Math.ceil(most * 0.6);
  return `${name.slice(0, most - tail - 1)}…${name.slice(-tail)}`;
};
const pairTitle = (p) => `${cameras.names[pairs.first[p]]} – ${cameras.names[pairs.second[p]]}`;
const off = (value) => number(value) && `${number(value)}°`;

const isDark = () => {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
};
const probe = $("scene").appendChild(element("i"));
probe.hidden = true;
// [red, green, blue] in 0..1 of a color of the style sheet, looked up once per theme.
const shades = new Map();
const rgbOf = (variable) => {
  if (!shades.has(variable)) {
    probe.style.color = `var(${variable})`;
    shades.set(variable, getComputedStyle(probe).color.match(/[\d.]+/g).slice(0, 3).map((part) => part / 255));
  }
  return shades.get(variable);
};

// --- what is said of a camera or a pair ------------------------------------------------------------

const agreeing = (k) => `${count(cameras.agreeing[k])} of ${count(cameras.degree[k])} agree`;
const otherPlace = (k) => {
  const away = number(Math.hypot(...at(cameras.other, k).map((part, c) => part - cameras.center[3 * k + c])));
  return `${away} ${data.unit} away, by ${counted(cameras.otherCounts[2 * k + 1], "pair")}; ${count(cameras.otherCounts[2 * k])} for where it is`;
};
const cameraFacts = (k) => [
  ["placed", isPlaced(k) ? "" : "no, left out"],
  ["trust", number(cameras.trust[k], 2)],
  ["uncertainty", isPlaced(k) && number(cameras.sigma[k], 2) ? `± ${number(cameras.sigma[k], 2)} ${data.unit}` : ""],
  ["pairs", cameras.degree[k] ? agreeing(k) : "none"],
  ["typical error", off(cameras.error[k])],
  ["moved from the input", cameras.shift && number(cameras.shift[k], 2) ? `${number(cameras.shift[k], 2)} ${data.unit}` : ""],
  ...cameras.further.map(({ title, values }) => [title.toLowerCase(), number(values[k])]),
  ["why", reason(cameras.reason[k])],
  ["stands apart", cameras.group[k] < 0 ? "" : `with group ${cameras.group[k] + 1} (colors show it)`],
  ["another place", Number.isFinite(cameras.other[3 * k]) ? otherPlace(k) : ""],
];
const pairFacts = (p) => [
  ["verdict", VERDICTS[pairs.verdict[p]]],
  ["off by", off(pairs.residual[p])],
  ["matches", pairs.support[p] ? count(pairs.support[p]) : ""],
  ["why", reason(pairs.reason[p])],
];
const cameraExpertFacts = (k) => [
  ["center", isPlaced(k) ? worldOf(k).slice(0, data.shownAxes).map((x) => number(x, 5)).join(", ") : ""],
  ["rigid piece", cameras.piece[k] < 0 ? "none" : String(cameras.piece[k])],
];
const pairExpertFacts = (p) => [
  ["residual at the certified optimum", off(pairs.certified[p])],
  ["residual at the input", off(pairs.input[p])],
  ["weight", number(pairs.weight[p])],
  ["leverage", number(pairs.leverage[p], 2)],
  ["dual norm", number(pairs.dual[p])],
];
const known = (facts) => facts.filter(([, value]) => value !== "" && value !== undefined);

// --- the box beside the pointer --------------------------------------------------------------------

const tooltip = $("tooltip");
const showTooltip = (event, title, facts) => {
  tooltip.replaceChildren(element("strong", title));
  for (const [label, value] of known(facts)) tooltip.append(`\n${label}: ${value}`);
  tooltip.hidden = false;
  const [x, y] = [event.clientX, event.clientY];
  tooltip.style.left = `${Math.max(Math.min(x + 14, innerWidth - tooltip.offsetWidth - 8), 4)}px`;
  tooltip.style.top = `${Math.max(Math.min(y + 14, innerHeight - tooltip.offsetHeight - 8), 4)}px`;
};
const hideTooltip = () => {
  tooltip.hidden = true;
};
const tell = (event, found) => {
  if (!found) hideTooltip();
  else if (found[0] === "text") showTooltip(event, found[1], found[2]);
  else if (found[0] === "camera") showTooltip(event, cameras.names[found[1]], cameraFacts(found[1]));
  else showTooltip(event, pairTitle(found[1]), pairFacts(found[1]));
};
