// Lint rules of our own JavaScript; vendored files are left out.
import js from "@eslint/js";
import globals from "globals";

export default [
  { ignores: ["**/vendor/**", "**/.venv*/**", "build/**", "dist/**"] },
  js.configs.recommended,
  {
    languageOptions: { ecmaVersion: 2023, sourceType: "module" },
    linterOptions: { reportUnusedDisableDirectives: "error" },
  },
  {
    files: ["src/**/*.js"],
    languageOptions: { globals: globals.browser },
  },
  {
    // Parts of one classic script, which share their top-level names; tsc checks these names.
    files: ["src/physion/report/viewer/*.js"],
    languageOptions: { sourceType: "script" },
    rules: { "no-undef": "off", "no-unused-vars": ["error", { vars: "local" }] },
  },
  {
    // Run by browsers without support for modules.
    files: ["src/physion/experiment/static/too_old.js"],
    languageOptions: { ecmaVersion: 5, sourceType: "script" },
  },
];
