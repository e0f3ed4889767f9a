// Pictures whose every pixel is known, from a server in the Rust test: a white person walks over grey ground.

import http from "node:http";
import net, { type AddressInfo } from "node:net";
import { expect, given, picture, test } from "./help";

const screen = "[data-camera=gate] .screen";

test("box and picture are of one frame", async ({ page }) => {
  await page.goto("/");
  await expect.poll(async () => Number(await page.locator(screen).getAttribute("data-pictures"))).toBeGreaterThanOrEqual(10);
  await expect(page.getByRole("img", { name: "Camera gate, live. In view: 1 person." })).toBeVisible();
  const seen = new Set<number>();
  while (seen.size < 5) {
    const look = await page.locator(screen).evaluate((element) => {
      const seq = Number((element as HTMLElement).dataset.seq);
      // Where tests/api_browser.rs has put the person.
      const [x, y, w, h] = [20 + ((seq * 4) % 500), 120, 80, 200];
      const read = (canvas: HTMLCanvasElement, px: number, py: number) => {
        const at = [px / 640, py / 480].map((v, i) => Math.floor(v * (i ? canvas.height : canvas.width)));
        return [...canvas.getContext("2d")!.getImageData(at[0]!, at[1]!, 1, 1).data];
      };
      const [under, over] = [".picture", ".boxes"].map((name) => element.querySelector<HTMLCanvasElement>(name)!);
      return {
        seq,
        inside: read(under!, x + w / 2, y + h / 2),
        beside: read(under!, x - 12, y + 30),
        edge: read(over!, x, y + 30),
        empty: read(over!, x + w / 2, y + 30),
      };
    });
    const { seq, inside, beside, edge, empty } = look;
    for (const value of inside.slice(0, 3)) expect(value, `inside of the person, ${JSON.stringify(look)}`).toBeGreaterThan(205);
    for (const value of beside.slice(0, 3)) expect(Math.abs(value - 51), `beside the person, ${JSON.stringify(look)}`).toBeLessThan(50);
    expect(edge[3], `the box's edge, ${JSON.stringify(look)}`).toBeGreaterThan(120);
    expect(empty[3], `within the box, ${JSON.stringify(look)}`).toBe(0);
    seen.add(seq);
    await page.waitForTimeout(60);
  }
  const order = [...seen];
  expect(order).toEqual([...order].sort((a, b) => a - b));
  await picture(page, "in-step");
});

test("only cameras on the screen stream", async ({ page }) => {
  await page.setViewportSize({ width: 600, height: 500 });
  await page.goto("/");
  await expect.poll(async () => Number(await page.locator(screen).getAttribute("data-pictures"))).toBeGreaterThan(3);
  const shown = () => page.locator(screen).getAttribute("data-seq");
  await page.getByRole("navigation").getByRole("link", { name: "Health" }).click();
  await expect(page.locator(screen)).toBeHidden();
  await page.getByRole("navigation").getByRole("link", { name: "Cameras" }).click();
  await expect.poll(async () => Number(await shown())).toBeGreaterThan(0);
  // Far below what can be seen.
  await page.evaluate(() => (document.querySelector<HTMLElement>(".grid")!.style.marginTop = "3000px"));
  await page.waitForTimeout(300);
  const before = await shown();
  await page.waitForTimeout(400);
  expect(await shown()).toBe(before);
  await page.evaluate(() => document.querySelector(".grid")!.scrollIntoView());
  await expect.poll(shown).not.toBe(before);
});

test("names, addresses and errors are text, never markup", async ({ page }) => {
  await page.goto("/");
  await expect(page.locator("[data-camera=odd] .error")).toHaveText("the camera refuses: <b>401</b><img src=x onerror=document.title='owned'>");
  await page.goto("/#/camera/odd");
  await expect(page.locator(".banner")).toContainText("<b>401</b>");
  await page.getByRole("button", { name: "Edit" }).click();
  await expect(page.getByLabel("New address")).toHaveAttribute("placeholder", "rtsp://host/<img src=x onerror=document.title='owned'>");
  await page.keyboard.press("Escape");
  await page.goto("/#/camera/<img src=x onerror=document.title='owned'>");
  await expect(page.getByRole("heading", { name: "There is no camera" })).toBeVisible();
  await page.goto("/#/health");
  await expect(page.locator("tr[data-state=retrying]")).toContainText("<b>401</b>");
  expect(await page.locator("img, main b").count()).toBe(0);
  await expect(page).toHaveTitle("Health · gakp");
});

test("a taken name is told", async ({ page }) => {
  await page.goto("/");
  await page.getByRole("button", { name: "Add a camera" }).click();
  const dialog = page.getByRole("dialog");
  await dialog.getByLabel("Name").fill("gate");
  await dialog.getByLabel("Address").fill("rtsp://host/other");
  await dialog.getByRole("button", { name: "Connect" }).click();
  await expect(dialog.getByRole("alert")).toContainText("exists");
  // The focus stays in the dialog.
  for (let i = 0; i < 12; i += 1) {
    await page.keyboard.press("Tab");
    expect(await page.evaluate(() => document.activeElement === document.body || document.activeElement!.closest("dialog") !== null)).toBe(true);
  }
});

