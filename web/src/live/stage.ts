// One camera's picture and the boxes over it: each WebSocket message is a picture with the tracks of that very frame,
// and both are drawn at once, so they are always in step. Who may not see pictures gets the boxes alone.

import type { Report } from "../api";
import { cameraPath } from "../api";
import { stream, type Link } from "../socket";
import { Painter } from "./draw";

/** What is shown just now, for the words beside the picture. */
export interface Shown {
  report: Report;
  /** Pictures in a second, over the last two. */
  rate: number;
  /** From capture to screen, milliseconds; `null` where the clock is a film's own. */
  delay: number | null;
}

const decoder = new TextDecoder();

/** Splits a message of `/v1/cameras/{id}/live`: length of the JSON, the JSON, the JPEG. */
function parse(buffer: ArrayBuffer): [Report, Blob] {
  const length = new DataView(buffer).getUint32(0);
  const report = JSON.parse(decoder.decode(new Uint8Array(buffer, 4, length))) as Report;
  return [report, new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" })];
}

export class Stage {
  private readonly painter = new Painter();
  private readonly over: CanvasRenderingContext2D;
  private readonly under: CanvasRenderingContext2D;
  private readonly sizes: ResizeObserver;
  private stop: (() => void) | null = null;
  private waiting: ArrayBuffer | null = null;
  private busy = false;
  private ratio = 1;
  private last: Report | null = null;
  private pictures = 0;
  private readonly times = new Float64Array(64);
  private told = 0;
  private slow = 0;

  /** `frame` holds both canvases and carries what is shown as `data-` attributes. */
  constructor(
    private readonly id: string,
    private readonly pictured: boolean,
    private readonly frame: HTMLElement,
    picture: HTMLCanvasElement,
    boxes: HTMLCanvasElement,
    private readonly on: { link: (link: Link) => void; shown: (shown: Shown) => void },
  ) {
    this.under = picture.getContext("2d", { alpha: false })!;
    this.over = boxes.getContext("2d")!;
    this.sizes = new ResizeObserver(() => this.fit());
    this.sizes.observe(boxes);
  }

  /** Connects while the picture can be seen, lets go when it cannot. */
  want(wanted: boolean): void {
    if (wanted === (this.stop !== null)) return;
    if (!wanted) {
      this.stop?.();
      this.stop = null;
      this.waiting = null;
      return;
    }
    const path = this.pictured
      ? cameraPath(this.id, "live")
      : `/v1/tracks?camera=${encodeURIComponent(this.id)}&rate=10`;
    this.stop = stream(path, {
      link: this.on.link,
      message: (data) => {
        if (typeof data === "string") {
          const report = JSON.parse(data) as Report;
          // A gap says only what was missed.
          if (report.tracks) this.show(null, report);
        } else {
          this.waiting = data;
          void this.decode();
        }
      },
    });
  }

  close(): void {
    this.want(false);
    this.sizes.disconnect();
  }

  /** Decodes what waits, one picture at a time; what came meanwhile is replaced by what is newer. */
  private async decode(): Promise<void> {
    if (this.busy) return;
    this.busy = true;
    try {
      while (this.waiting) {
        const [report, jpeg] = parse(this.waiting);
        this.waiting = null;
        const bitmap = await createImageBitmap(jpeg);
        if (this.stop) this.show(bitmap, report);
        bitmap.close();
      }
    } catch (error) {
      console.error(`camera ${this.id}: a picture could not be shown`, error);
    } finally {
      this.busy = false;
    }
  }

  private show(bitmap: ImageBitmap | null, report: Report): void {
    if (bitmap) {
      const { canvas } = this.under;
      if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
        canvas.width = bitmap.width;
        canvas.height = bitmap.height;
      }
      this.under.drawImage(bitmap, 0, 0);
    }
    this.painter.push(report);
    this.last = report;
    this.painter.draw(this.over, report, this.ratio);
    this.tell(report);
  }

  /** Boxes are drawn in the screen's own pixels. */
  private fit(): void {
    const { canvas } = this.over;
    this.ratio = Math.min(devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * this.ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * this.ratio));
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    if (this.last) this.painter.draw(this.over, this.last, this.ratio);
  }

  private tell(report: Report): void {
    const now = performance.now();
    this.times[this.pictures % this.times.length] = now;
    this.pictures += 1;
    const { dataset } = this.frame;
    dataset.pictures = String(this.pictures);
    dataset.seq = String(report.seq);
    dataset.captured = report.capture_ts;
    this.frame.dispatchEvent(new CustomEvent<Report>("shown", { detail: report }));

    const delay = report.clock === "media" ? null : Math.max(0, Date.now() - Date.parse(report.capture_ts));
    if (delay !== null) this.slow = this.slow === 0 ? delay : this.slow * 0.9 + delay * 0.1;
    // Words twice a second: nobody reads faster.
    if (now - this.told < 500) return;
    this.told = now;
    let count = 0;
    let first = now;
    for (const time of this.times) {
      if (time === 0 || now - time > 2000) continue;
      count += 1;
      first = Math.min(first, time);
    }
    const rate = now - first > 300 ? ((count - 1) * 1000) / (now - first) : 0;
    this.on.shown({ report, rate, delay: delay === null ? null : Math.round(this.slow) });
  }
}
