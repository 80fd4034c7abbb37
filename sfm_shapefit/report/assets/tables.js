// The tables of cameras and pairs: sorted, filtered, and in pages.

const ROWS_PER_PAGE = 10;

const makeTable = (id, kind, total, columns, text, why, onChoice) => {
  const isRanked = kind === "pair" || isKnown(cameras.trust) || cameras.reason.some((code) => code > 0);
  let order = Array.from({ length: total }, (_, k) => k);
  let page = 0;
  let sorted = null;
  let chosen = null;
  const search = element("input");
  search.type = "search";
  search.placeholder = "Filter";
  search.setAttribute("aria-label", `Filter ${kind}s by name`);
  const back = button("Back", "quiet", () => { page -= 1; draw(); });
  const next = button("Next", "quiet", () => { page += 1; draw(); });
  const shown = element("span", "", "count");
  const tools = element("div", "", "tools");
  tools.append(search, shown, back, next);
  const table = element("table");
  const head = table.createTHead().insertRow();
  const body = table.createTBody();
  const headings = columns.map((column) => {
    const cell = element("th", "", `${column.number ? "number" : ""} ${column.minor ? "minor" : ""}`.trim());
    const sorter = button(column.title, "", () => sortBy(column));
    if (column.hint) sorter.title = column.hint;
    cell.scope = "col";
    cell.append(sorter);
    head.append(cell);
    return cell;
  });
  // A row, and below it why it stands where it does.
  const rowOf = (k) => {
    const row = element("tr");
    row.tabIndex = 0;
    row.dataset.row = k;
    row.setAttribute("aria-selected", String(k === chosen));
    for (const column of columns) row.append(column.cell(k));
    const choose = () => onChoice(kind, k);
    row.onclick = choose;
    row.onkeydown = (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      choose();
      body.querySelector(`[data-row="${k}"]`)?.focus();
    };
    if (!why(k)) return [row];
    row.className = "told";
    const told = element("tr", "", "why");
    const cell = element("td");
    cell.colSpan = columns.length;
    cell.append(element("span", why(k)));
    told.append(cell);
    told.onclick = choose;
    return [row, told];
  };
  const draw = () => {
    const first = page * ROWS_PER_PAGE;
    const last = Math.min(first + ROWS_PER_PAGE, order.length);
    body.replaceChildren(...order.slice(first, last).flatMap(rowOf));
    shown.textContent = order.length ? `${count(first + 1)}–${count(last)} of ${count(order.length)}` : "none";
    if (order.length && !sorted && isRanked) shown.append(element("span", ", worst first", "minor"));
    back.disabled = page === 0;
    next.disabled = last >= order.length;
  };
  const sortBy = (column) => {
    const down = sorted && sorted.column === column ? !sorted.down : Boolean(column.number);
    sorted = { column, down };
    const sign = down ? -1 : 1;
    order.sort((a, b) => {
      const [u, v] = [column.value(a), column.value(b)];
      const [lostA, lostB] = [Number.isNaN(u), Number.isNaN(v)];
      if (lostA || lostB) return lostA - lostB || a - b;
      return u < v ? -sign : u > v ? sign : a - b;
    });
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

const numeric = (title, value, digits, hint, minor = false) => ({
  title, hint, number: true, minor, value, cell: (k) => element("td", number(value(k), digits), minor ? "number minor" : "number"),
});
// Numbers of one kind, all with as many decimals as small ones of them need.
const aligned = (title, values, digits, hint) => {
  const decimals = digits - 1 - Math.floor(Math.log10(quantile(Array.from(values).filter((value) => value > 0), 0.1)));
  const text = (value) => (decimals >= 0 && decimals <= 6 && Number.isFinite(value) ? value.toFixed(decimals) : number(value, digits));
  return { ...numeric(title, (k) => values[k], digits, hint), cell: (k) => element("td", text(values[k]), "number") };
};
const named = (title, name) => ({ title, value: name, cell: (k) => element("td", name(k), "name") });
const verdictCell = (p) => {
  const cell = element("td", "", "verdict");
  const dotted = element("span", "", "dot");
  dotted.style.background = `var(${VARIABLES[pairs.verdict[p]]})`;
  dotted.title = VERDICTS[pairs.verdict[p]];
  cell.append(dotted, element("span", ` ${dotted.title}`, "word"));
  return cell;
};
const drawTables = (onChoice) => {
  // Rows arrive worst first: the cameras by trust and pair error, the pairs by verdict and residual.
  const isSaid = new Set(data.looks.map(({ camera }) => camera));
  const why = (k) => (isSaid.has(k) ? "" : reason(cameras.reason[k]) || (isPlaced(k) ? "" : "left out"));
  const shift = cameras.shift ? [aligned("Shift", cameras.shift, 2, "How far it is from where the input has it, in units")] : [];
  return {
    camera: makeTable("cameras", "camera", numCameras, [
      named(capital(data.noun), (k) => cameras.names[k]),
      ...(isKnown(cameras.trust) ? [numeric("Trust", (k) => cameras.trust[k], 2, "1: its matches fit as well as usual; below 0.6 it is left out unless you say otherwise")] : []),
      ...(isKnown(cameras.sigma) ? [aligned("± units", cameras.sigma.map((value, k) => (isPlaced(k) ? value : NaN)), 2, "Uncertainty of its position: one standard deviation along the worst axis, in units")] : []),
      numeric("Pair error (°)", (k) => cameras.error[k], 2, "Median error of its pairs, in degrees: large where most of them contradict"),
      {
        title: "Pairs agree", number: true, value: (k) => (cameras.degree[k] ? cameras.agreeing[k] / cameras.degree[k] : NaN),
        cell: (k) => element("td", cameras.degree[k] ? `${cameras.agreeing[k]}/${cameras.degree[k]}` : "none", "number"),
      },
      ...shift,
      ...cameras.further.map(({ title, hint, values }, c) => numeric(title, (k) => values[k], 3, hint, c > 1)),
    ], (k) => cameras.names[k], why, onChoice),
    pair: makeTable("pairs", "pair", numPairs, [
      named(`${capital(data.noun)} 1`, (p) => cameras.names[pairs.first[p]]),
      named(`${capital(data.noun)} 2`, (p) => cameras.names[pairs.second[p]]),
      { title: "Verdict", value: (p) => VERDICTS[pairs.verdict[p]], cell: verdictCell },
      numeric("Off by (°)", (p) => pairs.residual[p], 3, "Angle between the direction that its matches say and the placed cameras"),
      ...(data.hasSupport ? [numeric("Matches", (p) => pairs.support[p], 3, "Matches that fit the pair")] : []),
    ], pairTitle, (p) => reason(pairs.reason[p]), onChoice),
  };
};
