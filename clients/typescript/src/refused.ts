import type { components } from "./generated/rest.js";

/** What every refusal of the service comes with (RFC 9457). */
export type Problem = components["schemas"]["Problem"];

/** The service refuses: a wrong token, an unknown camera. Trying again would not help. */
export class Refused extends Error {
  override name = "Refused";

  /**
   * `message` is the problem's `detail`. `type` and `title` are the problem's as well, or `about:blank` and the status
   * if the answer was none of the service's own.
   */
  constructor(
    detail: string,
    readonly status: number,
    readonly type: string,
    readonly title: string,
  ) {
    super(detail);
  }

  get detail(): string {
    return this.message;
  }

  /** Of an answer's status and body; the body is text or parsed already. */
  static of(status: number, body: unknown): Refused {
    const problem = typeof body === "string" ? parsed(body) : body;
    const { type, title, detail } = (problem ?? {}) as Partial<Record<keyof Problem, unknown>>;
    const text = (value: unknown, otherwise: string) => (typeof value === "string" ? value : otherwise);
    const said = `HTTP ${status}`;
    return new Refused(text(detail, said), status, text(type, "about:blank"), text(title, said));
  }
}

function parsed(text: string): unknown {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
