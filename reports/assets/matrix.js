// The matrix: filters, the cells that pass them, folding of families, keyboard.
import { fromCode } from "./chunks.js";
import { amend, href, read } from "./route.js";
import { h, number, svg } from "./text.js";

/** @type {(Node[])[]} the cells of the static page, restored where no filter is set */
const asWritten = [];
const FILTERS = /** @type {const} */ (["scenario", "verdict", "engine", "family", "level", "quantity", "q", "fresh"]);
let built = false;

/** @param {Record<string, string>} fields */
export function filtersOf(fields) {
  return Object.fromEntries(FILTERS.filter((name) => fields[name]).map((name) => [name, fields[name]]));
}

/**
 * Filters whose value this run does not have, as a sentence; "" where there is none.
 * @param {import("./report_data").Index} index @param {Record<string, string>} fields
 */
function unknownFilters(index, fields) {
  const values = /** @type {Record<string, string[]>} */ ({ scenario: index.scenarios, verdict: [...index.verdicts, ...index.verdicts.map((v) => "!" + v)],
    engine: index.engines, family: index.families, level: index.levels, quantity: index.quantitys });
  const unknown = Object.entries(fields).filter(([name, value]) => values[name] && !values[name].includes(value)).map(([name, value]) => `${name} “${value}”`);
  if (fields.fresh && !index.passed) unknown.push("earlier run that passed");
  return unknown.length ? `This run has no ${unknown.join(", no ")}. ` : "";
}

/**
 * A test of one row by its index.
 * @param {import("./report_data").Index} index @param {Record<string, string>} fields
 * @returns {(row: number) => boolean}
 */
export function chosen(index, fields) {
  const { rows } = index;
  const words = (fields.q ?? "").toLowerCase().split(/\s+/).filter(Boolean);
  const negated = (fields.verdict ?? "").startsWith("!");
  const verdict = index.verdicts.indexOf(negated ? fields.verdict.slice(1) : (fields.verdict ?? ""));
  const information = index.verdicts.indexOf("information");
  const engine = index.engines.indexOf(fields.engine ?? "");
  const level = index.levels.indexOf(fields.level ?? "");
  const quantity = index.quantitys.indexOf(fields.quantity ?? "");
  return (i) => {
    if (fields.verdict && (rows.verdict[i] === verdict) === negated) return false;
    if (negated && rows.verdict[i] === information) return false;
    if (fields.engine && rows.engine[i] !== engine) return false;
    if (fields.level && rows.level[i] !== level) return false;
    if (fields.quantity && rows.quantity[i] !== quantity) return false;
    if (fields.scenario && index.scenarios[rows.scenario[i]] !== fields.scenario) return false;
    if (fields.family && index.families[rows.scenario[i]] !== fields.family) return false;
    if (fields.fresh && !rows.fresh[i]) return false;
    if (!words.length) return true;
    const s = rows.scenario[i];
    const text = [index.scenarios[s], index.titles[s], index.families[s], index.engines[rows.engine[i]], index.engine_titles[rows.engine[i]],
      index.levels[rows.level[i]], index.integrators[rows.integrator[i]], index.quantitys[rows.quantity[i]], index.verdicts[rows.verdict[i]], index.reasons[i]]
      .join(" ").toLowerCase();
    return words.every((word) => text.includes(word));
  };
}

/**
 * @param {import("./report_data").Index} index @param {Record<string, string>} fields
 */
