// One camera's live pictures: each WebSocket message is a picture with the tracks of that very frame,
// so that boxes and picture are always in step.

import { Trails, annotate, colour } from "./draw.js";

const RETRY_FIRST_MS = 500;
const RETRY_MAX_MS = 8000;

/** Splits a message of /v1/cameras/{id}/live: length of the JSON, the JSON, the JPEG. */
function parse(buffer) {
  const length = new DataView(buffer).getUint32(0);
  const report = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { report, jpeg: new Blob([new Uint8Array(buffer, 4 + length)], { type: "image/jpeg" }) };
}

export class View {
  #id;
  #card;
  #canvas;
  #trails = new Trails();
  #socket = null;
  #retry = null;
  #delay = RETRY_FIRST_MS;
  #wanted = false;
  #waiting = null;
  #busy = false;
  #shown = [];
  #pictures = 0;

  constructor(id, card) {
    this.#id = id;
    this.#card = card;
    this.#canvas = card.querySelector("canvas");
  }

  /** Connects, or lets go when nobody can see the camera. */
  want(wanted) {
    if (this.#wanted === wanted) return;
    this.#wanted = wanted;
    if (wanted) this.#connect();
    else this.#disconnect();
  }

  #disconnect() {
    clearTimeout(this.#retry);
    const socket = this.#socket;
    this.#socket = null;
    this.#waiting = null;
    socket?.close();
  }

  #connect() {
    const url = new URL(`/v1/cameras/${encodeURIComponent(this.#id)}/live`, location.href);
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      this.#delay = RETRY_FIRST_MS;
      this.#waiting = data;
      this.#draw();
    };
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      this.#socket = null;
      if (!this.#wanted) return;
      this.#retry = setTimeout(() => this.#connect(), this.#delay * (0.75 + Math.random() / 2));
      this.#delay = Math.min(this.#delay * 2, RETRY_MAX_MS);
    };
    this.#socket = socket;
  }

  /** Draws what waits, one picture at a time; what came meanwhile is replaced by what is newer. */
  async #draw() {
    if (this.#busy) return;
    this.#busy = true;
    try {
      while (this.#waiting) {
        const { report, jpeg } = parse(this.#waiting);
        this.#waiting = null;
        const bitmap = await createImageBitmap(jpeg);
        this.#show(bitmap, report);
        bitmap.close();
      }
    } catch (error) {
      console.error(`camera ${this.#id}: a picture could not be shown`, error);
    } finally {
      this.#busy = false;
    }
  }

  #show(bitmap, report) {
    const canvas = this.#canvas;
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
    }
    const context = canvas.getContext("2d");
    context.drawImage(bitmap, 0, 0);
    this.#trails.push(report);
    annotate(context, report, this.#trails);
    this.#tell(report);
  }

  /** The same in words: attributes for programs, a list of ids for people who cannot see the canvas. */
  #tell(report) {
    const tracks = report.tracks;
    const confirmed = tracks.filter((t) => t.state === "confirmed").length;
    const card = this.#card;
    this.#pictures += 1;
    card.dataset.pictures = this.#pictures;
    card.dataset.epoch = report.epoch;
    card.dataset.seq = report.seq;
    card.dataset.frame = report.frame;
    card.dataset.tracks = tracks.length;
    card.dataset.confirmed = confirmed;
    this.#canvas.setAttribute("aria-label", `Camera ${this.#id}: ${confirmed} confirmed tracks`);

    const list = card.querySelector(".tracks");
    while (list.children.length > tracks.length) list.lastChild.remove();
    tracks.forEach((track, i) => {
      const item = list.children[i] ?? list.appendChild(document.createElement("li"));
      if (item.dataset.track !== String(track.id)) {
        item.dataset.track = track.id;
        item.style.setProperty("--swatch", colour(track.id));
      }
      if (item.dataset.state !== track.state) {
        item.dataset.state = track.state;
        item.textContent = track.state === "confirmed" ? track.id : `${track.id} (${track.state})`;
      }
      item.dataset.box = track.box.join(" ");
    });

    const now = performance.now();
    this.#shown.push(now);
    while (now - this.#shown[0] > 2000) this.#shown.shift();
    const span = now - this.#shown[0];
    const set = (name, text) => (card.querySelector(name).textContent = text);
    if (span > 500) set(".fps", `${((this.#shown.length - 1) / (span / 1000)).toFixed(1)} /s`);
    // A file's own time line says nothing about delay.
    const age = Date.now() - Date.parse(report.capture_ts);
    set(".latency", report.clock === "media" ? "-" : `${Math.max(0, Math.round(age))} ms`);
  }
}
