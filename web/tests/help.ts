// What the tests of the page share.

import { test as base, expect, type Locator, type Page } from "@playwright/test";
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";

export { expect };

/** A setting that the Rust test gives. */
export function given(name: string): string {
  const value = process.env[name];
  if (!value) throw new Error(`${name} is not set: these tests are run by \`cargo test\``);
  return value;
}

/** A test fails when the page has an exception, logs an error, or trips over its own content policy. */
export const test = base.extend<{ clean: void; tolerated: RegExp | null }>({
  tolerated: [null, { option: true }],
  clean: [
    async ({ page, tolerated }, use) => {
      const errors: string[] = [];
      page.on("pageerror", (error) => errors.push(String(error)));
      page.on("console", (message) => {
        if (message.type() !== "error") return;
        // Refusals and lost connections are shown on the page; the browser notes them here as well.
        if (/^Failed to load resource|^WebSocket connection to/.test(message.text())) return;
        if (!tolerated?.test(message.text())) errors.push(message.text());
      });
      await use();
      expect(errors).toEqual([]);
    },
    { auto: true },
  ],
});

export async function picture(page: Page, name: string): Promise<void> {
  if (process.env.GAKP_PICTURES) await page.screenshot({ path: `${process.env.GAKP_PICTURES}/${name}.png` });
}

/** A phone scrolls only down. */
export async function fits(page: Page): Promise<void> {
  const [content, window] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
  expect(content, `${page.url()} is wider than the window`).toBeLessThanOrEqual(window!);
}

interface Axe {
  run(options: object): Promise<{ violations: { id: string; help: string; nodes: { html: string }[] }[] }>;
}

/** What axe finds wrong with the page for people who cannot see it well, or have no mouse. */
export async function accessible(page: Page): Promise<void> {
  const source = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
  await page.evaluate(source);
  const found = await page.evaluate(async () => {
    const { violations } = await (window as unknown as { axe: Axe }).axe.run({ resultTypes: ["violations"] });
    return violations.map(({ id, help, nodes }) => `${id}: ${help}: ${nodes.map((node) => node.html.slice(0, 200)).join(" | ")}`);
  });
  expect(found, page.url()).toEqual([]);
}

/** How many values of a canvas's pixels are quite different from those at the last call; -1 at the first. */
export const changed = (canvas: Locator): Promise<number> =>
  canvas.evaluate((element: HTMLCanvasElement & { kept?: Uint8ClampedArray }) => {
    const { data } = element.getContext("2d")!.getImageData(0, 0, element.width, element.height);
    const before = element.kept;
    element.kept = data;
    return before ? data.reduce((sum, value, i) => sum + (Math.abs(value - before[i]!) > 40 ? 1 : 0), 0) : -1;
  });

/** How many pixels of a canvas are at least so opaque. */
export const opaque = (canvas: Locator, least = 200): Promise<number> =>
  canvas.evaluate((element: HTMLCanvasElement, least) => {
    const { data } = element.getContext("2d")!.getImageData(0, 0, element.width, element.height);
    return data.reduce((sum, value, i) => sum + (i % 4 === 3 && value >= least ? 1 : 0), 0);
  }, least);

/** Clicks at a place of the picture, in fractions of it. */
export async function clickAt(page: Page, [x, y]: [number, number]): Promise<void> {
  const box = (await page.locator(".overlay").boundingBox())!;
  await page.mouse.click(box.x + box.width * x, box.y + box.height * y);
}
