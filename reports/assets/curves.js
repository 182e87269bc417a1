// Curves over time, one panel per quantity, all on one clock; drawn by uPlot on log scales.
import { fromCode } from "./chunks.js";
import { decades, powers } from "./plot.js";
import { decade, h, ink, number, svg } from "./text.js";

/** @typedef {import("./report_data").CurveSet} CurveSet */

const PANELS = /** @type {const} */ ([
  ["position_error", "Position error, finest run", "m"],
  ["limit_error", "Position error, limit of the steps", "m"],
  ["attitude_error", "Attitude error", "rad"],
  ["energy_drift", "Energy drift", "J"],
  ["momentum_drift", "Angular momentum drift", "kg m²/s"],
  ["joint_gap", "Joint gap", "m"],
  ["gap_rate", "Gap rate", "m/s"],
  ["norm_drift", "‖p‖ − 1", "–"],
]);
const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3]];

/**
 * The colour and dash of the k-th series, the same in every picture of a view.
 * @param {number} k
 */
export const strokeOf = (k) => ({ colour: `--c${k % 8}`, dash: DASHES[Math.floor(k / 8) % 4], css: `s${k % 8} d${Math.floor(k / 8) % 4}` });

/**
 * Panels into `root`. `onTime` is called where a panel is clicked.
 * @param {HTMLElement} root @param {{ set: CurveSet, name: string, stroke: ReturnType<typeof strokeOf> }[]} series
 * @param {number | null} horizon @param {(t: number) => void} onTime
 * @returns {{ setTime: (t: number) => void, destroy: () => void }}
 */
export function panels(root, series, horizon, onTime) {
  /** @type {{ plot: uPlot, marker: HTMLElement }[]} */
  const shown = [];
  const sync = uPlot.sync("time" + Math.random());
  for (const [field, title, unit] of PANELS) {
    const having = series.filter(({ set }) => set[field]);
    const curves = having.map(({ set }) => Array.from(/** @type {Uint16Array} */ (set[field]), fromCode));
    const judged = having.filter(({ set }) => set.judged === field);
    const limits = judged.map(({ set }) => Array.from(/** @type {Uint16Array} */ (set.tolerance), fromCode));
    const range = decades([...curves.flat(), ...limits.flat()]);
    if (!range) continue;
    const readout = h("span");
    const box = h("div", { class: "panel" }, h("h3", {}, `${title} [${unit}]`, readout));
    root.append(box);
    const highest = having.map(({ name }, k) => [name, curves[k].reduce((a, b) => (b > a ? b : a), 0)]);
    const resting = "max " + number(Math.max(...highest.map(([, v]) => Number(v)))) + " " + unit;
    readout.textContent = resting;
    const times = Array.from(having[0].set.t);
    const same = having.every(({ set }) => set.t === having[0].set.t || set.t.every((v, k) => v === times[k]));
    const lines = [...curves, ...limits].map((ys) => ys.map((v) => (v > 0 ? v : null)));
    const tables = /** @type {uPlot.AlignedData[]} */ ([...having, ...judged].map(({ set }, k) => [Array.from(set.t), lines[k]]));
    const data = /** @type {uPlot.AlignedData} */ (same ? [times, ...lines] : uPlot.join(tables));
    const marker = h("div", { class: "now-line" });
    const axis = { stroke: ink("--soft"), font: `11px ${ink("--sans")}`, grid: { stroke: ink("--grid"), width: 1 }, ticks: { show: false }, gap: 4 };
    const plot = new uPlot(
      {
        width: box.clientWidth || 420,
        height: 178,
        legend: { show: false },
        cursor: { sync: { key: sync.key, setSeries: false }, y: false, points: { size: 5 }, drag: { x: false, y: false } },
        scales: { x: { time: false }, y: { distr: 3, range: () => range } },
        axes: [
          { ...axis, size: 26, values: (_, ticks) => ticks.map((v) => `${Number(v.toPrecision(6))} s`) },
          { ...axis, size: 50, splits: () => powers(range[0], range[1], 7).map((p) => 10 ** p), values: (_, ticks) => ticks.map((v) => decade(Math.round(Math.log10(v)))), filter: (_, ticks) => ticks },
        ],
        series: [
          {},
          ...having.map(({ name, stroke }) => ({ label: name, stroke: ink(stroke.colour), dash: stroke.dash, width: 1.4, points: { show: false }, spanGaps: false })),
          ...judged.map(({ name, stroke }) => ({ label: `tolerance of ${name}`, stroke: ink(judged.length > 1 ? stroke.colour : "--disagrees"), dash: [2, 3], width: 1.1, points: { show: false } })),
        ],
        hooks: {
          drawClear: [(u) => shadeHorizon(u, horizon)],
          setCursor: [(u) => {
            const at = u.cursor.idx;
            readout.textContent = at === null || at === undefined ? resting
              : `${number(u.data[0][at], 3)} s: ` + [...having.map(({ name }) => name), ...judged.map(({ name }) => "tolerance of " + name)].slice(0, 3).map((name, k) => `${name} ${number(u.data[k + 1][at])}`).join(" · ");
          }],
        },
      },
      data,
      box,
    );
    plot.over.append(marker);
    // Capture phase, because uPlot stops the propagation of a click that it takes for a drag. The position is
    // measured from the panel's edge, because the target may be a point of the cursor inside the panel.
    box.addEventListener("click", (event) => {
      if (plot.over.contains(/** @type {Node} */ (event.target))) onTime(plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, "x"));
    }, true);
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", `${title} over time, log scale; largest: ${highest.map(([name, v]) => `${name} ${number(Number(v))} ${unit}`).join(", ")}`);
    shown.push({ plot, marker });
  }
  const watch = new ResizeObserver(() => {
    for (const { plot } of shown) {
      const width = plot.root.parentElement?.clientWidth ?? 0;
      if (width && Math.abs(width - plot.width) > 1) plot.setSize({ width, height: plot.height });
    }
  });
  watch.observe(root);
  return {
    setTime(t) {
      for (const { plot, marker } of shown) marker.style.transform = `translateX(${plot.valToPos(t, "x")}px)`;
    },
    destroy() {
      watch.disconnect();
      for (const { plot } of shown) plot.destroy();
    },
  };
}

