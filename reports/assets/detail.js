// One cell: what was compared with what, curves, motion, convergence, states, and how to repeat it.
import { chunk, fromCode } from "./chunks.js";
import { keys, panels, strokeOf } from "./curves.js";
import { outranks, track } from "./matrix.js";
import { motion } from "./motion.js";
import { axes, decades, path } from "./plot.js";
import { amend, href } from "./route.js";
import { copyable, h, number, svg } from "./text.js";

/** @typedef {import("./report_data").Index} Index @typedef {import("./report_data").ScenarioChunk} ScenarioChunk @typedef {import("./report_data").Study} Study */

/** @type {(() => void)[]} clean-up of the cell on show, called before the next one */
let cleanups = [];

export function closeCell() {
  for (const cleanup of cleanups) cleanup();
  cleanups = [];
}

/**
 * @param {HTMLElement} root @param {Index} index @param {Record<string, string>} fields @param {string} back link to the matrix with its last filters
 */
export async function showCell(root, index, fields, back) {
  closeCell();
  const s = index.scenarios.indexOf(fields.scenario);
  const e = index.engines.indexOf(fields.engine);
  if (s < 0 || e < 0) {
    root.replaceChildren(h("h1", { class: "cell-title", tabindex: -1 }, "No such cell"), h("p", {}, `This run has no scenario “${fields.scenario}” with engine “${fields.engine}”. `, h("a", { href: back }, "To the matrix")));
    return;
  }
  const [packed, studies] = /** @type {[import("./report_data").PackedScenario, Study[]]} */ (await Promise.all([chunk(`scenario-${s}`), chunk("convergence")]));
  let place = 0;
  /** @type {ScenarioChunk} */
  const data = { ...packed, rows: Object.fromEntries(packed.places.map((step, k) => [(place += step), packed.rows[k]])) };
  const ours = [...index.rows.scenario.keys()].filter((i) => index.rows.scenario[i] === s && index.rows.engine[i] === e);
  const { scenario } = data;
  const title = index.engine_titles[e];
  /** @param {number} step */
  const neighbour = (step) => index.scenarios[(s + step + index.scenarios.length) % index.scenarios.length];
  const joints = [...new Set(scenario.joints)].map((kind) => `${scenario.joints.filter((j) => j === kind).length} ${kind}${scenario.joints.filter((j) => j === kind).length === 1 ? "" : "s"}`).join(", ");
  const version = ours.map((i) => data.rows[i]?.engine_version).find(Boolean);
  root.replaceChildren(
    h("nav", { class: "crumbs", "aria-label": "Place in the report" },
      h("a", { href: back }, "← Matrix"), h("span", {}, scenario.family), h("span", { class: "sep" }),
      index.scenarios.length > 1 && h("a", { href: href({ scenario: neighbour(-1), engine: fields.engine }), rel: "prev" }, `‹ ${neighbour(-1)}`),
      index.scenarios.length > 1 && h("a", { href: href({ scenario: neighbour(1), engine: fields.engine }), rel: "next" }, `${neighbour(1)} ›`)),
    h("h1", { class: "cell-title", tabindex: -1 }, fields.scenario, h("span", { class: "on" }, ` on ${title}`)),
    h("p", { class: "purpose" }, `${scenario.title}. ${scenario.purpose}`),
    h("dl", { class: "facts" },
      fact("Bodies", scenario.bodies), fact("Joints", joints), ...loopFacts(scenario), fact("Duration", `${number(scenario.duration, 3)} s`),
      fact("Horizon", scenario.horizon === null ? "–" : `${number(scenario.horizon, 3)} s`),
      fact("Truth", scenario.truth ?? "–"), fact("Exact solution", typeof scenario.exact === "string" ? scenario.exact : scenario.exact ? "yes" : "none"),
      fact("Uncertainty of truth", scenario.truth_uncertainty === null ? "–" : `${number(scenario.truth_uncertainty)} m`),
      fact("Engine", `${title} ${version ?? ""}`), fact("File", scenario.file), fact("Digest", scenario.digest.slice(0, 12))),
    h("ul", { class: "enginetabs" }, index.engines.map((name, k) => {
      const theirs = speaker(index, s, k);
      return h("li", {}, h("a", { href: href({ scenario: fields.scenario, engine: name }), "aria-current": k === e ? "page" : null },
        theirs === null ? null : h("span", { class: `g ${index.slugs[index.rows.verdict[theirs]]}`, "aria-hidden": "true" }, index.glyphs[index.rows.verdict[theirs]]),
        theirs === null ? null : h("span", { class: "vh" }, index.verdicts[index.rows.verdict[theirs]] + " "), index.engine_titles[k]));
    })));
  const diagnoses = new Set();
  for (const i of ours) {
    const row = data.rows[i];
    if (!row?.diagnosis || diagnoses.has(row.diagnosis)) continue;
    diagnoses.add(row.diagnosis);
    root.append(h("p", { class: `callout ${index.slugs[index.rows.verdict[i]]}` }, row.diagnosis, h("small", {}, `Diagnosis of ${index.levels[index.rows.level[i]]}, ${index.quantitys[index.rows.quantity[i]]}`)));
  }
  root.append(h("h2", { class: "sub" }, "What was compared"), compared(index, data, ours, fields));
  moving(root, index, data, fields);
  if (data.departures) root.append(h("h2", { class: "sub" }, "When engines provably leave the true motion"), ...departures(index, data, data.departures));
  const plots = h("div", { class: "plots" });
  const study = studies.filter((one) => one.scenario === fields.scenario && one.engine === fields.engine);
  for (const kind of /** @type {const} */ (["step", "tolerance"])) {
    const plot = workPrecision(study.filter((one) => one.kind === kind && one.quantity === "position"), kind);
    if (plot) plots.append(plot);
  }
  const spread = stateSpread(data.states.filter((one) => one.engine === fields.engine));
  if (spread) plots.append(spread);
  if (plots.childElementCount) root.append(h("h2", { class: "sub" }, "Convergence and states"), plots);
  root.append(h("h2", { class: "sub" }, "Repeat this cell"));
  for (const level of [...new Set(ours.map((i) => index.levels[index.rows.level[i]])), "long"]) {
    const line = data.commands[`${fields.engine}/${level}`];
    if (line && ![...root.querySelectorAll("pre")].some((pre) => pre.textContent === line)) root.append(copyable(line, `command for ${level}`));
  }
  /** @type {Map<string, string[]>} */
  const scripts = new Map();
  for (const i of ours) {
    const script = data.rows[i]?.script;
    if (script) scripts.set(script, [...(scripts.get(script) ?? []), `${index.levels[index.rows.level[i]]}, ${index.quantitys[index.rows.quantity[i]].replaceAll("_", " ")}`]);
  }
  for (const [script, names] of scripts) root.append(h("details", {}, h("summary", {}, `Stand-alone script: ${[...new Set(names)].join("; ")}`), copyable(script, "script")));
}