export function showMatrix(index, fields) {
  const table = /** @type {HTMLTableElement} */ (document.getElementById("matrix"));
  if (!built) {
    built = true;
    buildFilters(index);
    buildFolds(table);
    complete(index, table);
    for (const line of table.querySelectorAll("tr.line")) asWritten.push([...line.querySelectorAll("td")].map((td) => td.cloneNode(true)));
    table.addEventListener("keydown", moveByArrow);
    table.addEventListener("focusin", (event) => event.target instanceof HTMLAnchorElement && setTabStop(table, event.target));
    document.addEventListener("keydown", (event) => {
      const search = /** @type {HTMLElement} */ (document.querySelector("#filters [name=q]"));
      if (event.key !== "/" || event.ctrlKey || event.metaKey || event.altKey || !search.checkVisibility() || (event.target instanceof Element && event.target.matches("input, select, textarea"))) return;
      event.preventDefault();
      search.focus();
    });
  }
  for (const control of document.querySelectorAll("#filters [name]")) {
    const input = /** @type {HTMLInputElement} */ (control);
    const value = fields[input.name] ?? "";
    if (input.type === "checkbox") input.checked = value !== "";
    else if (input.value !== value && document.activeElement !== input) input.value = value;
  }
  const filters = filtersOf(fields);
  const filtered = Object.keys(filters).length > 0;
  const { rows } = index;
  const [cells, count] = filtered ? speakers(index, chosen(index, filters)) : [new Map(), 0];
  let lines = 0;
  table.querySelectorAll("tr.line").forEach((line, place) => {
    const scenario = Number(/** @type {HTMLElement} */ (line).dataset.scenario);
    const ours = index.engines.map((_, e) => cells.get(scenario * index.engines.length + e));
    const visible = !filtered || ours.some((i) => i !== undefined);
    /** @type {HTMLElement} */ (line).hidden = !visible;
    if (!visible) return;
    lines++;
    line.querySelectorAll("td").forEach((td, e) => {
      const cell = ours[e];
      td.replaceWith(!filtered ? asWritten[place][e].cloneNode(true) : cell !== undefined ? cellOf(index, cell) : h("td", { class: "cell empty" }));
    });
  });
  for (const body of table.tBodies) {
    const left = body.querySelectorAll("tr.line:not([hidden])").length;
    body.hidden = left === 0;
    body.querySelectorAll("tr.family td").forEach((td) => td.classList.toggle("vh", filtered));
  }
  const status = /** @type {HTMLElement} */ (document.getElementById("status"));
  status.replaceChildren();
  if (filtered) status.append(`${count} of ${rows.scenario.length} comparisons in ${lines} scenario${lines === 1 ? "" : "s"}. `, h("a", { href: href({ view: "matrix" }) }, "Show all"));
  status.prepend(unknownFilters(index, filters));
  /** @type {HTMLElement} */ (document.getElementById("findings")).hidden = filtered;
  setTabStop(table, table.querySelector("a[tabindex='0']"));
}

/**
 * The row that stands for each cell, by scenario and engine, and the number of rows that pass.
 * @param {import("./report_data").Index} index @param {(row: number) => boolean} passes
 * @returns {[Map<number, number>, number]}
 */
function speakers(index, passes) {
  const { rows } = index;
  const cells = new Map();
  let count = 0;
  for (let i = 0; i < rows.scenario.length; i++) {
    if (!passes(i)) continue;
    count++;
    const place = rows.scenario[i] * index.engines.length + rows.engine[i];
    const worst = cells.get(place);
    if (worst === undefined || outranks(index, i, worst)) cells.set(place, i);
  }
  return [cells, count];
}

/**
 * Add links, reasons and marks to the cells of the static page.
 * @param {import("./report_data").Index} index @param {HTMLTableElement} table
 */
function complete(index, table) {
  const [cells] = speakers(index, () => true);
  for (const line of /** @type {NodeListOf<HTMLElement>} */ (table.querySelectorAll("tr.line"))) {
    line.querySelectorAll("td").forEach((td, e) => {
      const row = cells.get(Number(line.dataset.scenario) * index.engines.length + e);
      const link = td.querySelector("a");
      if (row === undefined || !link) return;
      const ratio = fromCode(index.rows.ratio[row]);
      link.href = href({ scenario: index.scenarios[index.rows.scenario[row]], engine: index.engines[e] });
      link.title += `: ${index.reasons[row]}`;
      if (!Number.isNaN(ratio)) link.append(track(ratio));
    });
  }
}

/**
 * Leave one cell in the order of the Tab key, the first visible one unless given; arrow keys reach the others.
 * @param {HTMLTableElement} table @param {HTMLElement | null} [link]
 */
function setTabStop(table, link) {
  const links = /** @type {NodeListOf<HTMLElement>} */ (table.querySelectorAll("tr.line td a"));
  const stop = link?.checkVisibility() ? link : [...links].find((one) => one.checkVisibility());
  for (const one of links) one.tabIndex = one === stop ? 0 : -1;
}

/** Focus the cell that a view of it was opened from. @param {Record<string, string>} fields */
export function focusCell(fields) {
  for (const link of /** @type {NodeListOf<HTMLAnchorElement>} */ (document.querySelectorAll("#matrix tr.line td a"))) {
    const target = new URLSearchParams(link.hash.slice(1));
    if (target.get("scenario") === fields.scenario && target.get("engine") === fields.engine) return link.focus();
  }
}

/**
 * Whether row i stands for its cell rather than row k.
 * @param {import("./report_data").Index} index @param {number} i @param {number} k
 */
export function outranks({ rows }, i, k) {
  return rows.severity[i] > rows.severity[k] || (rows.severity[i] === rows.severity[k] && rows.ratio[i] > rows.ratio[k]);
}

