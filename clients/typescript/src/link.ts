import type { IncomingMessage } from "node:http";
import { WebSocket } from "ws";
import { Refused } from "./refused.js";

/** Messages that are kept for who does not take them yet; then nothing more is read, and the service keeps its own account. */
const MOST_WAITING = 16;
const HANDSHAKE_MS = 10_000;
/** From the service's goodbye to the end of its connection. */
const CLOSE_MS = 2_000;
/** The service pings every 10 seconds. */
const DEAD_AFTER_MS = 30_000;
/** Of a refusal. */
const MOST_BODY = 65_536;

/** One WebSocket connection whose messages are taken one by one. */
export class Link {
  /** Why there is no connection, or no longer one. */
  why: Error = new Error("the connection was closed");
  /** Whether there ever was one. */
  opened = false;

  readonly #socket: WebSocket;
  readonly #waiting: (string | Uint8Array)[] = [];
  #closed = false;
  #failed = false;
  #wake: () => void = () => {};
  #dead: NodeJS.Timeout | undefined;

  constructor(address: URL, protocols: string[], headers: Record<string, string>) {
    // Not compressed: the service offers it to nobody.
    const options = { headers, handshakeTimeout: HANDSHAKE_MS, closeTimeout: CLOSE_MS, perMessageDeflate: false };
    this.#socket = new WebSocket(address, protocols, options);
    this.#socket.on("open", () => {
      this.opened = true;
      this.#alive();
    });
    this.#socket.on("ping", () => this.#alive());
    this.#socket.on("message", (data, binary) => {
      this.#alive();
      this.#waiting.push(binary ? (data as Buffer) : data.toString());
      if (this.#waiting.length >= MOST_WAITING) this.#socket.pause();
      this.#wake();
    });
    this.#socket.on("unexpected-response", (_, response) => void this.#refused(response));
    this.#socket.on("error", (error) => this.#fail(error));
    this.#socket.on("close", (code, reason) => {
      this.#fail(new Error(`the connection was closed: ${[code, reason.toString()].join(" ").trim()}`));
      this.#closed = true;
      clearTimeout(this.#dead);
      this.#wake();
    });
  }

  /** The next message; `undefined` when the connection is gone and all its messages were taken, or by the signal. */
  async next(signal: AbortSignal | undefined): Promise<string | Uint8Array | undefined> {
    while (!signal?.aborted) {
      const message = this.#waiting.shift();
      if (message !== undefined) return message;
      if (this.#closed) return undefined;
      if (this.#socket.isPaused) {
        this.#socket.resume();
        this.#alive();
      }
      await new Promise<void>((done) => {
        this.#wake = () => {
          signal?.removeEventListener("abort", this.#wake);
          done();
        };
        signal?.addEventListener("abort", this.#wake, { once: true });
      });
    }
    return undefined;
  }

  /** At once: nothing of the client's own is under way. */
  close(): void {
    clearTimeout(this.#dead);
    this.#waiting.length = 0;
    this.#socket.terminate();
  }

  /** While nothing is read nothing can be heard of the service; it may be there all the same. */
  #alive(): void {
    clearTimeout(this.#dead);
    this.#dead = setTimeout(() => {
      if (this.#socket.isPaused) return;
      this.#fail(new Error(`nothing was heard of the service for ${DEAD_AFTER_MS / 1000} s`));
      this.#socket.terminate();
    }, DEAD_AFTER_MS);
  }

  /** What comes first tells why; the rest follows from it. */
  #fail(why: Error): void {
    if (!this.#failed) this.why = why;
    this.#failed = true;
  }

  async #refused(response: IncomingMessage): Promise<void> {
    const status = response.statusCode ?? 0;
    let body = "";
    try {
      for await (const part of response.setEncoding("utf8")) {
        body += part;
        if (body.length > MOST_BODY) break;
      }
    } catch {
      // The status tells enough.
    }
    const refused = Refused.of(status, body);
    this.#fail(status < 500 ? refused : new Error(`the service answered ${status}: ${refused.detail}`));
    this.#socket.terminate();
  }
}
