// What every part of the page knows: who is here, which cameras there are, whether the service answers.

import { computed, signal } from "@preact/signals";
import { ApiError, ask, type Camera, type Session } from "./api";

const POLL_MS = 1500;

/** Who asks; `null` until the service has said. */
export const session = signal<Session | null>(null);
/** The cameras; `null` until known. */
export const cameras = signal<Camera[] | null>(null);
/** Whether the service has stopped answering. */
export const offline = signal(false);
/** Whether the page can be seen. */
export const awake = signal(!document.hidden);

export const mustSignIn = computed(() => session.value?.auth === "required" && session.value.role === null);
/** Whether cameras, lines and zones may be changed. */
export const mayEdit = computed(() => session.value?.role === "operator" || session.value?.role === "admin");
/** Whether what is hidden of pictures may be changed. */
export const mayHide = computed(() => session.value?.role === "admin");
/** Whether pictures may be seen. */
export const maySee = computed(() => session.value?.video === true);

/** Asks who is here, anew. */
export async function learnWho(): Promise<void> {
  const before = session.value;
  const now = await ask<Session>("/v1/session");
  if (JSON.stringify(before) !== JSON.stringify(now)) session.value = now;
  if (mustSignIn.value) cameras.value = null;
}

export async function signIn(token: string): Promise<void> {
  session.value = await ask<Session>("/v1/session", "POST", { token });
  refresh();
}

export async function signOut(): Promise<void> {
  await ask("/v1/session", "DELETE");
  await learnWho();
}

let timer: ReturnType<typeof setTimeout> | undefined;
let running = false;
let again = false;

/** Looks at the cameras now, not at the next turn. */
export function refresh(): void {
  if (running) {
    again = true;
    return;
  }
  clearTimeout(timer);
  void turn();
}

async function turn(): Promise<void> {
  running = true;
  try {
    if (session.value === null || mustSignIn.value || offline.value) await learnWho();
    if (!mustSignIn.value) cameras.value = (await ask<{ cameras: Camera[] }>("/v1/cameras")).cameras;
    offline.value = false;
  } catch (error) {
    if (error instanceof ApiError && error.status === 0) offline.value = true;
    // The session has ended, or the rights have changed.
    else await learnWho().catch(() => (offline.value = true));
  } finally {
    running = false;
  }
  const wait = again ? 0 : POLL_MS;
  again = false;
  timer = setTimeout(() => {
    if (awake.value) void turn();
  }, wait);
}

export function start(): void {
  document.addEventListener("visibilitychange", () => {
    awake.value = !document.hidden;
    if (awake.value) refresh();
  });
  addEventListener("online", refresh);
  refresh();
}