/** @param {import("./report_data").Index} index @param {number} i */
function cellOf(index, i) {
  const { rows } = index;
  const slug = index.slugs[rows.verdict[i]];
  const ratio = fromCode(rows.ratio[i]);
  const verdict = index.verdicts[rows.verdict[i]];
  const row = [index.levels[rows.level[i]], index.integrators[rows.integrator[i]], index.quantitys[rows.quantity[i]]];
  return h("td", { class: `cell ${slug}` },
    h("a", { href: href({ scenario: index.scenarios[rows.scenario[i]], engine: index.engines[rows.engine[i]], row: row.join("/") }), title: `${row[0]}, ${row[2]}${row[1] === "-" ? "" : ", " + row[1]}: ${index.reasons[i]}` },
      h("span", { class: `g ${slug}`, "aria-hidden": "true" }, index.glyphs[rows.verdict[i]]),
      h("span", { class: "vh" }, verdict + ","),
      h("span", { class: "q" }, Number.isNaN(ratio) ? verdict : number(ratio)),
      Number.isNaN(ratio) ? null : track(ratio)));
}

/**
 * Error over tolerance as a mark on a log scale, the tick in the middle is the tolerance.
 * @param {number} ratio
 */
export function track(ratio) {
  const at = Math.min(Math.max((Math.log10(Math.max(ratio, 1e-30)) + 4) * 12, 0), 96);
  return svg("svg", { class: "track", viewBox: "-3 0 102 6", preserveAspectRatio: "xMinYMid", "aria-hidden": "true" },
    svg("path", { d: "M0 3H96M48 .5v5" }), svg("circle", { cx: at.toFixed(1), cy: 3, r: 2.4 }));
}

/** @param {import("./report_data").Index} index */
function buildFilters(index) {
  const form = /** @type {HTMLFormElement} */ (document.getElementById("filters"));
  /** @param {string} name @param {string} title @param {string[]} values @param {(v: string) => string} [format] */
  const pick = (name, title, values, format = (v) => v) =>
    h("label", {}, title, h("select", { name }, h("option", { value: "" }, "all"), values.map((v) => h("option", { value: v }, format(v)))));
  form.append(
    h("label", {}, "Search", h("input", { type: "search", name: "q", placeholder: "scenario, engine, reason", spellcheck: "false" })),
    pick("verdict", "Verdict", [...index.verdicts, "!agrees"], (v) => (v === "!agrees" ? "anything but agrees" : v)),
    pick("engine", "Engine", index.engines, (v) => index.engine_titles[index.engines.indexOf(v)]),
    pick("family", "Family", [...new Set(index.families)]),
    pick("level", "Level", index.levels),
    pick("quantity", "Quantity", index.quantitys, (v) => v.replaceAll("_", " ")));
  if (index.passed) form.append(h("label", { class: "check" }, h("input", { type: "checkbox", name: "fresh", value: "1" }), "newly failing"));
  form.append(h("button", { type: "button", click: () => (location.hash = "view=matrix") }, "Clear"));
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("input", () => {
    /** @type {Record<string, string>} */
    const fields = {};
    for (const [name, value] of new FormData(form)) fields[name] = String(value);
    amend({ ...Object.fromEntries(FILTERS.map((name) => [name, ""])), ...fields, view: "" });
    showMatrix(index, read());
  });
}

/** @param {HTMLTableElement} table */
function buildFolds(table) {
  for (const body of table.tBodies) {
    const head = body.querySelector("tr.family th");
    if (!head) continue;
    const button = h("button", { type: "button", class: "fold", "aria-expanded": "true", click: () => {
      const folded = body.classList.toggle("folded");
      button.setAttribute("aria-expanded", String(!folded));
      setTabStop(table, table.querySelector("a[tabindex='0']"));
    } });
    button.append(...head.childNodes);
    head.replaceChildren(button);
  }
}

/** @param {KeyboardEvent} event */
function moveByArrow(event) {
  const step = /** @type {Record<string, [number, number]>} */ ({ ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] })[event.key];
  const cell = event.target instanceof Element ? event.target.closest("td.cell") : null;
  if (!step || !cell || event.altKey || event.ctrlKey || event.metaKey) return;
  const table = /** @type {HTMLTableElement} */ (event.currentTarget);
  const lines = [...table.querySelectorAll("tbody:not(.folded):not([hidden]) tr.line:not([hidden])")];
  let row = lines.indexOf(/** @type {Element} */ (cell.parentElement));
  let column = /** @type {HTMLTableCellElement} */ (cell).cellIndex;
  for (;;) {
    row += step[0];
    column += step[1];
    const next = /** @type {HTMLTableRowElement | undefined} */ (lines[row])?.cells[column];
    if (!next || column < 1) return;
    const link = next.querySelector("a");
    if (!link) continue; // an empty cell: continue in the same direction
    event.preventDefault();
    link.focus();
    return;
  }
}
