// Lines and zones on a picture, in fractions of it.

import type { Point } from "../api";

export const clamp = (value: number): number => Math.min(1, Math.max(0, Math.round(value * 10_000) / 10_000));

/** The middle of a line by its length, and the way to its "in" side: right of who walks along it. In pixels. */
export function sides(points: Point[], width: number, height: number): { at: Point; inwards: Point } {
  const pixels = points.map(([x, y]): Point => [x * width, y * height]);
  const lengths = pixels.slice(1).map((p, i) => Math.hypot(p[0] - pixels[i]![0], p[1] - pixels[i]![1]));
  let left = lengths.reduce((sum, l) => sum + l, 0) / 2;
  for (let i = 0; i < lengths.length; i += 1) {
    const length = lengths[i]!;
    if (left <= length || i === lengths.length - 1) {
      const [ax, ay] = pixels[i]!;
      const [bx, by] = pixels[i + 1]!;
      const part = length > 0 ? left / length : 0;
      const [dx, dy] = length > 0 ? [(bx - ax) / length, (by - ay) / length] : [0, -1];
      return { at: [ax + (bx - ax) * part, ay + (by - ay) * part], inwards: [-dy, dx] };
    }
    left -= length;
  }
  return { at: pixels[0] ?? [0, 0], inwards: [1, 0] };
}

/** Where a zone's name stands: the middle of its corners. */
export function middle(points: Point[]): Point {
  const sum = points.reduce(([x, y], [px, py]): Point => [x + px, y + py], [0, 0] as Point);
  return [sum[0] / points.length, sum[1] / points.length];
}

/** A name that is free: `line-1`, `line-2`, ... */
export function freeName(kind: string, taken: string[]): string {
  for (let n = 1; ; n += 1) {
    const name = `${kind}-${n}`;
    if (!taken.includes(name)) return name;
  }
}