/** @param {string} name @param {string | number} value */
const fact = (name, value) => h("div", {}, h("dt", {}, name), h("dd", {}, value));

/**
 * The row that stands for a cell; null for an empty one.
 * @param {Index} index @param {number} s @param {number} e
 */
function speaker(index, s, e) {
  const { rows } = index;
  let found = -1;
  for (let i = 0; i < rows.scenario.length; i++) {
    if (rows.scenario[i] !== s || rows.engine[i] !== e) continue;
    if (found < 0 || outranks(index, i, found)) found = i;
  }
  return found < 0 ? null : found;
}

/** What closes loops, and what its rows leave determinate of the joints' forces and moments. @param {ScenarioChunk["scenario"]} scenario */
function loopFacts({ loops }) {
  if (!loops) return [];
  const least = Math.min(...loops.determinate);
  const wrench = least === 6 ? "forces and moments of all joints are determinate"
    : `of force and moment ${least} of 6 components or more are determinate, and compared, at ${loops.determinate.filter((rank) => rank < 6).length} joints`;
  return [fact("Closed by", loops.closing.join(", ")), fact("Rows that close", `${loops.rows}, ${loops.independent} of them independent; ${wrench}`)];
}

const LEVELS = ["state", "surface", "step", "trajectory", "invariants", "relations"];