test.describe("a finger", () => {
  test.use({ hasTouch: true, isMobile: true, viewport: { width: 390, height: 844 } });

  test("draws a line", async ({ page, request }) => {
    await page.goto("/#/camera/gate");
    await page.getByRole("button", { name: "Draw a line" }).tap();
    const box = (await page.locator(".overlay").boundingBox())!;
    await page.touchscreen.tap(box.x + box.width * 0.3, box.y + box.height * 0.9);
    await expect(page.locator(".overlay .dot")).toHaveCount(1);
    await page.touchscreen.tap(box.x + box.width * 0.3, box.y + box.height * 0.1);
    await page.getByRole("textbox", { name: "Name" }).fill("door");
    await page.getByRole("button", { name: "Swap in and out" }).click();
    await page.getByRole("button", { name: "Save" }).click();
    await expect(page.locator("tr[data-line=door]")).toBeVisible();
    await expect(page.locator(".overlay [data-line=door]")).toBeVisible();
    const { lines } = await (await request.get("/v1/cameras/gate/lines")).json();
    // Drawn upwards, then swapped: downwards.
    expect(lines[0].points[0][1]).toBeCloseTo(0.1, 1);
    expect(lines[0].points[1][1]).toBeCloseTo(0.9, 1);
  });
});

test.describe("others", () => {
  // The browser's words about what it has refused.
  test.use({ tolerated: /Content Security Policy|CORS policy/ });

  test("what is not from the service does not run", async ({ page }) => {
    await page.goto("/");
    const broken = await page.evaluate(async () => {
      const blocked: string[] = [];
      document.addEventListener("securitypolicyviolation", (event) => blocked.push(event.effectiveDirective));
      const script = document.createElement("script");
      script.textContent = "document.title = 'owned'";
      document.body.append(script);
      const style = document.createElement("style");
      style.textContent = "body { display: none }";
      document.body.append(style);
      await fetch("http://127.0.0.1:9/").catch(() => undefined);
      await new Promise((done) => setTimeout(done, 100));
      return { blocked, title: document.title, shown: getComputedStyle(document.body).display };
    });
    expect(broken.blocked.map((name) => name.split("-").slice(0, 2).join("-")).sort()).toEqual(["connect-src", "script-src", "style-src"]);
    expect(broken).toMatchObject({ title: "Cameras · gakp", shown: "block" });
  });

  test("another site's page reads nothing", async ({ page }) => {
    const site = http.createServer((_, response) => response.setHeader("Content-Type", "text/html").end("<title>other</title>"));
    await new Promise<void>((done) => site.listen(0, "127.0.0.1", done));
    try {
      await page.goto(`http://127.0.0.1:${(site.address() as AddressInfo).port}/`);
      const read = await page.evaluate(async (url) => {
        const text = await fetch(`${url}/v1/cameras`).then((r) => r.text(), () => "refused");
        const added = await fetch(`${url}/v1/cameras`, { method: "POST", body: "{}", headers: { "Content-Type": "application/json" } }).then(() => "sent", () => "refused");
        const socket = new WebSocket(`${url.replace("http", "ws")}/v1/cameras/gate/live`);
        const opened = await new Promise((done) => {
          socket.onopen = () => done("open");
          socket.onerror = () => done("refused");
        });
        return [text, added, opened];
      }, given("GAKP_URL"));
      expect(read).toEqual(["refused", "refused", "refused"]);
    } finally {
      site.close();
    }
  });

});

/** Hands connections on to the service until it is cut. */
class Cable {
  private readonly sockets = new Set<net.Socket>();
  private server: net.Server | null = null;
  port = 0;

  async plug(): Promise<void> {
    const { hostname, port } = new URL(given("GAKP_URL"));
    this.server = net.createServer((near) => {
      const far = net.connect(Number(port), hostname);
      for (const [from, to] of [[near, far], [far, near]] as const) {
        this.sockets.add(from);
        from.on("error", () => to.destroy()).on("close", () => to.destroy());
        from.pipe(to);
      }
    });
    await new Promise<void>((done) => this.server!.listen(this.port, "127.0.0.1", done));
    this.port = (this.server.address() as AddressInfo).port;
  }

  cut(): void {
    this.server?.close();
    for (const socket of this.sockets) socket.destroy();
    this.sockets.clear();
  }
}

test("the page says that the connection is lost, and comes back", async ({ page }) => {
  const cable = new Cable();
  await cable.plug();
  try {
    await page.goto(`http://127.0.0.1:${cable.port}/`);
    const seq = async () => Number(await page.locator(screen).getAttribute("data-seq"));
    await expect.poll(seq).toBeGreaterThan(0);
    cable.cut();
    await expect(page.getByText("Connection lost. Connecting again…").first()).toBeVisible();
    await expect(page.getByText("Connection lost: the service does not answer.")).toBeVisible();
    await expect(page.locator("[data-camera=gate] .state")).toHaveText("Unknown");
    await picture(page, "lost");
    const before = await seq();
    await cable.plug();
    await expect.poll(seq).toBeGreaterThan(before + 5);
    await expect(page.getByText("Connection lost: the service does not answer.")).toBeHidden();
  } finally {
    cable.cut();
  }
});
