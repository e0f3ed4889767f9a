import type { PastTrack } from "../api";
import { colour } from "../live/draw";

/** The way somebody took, small: from the hollow dot to the full one, on the frame of the picture. */
export function PathDrawing({ track }: { track: PastTrack }) {
  const { width, height, path } = track;
  const points = path.map(({ box: [x, y, w, h] }) => [x + w / 2, y + h] as const);
  const first = points[0];
  const last = points[points.length - 1];
  if (!first || !last) return null;
  const dot = width / 24;
  return (
    <svg class="path" viewBox={`0 0 ${width} ${height}`} role="img" aria-label={`The way of ${track.class} ${track.id}`}>
      <polyline points={points.map(([x, y]) => `${x.toFixed(0)},${y.toFixed(0)}`).join(" ")} stroke={colour(track.id)} />
      <circle cx={first[0]} cy={first[1]} r={dot} stroke={colour(track.id)} fill="none" />
      <circle cx={last[0]} cy={last[1]} r={dot} fill={colour(track.id)} />
    </svg>
  );
}