/** The name of a row within its cell. @param {Index} index @param {number} i */
const placeOf = ({ rows, levels, integrators, quantitys }, i) => [levels[rows.level[i]], integrators[rows.integrator[i]], quantitys[rows.quantity[i]]].join("/");

/**
 * Every row of the cell: quantities down, integrators across, one table per set of integrators; and
 * below them the one that is chosen, with its tolerance's derivation.
 * @param {Index} index @param {ScenarioChunk} data @param {number[]} ours @param {Record<string, string>} fields
 */
function compared(index, data, ours, fields) {
  const { rows } = index;
  const chosenBox = h("div", { class: "chosen-row", "aria-live": "polite" });
  const tables = h("div", { class: "tables" });
  /** @type {Map<number, HTMLButtonElement>} */
  const buttons = new Map();
  /** @param {number} i @param {boolean} byUser */
  const choose = (i, byUser) => {
    for (const [k, button] of buttons) button.setAttribute("aria-pressed", String(k === i));
    chosenBox.replaceChildren(chosenRow(index, data.rows[i] ?? {}, i));
    if (byUser) amend({ row: placeOf(index, i) });
  };
  const withoutIntegrator = ours.filter((i) => index.integrators[rows.integrator[i]] === "-");
  const byIntegrator = ours.filter((i) => index.integrators[rows.integrator[i]] !== "-");
  for (const part of [withoutIntegrator, byIntegrator]) {
    if (!part.length) continue;
    const integrators = [...new Set(part.map((i) => rows.integrator[i]))];
    const body = h("tbody");
    const lines = [...new Set(part.map((i) => `${LEVELS.indexOf(index.levels[rows.level[i]])}/${rows.quantity[i]}`))].sort((a, b) => parseInt(a) - parseInt(b));
    let level = "";
    for (const line of lines) {
      const these = part.filter((i) => `${LEVELS.indexOf(index.levels[rows.level[i]])}/${rows.quantity[i]}` === line);
      const name = index.levels[rows.level[these[0]]];
      if (name !== level) body.append(h("tr", { class: "lvl" }, h("th", { scope: "rowgroup", colspan: integrators.length + 1 }, (level = name))));
      const unit = these.map((i) => data.rows[i]?.unit).find(Boolean);
      body.append(h("tr", {}, h("th", { scope: "row" }, index.quantitys[rows.quantity[these[0]]].replaceAll("_", " "), h("span", { class: "why" }, unitOf(unit) && ` [${unit}]`)),
        integrators.map((integrator) => {
          const i = these.find((k) => rows.integrator[k] === integrator);
          if (i === undefined) return h("td", {}, "");
          const row = data.rows[i] ?? {};
          const slug = index.slugs[rows.verdict[i]];
          const ratio = fromCode(rows.ratio[i]);
          const button = h("button", { type: "button", class: "row", "aria-pressed": "false", title: index.reasons[i], click: () => choose(i, true) },
            h("span", { class: `g ${slug}`, "aria-hidden": "true" }, index.glyphs[rows.verdict[i]]), h("span", { class: "vh" }, index.verdicts[rows.verdict[i]] + ", "),
            h("span", { class: "q" }, row.value === undefined || row.value === null ? index.verdicts[rows.verdict[i]] : number(row.value)),
            row.known_issue ? h("sup", {}, "†") : null,
            row.tolerance === undefined || row.tolerance === null ? null : h("span", { class: "why" }, `of ${number(row.tolerance)}`),
            Number.isNaN(ratio) ? null : track(ratio));
          buttons.set(i, button);
          return h("td", { class: slug }, button);
        })));
    }
    tables.append(h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": part === withoutIntegrator ? "Without an integrator" : "By integrator" },
      h("table", { class: "plain compared" },
        h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "Quantity"), integrators.map((k) => {
          const alias = part.map((i) => (rows.integrator[i] === k ? data.rows[i]?.alias_of : undefined)).find(Boolean);
          return h("th", { scope: "col" }, index.integrators[k] === "-" ? "error, of its bound" : index.integrators[k], alias ? h("span", { class: "why" }, ` = ${alias}`) : null);
        }))), body)));
  }
  const worst = ours.reduce((a, b) => (outranks(index, b, a) ? b : a), ours[0]);
  const requested = ours.find((i) => placeOf(index, i) === fields.row);
  if (ours.length) choose(requested ?? worst, false);
  if (requested !== undefined) queueMicrotask(() => buttons.get(requested)?.focus({ preventScroll: true }));
  return h("div", {}, tables, chosenBox);
}

