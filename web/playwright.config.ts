// Run by `cargo test` (tests/browser/playwright.rs), which starts what the tests look at and says where it is.

import { defineConfig } from "@playwright/test";

export default defineConfig({
  testDir: "tests",
  outputDir: process.env.GAKP_PICTURES ? `${process.env.GAKP_PICTURES}/failed` : "test-results",
  // One browser and one test at a time: the service needs the cores.
  workers: 1,
  timeout: 180_000,
  expect: { timeout: 30_000 },
  // With how long each step takes.
  reporter: [["list", { printSteps: true }]],
  forbidOnly: true,
  use: {
    baseURL: process.env.GAKP_URL,
    viewport: { width: 1280, height: 900 },
    screenshot: "only-on-failure",
    launchOptions: {
      // Debian's own: none is ever downloaded.
      executablePath: process.env.GAKP_CHROMIUM ?? "/usr/bin/chromium",
      args: [
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--disable-dev-shm-usage",
      ],
    },
  },
});
