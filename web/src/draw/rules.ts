// A camera's lines, zones and masks: what there is, and what is being drawn.

import { ask, cameraPath, type Line, type Mask, type Point, type Zone } from "../api";

export type Kind = "line" | "zone" | "mask";

/** A line, zone or mask while it is drawn or changed. */
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
  style: "fill" | "pixelate";
}

export interface Rules {
  lines: Line[];
  zones: Zone[];
  masks: Mask[];
}

export function rulesOf(rules: Rules, kind: Kind): (Line | Zone | Mask)[] {
  return kind === "line" ? rules.lines : kind === "zone" ? rules.zones : rules.masks;
}

export const leastPoints = (kind: Kind): number => (kind === "line" ? 2 : 3);
export const MOST_POINTS = 32;

export async function fetchRules(camera: string): Promise<Rules> {
  const [{ lines }, { zones }, { masks }] = await Promise.all([
    ask<{ lines: Line[] }>(cameraPath(camera, "lines")),
    ask<{ zones: Zone[] }>(cameraPath(camera, "zones")),
    ask<{ masks: Mask[] }>(cameraPath(camera, "masks")),
  ]);
  return { lines, zones, masks };
}

export function newDraft(kind: Kind, name: string): Draft {
  const settings = { anchor: "foot", loiter: "", capacity: "", style: "fill" } as const;
  return { kind, was: "", name, points: [], open: true, ...settings };
}

export function draftOf(kind: Kind, rule: Line | Zone | Mask): Draft {
  const zone = rule as Zone;
  return {
    kind,
    was: rule.id,
    name: rule.id,
    points: rule.points.map(([x, y]): Point => [x, y]),
    open: false,
    anchor: zone.anchor ?? "foot",
    loiter: zone.loiter_s === undefined ? "" : String(zone.loiter_s),
    capacity: zone.capacity === undefined ? "" : String(zone.capacity),
    style: (rule as Mask).style ?? "fill",
  };
}

function bodyOf({ kind, name: id, points, anchor, loiter, capacity, style }: Draft): Line | Zone | Mask {
  if (kind === "mask") return { id, points, style };
  const zone: Zone = { id, points, anchor };
  if (kind === "zone" && loiter) zone.loiter_s = Number(loiter);
  if (kind === "zone" && capacity) zone.capacity = Number(capacity);
  return zone;
}

/** Saves a draft. Another name is another line: the old one goes once the new one is there. */
export async function save(camera: string, draft: Draft): Promise<void> {
  const plural = `${draft.kind}s`;
  const body = bodyOf(draft);
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
