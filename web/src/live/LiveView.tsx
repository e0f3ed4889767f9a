import { useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef } from "preact/hooks";
import { awake, maySee } from "../state";
import type { Camera } from "../api";
import { many } from "../format";
import type { Link } from "../socket";
import { Stage, type Shown } from "./stage";

/** People and things in view, by what they are. */
export function counted(shown: Shown | null): [string, number][] {
  const found = new Map<string, number>();
  for (const track of shown?.report.tracks ?? []) {
    if (track.state === "confirmed") found.set(track.class, (found.get(track.class) ?? 0) + 1);
  }
  return [...found].sort();
}

/** A camera's live picture with its boxes; children lie over it. Streams only while it is on the screen. */
export function LiveView(props: { camera: Camera; shown?: (shown: Shown) => void; children?: ComponentChildren }) {
  const { camera } = props;
  const frame = useRef<HTMLDivElement>(null);
  const picture = useRef<HTMLCanvasElement>(null);
  const boxes = useRef<HTMLCanvasElement>(null);
  const link = useSignal<Link>("connecting");
  const shown = useSignal<Shown | null>(null);
  const stale = useSignal(false);
  const paused = camera.state === "paused";
  const pictured = maySee.value;
  const tell = useRef(props.shown);
  tell.current = props.shown;

  useEffect(() => {
    if (paused) return;
    let at = performance.now();
    const stage = new Stage(camera.id, pictured, frame.current!, picture.current!, boxes.current!, {
      link: (now) => {
        at = performance.now();
        link.value = now;
      },
      shown: (now) => {
        at = performance.now();
        stale.value = false;
        shown.value = now;
        tell.current?.(now);
      },
    });
    let visible = false;
    const decide = () => stage.want(visible && awake.value);
    const watcher = new IntersectionObserver((entries) => {
      visible = entries.some((entry) => entry.isIntersecting);
      decide();
    });
    watcher.observe(frame.current!);
    const unsubscribe = awake.subscribe(decide);
    const timer = setInterval(() => (stale.value = performance.now() - at > 5000), 1000);
    return () => {
      clearInterval(timer);
      unsubscribe();
      watcher.disconnect();
      stage.close();
    };
  }, [camera.id, paused, pictured]);

  const count = counted(shown.value);
  const seen = count.length ? count.map(([name, n]) => many(n, name)).join(", ") : "nobody";
  const width = shown.value?.report.width ?? camera.width ?? 16;
  const height = shown.value?.report.height ?? camera.height ?? 9;
  return (
    <div
      class="screen"
      ref={frame}
      style={{ aspectRatio: `${width} / ${height}`, "--ratio": width / height }}
      data-link={link.value}
      data-confirmed={shown.value?.report.tracks.filter((t) => t.state === "confirmed").length ?? 0}
      data-plain={pictured ? undefined : ""}
    >
      <canvas class="picture" ref={picture} width={16} height={9} aria-hidden="true" />
      <canvas
        class="boxes"
        ref={boxes}
        role="img"
        aria-label={`Camera ${camera.id}, live. In view: ${seen}.`}
      />
      {props.children}
      <Note camera={camera} link={link.value} shown={shown.value} stale={stale.value} />
    </div>
  );
}

function Note(props: { camera: Camera; link: Link; shown: Shown | null; stale: boolean }) {
  const { camera, link, shown, stale } = props;
  let text = "";
  let busy = false;
  if (camera.state === "paused") text = "Paused";
  else if (link === "lost") text = "Connection lost. Connecting again…";
  else if (camera.state === "retrying" || camera.state === "failed") text = "No picture from the camera";
  else if (camera.state === "connecting") [text, busy] = ["Connecting to the camera…", true];
  else if (!shown) [text, busy] = ["Waiting for the first picture…", true];
  else if (stale && camera.state === "live") text = "No new picture for some seconds";
  if (!text) return null;
  return (
    <p class={`note${link === "lost" ? " lost" : ""}`} role="status">
      {busy && <span class="spinner" aria-hidden="true" />}
      {text}
    </p>
  );
}
