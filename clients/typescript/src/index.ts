/**
 * Tracks and events of a gakp service, as they happen.
 *
 *     const gakp = new Client("http://127.0.0.1:8080", { token: "gakp_..." });
 *     for await (const { message } of gakp.tracks({ camera: ["gate"], state: ["confirmed"] })) {
 *       ...
 *     }
 *
 * Who leaves the loop closes the stream. A service that restarts, or a network that breaks, is waited for; what was missed
 * in between is not sent again, which the `epoch` and `seq` of reports tell. Who reads too slowly is told what it lost by
 * a `gap`; here no more than a few messages wait.
 */
export * from "./client.js";
export type { components, operations, paths } from "./generated/rest.js";
export * from "./generated/tracks_pb.js";
export * from "./refused.js";
