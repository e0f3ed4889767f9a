// Boxes, ids and trails over a picture, as src/publish/draw.rs draws them into one.

import type { Report, Track } from "../api";

const TRAIL_MS = 2000;
/** Points of a trail at most: as many as 32 frames a second leave in its time. */
const TRAIL_POINTS = 64;

/** A track's colour: hues a golden angle apart. */
const colours = new Map<number, string>();
export function colour(id: number): string {
  let found = colours.get(id);
  if (found === undefined) {
    if (colours.size > 2000) colours.clear();
    found = `hsl(${((id % 1e6) * 137.508) % 360} 90% 70%)`;
    colours.set(id, found);
  }
  return found;
}

/** Where one track stood lately: a ring of x, y, time. */
class Trail {
  readonly points = new Float64Array(TRAIL_POINTS * 3);
  start = 0;
  length = 0;
  seen = 0;

  push(x: number, y: number, at: number): void {
    const place = ((this.start + this.length) % TRAIL_POINTS) * 3;
    this.points[place] = x;
    this.points[place + 1] = y;
    this.points[place + 2] = at;
    if (this.length < TRAIL_POINTS) this.length += 1;
    else this.start = (this.start + 1) % TRAIL_POINTS;
  }

  /** Forgets what is older than trails are, or of a time line that has jumped back. */
  trim(now: number): void {
    while (this.length > 0) {
      const at = this.points[this.start * 3 + 2]!;
      if (at <= now && now - at <= TRAIL_MS) return;
      this.start = (this.start + 1) % TRAIL_POINTS;
      this.length -= 1;
    }
  }
}

/** Draws reports on a canvas that lies over the picture. Keeps trails from one to the next. */
export class Painter {
  private readonly trails = new Map<number, Trail>();
  private readonly spare: Trail[] = [];
  private epoch = -1;
  private turn = 0;
  private now = 0;
  private dash: number[] = [4, 4];
  private readonly solid: number[] = [];

  /** Takes a report in. */
  push(report: Report): void {
    if (this.epoch !== report.epoch) {
      this.trails.clear();
      this.epoch = report.epoch;
    }
    this.turn += 1;
    this.now = Date.parse(report.capture_ts);
    for (const track of report.tracks) {
      let trail = this.trails.get(track.id);
      if (trail === undefined) {
        trail = this.spare.pop() ?? new Trail();
        trail.start = trail.length = 0;
        this.trails.set(track.id, trail);
      }
      trail.seen = this.turn;
      const [x, y, w, h] = track.box;
      if (track.state !== "lost") trail.push(x + w / 2, y + h, this.now);
      trail.trim(this.now);
    }
    for (const [id, trail] of this.trails) {
      if (trail.seen === this.turn) continue;
      this.trails.delete(id);
      if (this.spare.length < 64) this.spare.push(trail);
    }
  }

  /** Draws the report over the whole canvas; `ratio` device pixels are a CSS pixel. */
  draw(context: CanvasRenderingContext2D, report: Report, ratio: number): void {
    const { width, height } = context.canvas;
    const sx = width / report.width;
    const sy = height / report.height;
    const stroke = Math.max(1.5, Math.min(3, width / ratio / 320)) * ratio;
    const text = Math.max(11, Math.min(15, width / ratio / 45)) * ratio;
    context.clearRect(0, 0, width, height);
    context.textBaseline = "middle";
    context.lineJoin = "round";
    context.lineCap = "round";
    context.font = `600 ${text}px system-ui, sans-serif`;
    this.dash[0] = this.dash[1] = 4 * stroke;
    for (const track of report.tracks) this.trail(context, track, sx, sy, stroke);
    for (const track of report.tracks) this.box(context, track, sx, sy, stroke);
    for (const track of report.tracks) {
      if (track.state !== "tentative") plate(context, track, track.box[0] * sx, track.box[1] * sy, text);
    }
  }

  private trail(context: CanvasRenderingContext2D, track: Track, sx: number, sy: number, stroke: number): void {
    const trail = this.trails.get(track.id);
    if (track.state !== "confirmed" || trail === undefined || trail.length < 2) return;
    context.strokeStyle = colour(track.id);
    context.lineWidth = stroke;
    const { points } = trail;
    for (let i = 1; i < trail.length; i += 1) {
      const from = ((trail.start + i - 1) % TRAIL_POINTS) * 3;
      const to = ((trail.start + i) % TRAIL_POINTS) * 3;
      // Older is fainter.
      context.globalAlpha = Math.max(0.08, 1 - (this.now - points[to + 2]!) / TRAIL_MS);
      context.beginPath();
      context.moveTo(points[from]! * sx, points[from + 1]! * sy);
      context.lineTo(points[to]! * sx, points[to + 1]! * sy);
      context.stroke();
    }
    context.globalAlpha = 1;
  }

  private box(context: CanvasRenderingContext2D, track: Track, sx: number, sy: number, stroke: number): void {
    const [x, y, w, h] = track.box;
    context.strokeStyle = colour(track.id);
    context.lineWidth = track.state === "tentative" ? stroke / 2 : stroke;
    context.setLineDash(track.state === "confirmed" ? this.solid : this.dash);
    context.strokeRect(x * sx, y * sy, w * sx, h * sy);
    context.setLineDash(this.solid);
  }
}

/** The id on a plate at the top left of its box; other classes than people say what they are. */
function plate(context: CanvasRenderingContext2D, track: Track, x: number, y: number, text: number): void {
  const name = track.class === "person" ? String(track.id) : `${track.class} ${track.id}`;
  const height = text * 1.3;
  const width = context.measureText(name).width + text * 0.6;
  const left = Math.min(Math.max(x, 0), Math.max(context.canvas.width - width, 0));
  const top = y >= height ? y - height : Math.max(y, 0);
  context.fillStyle = colour(track.id);
  context.fillRect(left, top, width, height);
  context.fillStyle = "#000";
  context.fillText(name, left + text * 0.3, top + height * 0.54);
}