/** @param {uPlot} u @param {number | null} horizon */
function shadeHorizon(u, horizon) {
  const end = u.scales.x.max ?? 0;
  if (horizon === null || horizon >= end) return;
  const from = u.valToPos(horizon, "x", true);
  const { ctx, bbox } = u;
  ctx.save();
  ctx.fillStyle = ink("--hair");
  ctx.fillRect(from, bbox.top, bbox.left + bbox.width - from, bbox.height);
  ctx.fillStyle = ink("--soft");
  ctx.font = `${11 * devicePixelRatio}px ${ink("--sans")}`;
  ctx.textAlign = "left";
  ctx.textBaseline = "bottom";
  if (bbox.left + bbox.width - from > 110 * devicePixelRatio) ctx.fillText("beyond the horizon", from + 5 * devicePixelRatio, bbox.top + bbox.height - 3 * devicePixelRatio);
  ctx.restore();
}

/**
 * What each stroke means.
 * @param {{ name: string, stroke: ReturnType<typeof strokeOf> }[]} series @param {boolean} tolerance
 */
export function keys(series, tolerance) {
  return h("ul", { class: "keys" },
    series.map(({ name, stroke }) => h("li", {}, svg("svg", { class: "plot", viewBox: "0 0 26 8" }, svg("path", { class: `ln ${stroke.css}`, d: "M0 4H26" })), name)),
    tolerance ? h("li", {}, svg("svg", { class: "plot", viewBox: "0 0 26 8" }, svg("path", { class: "tol dot", d: "M0 4H26" })), "dotted: the tolerance of that curve") : null);
}
