// Counts as they were seen since the page was opened: for charts where the service keeps no history.

import type { Bucket, Counts } from "../api";

interface Sample {
  at: number;
  counts: Counts;
}

const STEP_S = 10;
const KEPT = 3600;
const samples = new Map<string, Sample[]>();

/** Takes a camera's counts in; only what has changed, and the first. */
export function remember(counts: Counts): void {
  let list = samples.get(counts.camera);
  if (!list) samples.set(counts.camera, (list = []));
  const last = list[list.length - 1];
  if (last && JSON.stringify(last.counts) === JSON.stringify(counts)) return;
  list.push({ at: Date.now() / 1000, counts });
  if (list.length > KEPT) list.shift();
}

/** What a line or zone has counted since the page was opened, in steps of ten seconds. */
export function sampled(camera: string, kind: "line" | "zone", name: string): { since: number; step: number; buckets: Bucket[] } {
  const list = samples.get(camera) ?? [];
  const buckets = new Map<number, Bucket>();
  const [first, second] = kind === "line" ? (["in", "out"] as const) : (["entries", "exits"] as const);
  let before: Record<string, number> | undefined;
  for (const { at, counts } of list) {
    const now = (kind === "line" ? counts.lines : counts.zones)[name] as unknown as Record<string, number> | undefined;
    if (now && before) {
      const start = Math.floor(at / STEP_S) * STEP_S;
      const bucket: Record<string, number> & { start?: string } = (buckets.get(start) as never) ?? {};
      for (const key of [first, second]) {
        // A line that was moved counts anew.
        const more = now[key]! >= before[key]! ? now[key]! - before[key]! : now[key]!;
        bucket[key] = (bucket[key] ?? 0) + more;
      }
      buckets.set(start, { ...bucket, start: new Date(start * 1000).toISOString() });
    }
    before = now ?? before;
  }
  return { since: list[0]?.at ?? Date.now() / 1000, step: STEP_S, buckets: [...buckets.values()] };
}
