// Numbers, times and events in words.

import type { Camera, GakpEvent } from "./api";

const day = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "medium" });
const hour = new Intl.DateTimeFormat(undefined, { timeStyle: "medium" });
const whole = new Intl.NumberFormat();

export const number = (value: number): string => whole.format(value);

/** A moment: the time alone where it is today. */
export function moment(text: string): string {
  const at = new Date(text);
  return at.toDateString() === new Date().toDateString() ? hour.format(at) : day.format(at);
}

/** So many of something, in words. */
export function many(count: number, what: string): string {
  const plural = what === "person" ? "people" : /(s|x|ch)$/.test(what) ? `${what}es` : `${what}s`;
  return `${number(count)} ${count === 1 ? what : plural}`;
}

/** A length of time. */
export function span(seconds: number): string {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

export function bytes(value: number): string {
  if (value < 1e6) return `${(value / 1e3).toFixed(0)} kB`;
  return value < 1e9 ? `${(value / 1e6).toFixed(0)} MB` : `${(value / 1e9).toFixed(1)} GB`;
}

/** What a camera is doing, in words. */
export function stateWords(camera: Camera): string {
  switch (camera.state) {
    case "live":
      return "Live";
    case "connecting":
      return "Connecting";
    case "retrying":
      return camera.next_retry_s === null ? "Trying again" : `Trying again in ${Math.ceil(camera.next_retry_s)} s`;
    case "ended":
      return "The film has ended";
    case "failed":
      return "Not working";
    case "paused":
      return "Paused";
  }
}

/** What to do about a failure. */
export function advice(kind: string | null): string {
  switch (kind) {
    case "refused":
      return "Something is at that address, but nothing listens on the port. Check the port (554 for most cameras), and that RTSP is switched on in the camera.";
    case "unknown_host":
      return "The name in the address is not known on this network. Check the spelling, or use the camera's IP address.";
    case "unreachable":
      return "Nothing answers at that address. Check that the camera is on, and in a network that this machine can reach.";
    case "unauthorized":
      return "The camera wants a user name and a password: rtsp://user:password@address/...";
    case "not_found":
      return "The camera answers, but not for this path. The camera's manual tells the path of its stream.";
    case "busy":
      return "Something else uses it. Close the other program.";
    case "silent":
      return "It was found, but sends nothing. Check the address, and firewalls between here and there.";
    case "disconnected":
      return "It hung up. It may have too many viewers already.";
    case "transport":
      return "Try the other way to send the video (TCP or UDP, under More).";
    case "unsupported":
    case "garbage":
      return "What comes from there is not video that can be shown. Set the camera to H.264 or H.265.";
    default:
      return "";
  }
}

const who = (event: GakpEvent): string => {
  const name = event.class ?? "track";
  return `${name.charAt(0).toUpperCase()}${name.slice(1)} ${event.track ?? ""}`.trim();
};

/** An event in words. */
export function eventWords(event: GakpEvent): string {
  switch (event.type) {
    case "line.crossed":
      return `${who(event)} crossed ${event.line}, ${event.direction}`;
    case "zone.entered":
      return `${who(event)} came into ${event.zone}`;
    case "zone.left":
      return `${who(event)} left ${event.zone} after ${span(event.dwell_s ?? 0)}`;
    case "zone.loitering":
      return `${who(event)} has stayed in ${event.zone} for ${span(event.dwell_s ?? 0)}`;
    case "zone.crowded":
      return `${event.zone} is crowded: ${event.occupancy} inside`;
    case "zone.cleared":
      return `${event.zone} is no longer crowded: ${event.occupancy} inside`;
    default:
      return event.type;
  }
}

export const EVENT_TYPES: [string, string][] = [
  ["line.crossed", "Line crossed"],
  ["zone.entered", "Zone entered"],
  ["zone.left", "Zone left"],
  ["zone.loitering", "Stayed too long"],
  ["zone.crowded", "Crowded"],
  ["zone.cleared", "No longer crowded"],
];
