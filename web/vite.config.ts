import { defineConfig } from "vite";

// `npx vite` serves the page while it is worked on; the API is a running service's.
const api = { target: process.env.GAKP_URL ?? "http://127.0.0.1:8080", ws: true, changeOrigin: false };

export default defineConfig({
  esbuild: { jsx: "automatic", jsxImportSource: "preact" },
  build: {
    // The service lets everybody read `/` and `/page/*`.
    assetsDir: "page",
    // The policy allows no data: scripts and styles.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    reportCompressedSize: false,
    target: "es2022",
  },
  server: { proxy: { "/v1": api, "/metrics": api, "/readyz": api } },
});
