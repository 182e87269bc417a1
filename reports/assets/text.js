// Elements and numbers. Text enters the page as text nodes and attributes only, never as markup.

/** @typedef {Node | string | number | null | undefined | false} Child */

/**
 * @param {Element} element @param {Record<string, any>} props @param {(Child | Child[])[]} children
 */
function dress(element, props, children) {
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(name, value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  for (const child of children.flat()) {
    if (child !== null && child !== undefined && child !== false) element.append(child instanceof Node ? child : String(child));
  }
}

/**
 * An HTML element; function properties are event listeners.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag @param {Record<string, any>} [props] @param {(Child | Child[])[]} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  dress(element, props, children);
  return element;
}

/**
 * An SVG element.
 * @param {string} tag @param {Record<string, any>} [props] @param {(Child | Child[])[]} children
 * @returns {SVGElement}
 */
export function svg(tag, props = {}, ...children) {
  const element = /** @type {SVGElement} */ (document.createElementNS("http://www.w3.org/2000/svg", tag));
  dress(element, props, children);
  return element;
}

/** @param {number} n */
export function superscript(n) {
  return String(n).replace(/[-0-9]/g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"[c === "-" ? 0 : Number(c) + 1]);
}

/**
 * A number in few digits: 0.031, 4.2×10⁻⁶; "–" for none.
 * @param {number | null | undefined} x @param {number} [digits]
 */
export function number(x, digits = 2) {
  if (x === null || x === undefined) return "–";
  if (!Number.isFinite(x)) return "not finite";
  if (x === 0) return "0";
  const [mantissa, exponent] = x.toExponential(digits - 1).split("e");
  const power = Number(exponent);
  const text = power > -4 && power < 4 ? Number(x.toPrecision(digits)).toFixed(Math.max(0, digits - 1 - power)) : `${mantissa}×10${superscript(power)}`;
  return text.replace("-", "−");
}

/** @param {number} power */
export const decade = (power) => (power === 0 ? "1" : "10" + superscript(power));

/**
 * A value of the page's style, for canvases.
 * @param {string} name
 */
export const ink = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/**
 * Text to copy, in a box with a button.
 * @param {string} text @param {string} what
 */
export function copyable(text, what) {
  const button = h("button", { type: "button", "aria-label": `Copy ${what}` }, "Copy");
  const pre = h("pre", { tabindex: 0, "aria-label": what, role: "region" }, text);
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(text);
      button.textContent = "Copied";
    } catch {
      // no clipboard on this page (file://, older browsers): select it, so that one key copies it
      getSelection()?.selectAllChildren(pre);
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), 1500);
  });
  return h("div", { class: "code" }, pre, button);
}
