import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ApiError, ask, askText, words } from "../api";
import { bytes, moment, number, span, stateWords } from "../format";
import { cameraHref } from "../route";
import { awake, cameras } from "../state";
import { Table } from "../ui/Table";
import { parse, quantile, rate, sum, type Metrics } from "./metrics";

const LOOK_MS = 2000;

interface Look {
  at: number;
  now: Metrics;
  before: Metrics | null;
  seconds: number;
}

const MODELS: Record<string, string> = { detect: "Finding people", reid: "Telling them apart", link: "Following them" };

const ms = (seconds: number | null): string => (seconds === null ? "-" : `${(seconds * 1000).toFixed(seconds < 0.01 ? 1 : 0)} ms`);
const perSecond = (value: number | null): string => (value === null ? "-" : `${value.toFixed(1)}/s`);

/** How the service and its cameras are doing. */
export function Health() {
  const ready = useSignal<{ ok: boolean; reasons: string[] } | null>(null);
  const look = useSignal<Look | null>(null);
  const error = useSignal("");
  const kept = useSignal<{ tracks: number; events: number; bytes: number } | null>(null);

  useEffect(() => {
    // Counting what is kept takes the database a while.
    const turn = () => {
      if (!awake.value) return;
      ask<{ tracks: number; events: number; bytes: number }>("/v1/history").then(
        (found) => (kept.value = found),
        () => (kept.value = null),
      );
    };
    turn();
    const timer = setInterval(turn, 30_000);
    return () => clearInterval(timer);
  }, []);
  useEffect(() => {
    let past: { at: number; metrics: Metrics }[] = [];
    const turn = async () => {
      if (!awake.value) return;
      try {
        const metrics = parse(await askText("/metrics"));
        const at = performance.now();
        // Over the last half a minute.
        past = [...past, { at, metrics }].slice(-15);
        const first = past[0]!;
        const old = past.length > 1 ? first : null;
        look.value = { at, now: metrics, before: old?.metrics ?? null, seconds: old ? (at - old.at) / 1000 : 0 };
        error.value = "";
      } catch (problem) {
        error.value = words(problem);
      }
      try {
        await ask("/readyz");
        ready.value = { ok: true, reasons: [] };
      } catch (problem) {
        if (problem instanceof ApiError && problem.status === 503) {
          const reasons = await fetch("/readyz").then((r) => r.json() as Promise<{ reasons?: string[] }>, () => ({ reasons: [] }));
          ready.value = { ok: false, reasons: reasons.reasons ?? [] };
        } else ready.value = { ok: false, reasons: [words(problem)] };
      }
    };
    void turn();
    const timer = setInterval(() => void turn(), LOOK_MS);
    return () => clearInterval(timer);
  }, []);

  const all = cameras.value ?? [];
  const up = all.filter((camera) => camera.state === "live").length;
  const now = look.value;
  const [m, b, s]: [Metrics, Metrics | null, number] = now ? [now.now, now.before, now.seconds] : [new Map(), null, 0];
  const memory = sum(m, "process_resident_memory_bytes");
  const cpu = rate(m, b, s, "process_cpu_seconds_total");
  const began = sum(m, "process_start_time_seconds");
  const dropped = sum(m, "gakp_frames_dropped_total");
  const late = quantile(m, b, "gakp_decode_to_publish_seconds", 0.95);
  const provider = m.get("gakp_execution_provider")?.find((sample) => sample.value === 1)?.labels.provider;
  const tiles: [string, string, string][] = [
    ["Cameras live", `${up} of ${all.length}`, up < all.length ? "wait" : "good"],
    ["Pictures tracked", perSecond(rate(m, b, s, "gakp_frames_tracked_total")), ""],
    ["From picture to tracks, 95 % within", ms(late), late !== null && late > 0.5 ? "bad" : ""],
    ["Pictures left out", dropped === null ? "-" : number(dropped), ""],
    ["Memory", memory === null ? "-" : bytes(memory), ""],
    ["Processor", cpu === null || s < 8 ? "-" : `${(cpu * 100).toFixed(0)} %`, ""],
    ["Networks run on", provider?.toUpperCase() ?? "-", ""],
    ["Listeners", number(sum(m, "gakp_hub_subscribers") ?? 0), ""],
    ["Tracks in the history", kept.value ? number(kept.value.tracks) : "none", ""],
    ["Size of the history", kept.value ? bytes(kept.value.bytes) : "-", ""],
    ["Running for", began === null ? "-" : span(Date.now() / 1000 - began), ""],
  ];
  return (
    <>
      <div class="title">
        <h1>Health</h1>
        {ready.value && (
          <span class={`state ${ready.value.ok ? "good" : "bad"}`} role="status">
            {ready.value.ok ? "Everything works" : "Not ready"}
          </span>
        )}
      </div>
      {error.value && (
        <p role="alert" class="bad">
          {error.value}
        </p>
      )}
      {ready.value?.reasons.map((reason) => (
        <p class="banner" key={reason}>
          {reason}
        </p>
      ))}
      <dl class="tiles">
        {tiles.map(([name, value, tone]) => (
          <div class="panel" key={name}>
            <dt>{name}</dt>
            <dd class={tone}>{value}</dd>
          </div>
        ))}
      </dl>
      <section class="panel" aria-labelledby="cameras">
        <h2 id="cameras">Cameras</h2>
        {all.length === 0 && <p class="quiet">No camera yet.</p>}
        {all.length > 0 && (
          <Table heads={["Camera", "State", "Since", "Pictures", "95 % within", "Left out", "Reconnects", "Last trouble"]}>
            {all.map((camera) => {
              const labels = { camera: camera.id };
              return (
                <tr key={camera.id} data-state={camera.state}>
                  <th scope="row">
                    <a href={cameraHref(camera.id)}>{camera.id}</a>
                  </th>
                  <td data-label="State" class="state">
                    {stateWords(camera)}
                  </td>
                  <td data-label="Since">{moment(camera.since)}</td>
                  <td data-label="Pictures">{perSecond(rate(m, b, s, "gakp_frames_tracked_total", labels))}</td>
                  <td data-label="95 % within">{ms(quantile(m, b, "gakp_decode_to_publish_seconds", 0.95, labels))}</td>
                  <td data-label="Left out">{number(Object.values(camera.dropped).reduce((sum, n) => sum + n, 0))}</td>
                  <td data-label="Reconnects">{number(camera.reconnects)}</td>
                  <td data-label="Last trouble">{camera.last_error ?? "none"}</td>
                </tr>
              );
            })}
          </Table>
        )}
      </section>
      <section class="panel" aria-labelledby="models">
        <h2 id="models">Networks</h2>
        <Table heads={["Network", "Runs", "Half within", "95 % within"]}>
          {(m.get("gakp_model_run_seconds_count") ?? []).map(({ labels: { model = "" } }) => (
            <tr key={model}>
              <th scope="row">{MODELS[model] ?? model}</th>
              <td data-label="Runs">{perSecond(rate(m, b, s, "gakp_model_run_seconds_count", { model }))}</td>
              <td data-label="Half within">{ms(quantile(m, b, "gakp_model_run_seconds", 0.5, { model }))}</td>
              <td data-label="95 % within">{ms(quantile(m, b, "gakp_model_run_seconds", 0.95, { model }))}</td>
            </tr>
          ))}
        </Table>
      </section>
    </>
  );
}
