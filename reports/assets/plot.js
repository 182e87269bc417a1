// Log-log plots as SVG: readable decades, nothing else.
import { decade, svg } from "./text.js";

/**
 * @typedef {{ label: string, min: number, max: number, log?: boolean, ticks?: [number, string][] }} Scale
 * @typedef {{ root: SVGElement, x: (v: number) => number, y: (v: number) => number, width: number, height: number,
 *   left: number, right: number, top: number, bottom: number }} Plot
 */

/**
 * Whole decades around some positive numbers; null where there is none.
 * @param {number[]} values @returns {[number, number] | null}
 */
export function decades(values) {
  const good = values.filter((v) => v > 0 && Number.isFinite(v));
  if (!good.length) return null;
  const low = Math.floor(Math.log10(good.reduce((a, b) => Math.min(a, b))) + 1e-9);
  const high = Math.ceil(Math.log10(good.reduce((a, b) => Math.max(a, b))) - 1e-9);
  return [10 ** low, 10 ** Math.max(high, low + 1)];
}

/**
 * Powers of ten between two numbers, at most `count` of them.
 * @param {number} min @param {number} max @param {number} count
 */
export function powers(min, max, count) {
  const low = Math.ceil(Math.log10(min) - 1e-9);
  const high = Math.floor(Math.log10(max) + 1e-9);
  const stride = [1, 2, 3, 4, 5, 10, 20].find((s) => (high - low) / s < count) ?? 50;
  const found = [];
  for (let p = Math.ceil(low / stride) * stride; p <= high; p += stride) found.push(p);
  return found;
}

/**
 * Axes with grid and labels; draw into `root` with `x` and `y`.
 * @param {{ title?: string, x: Scale, y: Scale, width?: number, height?: number, left?: number, right?: number, label: string }} o
 * @returns {Plot}
 */
export function axes(o) {
  const width = o.width ?? 520;
  const height = o.height ?? 300;
  const left = o.left ?? 52;
  const right = width - (o.right ?? 14);
  const top = o.title ? 24 : 10;
  const bottom = height - 38;
  const root = svg("svg", { class: "plot", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": o.label });
  /** @param {Scale} s @param {number} a @param {number} b */
  const map = (s, a, b) => (/** @type {number} */ v) =>
    s.log === false
      ? a + ((v - s.min) / (s.max - s.min || 1)) * (b - a)
      : a + ((Math.log10(v) - Math.log10(s.min)) / (Math.log10(s.max) - Math.log10(s.min) || 1)) * (b - a);
  const x = map(o.x, left, right);
  const y = map(o.y, bottom, top);
  /** @param {Scale} s @param {number} count @returns {[number, string][]} */
  const ticks = (s, count) => s.ticks ?? powers(s.min, s.max, count).map((p) => [10 ** p, decade(p)]);
  if (o.title) root.append(svg("text", { class: "title", x: left, y: 13 }, o.title));
  for (const [v, text] of ticks(o.x, Math.max(3, (right - left) / 62))) {
    root.append(svg("path", { class: "grid", d: `M${x(v)} ${top}V${bottom}` }), svg("text", { x: x(v), y: bottom + 15, "text-anchor": "middle" }, text));
  }
  for (const [v, text] of ticks(o.y, Math.max(3, (bottom - top) / 30))) {
    root.append(svg("path", { class: "grid", d: `M${left} ${y(v)}H${right}` }), svg("text", { x: left - 6, y: y(v) + 4, "text-anchor": "end" }, text));
  }
  root.append(svg("path", { class: "axis", d: `M${left} ${top}V${bottom}H${right}` }));
  root.append(svg("text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle" }, o.x.label));
  root.append(svg("text", { x: 12, y: (top + bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${(top + bottom) / 2})` }, o.y.label));
  return { root, x, y, width, height, left, right, top, bottom };
}

/**
 * A path through the points that are numbers; it breaks where one is not.
 * @param {Plot} plot @param {(number | null)[]} xs @param {(number | null)[]} ys
 */
export function path(plot, xs, ys) {
  let d = "";
  let pen = "M";
  for (let i = 0; i < xs.length; i++) {
    const px = plot.x(xs[i] ?? NaN);
    const py = plot.y(ys[i] ?? NaN);
    if (!Number.isFinite(px) || !Number.isFinite(py)) {
      pen = "M";
      continue;
    }
    d += `${pen}${px.toFixed(1)} ${py.toFixed(1)}`;
    pen = "L";
  }
  return d;
}
