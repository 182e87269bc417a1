import js from "@eslint/js";
import globals from "globals";

export default [
  { ignores: ["assets/vendor/", "node_modules/"] },
  js.configs.recommended,
  {
    files: ["assets/*.js"],
    languageOptions: { globals: { ...globals.browser, uPlot: "readonly" } },
    rules: { eqeqeq: "error", "prefer-const": "error", "no-var": "error", "no-restricted-properties": ["error", { property: "innerHTML" }, { property: "outerHTML" }, { property: "insertAdjacentHTML" }] },
  },
];
