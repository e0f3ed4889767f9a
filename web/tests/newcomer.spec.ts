// From an empty service to counts, on a real RTSP camera: what somebody does who has read nothing.

import { createServer } from "node:http";
import type { AddressInfo } from "node:net";
import { accessible, changed, clickAt, expect, fits, given, opaque, picture, test } from "./help";

test("a camera is added, seen, counted and searched", async ({ page, request }) => {
  await test.step("the empty page invites to add the first camera", async () => {
    await page.goto("/");
    await expect(page.getByRole("heading", { name: "No camera yet" })).toBeVisible();
    await expect(page.getByText("rtsp://user:password@192.168.1.20/stream1")).toBeVisible();
    await accessible(page);
    await picture(page, "empty");
  });

  const dialog = page.getByRole("dialog");
  await test.step("a wrong address gives a readable reason", async () => {
    await page.getByRole("button", { name: "Add the first camera" }).click();
    await dialog.getByLabel("Name").fill("gate");
    await dialog.getByLabel("Address").fill("nonsense");
    await dialog.getByRole("button", { name: "Connect" }).click();
    await expect(dialog.getByRole("alert")).toContainText("nonsense");
    await dialog.getByLabel("Address").fill(given("GAKP_WRONG"));
    await dialog.getByRole("button", { name: "Connect" }).click();
    await expect(dialog.getByText("No connection: connection refused")).toBeVisible();
    await expect(dialog.getByText("nothing listens on the port")).toBeVisible();
    await accessible(page);
    await picture(page, "refused");
    await dialog.getByRole("button", { name: "Change the address" }).click();
    await expect(dialog.getByLabel("Name")).toHaveValue("gate");
  });

  await test.step("the right one connects", async () => {
    await dialog.getByLabel("Address").fill(given("GAKP_CAMERA"));
    await dialog.getByRole("button", { name: "Connect" }).click();
    await expect(dialog.getByText("It works: 768 × 576 pixels")).toBeVisible();
    await dialog.getByRole("button", { name: "Open it and draw a line" }).click();
    await expect(dialog).toBeHidden();
    await expect(page.getByRole("heading", { name: "gate", level: 1 })).toBeVisible();
  });

  const screen = page.locator(".stage .screen");
  await test.step("the picture moves, and boxes with it", async () => {
    await expect.poll(async () => Number(await screen.getAttribute("data-confirmed"))).toBeGreaterThanOrEqual(2);
    const canvas = screen.locator("canvas.picture");
    expect(await changed(canvas)).toBe(-1);
    const seq = Number(await screen.getAttribute("data-seq"));
    await expect.poll(async () => Number(await screen.getAttribute("data-seq"))).toBeGreaterThan(seq + 5);
    expect(await changed(canvas), "values of the picture that changed").toBeGreaterThan(500);
    expect(await opaque(screen.locator("canvas.boxes")), "pixels of boxes").toBeGreaterThan(500);
    await expect(page.getByRole("img", { name: /^Camera gate, live\. In view: \d+ p/ })).toBeVisible();
  });

  await test.step("a line is drawn with the mouse, and counts", async () => {
    await page.getByRole("button", { name: "Draw a line" }).click();
    await clickAt(page, [0.5, 0.98]);
    await clickAt(page, [0.5, 0.02]);
    await expect(page.locator(".overlay .side.in")).toBeVisible();
    await picture(page, "drawing");
    await page.getByRole("textbox", { name: "Name" }).fill("door");
    await page.getByRole("button", { name: "Save" }).click();
    const row = page.locator("tr[data-line=door]");
    await expect(row).toBeVisible();
    const { lines } = await (await request.get("/v1/cameras/gate/lines")).json();
    expect(lines[0].points[0][0]).toBeCloseTo(0.5, 2);
    expect(lines[0].points[1][1]).toBeCloseTo(0.02, 2);
    const sum = async () => Number(await row.locator(".in").innerText()) + Number(await row.locator(".out").innerText());
    await expect.poll(sum, { timeout: 60_000 }).toBeGreaterThan(0);
    await expect(page.locator(".events li").filter({ hasText: /^.*Person \d+ crossed door, (in|out)/ }).first()).toBeVisible();
    await expect(page.getByRole("img", { name: /door over time: In \d+, Out \d+/ })).toBeVisible();
    await picture(page, "counted");
    await accessible(page);
  });

  await test.step("a point is moved by keyboard, another by mouse", async () => {
    await page.getByRole("button", { name: "door", exact: true }).click();
    const point = page.getByRole("button", { name: /^Point 1 of 2/ });
    await point.focus();
    await page.keyboard.press("Shift+ArrowRight");
    await page.keyboard.press("ArrowLeft");
    const top = (await page.getByRole("button", { name: /^Point 2 of 2/ }).locator(".dot").boundingBox())!;
    await page.mouse.move(top.x + top.width / 2, top.y + top.height / 2);
    await page.mouse.down();
    await page.mouse.move(top.x + 60, top.y + 30, { steps: 4 });
    await page.mouse.up();
    await page.getByRole("button", { name: "Save" }).click();
    await expect(page.locator("tr[data-line=door]")).toBeVisible();
    const { lines } = await (await request.get("/v1/cameras/gate/lines")).json();
    expect(lines).toHaveLength(1);
    expect(lines[0].points[0][0]).toBeCloseTo(0.535, 2);
    expect(lines[0].points[1][0]).toBeGreaterThan(0.53);
  });

  await test.step("a zone is drawn by keyboard alone", async () => {
    await page.getByRole("button", { name: "Draw a zone" }).focus();
    await page.keyboard.press("Enter");
    await expect(page.getByRole("application")).toBeFocused();
    const steps = async (key: string, count: number) => {
      for (let i = 0; i < count; i += 1) await page.keyboard.press(`Shift+${key}`);
    };
    await steps("ArrowLeft", 12);
    await steps("ArrowUp", 12);
    await page.keyboard.press("Space");
    await steps("ArrowRight", 24);
    await page.keyboard.press("Space");
    await steps("ArrowDown", 24);
    await page.keyboard.press("Space");
    await page.keyboard.press("Enter");
    await page.getByLabel("Tell who stays longer").fill("2");
    await page.getByLabel("Crowded with more than").fill("1");
    await picture(page, "zone");
    await page.getByRole("button", { name: "Save" }).click();
    await expect(page.locator("tr[data-zone='zone-1']")).toBeVisible();
    const { zones } = await (await request.get("/v1/cameras/gate/zones")).json();
    expect(zones[0]).toMatchObject({ id: "zone-1", loiter_s: 2, capacity: 1 });
    expect(zones[0].points).toHaveLength(3);
    await page.getByRole("button", { name: "Draw a line" }).click();
    await page.keyboard.press("Escape");
    await expect(page.getByRole("heading", { name: "Counts" })).toBeVisible();
  });

  await test.step("a part of the picture is hidden, and shown again", async () => {
    /** The brightest of nine points in the middle of the picture. */
    const brightest = () =>
      page.locator("canvas.picture").evaluate((element) => {
        const canvas = element as HTMLCanvasElement;
        const values = [-6, 0, 6].flatMap((dx) =>
          [-6, 0, 6].flatMap((dy) => [
            ...canvas.getContext("2d")!.getImageData(canvas.width * 0.5 + dx, canvas.height * 0.5 + dy, 1, 1).data.slice(0, 3),
          ]),
        );
        return Math.max(...values);
      });
    await expect.poll(brightest).toBeGreaterThan(40);
    await page.getByRole("button", { name: "Hide a part" }).click();
    for (const corner of [[0.3, 0.3], [0.7, 0.3], [0.7, 0.7], [0.3, 0.7]] as const) await clickAt(page, [...corner]);
    await page.getByRole("button", { name: "Finish" }).click();
    await expect(page.getByRole("form", { name: "New mask" })).toBeVisible();
    await page.getByRole("button", { name: "Save" }).click();
    await expect.poll(brightest).toBeLessThan(12);
    await picture(page, "hidden");
    await accessible(page);
    await page.getByRole("button", { name: "Change mask mask-1" }).press("Enter");
    await page.getByLabel("How it hides").selectOption("pixelate");
    await page.getByRole("button", { name: "Save" }).click();
    await expect.poll(brightest).toBeGreaterThan(40);
    const { masks } = await (await request.get("/v1/cameras/gate/masks")).json();
    expect(masks).toMatchObject([{ id: "mask-1", style: "pixelate" }]);
    await page.getByRole("button", { name: "Change mask mask-1" }).click();
    await page.getByRole("button", { name: "Delete", exact: true }).last().click();
    await expect(page.getByRole("button", { name: "Change mask mask-1" })).toBeHidden();
  });

  await test.step("the heat map lies over the picture", async () => {
    await page.getByRole("button", { name: "Heat map" }).click();
    const heat = page.getByRole("img", { name: /^Heat map/ });
    await expect.poll(() => opaque(heat, 20)).toBeGreaterThan(20);
    await picture(page, "heat");
    await page.getByRole("button", { name: "Heat map" }).click();
  });

  await test.step("events are listed", async () => {
    await page.getByRole("navigation").getByRole("link", { name: "Events" }).click();
    await page.getByLabel("Kind of event").selectOption("line.crossed");
    await expect(page.locator(".events li").first()).toContainText("crossed door");
    await expect(page.locator(".events li:not([data-type='line.crossed'])")).toHaveCount(0);
    await expect(page.locator(".events li").first()).toContainText("crossed door");
    await accessible(page);
  });

  await test.step("events are sent to another system", async () => {
    const posts: { type: string; signature: string | undefined }[] = [];
    const receiver = createServer((message, answer) => {
      let body = "";
      message.on("data", (part: Buffer) => (body += part));
      message.on("end", () => {
        posts.push({ type: JSON.parse(body).type, signature: message.headers["webhook-signature"] as string | undefined });
        answer.writeHead(204).end();
      });
    });
    await new Promise<void>((listens) => receiver.listen(0, "127.0.0.1", listens));
    const { port } = receiver.address() as AddressInfo;
    try {
      await page.getByRole("button", { name: "Add a receiver" }).click();
      await accessible(page);
      const form = page.getByRole("dialog");
      await form.getByLabel("Name").fill("alarm");
      await form.getByLabel("Address").fill("ftp://nowhere/");
      await form.getByRole("button", { name: "Add" }).click();
      await expect(form.getByRole("alert")).toContainText("does not begin with http://");
      await form.getByLabel("Address").fill(`http://127.0.0.1:${port}/hook?key=T0KEN`);
      await form.getByRole("button", { name: "Add" }).click();
      await expect(form.locator("code")).toHaveText(/^whsec_[A-Za-z0-9+/]{43}=$/);
      await form.getByRole("button", { name: "I have it" }).click();
      const row = page.getByRole("row", { name: /alarm/ });
      await expect(row).toContainText(`http://127.0.0.1:${port}/... (signed)`);
      await page.getByRole("button", { name: "Try alarm" }).click();
      await expect(row.getByRole("status")).toContainText("took a test message");
      expect(posts.map(({ type }) => type)).toContain("gakp.test");
      await expect.poll(() => posts.some(({ type }) => /^gakp\.(line|zone)\./.test(type)), { timeout: 60_000 }).toBe(true);
      expect(posts.every(({ signature }) => signature?.startsWith("v1,"))).toBe(true);
      await expect(row.locator("[data-label=Delivered]")).not.toHaveText("0");
      await picture(page, "receivers");
      await accessible(page);
      await fits(page);
      await page.getByRole("button", { name: "Delete alarm" }).click();
      const asked = page.getByRole("dialog", { name: "Delete alarm?" });
      await asked.getByRole("button", { name: "Keep it" }).click();
      await expect(asked).toBeHidden();
      await expect(row).toBeVisible();
      await page.getByRole("button", { name: "Delete alarm" }).click();
      await asked.getByRole("button", { name: "Delete the receiver" }).click();
      await expect(page.getByText("Nobody yet.")).toBeVisible();
    } finally {
      receiver.closeAllConnections();
      receiver.close();
    }
  });

  await test.step("the history is searched", async () => {
    await page.getByRole("navigation").getByRole("link", { name: "History" }).click();
    const form = page.getByRole("form", { name: "Search the history" });
    await form.locator("[name=camera]").selectOption("gate");
    await form.locator("[name=rule]").selectOption("across door");
    const results = page.getByRole("region", { name: "Results" });
    await expect(async () => {
      await form.getByRole("button", { name: "Search" }).click();
      await expect(results.getByRole("img", { name: /^The way of person/ }).first()).toBeVisible({ timeout: 2000 });
    }).toPass({ timeout: 60_000 });
    const csv = await request.get((await results.getByRole("link", { name: "Download as CSV" }).getAttribute("href"))!);
    expect(csv.status()).toBe(200);
    expect((await csv.text()).trim().split("\n").length).toBeGreaterThan(1);
    await picture(page, "history");
    await accessible(page);
    await form.locator("[name=what]").selectOption("events");
    await form.getByRole("button", { name: "Search" }).click();
    await expect(results.locator(".events li").first()).toContainText("crossed door");
  });

  await test.step("health is told", async () => {
    await page.getByRole("navigation").getByRole("link", { name: "Health" }).click();
    await expect(page.getByText("Everything works")).toBeVisible();
    await expect(page.locator(".tiles")).toContainText("1 of 1");
    await expect(page.locator("tr[data-state=live]")).toContainText(/\d\.\d\/s/);
    await accessible(page);
  });

  await test.step("a phone scrolls only down, in dark colours as well", async () => {
    await page.setViewportSize({ width: 390, height: 844 });
    await page.emulateMedia({ colorScheme: "dark" });
    for (const [name, hash] of Object.entries({ cameras: "", camera: "camera/gate", events: "events", history: "history", health: "health" })) {
      await page.goto(`/#/${hash}`);
      await expect(page.locator("main h1")).toBeVisible();
      await fits(page);
      await accessible(page);
      await picture(page, `phone-${name}`);
    }
    await page.setViewportSize({ width: 1280, height: 900 });
    await page.emulateMedia({ colorScheme: "light" });
  });

  await test.step("it is paused, resumed and deleted", async () => {
    await page.goto("/#/camera/gate");
    await page.getByRole("button", { name: "Pause" }).click();
    await expect(page.locator(".title .state")).toHaveText("Paused");
    await page.getByRole("button", { name: "Resume" }).click();
    await expect(page.locator(".title .state")).toHaveText("Live");
    const remove = page.getByRole("button", { name: "Delete" });
    await remove.click();
    await expect(dialog).toBeVisible();
    await page.keyboard.press("Escape");
    await expect(dialog).toBeHidden();
    await expect(remove).toBeFocused();
    await remove.click();
    await dialog.getByRole("button", { name: "Delete the camera" }).click();
    await expect(page.getByRole("heading", { name: "No camera yet" })).toBeVisible();
  });
});
