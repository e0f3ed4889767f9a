// A camera's lines and zones: what there is, and what is being drawn.

import { ask, cameraPath, type Line, type Point, type Zone } from "../api";

export type Kind = "line" | "zone";

/** A line or zone while it is drawn or changed. */
export interface Draft {
  kind: Kind;
  /** The name it had; empty for a new one. */
  was: string;
  name: string;
  points: Point[];
  /** Points are still being put. */
  open: boolean;
  anchor: "foot" | "centre";
  loiter: string;
  capacity: string;
}

export interface Rules {
  lines: Line[];
  zones: Zone[];
}

export const leastPoints = (kind: Kind): number => (kind === "line" ? 2 : 3);
export const MOST_POINTS = 32;

export async function fetchRules(camera: string): Promise<Rules> {
  const [{ lines }, { zones }] = await Promise.all([
    ask<{ lines: Line[] }>(cameraPath(camera, "lines")),
    ask<{ zones: Zone[] }>(cameraPath(camera, "zones")),
  ]);
  return { lines, zones };
}

export function draftOf(kind: Kind, rule: Line | Zone): Draft {
  const zone = rule as Zone;
  return {
    kind,
    was: rule.id,
    name: rule.id,
    points: rule.points.map(([x, y]): Point => [x, y]),
    open: false,
    anchor: rule.anchor ?? "foot",
    loiter: zone.loiter_s === undefined ? "" : String(zone.loiter_s),
    capacity: zone.capacity === undefined ? "" : String(zone.capacity),
  };
}

/** Saves a draft. Another name is another line: the old one goes once the new one is there. */
export async function save(camera: string, draft: Draft): Promise<void> {
  const plural = `${draft.kind}s`;
  const body: Zone = { id: draft.name, points: draft.points, anchor: draft.anchor };
  if (draft.kind === "zone" && draft.loiter) body.loiter_s = Number(draft.loiter);
  if (draft.kind === "zone" && draft.capacity) body.capacity = Number(draft.capacity);
  if (draft.was === draft.name) {
    await ask(cameraPath(camera, plural, draft.name), "PUT", body);
    return;
  }
  await ask(cameraPath(camera, plural), "POST", body);
  if (draft.was) await remove(camera, draft.kind, draft.was);
}

export async function remove(camera: string, kind: Kind, name: string): Promise<void> {
  await ask(cameraPath(camera, `${kind}s`, name), "DELETE");
}
