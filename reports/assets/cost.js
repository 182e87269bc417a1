// Convergence and cost: error against CPU time per family, and the observed orders.
import { chunk } from "./chunks.js";
import { strokeOf } from "./curves.js";
import { axes, decades, path } from "./plot.js";
import { amend, read } from "./route.js";
import { decade, h, number, svg } from "./text.js";

/** @typedef {import("./report_data").Study} Study @typedef {import("./report_data").Index} Index */

const TARGETS = [1e-4, 1e-6, 1e-8, 1e-10];

/** @param {HTMLElement} root @param {Index} index @param {Record<string, string>} fields */
export async function showCost(root, index, fields) {
  const all = /** @type {Study[]} */ ((await chunk("convergence")) ?? []);
  const choice = h("select", { name: "quantity", change: () => { amend({ quantity: choice.value }); showCost(root, index, read()).then(() => root.querySelector("select")?.focus()); } },
    [...new Set(all.map((one) => one.quantity))].map((q) => h("option", { value: q }, q)));
  choice.value = fields.quantity && all.some((one) => one.quantity === fields.quantity) ? fields.quantity : "position";
  const studies = all.filter((one) => one.quantity === choice.value);
  const unit = choice.value === "attitude" ? "rad" : "m";
  const methods = [...new Set(studies.map((one) => `${one.engine} ${one.integrator}`))];
  const strokes = new Map(methods.map((name) => {
    const engine = name.slice(0, name.indexOf(" "));
    const siblings = methods.filter((other) => other.startsWith(engine + " "));
    return [name, strokeOf((index.engines.indexOf(engine) % 8) + 8 * siblings.indexOf(name))]; // the colour is the engine's, the dashes are the integrator's
  }));
  root.replaceChildren(
    h("h1", { class: "cell-title", tabindex: -1 }, "Convergence and cost"),
    h("p", { class: "purpose" }, "Error, up to the scenario's horizon, against the CPU time that it took: thin lines are scenarios, bold ones the geometric mean of the family at each refinement. Lower and further left is better."),
    h("p", {}, h("label", { class: "pick" }, "Quantity", choice)),
    h("ul", { class: "keys" }, methods.map((name) => h("li", {}, svg("svg", { class: "plot", viewBox: "0 0 26 8" }, svg("path", { class: `ln ${strokes.get(name)?.css}`, d: "M0 4H26" })), name))));
  if (!studies.length) {
    root.append(h("p", { class: "note" }, "No convergence study was stored with this run."));
    return;
  }
  const plots = h("div", { class: "plots" });
  const families = [...new Set(index.families)];
  const xs = /** @type {[number, number]} */ (decades(studies.flatMap((one) => one.cost.map((v, k) => ((one.error[k] ?? 0) > 0 ? (v ?? 0) : 0)))) ?? [1e-3, 1]);
  const ys = /** @type {[number, number]} */ (decades(studies.flatMap((one) => one.error.map((v) => v ?? 0))) ?? [1e-12, 1]);
  for (const family of families) {
    const ours = studies.filter((one) => index.families[index.scenarios.indexOf(one.scenario)] === family);
    if (!ours.length) continue;
    const plot = axes({ title: family, x: { label: "CPU time [s]", min: xs[0], max: xs[1] }, y: { label: `error [${unit}]`, min: ys[0], max: ys[1] }, label: `Error against CPU time, family ${family}; the table below has the times` });
    for (const name of methods) {
      const group = ours.filter((one) => `${one.engine} ${one.integrator}` === name);
      const css = strokes.get(name)?.css ?? "";
      for (const one of group) plot.root.append(svg("path", { class: `ln thin ${css}`, d: path(plot, one.cost, one.error) }));
      const steps = Math.max(0, ...group.map((one) => one.error.length));
      /** @type {[number, number][]} */
      const mean = [];
      for (let k = 0; k < steps; k++) {
        const points = group.map((one) => [one.cost[k] ?? 0, one.error[k] ?? 0]).filter(([c, e]) => c > 0 && e > 0);
        if (points.length) mean.push([geometric(points.map(([c]) => c)), geometric(points.map(([, e]) => e))]);
      }
      plot.root.append(svg("path", { class: `ln ${css}`, d: path(plot, mean.map(([c]) => c), mean.map(([, e]) => e)) }));
      for (const [c, e] of mean) plot.root.append(svg("circle", { class: `pt ${css}`, cx: plot.x(c).toFixed(1), cy: plot.y(e).toFixed(1), r: 2.6 }, svg("title", {}, `${name}: ${number(e)} ${unit} in ${number(c)} s`)));
    }
    plots.append(h("div", {}, plot.root));
  }
  root.append(plots, h("h2", { class: "sub" }, `CPU time to reach an error, geometric mean over the scenarios that reach it`), costTable(studies, methods, unit), h("h2", { class: "sub" }, "Observed order"), h("p", { class: "why" }, "Of the studies whose order is resolved; one that is not in its asymptotic range shows no order."), orderTable(index, studies, methods));
}

