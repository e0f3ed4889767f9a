// Boxes, ids and trails on a canvas, as src/publish/draw.rs draws them into a picture.

const TRAIL_MS = 2000;

/** A track's colour: hues a golden angle apart. */
export const colour = (id) => `hsl(${((id % 1e6) * 137.508) % 360} 90% 60%)`;

/** Where the tracks of one camera stood in the last seconds. */
export class Trails {
  #epoch = null;
  #points = new Map();

  push(report) {
    if (this.#epoch !== report.epoch) {
      this.#points.clear();
      this.#epoch = report.epoch;
    }
    const now = Date.parse(report.capture_ts);
    const alive = new Set(report.tracks.map((t) => t.id));
    for (const id of this.#points.keys()) if (!alive.has(id)) this.#points.delete(id);
    for (const { id, state, box: [x, y, w, h] } of report.tracks) {
      const trail = this.#points.get(id) ?? [];
      if (state !== "lost") trail.push({ at: now, x: x + w / 2, y: y + h });
      this.#points.set(id, trail.filter((p) => now - p.at <= TRAIL_MS && p.at <= now));
    }
  }

  of(id) {
    return this.#points.get(id) ?? [];
  }
}

/** Draws a report's tracks over the picture that is on the canvas. */
export function annotate(context, report, trails) {
  const { width, height } = context.canvas;
  const [sx, sy] = [width / report.width, height / report.height];
  const stroke = Math.max(1, Math.floor(height / 240));
  context.textBaseline = "top";
  context.font = `600 ${10 + 4 * stroke}px system-ui, sans-serif`;
  context.lineJoin = "round";
  for (const track of report.tracks) {
    const [x, y, w, h] = [track.box[0] * sx, track.box[1] * sy, track.box[2] * sx, track.box[3] * sy];
    context.strokeStyle = colour(track.id);
    context.lineWidth = track.state === "tentative" ? 1 : stroke;
    context.setLineDash(track.state === "confirmed" ? [] : [4 * stroke, 4 * stroke]);
    context.strokeRect(x, y, w, h);
    context.setLineDash([]);
    if (track.state === "confirmed") {
      context.beginPath();
      for (const point of trails.of(track.id)) context.lineTo(point.x * sx, point.y * sy);
      context.stroke();
    }
    if (track.state !== "tentative") plate(context, track.id, x, y, 12 + 4 * stroke);
  }
}

function plate(context, id, x, y, height) {
  const text = String(id);
  const width = context.measureText(text).width + 6;
  const left = Math.min(Math.max(x, 0), Math.max(context.canvas.width - width, 0));
  const top = y >= height ? y - height : Math.max(y, 0);
  context.fillStyle = colour(id);
  context.fillRect(left, top, width, height);
  context.fillStyle = "#000";
  context.fillText(text, left + 3, top + 1);
}
