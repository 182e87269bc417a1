// Trends: every key's error over its tolerance, night by night, with version changes marked.
import { chunk, fromCode } from "./chunks.js";
import { chosen, filtersOf } from "./matrix.js";
import { axes, decades, path } from "./plot.js";
import { amend, href, read } from "./route.js";
import { h, number, svg } from "./text.js";

/** @typedef {import("./report_data").Index} Index @typedef {import("./report_data").HistoryChunk} HistoryChunk */

const SHOWN = 48;

/** @param {HTMLElement} root @param {Index} index @param {Record<string, string>} fields */
export async function showTrend(root, index, fields) {
  const past = /** @type {HistoryChunk | null} */ (await chunk("history"));
  root.replaceChildren(h("h1", { class: "cell-title", tabindex: -1 }, "Trends"));
  if (!past) {
    root.append(h("p", { class: "note" }, "This report was made without a history; give one with --history."));
    return;
  }
  const { nights } = past;
  const count = nights.length;
  const passes = chosen(index, filtersOf(fields));
  const rows = [...index.rows.scenario.keys()].filter(passes);
  /** How much a key changed: a change of verdict first, then decades. @param {number} i */
  const moved = (i) => {
    const verdicts = new Set(past.verdict.subarray(i * count, (i + 1) * count).filter(Boolean));
    const codes = [...past.ratio.subarray(i * count, (i + 1) * count)].filter((c) => c > 1);
    return (verdicts.size > 1 ? 1e6 : 0) + (codes.length ? Math.max(...codes) - Math.min(...codes) : 0);
  };
  const scores = new Map(rows.map((i) => [i, moved(i)]));
  rows.sort((a, b) => (scores.get(b) ?? 0) - (scores.get(a) ?? 0));
  const search = h("input", { type: "search", value: fields.q ?? "", placeholder: "scenario, quantity, verdict", spellcheck: "false", change: () => { amend({ q: search.value }); showTrend(root, index, read()).then(() => root.querySelector("input")?.focus()); } });
  const narrowed = Object.entries(filtersOf(fields)).map(([name, value]) => `${name}: ${value}`).join(", ");
  root.append(
    h("p", { class: "purpose" }, `Error over tolerance on ${count} nights, ${nights[0].started.slice(0, 10)} to ${nights[count - 1].started.slice(0, 10)}; the dashed line is the tolerance, a vertical line a change of that engine's version. Those that changed most come first.`),
    past.damaged.length ? h("p", { class: "note" }, `Skipped as damaged: ${past.damaged.join(", ")}`) : "",
    h("h2", { class: "sub" }, "Nights"), nightTable(past, index),
    h("h2", { class: "sub" }, `${rows.length} key${rows.length === 1 ? "" : "s"}`, narrowed ? ` (${narrowed})` : ""),
    h("div", { class: "filters", role: "search" }, h("label", {}, "Search keys", search)),
    h("p", { class: "keys" }, index.engines.map((name) => h("a", { href: href({ ...fields, view: "trend", engine: name }), "aria-current": fields.engine === name ? "true" : null }, name)), h("a", { href: "#view=trend" }, "all engines")),
    h("div", { class: "trends" }, rows.slice(0, SHOWN).map((i) => trend(past, index, i))));
  if (rows.length > SHOWN) root.append(h("p", { class: "why" }, `… and ${rows.length - SHOWN} that changed less; select an engine, or add a filter of the matrix to the address.`));
}

/** @param {HistoryChunk} past @param {Index} index @param {number} i */
function trend(past, index, i) {
  const { nights } = past;
  const count = nights.length;
  const engine = index.engines[index.rows.engine[i]];
  const name = [index.scenarios[index.rows.scenario[i]], engine, index.levels[index.rows.level[i]], index.integrators[index.rows.integrator[i]], index.quantitys[index.rows.quantity[i]]];
  const link = h("a", { href: href({ scenario: name[0], engine, row: name.slice(2).join("/") }) }, name.filter((part) => part !== "-").join(" · "));
  const values = [...past.value.subarray(i * count, (i + 1) * count)].map(fromCode);
  const ratios = [...past.ratio.subarray(i * count, (i + 1) * count)].map(fromCode);
  const range = decades([...ratios, 1]) ?? [0.1, 10];
  const plot = axes({
    width: 320, height: 120, left: 42, right: 8,
    x: { label: "", min: -0.5, max: count - 0.5, log: false, ticks: [[0, nights[0].started.slice(5, 10)], [count - 1, nights[count - 1].started.slice(5, 10)]] },
    y: { label: "", min: range[0], max: Math.max(range[1], 10) },
    label: `${name.join(" ")}: last ${number(ratios[count - 1])} of its tolerance`,
  });
  nights.forEach((night, k) => {
    if (k && night.versions?.[engine] !== nights[k - 1].versions?.[engine]) {
      const x = plot.x(k - 0.5);
      plot.root.append(svg("path", { class: "axis mark", d: `M${x} ${plot.top}V${plot.bottom}` }), svg("text", { x: x + 3, y: plot.top + 8 }, `${night.versions?.[engine] ?? "–"}`));
    }
  });
  plot.root.append(svg("path", { class: "tol", d: `M${plot.left} ${plot.y(1)}H${plot.right}` }), svg("path", { class: "ln s0", d: path(plot, ratios.map((_, k) => k), ratios.map((v) => (v > 0 ? v : null))) }));
  ratios.forEach((v, k) => {
    const verdict = past.verdict[i * count + k];
    if (!verdict) return;
    const slug = index.slugs[verdict - 1];
    const y = v > 0 ? Math.min(Math.max(plot.y(v), plot.top), plot.bottom) : plot.bottom;
    const fine = slug === "agrees" || slug === "information";
    plot.root.append(svg(fine ? "circle" : "rect", fine ? { class: "pt s0", cx: plot.x(k), cy: y, r: 2 } : { class: "bad", x: plot.x(k) - 3, y: y - 3, width: 6, height: 6 },
      svg("title", {}, `${nights[k].started.slice(0, 10)}: ${index.verdicts[verdict - 1]}, error ${number(values[k])}, ${number(v)} of its tolerance`)));
  });
  return h("div", {}, link, plot.root);
}

/** @param {HistoryChunk} past @param {Index} index */
function nightTable(past, index) {
  return h("details", {}, h("summary", {}, `${past.nights.length} nights with their verdicts and versions`), h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Nights" }, h("table", { class: "plain" },
    h("thead", {}, h("tr", {}, ["Night", "Commit", "Exit code", "Verdict", ...index.engine_titles].map((t) => h("th", { scope: "col" }, t)))),
    h("tbody", {}, past.nights.map((night, k) => h("tr", {}, h("td", {}, night.started.slice(0, 16).replace("T", " ")), h("td", {}, night.commit ?? "–"), h("td", {}, night.exit_code), h("td", {}, night.sentence),
      index.engines.map((engine) => {
        const version = night.versions?.[engine] ?? "–";
        const changed = k > 0 && past.nights[k - 1].versions?.[engine] !== night.versions?.[engine];
        return h("td", {}, changed ? h("b", {}, `→ ${version}`) : version);
      })))))));
}