/** "" for a pure number. @param {string | undefined} unit */
const unitOf = (unit) => (unit && unit !== "1" && unit !== "–" ? unit : "");

/** @param {Index} index @param {import("./report_data").RowDetail} row @param {number} i */
function chosenRow(index, row, i) {
  const { rows } = index;
  const slug = index.slugs[rows.verdict[i]];
  const integrator = index.integrators[rows.integrator[i]];
  return h("section", { class: `chosen ${slug}`, "aria-label": "Chosen comparison" },
    h("h3", {}, h("span", { class: `g ${slug}`, "aria-hidden": "true" }, index.glyphs[rows.verdict[i]]), ` ${index.quantitys[rows.quantity[i]].replaceAll("_", " ")}${integrator === "-" ? "" : `, ${integrator}`} `, h("span", { class: "what" }, index.verdicts[rows.verdict[i]])),
    h("p", { class: "reason" }, index.reasons[i]), derivation(row));
}

/** Label and unit of a row's further numbers; "row" for the unit of its error. @type {Record<string, [string, string]>} */
const EXTRA = {
  calls: ["Calls compared", ""], relative: ["Error over scale", ""], bound_relative: ["Tolerance over scale, largest", ""], states: ["States compared", ""], compared_states: ["With a tolerance tight enough", ""], comparisons: ["Comparisons", ""], scenarios: ["Scenarios", ""], state: ["Worst state", ""], body: ["Worst body", ""],
  visible: ["Effect of a detectable mistake", "row"], growth: ["Growth of a perturbation", ""], resolution: ["Finest step or tolerance", ""], scale: ["Scale", "row"],
  whole: ["Drift at the end", "row"], limit: ["Drift of the limit", "row"], limit_tolerance: ["Tolerance of the limit", "row"], limit_error: ["Uncertainty of the limit", "row"], asked: ["Requested duration", "s"], end: ["End", "s"], step: ["Step size", "s"], steps: ["Steps", ""], worst_step: ["Worst step", ""], first_step: ["First wrong step", ""], wrong_steps: ["Wrong steps", ""], left_out_steps: ["Steps not compared", ""], left_out_wrong_steps: ["Of these, steps that differ", ""], scatter: ["Scatter of the error over the tolerance", ""],
};

/** @param {import("./report_data").RowDetail} row */
function derivation(row) {
  const list = h("dl", { class: "derive" });
  /** @param {string} name @param {string | number | null | undefined} value */
  const entry = (name, value) => value !== null && value !== undefined && value !== "" && list.append(h("dt", {}, name), h("dd", {}, value));
  entry("Diagnosis", row.diagnosis);
  entry("Tolerance", row.tolerance === undefined ? null : `${number(row.tolerance, 4)} ${unitOf(row.unit)}${row.derivation ? ": " + row.derivation : ""}`);
  entry("Measured", row.value === undefined ? null : `${number(row.value, 4)} ${unitOf(row.unit)}`);
  entry("Uncertainty", row.uncertainty === undefined ? null : `${number(row.uncertainty, 3)} ${unitOf(row.unit)}, of the truth and of the limit together`);
  entry("Horizon", row.compared_until === undefined ? null : `${number(row.compared_until, 3)} s, up to which positions were compared`);
  entry("Order", row.order === undefined ? null : `observed ${number(row.order, 4)}${row.declared_order ? `, declared ${row.declared_order}` : ""}`);
  entry("Alias", row.alias_of ? `equals ${row.alias_of} here, so it is not independent evidence` : null);
  entry(row.is_declared ? "Declared gap" : "Known issue", row.known_issue);
  entry("Your tolerance", row.user_rtol === undefined ? null : `${number(row.user_rtol)} ${unitOf(row.unit)}: the error is ${(row.value ?? Infinity) <= row.user_rtol ? "within" : "above"} the tolerance given on the command line; the verdict does not depend on it`);
  for (const [name, value] of Object.entries(row.extra ?? {})) {
    const [label, unit] = EXTRA[name] ?? [name.replaceAll("_", " "), ""];
    entry(label, `${Number.isInteger(value) && Math.abs(value ?? 0) < 1e6 ? value : number(value, 4)} ${unit === "row" ? unitOf(row.unit) : unit}`);
  }
  entry("CPU time", row.cpu_time === undefined ? null : `${number(row.cpu_time)} s`);
  return list;
}