/** @param {number[]} values */
const geometric = (values) => Math.exp(values.reduce((sum, v) => sum + Math.log(v), 0) / values.length);

/**
 * CPU time at which a study's error falls to the target, by interpolation between its points; null where it does not.
 * @param {Study} one @param {number} target
 */
function timeTo(one, target) {
  for (let k = 0; k < one.error.length; k++) {
    const [e1, c1] = [one.error[k], one.cost[k]];
    if (e1 === null || c1 === null || !(c1 > 0) || e1 > target) continue;
    const [e0, c0] = [one.error[k - 1] ?? null, one.cost[k - 1] ?? null];
    if (e0 === null || c0 === null || !(e0 > target) || !(c0 > 0) || !(e1 > 0)) return c1;
    return c0 * (c1 / c0) ** (Math.log(e0 / target) / Math.log(e0 / e1));
  }
  return null;
}

/** @param {Study[]} studies @param {string[]} methods @param {string} unit */
function costTable(studies, methods, unit) {
  return h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "CPU time to reach an error" }, h("table", { class: "plain" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Engine and integrator"), TARGETS.map((t) => h("th", { scope: "col", class: "r" }, `${decade(Math.round(Math.log10(t)))} ${unit}`)))),
    h("tbody", {}, methods.map((name) => {
      const group = studies.filter((one) => `${one.engine} ${one.integrator}` === name);
      return h("tr", {}, h("th", { scope: "row" }, name), TARGETS.map((target) => {
        const times = group.map((one) => timeTo(one, target)).filter((t) => t !== null);
        return h("td", { class: "r" }, times.length ? `${number(geometric(times))} s` : "–", h("span", { class: "why" }, ` ${times.length}/${group.length}`));
      }));
    }))));
}

/** @param {Index} index @param {Study[]} studies @param {string[]} methods */
function orderTable(index, studies, methods) {
  const { rows } = index;
  const unresolved = new Set();
  for (let i = 0; i < rows.scenario.length; i++) {
    if (index.quantitys[rows.quantity[i]] === "order" && index.verdicts[rows.verdict[i]] === "unresolved") {
      unresolved.add([index.scenarios[rows.scenario[i]], index.engines[rows.engine[i]], index.integrators[rows.integrator[i]]].join("/"));
    }
  }
  return h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Observed order" }, h("table", { class: "plain" },
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Engine and integrator"), ["Declared", "Median", "Lowest", "Highest", "Studies"].map((t) => h("th", { scope: "col", class: "r" }, t)))),
    h("tbody", {}, methods.map((name) => {
      const group = studies.filter((one) => `${one.engine} ${one.integrator}` === name && one.kind === "step");
      const resolved = group.filter((one) => !unresolved.has([one.scenario, one.engine, one.integrator].join("/")));
      const orders = resolved.map((one) => [...one.order].reverse().find((v) => v !== null) ?? null).filter((v) => v !== null).sort((a, b) => a - b);
      if (!group.length) return null;
      return h("tr", {}, h("th", { scope: "row" }, name + (group[0].alias ? ` = ${group[0].alias}` : "")),
        [number(group[0].declared, 1), ...[orders[orders.length >> 1], orders[0], orders[orders.length - 1]].map((v) => number(v, 3)), `${orders.length} of ${group.length}`].map((text) => h("td", { class: "r" }, text)));
    }))));
}
