import { setTimeout as sleep } from "node:timers/promises";
import { fromBinary } from "@bufbuild/protobuf";
import createClient, { type Client as RestClient } from "openapi-fetch";
import type { components, operations, paths } from "./generated/rest.js";
import { type TrackMessage, TrackMessageSchema } from "./generated/tracks_pb.js";
import { Link } from "./link.js";
import { Refused } from "./refused.js";

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 10_000;

type Schemas = components["schemas"];

/** A report or a gap as JSON. */
export type JsonTrackMessage = Schemas["TrackMessage"];
/** An event, or a gap: how many were missed. */
export type EventMessage = Schemas["EventMessage"];

/** The filters of `/v1/tracks`; what is not there lets everything through. */
export type TrackFilter = NonNullable<operations["tracks"]["parameters"]["query"]>;
/** The filters of `/v1/events/live`; what is not there lets everything through. */
export type EventFilter = NonNullable<operations["liveEvents"]["parameters"]["query"]>;

export interface ClientOptions {
  /** The bearer token, where the service wants one. */
  token?: string | undefined;
  /** `false`: a stream ends with its connection. */
  reconnect?: boolean;
  /** Told why there is no connection each time that one breaks or cannot be made. */
  interrupted?: (why: Error) => void;
}

export interface StreamOptions {
  /** Ends the stream, also while it waits. */
  signal?: AbortSignal;
}

/** A service at `url` (`http://` or `https://`). */
export class Client {
  /** Everything else that the service does, typed by its own description: see openapi-fetch, and {@link answer}. */
  readonly rest: RestClient<paths>;

  readonly #base: URL;
  readonly #headers: Record<string, string>;
  readonly #options: ClientOptions;

  constructor(url: string | URL, options: ClientOptions = {}) {
    this.#base = new URL(url);
    if (!["http:", "https:"].includes(this.#base.protocol)) throw new TypeError(`${url} is no http:// or https:// address`);
    this.#headers = options.token ? { Authorization: `Bearer ${options.token}` } : {};
    this.#options = options;
    const baseUrl = this.#base.origin + this.#base.pathname;
    this.rest = createClient<paths>({ baseUrl, headers: this.#headers });
  }

  /** Reports (`message.case` is `frame`) and what was lost (`gap`). */
  async *tracks(filter: TrackFilter = {}, options: StreamOptions = {}): AsyncGenerator<TrackMessage, void, undefined> {
    for await (const data of this.#messages("/v1/tracks", filter, "gakp.v1.protobuf", options.signal)) {
      if (typeof data === "string") throw new TypeError("the service sent text where protobuf was agreed on");
      yield fromBinary(TrackMessageSchema, data);
    }
  }

  /** The same as JSON, about three times the bytes: a report, or a gap where there is `gap`. */
  async *tracksAsJson(
    filter: TrackFilter = {},
    options: StreamOptions = {},
  ): AsyncGenerator<JsonTrackMessage, void, undefined> {
    for await (const data of this.#messages("/v1/tracks", filter, "gakp.v1.json", options.signal)) {
      yield JSON.parse(data.toString()) as JsonTrackMessage;
    }
  }

  /** What happens at lines and in zones, and how much of that was missed (`gap`). */
  async *events(filter: EventFilter = {}, options: StreamOptions = {}): AsyncGenerator<EventMessage, void, undefined> {
    for await (const data of this.#messages("/v1/events/live", filter, null, options.signal)) {
      yield JSON.parse(data.toString()) as EventMessage;
    }
  }

  async *#messages(
    path: string,
    filter: TrackFilter | EventFilter,
    protocol: string | null,
    signal: AbortSignal | undefined,
  ): AsyncGenerator<string | Uint8Array, void, undefined> {
    const address = new URL(this.#base);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    address.pathname = address.pathname.replace(/\/$/, "") + path;
    address.hash = "";
    address.search = query(filter).toString();
    let wait = FIRST_WAIT_MS;
    while (!signal?.aborted) {
      const link = new Link(address, protocol ? [protocol] : [], this.#headers);
      try {
        for (let data; (data = await link.next(signal)) !== undefined; ) yield data;
      } finally {
        link.close();
      }
      if (signal?.aborted) return;
      if (link.why instanceof Refused) throw link.why;
      this.#options.interrupted?.(link.why);
      if (this.#options.reconnect === false) return;
      if (link.opened) wait = FIRST_WAIT_MS;
      // Not all at the same moment, when a service with many clients comes back.
      await sleep(wait * (0.75 + Math.random() / 2), undefined, signal && { signal }).catch(() => {});
      wait = Math.min(wait * 2, LONGEST_WAIT_MS);
    }
  }
}

/**
 * What the service answers to a request of {@link Client.rest}; throws {@link Refused} if it is an error.
 *
 *     const { cameras } = await answer(gakp.rest.GET("/v1/cameras"));
 */
export async function answer<T>(
  request: Promise<{ data?: T; error?: unknown; response: Response }>,
): Promise<T> {
  const { data, error, response } = await request;
  if (!response.ok) throw Refused.of(response.status, error);
  return data as T;
}

function query(filter: TrackFilter | EventFilter): URLSearchParams {
  const search = new URLSearchParams();
  for (const [name, value] of Object.entries(filter)) {
    for (const one of Array.isArray(value) ? value : [value]) {
      if (one !== undefined) search.append(name, String(one));
    }
  }
  return search;
}
