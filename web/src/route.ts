// Where one is: `#/`, `#/camera/gate`, `#/events`, `#/history`, `#/health`.

import { signal } from "@preact/signals";

export interface Route {
  page: "cameras" | "camera" | "events" | "history" | "health";
  camera: string;
}

function read(): Route {
  const [page = "", name = ""] = location.hash.replace(/^#\//, "").split("/");
  try {
    if (page === "camera" && name) return { page, camera: decodeURIComponent(name) };
  } catch {
    // A name that is no name: the cameras.
  }
  if (page === "events" || page === "history" || page === "health") return { page, camera: "" };
  return { page: "cameras", camera: "" };
}

export const route = signal<Route>(read());

addEventListener("hashchange", () => {
  route.value = read();
  scrollTo(0, 0);
});

export const cameraHref = (id: string): string => `#/camera/${encodeURIComponent(id)}`;

export function go(hash: string): void {
  location.hash = hash;
}
