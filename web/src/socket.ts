// A WebSocket that comes back: after a wait that grows, at once when the service answers again.

import { effect } from "@preact/signals";
import { offline } from "./state";

const FIRST_MS = 500;
const MOST_MS = 8000;

export type Link = "connecting" | "open" | "lost";

/** Keeps a WebSocket to `path` open until the returned function is called. */
export function stream(
  path: string,
  on: { message: (data: string | ArrayBuffer) => void; link: (link: Link) => void },
): () => void {
  let socket: WebSocket | null = null;
  let timer: ReturnType<typeof setTimeout> | undefined;
  let wait = FIRST_MS;
  let wanted = true;

  const connect = () => {
    clearTimeout(timer);
    const url = new URL(path, location.href);
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    const now = new WebSocket(url);
    socket = now;
    now.binaryType = "arraybuffer";
    now.onopen = () => {
      if (socket === now) on.link("open");
    };
    now.onmessage = ({ data }) => {
      if (socket !== now) return;
      wait = FIRST_MS;
      on.message(data as string | ArrayBuffer);
    };
    now.onclose = () => {
      if (socket !== now || !wanted) return;
      socket = null;
      on.link("lost");
      // Not all at the same moment, when a service with many viewers comes back.
      timer = setTimeout(connect, wait * (0.75 + Math.random() / 2));
      wait = Math.min(wait * 2, MOST_MS);
    };
  };

  on.link("connecting");
  connect();
  const stop = effect(() => {
    if (!offline.value && socket === null) {
      wait = FIRST_MS;
      connect();
    }
  });
  return () => {
    wanted = false;
    stop();
    clearTimeout(timer);
    const last = socket;
    socket = null;
    last?.close();
  };
}
