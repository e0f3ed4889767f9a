// What the service says, as docs/api.md describes it, and how it is asked.

export interface Session {
  auth: "open" | "required";
  name: string | null;
  role: "viewer" | "operator" | "admin" | null;
  video: boolean | null;
}

export type CameraState = "connecting" | "live" | "retrying" | "ended" | "failed" | "paused";

export interface Camera {
  id: string;
  url: string;
  state: CameraState;
  since: string;
  last_error: string | null;
  last_error_kind: string | null;
  next_retry_s: number | null;
  reconnects: number;
  epoch: number;
  width: number | null;
  height: number | null;
  fps: number | null;
  frames_in: number;
  tracked: number;
  dropped: Record<string, number>;
  tracks: { tentative: number; confirmed: number; lost: number };
}

export type Point = [number, number];

export interface Line {
  id: string;
  points: Point[];
  anchor?: "foot" | "centre";
}

export interface Zone extends Line {
  loiter_s?: number;
  capacity?: number;
}

export interface Mask {
  id: string;
  points: Point[];
  style?: "fill" | "pixelate";
}

export interface LineCount {
  in: number;
  out: number;
}

export interface ZoneCount {
  occupancy: number;
  entries: number;
  exits: number;
  mean_dwell_s: number | null;
  longest_s: number;
  crowded: boolean;
}

export interface Counts {
  camera: string;
  since: string;
  lines: Record<string, LineCount>;
  zones: Record<string, ZoneCount>;
}

export interface Heat {
  columns: number;
  rows: number;
  seconds: number[];
}

export interface Track {
  id: number;
  state: "tentative" | "confirmed" | "lost";
  class: string;
  box: [number, number, number, number];
}

export interface Report {
  camera: string;
  epoch: number;
  seq: number;
  frame: number;
  capture_ts: string;
  clock: "rtcp" | "arrival" | "media";
  width: number;
  height: number;
  tracks: Track[];
}

export interface GakpEvent {
  id: string;
  type: string;
  camera: string;
  time: string;
  clock: string;
  track?: number;
  class?: string;
  line?: string;
  zone?: string;
  direction?: "in" | "out";
  dwell_s?: number;
  occupancy?: number;
}

export interface PastTrack {
  camera: string;
  epoch: number;
  id: number;
  class: string;
  first: string;
  last: string;
  seconds: number;
  confidence: number;
  ended: boolean;
  width: number;
  height: number;
  path: { time: string; frame: number; box: [number, number, number, number] }[];
  snapshot?: string;
}

export interface Bucket {
  start: string;
  in?: number;
  out?: number;
  entries?: number;
  exits?: number;
}

export interface Webhook {
  name: string;
  source: "configuration" | "api";
  url: string;
  signed: boolean;
  cameras: string[];
  types: string[];
  delivered: number;
  failed: number;
  pending: number;
  last_error: string | null;
  last_error_time: string | null;
}

export interface WebhookTrial {
  delivered: boolean;
  error: string | null;
  took_ms: number;
}

/** A refusal: a problem document's status, kind and detail. Status 0: the service did not answer. */
export class ApiError extends Error {
  constructor(
    readonly status: number,
    readonly kind: string,
    detail: string,
  ) {
    super(detail);
  }
}

/** Asks the service; what it answers, or `undefined` for an empty answer. */
export async function ask<T>(path: string, method = "GET", body?: unknown): Promise<T> {
  const response = await answer(path, method, body);
  if (response.status === 204) return undefined as T;
  return (await response.json()) as T;
}

/** The same for answers that are text. */
export async function askText(path: string): Promise<string> {
  return (await answer(path, "GET")).text();
}

async function answer(path: string, method: string, body?: unknown): Promise<Response> {
  let response: Response;
  try {
    response = await fetch(path, {
      method,
      headers: body === undefined ? {} : { "Content-Type": "application/json" },
      body: body === undefined ? undefined : JSON.stringify(body),
      signal: AbortSignal.timeout(15_000),
    });
  } catch {
    throw new ApiError(0, "offline", "The service does not answer.");
  }
  if (response.ok) return response;
  const problem = (await response.json().catch(() => null)) as { type?: string; detail?: string } | null;
  const kind = problem?.type?.split(":").pop() ?? "unknown";
  throw new ApiError(response.status, kind, problem?.detail ?? `The service answered with status ${response.status}.`);
}

/** The path of a camera, and of something of it. */
export function cameraPath(id: string, ...rest: string[]): string {
  return ["/v1/cameras", id, ...rest].map((part, i) => (i === 0 ? part : encodeURIComponent(part))).join("/");
}

/** The path of a webhook, and of something of it. */
export function webhookPath(name: string, ...rest: string[]): string {
  return ["/v1/webhooks", encodeURIComponent(name), ...rest].join("/");
}

/** A query string of what is not empty. */
export function query(values: Record<string, string | number | undefined>): string {
  const search = new URLSearchParams();
  for (const [key, value] of Object.entries(values)) {
    if (value !== undefined && value !== "") search.set(key, String(value));
  }
  const text = search.toString();
  return text ? `?${text}` : "";
}

/** What to tell people of an error. */
export const words = (error: unknown): string => (error instanceof Error ? error.message : String(error));