/** @param {HTMLElement} root @param {Index} index @param {ScenarioChunk} data @param {Record<string, string>} fields */
function moving(root, index, data, fields) {
  const curves = data.curves ?? [];
  if (!curves.length && !data.motion) return;
  const end = Math.max(...curves.map((set) => set.t[set.t.length - 1]), data.motion ? data.motion.t[data.motion.t.length - 1] : 0);
  const crossings = curves.filter((set) => set.engine === fields.engine && set.crossing !== undefined);
  const first = crossings.length ? crossings.reduce((a, b) => (/** @type {number} */ (b.crossing) < /** @type {number} */ (a.crossing) ? b : a)) : null;
  const room = h("section", { class: "moving", "aria-label": "Motion and curves" });
  root.append(h("h2", { class: "sub" }, data.motion && !data.motion.base[0] ? "Initial state" : "Motion and curves"), room);
  /** @param {string} engine */
  const titleOf = (engine) => index.engine_titles[index.engines.indexOf(engine)];
  /** @type {ReturnType<typeof panels> | null} */
  let drawn = null;
  const stage = motion(data, {
    engine: fields.engine, engines: index.engines, titleOf, judged: curves.some((set) => set.engine === fields.engine && set.tolerance), end, start: Number(fields.t) || 0, magnify: fields.mag === undefined ? null : Number(fields.mag),
    crossing: first ? { t: /** @type {number} */ (first.crossing), name: first.integrator } : null,
    onTime: (t) => drawn?.setTime(t),
    onRest: (state) => amend(state),
  });
  room.append(stage.root);
  cleanups.push(stage.destroy);
  const choice = h("select", { "aria-label": "Curves shown" }, h("option", { value: "" }, "this engine, every integrator"), h("option", { value: "all" }, "every engine, its best integrator"));
  choice.value = fields.curves === "all" ? "all" : "";
  const legend = h("div");
  const area = h("div", { class: "panels" });
  if (curves.length) room.append(h("div", { class: "crumbs" }, choice, legend), area);
  if (end > 0) room.append(stage.transport);
  const draw = () => {
    drawn?.destroy();
    area.replaceChildren();
    const sets = choice.value === "all" ? best(curves) : curves.filter((set) => set.engine === fields.engine);
    const series = sets.map((set, k) => ({ set, name: choice.value === "all" ? `${titleOf(set.engine)} ${set.integrator}` : set.integrator, stroke: strokeOf(choice.value === "all" ? index.engines.indexOf(set.engine) : k) }));
    if (!series.length) area.append(h("p", { class: "note" }, "No trajectory of this engine was stored; the table above has the reasons."));
    legend.replaceChildren(keys(series, sets.some((set) => set.tolerance)));
    drawn = panels(area, series, data.scenario.horizon, (t) => stage.setTime(t));
    drawn.setTime(stage.time());
  };
  choice.addEventListener("change", () => {
    amend({ curves: choice.value });
    draw();
  });
  if (curves.length) draw();
  cleanups.push(() => drawn?.destroy());
}

/**
 * Of every run the first sample at which it is off by more than the proof's radius and a fixed distance.
 * @param {Index} index @param {ScenarioChunk} data @param {import("./report_data").Departures} found
 */
