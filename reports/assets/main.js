// Shows the view that the address names.
import { chunk } from "./chunks.js";
import { showCost } from "./cost.js";
import { closeCell, showCell } from "./detail.js";
import { focusCell, showMatrix } from "./matrix.js";
import { read, viewOf } from "./route.js";
import { h } from "./text.js";
import { showTrend } from "./trend.js";

/** @param {string} id */
const byId = (id) => /** @type {HTMLElement} */ (document.getElementById(id));
let back = "#view=matrix";
let latest = 0;
/** @type {Record<string, string>} fields of the view on show */
let viewed = {};

async function show() {
  const mine = ++latest;
  if (location.hash === "#main") return;
  const fields = read();
  const view = viewOf(fields);
  const index = /** @type {import("./report_data").Index} */ (await chunk("index"));
  if (mine !== latest) return;
  closeCell();
  for (const name of ["matrix", "cell", "cost", "trend", "gaps"]) {
    const section = document.getElementById(name + "-view");
    if (section) section.hidden = name !== view;
  }
  byId("verdict").hidden = view !== "matrix";
  for (const link of document.querySelectorAll(".views a")) {
    if (link.getAttribute("href") === "#view=" + view) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (view === "matrix") {
    back = location.hash || "#view=matrix";
    showMatrix(index, fields);
  } else if (view === "cell") await showCell(byId("cell-view"), index, fields, back);
  else if (view === "cost") await showCost(byId("cost-view"), index, fields);
  else if (view === "trend") await showTrend(byId("trend-view"), index, fields);
  viewed = fields;
  document.documentElement.dataset.shown = view;
}

/** Show the view of a new address from its top, with the focus on its title; back in the matrix, on the cell that was left. */
async function follow() {
  const before = document.documentElement.dataset.shown;
  const left = viewed;
  await show();
  const now = document.documentElement.dataset.shown;
  if (now === "matrix" && before === "cell") focusCell(left);
  else if (now !== before || now === "cell") {
    scrollTo(0, 0);
    if (!read().row) /** @type {HTMLElement | null} */ (document.querySelector(`#${now}-view h1[tabindex]`))?.focus({ preventScroll: true });
  }
}

document.documentElement.classList.remove("static");
if (!("DecompressionStream" in window)) {
  byId("main").append(h("p", { class: "note" }, "This browser is too old to unpack the details (it has no DecompressionStream); the matrix above is complete."));
} else {
  window.addEventListener("hashchange", follow);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", show); // canvases take their colours when drawn
  show();
}
