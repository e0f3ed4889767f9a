// The list of cameras: asks for their status, keeps one card each, adds and deletes.
// Names, URLs and errors come from outside: they reach the page as text only.

import { View } from "./view.js";

const POLL_MS = 2000;
const WORDS = {
  connecting: "connecting", live: "live", retrying: "retrying", ended: "ended", failed: "failed", paused: "paused",
};

const $ = (selector) => document.querySelector(selector);
const cards = new Map();

async function api(path, options = {}) {
  const response = await fetch(path, { ...options, cache: "no-store", signal: AbortSignal.timeout(15000) });
  if (response.ok) return response.status === 204 ? null : response.json();
  const problem = await response.json().catch(() => null);
  if (response.status === 401 && path !== "/v1/session") askForToken();
  const error = new Error(problem?.detail ?? `The service answered ${response.status}.`);
  error.answered = true;
  throw error;
}

// Who is at the page, and what may be done from it.
let session = null;

async function learnWhoIAm() {
  session = await api("/v1/session");
  const known = session.role !== null;
  const may = (...roles) => known && roles.includes(session.role);
  document.body.dataset.role = session.role ?? "nobody";
  $("#login").hidden = known;
  $("#main").hidden = !known;
  $("#who").hidden = !known || session.auth === "open";
  $("#who span").textContent = known ? `${session.name} (${session.role})` : "";
  $(".add").hidden = !may("operator", "admin");
  if (!known) $("#summary").textContent = "Not signed in";
  refreshViews();
}

function askForToken() {
  if (session?.role == null) return;
  session = { ...session, role: null };
  for (const { view } of cards.values()) view.want(false);
  learnWhoIAm().catch(console.error);
}

$("#login").addEventListener("submit", async (event) => {
  event.preventDefault();
  const { token } = event.target.elements;
  const result = $("#login-result");
  result.textContent = "";
  try {
    await api("/v1/session", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ token: token.value }),
    });
    token.value = "";
    await learnWhoIAm();
    await poll();
  } catch (error) {
    result.textContent = error.answered ? error.message : "The service does not answer.";
  }
});

$("#sign-out").addEventListener("click", async () => {
  await api("/v1/session", { method: "DELETE" }).catch(console.error);
  session = { ...session, role: null };
  for (const { view } of cards.values()) view.want(false);
  show([]);
  await learnWhoIAm();
});

// Pictures cost the service work: only for cards that can be seen.
const inSight = new IntersectionObserver((entries) => {
  for (const entry of entries) {
    const card = cards.get(entry.target.dataset.camera);
    if (card) card.inSight = entry.isIntersecting;
  }
  refreshViews();
});

function refreshViews() {
  for (const { view, inSight } of cards.values()) view.want(inSight && !document.hidden && session?.video === true);
}
document.addEventListener("visibilitychange", refreshViews);

function newCard(id) {
  const element = $("#card").content.firstElementChild.cloneNode(true);
  element.dataset.camera = id;
  element.dataset.tracks = 0;
  element.setAttribute("aria-label", `Camera ${id}`);
  element.querySelector("h2").textContent = id;
  element.querySelector("canvas").setAttribute("aria-label", `Camera ${id}: no picture yet`);
  element.querySelector(".tracks").setAttribute("aria-label", `Tracks of camera ${id}`);
  const button = element.querySelector(".delete");
  button.setAttribute("aria-label", `Delete camera ${id}`);
  button.addEventListener("click", () => remove(id, button));
  return { element, view: new View(id, element), inSight: false };
}

/** The first click asks, the second within four seconds deletes. */
async function remove(id, button) {
  if (!button.classList.contains("sure")) {
    button.classList.add("sure");
    button.textContent = "Really delete?";
    setTimeout(() => {
      button.classList.remove("sure");
      button.textContent = "Delete";
    }, 4000);
    return;
  }
  button.disabled = true;
  try {
    await api(`/v1/cameras/${encodeURIComponent(id)}`, { method: "DELETE" });
  } catch (error) {
    cards.get(id)?.element.querySelector(".error").replaceChildren(error.message);
  }
  button.disabled = false;
  await poll();
}

function showCamera(card, camera) {
  const { element } = card;
  const set = (name, text) => {
    const target = element.querySelector(name);
    if (target.textContent !== text) target.textContent = text;
  };
  element.dataset.state = camera.state;
  const retry = camera.state === "retrying" && camera.next_retry_s != null;
  set(".state", (WORDS[camera.state] ?? camera.state) + (retry ? ` in ${Math.ceil(camera.next_retry_s)} s` : ""));
  set(".url", camera.url);
  set(".error", camera.state === "live" || !camera.last_error ? "" : camera.last_error);
  const unseen = session?.video === false ? "Your token may not see pictures." : "";
  set(".note", camera.state === "live" ? unseen : `This camera is ${WORDS[camera.state] ?? camera.state}.`);
  element.querySelector(".delete").hidden = session?.role === "viewer";
  set(".rate", camera.fps == null ? "-" : `${camera.fps.toFixed(1)} /s`);
  set(".size", camera.width && camera.height ? `${camera.width} x ${camera.height}` : "-");
  const dropped = Object.values(camera.dropped).reduce((sum, n) => sum + n, 0);
  set(".dropped", `${dropped} of ${camera.frames_in}`);
  set(".reconnects", String(camera.reconnects));
}

function show(cameras) {
  const ids = new Set(cameras.map((c) => c.id));
  for (const [id, card] of cards) {
    if (ids.has(id)) continue;
    card.view.want(false);
    inSight.unobserve(card.element);
    card.element.remove();
    cards.delete(id);
  }
  cameras.forEach((camera, i) => {
    let card = cards.get(camera.id);
    if (!card) {
      card = newCard(camera.id);
      cards.set(camera.id, card);
      $("#cameras").insertBefore(card.element, $("#cameras").children[i] ?? null);
      inSight.observe(card.element);
    }
    showCamera(card, camera);
  });
  const live = cameras.filter((c) => c.state === "live").length;
  $("#summary").textContent = `${cameras.length} ${cameras.length === 1 ? "camera" : "cameras"}, ${live} live`;
  $("#none").hidden = cameras.length > 0;
}

let asked = 0;
async function poll() {
  if (session?.role == null) return;
  const turn = ++asked;
  try {
    const { cameras } = await api("/v1/cameras");
    // An answer that is overtaken by a newer question is stale.
    if (turn === asked) show(cameras);
    $("#offline").hidden = true;
  } catch (error) {
    console.error(error);
    $("#offline").hidden = false;
  }
}

$("#add").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  const result = $("#add-result");
  const { id, url, transport, loop } = form.elements;
  const body = { id: id.value.trim(), url: url.value.trim(), loop: loop.checked };
  if (transport.value) body.transport = transport.value;
  result.className = "";
  result.textContent = "Adding";
  try {
    await api("/v1/cameras", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
    });
    form.reset();
    result.textContent = `Camera ${body.id} was added.`;
    await poll();
  } catch (error) {
    result.className = "bad";
    result.textContent = error.answered ? error.message : "The service does not answer. Nothing was added.";
  }
});

async function forever() {
  for (;;) {
    if (session === null) {
      await learnWhoIAm().catch(() => ($("#offline").hidden = false));
    }
    if (!document.hidden) await poll();
    await new Promise((resolve) => setTimeout(resolve, POLL_MS));
  }
}
forever();