function departures(index, { scenario }, { distance, runs }) {
  const absent = index.engines.filter((name) => !runs.some((run) => run.engine === name)).map((name) => index.engine_titles[index.engines.indexOf(name)]);
  return [
    h("p", { class: "why" }, `The true motion is ${scenario.truth}; the certificate is that of plumbline prove. A run has left it at the first sample (one every ${number(scenario.sample, 3)} s) at which a body's position is more than ${number(distance, 1)} m plus the radius from the midpoint: that it is wrong by then is a theorem. Of every integrator the finest run.${absent.length ? ` No finished run of ${absent.join(", ")}.` : ""}`),
    h("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "When engines leave the true motion" },
      h("table", { class: "plain departures" },
        h("thead", {}, h("tr", {}, ["Engine", "Integrator", "Step or tolerance", "Leaves the true motion"].map((name) => h("th", { scope: "col" }, name)))),
        h("tbody", {}, runs.map(({ engine, integrator, kind, resolution, left, until }) => h("tr", {},
          h("th", { scope: "row" }, index.engine_titles[index.engines.indexOf(engine)]), h("td", {}, integrator),
          h("td", {}, kind === "step" ? `step ${number(resolution, 3)} s` : `tolerance ${number(resolution, 1)}`),
          h("td", {}, left === null ? `stays within ${number(distance, 1)} m up to ${number(until, 3)} s` : `at ${number(left, 4)} s`)))))),
  ];
}

/**
 * Of each engine the curve that ends with the smallest error.
 * @param {import("./report_data").CurveSet[]} curves
 */
function best(curves) {
  /** @param {import("./report_data").CurveSet} set */
  const last = (set) => {
    const error = set.position_error ? fromCode(set.position_error[set.position_error.length - 1]) : 0;
    return Number.isNaN(error) ? Infinity : error;
  };
  /** @type {Map<string, import("./report_data").CurveSet>} */
  const found = new Map();
  for (const set of curves) {
    const other = found.get(set.engine);
    if (!other || last(set) < last(other)) found.set(set.engine, set);
  }
  return [...found.values()];
}

/** @param {Study[]} studies @param {"step" | "tolerance"} kind */
function workPrecision(studies, kind) {
  const xs = decades(studies.flatMap((one) => one.resolution.map((v) => v ?? 0)));
  const ys = decades(studies.flatMap((one) => one.error.map((v) => v ?? 0)));
  if (!xs || !ys) return null;
  const name = kind === "step" ? "step" : "relative tolerance";
  const words = studies.map((one) => `${one.integrator} order ${number(lastNumber(one.order), 3)}`).join(", ");
  const plot = axes({ title: `Position error up to the horizon against ${name}`, x: { label: kind === "step" ? "step [s]" : "relative tolerance", min: xs[0], max: xs[1] }, y: { label: "error [m]", min: ys[0], max: ys[1] }, right: 110, label: `Error against ${name}: ${words}` });
  /** @type {{ y: number, x: number, text: string, css: string }[]} */
  const labels = [];
  studies.forEach((one, k) => {
    const { css } = strokeOf(k);
    plot.root.append(svg("path", { class: `ln ${css}`, d: path(plot, one.resolution, one.error) }));
    one.resolution.forEach((x, j) => {
      const y = one.error[j];
      if (!x || !y) return;
      plot.root.append(svg("circle", { class: `pt ${css}`, cx: plot.x(x).toFixed(1), cy: plot.y(y).toFixed(1), r: 3 }, svg("title", {}, `${one.integrator}: ${number(x, 3)} → ${number(y, 3)} m${one.order[j] === null ? "" : `, order ${number(one.order[j], 3)}`}`)));
    });
    const at = one.error.findIndex((y) => y !== null && y > 0);
    if (at < 0) return;
    const y = plot.y(one.error[at] ?? 1);
    const order = lastNumber(one.order);
    labels.push({ y: y + 4, x: plot.x(one.resolution[at] ?? 1) + 7, css, text: one.integrator + (kind === "step" && order !== null ? ` ${number(order, 3)}` : "") });
    if (kind === "step" && one.declared) triangle(plot, one, one.declared);
  });
  labels.sort((a, b) => a.y - b.y).forEach((label, k) => {
    if (k) label.y = Math.max(label.y, labels[k - 1].y + 13); // labels must not overlap
    plot.root.append(svg("text", { class: `series ${label.css}`, x: label.x, y: label.y }, label.text));
  });
  return h("div", {}, plot.root);
}

