// A service that asks for tokens: nothing without one, and with one what its role may.

import { execFileSync } from "node:child_process";
import { accessible, expect, given, opaque, picture, test } from "./help";

test("the page asks for a token and offers what it may", async ({ page, context }) => {
  const form = page.getByRole("form", { name: "Sign in" });
  const signIn = async (token: string) => {
    await form.getByLabel("Token").fill(token);
    await form.getByRole("button", { name: "Sign in" }).click();
  };
  const card = page.locator("[data-camera=gate]");
  const pictures = async () => Number(await card.locator(".screen").getAttribute("data-pictures"));

  await test.step("without a token there is nothing", async () => {
    await page.goto("/#/camera/gate");
    await expect(form).toBeVisible();
    await expect(page.getByRole("navigation")).toBeHidden();
    await expect(card).toBeHidden();
    await accessible(page);
    await picture(page, "sign-in");
    await signIn("gakp_wrong");
    await expect(form.getByRole("alert")).toContainText("not known");
  });

  await test.step("a viewer without pictures sees boxes on a plain ground", async () => {
    await signIn(given("GAKP_PLAIN"));
    await expect.poll(pictures).toBeGreaterThan(2);
    await expect(card.locator(".screen[data-plain]")).toBeVisible();
    await expect(page.locator(".who")).toContainText("plain (viewer)");
    expect(await opaque(card.locator("canvas.boxes"))).toBeGreaterThan(100);
    await page.goto("/#/");
    await expect(page.getByText("Your token may not see pictures")).toBeVisible();
    await picture(page, "plain");
    await page.getByRole("button", { name: "Sign out" }).click();
    await expect(form).toBeVisible();
    await expect(card).toBeHidden();
  });

  await test.step("a viewer with pictures is offered nothing to change", async () => {
    await signIn(given("GAKP_WALL"));
    await expect.poll(pictures).toBeGreaterThan(2);
    await expect(page.getByRole("button", { name: /Add/ })).toHaveCount(0);
    await page.goto("/#/camera/gate");
    await expect(page.getByRole("heading", { name: "Counts" })).toBeVisible();
    await expect(page.getByRole("button", { name: "Heat map" })).toBeVisible();
    await expect(page.getByRole("button", { name: /Pause|Edit|Delete|Draw|door/ })).toHaveCount(0);
    await expect(page.locator("tr[data-line=door]")).toBeVisible();
    // The cookie is out of the reach of scripts.
    expect(await page.evaluate(() => document.cookie)).toBe("");
    expect((await context.cookies()).map(({ httpOnly, sameSite }) => [httpOnly, sameSite])).toEqual([[true, "Strict"]]);
  });

  await test.step("a revoked token's page closes", async () => {
    execFileSync(given("GAKP_BINARY"), ["token", "--state-dir", given("GAKP_STATE"), "revoke", "wall"]);
    await expect(form).toBeVisible();
    await expect(card).toBeHidden();
  });

  await test.step("an operator may draw", async () => {
    await signIn(given("GAKP_DESK"));
    await expect(page.getByRole("button", { name: "Draw a line" })).toBeVisible();
  });
});
