// How old pictures are when they are on the screen with their boxes: from capture, by the time in each message, to the
// frame of the browser that shows them.
//
//   npm run latency -- http://127.0.0.1:8080 CAMERA [PICTURES]
//
// The camera must tell the time of capture (an RTSP camera, such as `gakp camera`; no file), and its clock must be
// this machine's.

import { chromium } from "@playwright/test";

const LIMIT_MS = 500;
const [url, camera, wanted = "300"] = process.argv.slice(2);
if (!url || !camera) {
  console.error("usage: npm run latency -- URL CAMERA [PICTURES]");
  process.exit(2);
}
const flags =
  "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync";
const browser = await chromium.launch({
  executablePath: process.env.GAKP_CHROMIUM ?? "/usr/bin/chromium",
  args: flags.split(" "),
});
try {
  const page = await browser.newPage({ viewport: { width: 1280, height: 900 } });
  await page.goto(`${url}/#/camera/${encodeURIComponent(camera)}`);
  const screen = page.locator(".stage .screen[data-seq]");
  await screen.waitFor({ timeout: 30_000 });
  const ages = await screen.evaluate(
    (element, wanted) =>
      new Promise((done, fail) => {
        const ages = [];
        element.addEventListener("shown", ({ detail: { capture_ts, clock } }) => {
          if (clock === "media") return fail(new Error("the camera is a file: its pictures have no time of capture"));
          const captured = Date.parse(capture_ts);
          // The first moment at which what was drawn can have reached the screen.
          requestAnimationFrame(() =>
            setTimeout(() => {
              ages.push(performance.timeOrigin + performance.now() - captured);
              if (ages.length === wanted) done(ages);
            }),
          );
          return undefined;
        });
      }),
    Number(wanted),
  );
  ages.sort((a, b) => a - b);
  const [p50, p95, most] = [0.5, 0.95, 1].map((part) => ages[Math.min(ages.length - 1, Math.floor(ages.length * part))]);
  const figures = [p50, p95, most].map((age) => age.toFixed(0));
  console.log(`capture to screen, ${ages.length} pictures: p50 ${figures[0]} ms, p95 ${figures[1]} ms, most ${figures[2]} ms; limit ${LIMIT_MS} ms`);
  process.exitCode = p95 <= LIMIT_MS ? 0 : 1;
} finally {
  await browser.close();
}