/** @param {(number | null)[]} values */
const lastNumber = (values) => [...values].reverse().find((v) => v !== null) ?? null;

/**
 * The declared order as a slope, under the middle of the curve.
 * @param {import("./plot.js").Plot} plot @param {Study} one @param {number} order
 */
function triangle(plot, one, order) {
  const good = one.resolution.map((x, j) => [x ?? 0, one.error[j] ?? 0]).filter(([x, y]) => x > 0 && y > 0);
  if (good.length < 2) return;
  const [x1, y1] = good[Math.floor((good.length - 2) / 2)];
  const x0 = good[Math.floor((good.length - 2) / 2) + 1][0];
  const y0 = y1 * (x0 / x1) ** order;
  const drop = 9;
  const [a, b, top, low] = [plot.x(x0), plot.x(x1), plot.y(y1) + drop, plot.y(y0) + drop];
  if (low > plot.bottom) return;
  plot.root.append(svg("path", { class: "tri", d: `M${a} ${low}H${b}V${top}Z` }), svg("text", { x: b + 4, y: (top + low) / 2 + 4 }, String(order)));
}

/** @param {import("./report_data").StateSpread[]} spreads */
function stateSpread(spreads) {
  const values = spreads.map((one) => Array.from(one.ratio, fromCode));
  const range = decades([...values.flat(), 1]);
  if (!range || !spreads.length) return null;
  const low = Math.max(range[0], 1e-8);
  const high = Math.max(range[1], 10);
  const step = 34;
  const height = 62 + step * spreads.length;
  const words = spreads.map((one, k) => `${one.quantity} worst ${number(Math.max(...values[k].filter((v) => !Number.isNaN(v))))}`).join(", ");
  const plot = axes({ title: `Error over its bound at ${values[0].length} states`, x: { label: "error / bound", min: low, max: high }, y: { label: "", min: 0, max: spreads.length, log: false, ticks: [] }, height, left: 132, label: `Error over bound: ${words}` });
  plot.root.append(svg("path", { class: "tol", d: `M${plot.x(1)} ${plot.top}V${plot.bottom}` }));
  spreads.forEach((one, k) => {
    const y = plot.y(spreads.length - k - 0.5);
    const sorted = values[k].filter((v) => v > 0 && Number.isFinite(v)).sort((a, b) => a - b);
    plot.root.append(svg("text", { x: 126, y: y + 4, "text-anchor": "end" }, one.quantity.replaceAll("_", " ")));
    if (sorted.length) {
      const [q1, q2, q3] = [0.25, 0.5, 0.75].map((q) => plot.x(Math.max(low, sorted[Math.floor(q * (sorted.length - 1))])));
      plot.root.append(svg("rect", { class: "box s0", x: q1, y: y - 9, width: Math.max(1, q3 - q1), height: 18 }), svg("path", { class: "ln s0", d: `M${q2} ${y - 9}V${y + 9}` }));
    }
    values[k].forEach((v, place) => {
      const at = Number.isNaN(v) ? high : Math.min(Math.max(v, low), high);
      plot.root.append(svg("circle", { class: v <= 1 ? "pt s0" : "bad", cx: plot.x(at).toFixed(1), cy: (y - 8 + ((place * 7) % 17)).toFixed(1), r: 1.8 }, svg("title", {}, number(v))));
    });
  });
  const top = spreads.reduce((a, b) => (Math.max(...b.ratio) > Math.max(...a.ratio) ? b : a));
  return h("div", {}, plot.root, h("p", { class: "why" }, `Closest to its bound: ${top.quantity.replaceAll("_", " ")} at state ${top.worst[0]}, body ${top.worst[1]} (error ${number(top.error)}; median bound ${number(top.bound)})`));
}
