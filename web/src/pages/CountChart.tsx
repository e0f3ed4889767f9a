import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ApiError, ask, query, words, type Bucket } from "../api";
import type { Rules } from "../draw/rules";
import { moment } from "../format";
import { awake } from "../state";
import { Chart } from "../ui/Chart";
import { sampled } from "./samples";

/** Seconds that are shown, and those of a bar. */
const SPANS: [string, number, number][] = [
  ["Last hour", 3600, 120],
  ["Last day", 86_400, 3600],
  ["Last week", 604_800, 6 * 3600],
];

interface Data {
  times: number[];
  first: number[];
  second: number[];
  from: number;
  to: number;
}

/** Fills the buckets in which nothing happened. */
function fill(buckets: Bucket[], from: number, to: number, step: number): Data {
  const data: Data = { times: [], first: [], second: [], from, to };
  const known = new Map(buckets.map((b) => [Math.floor(Date.parse(b.start) / 1000 / step), b]));
  for (let n = Math.floor(from / step); n * step < to; n += 1) {
    const bucket = known.get(n);
    data.times.push(n * step + step / 2);
    data.first.push(bucket?.in ?? bucket?.entries ?? 0);
    data.second.push(bucket?.out ?? bucket?.exits ?? 0);
  }
  return data;
}

/** One line or zone over time: from the history, or as seen since the page was opened. */
export function CountChart({ camera, rules }: { camera: string; rules: Rules }) {
  const all = [...rules.lines.map((l) => `line:${l.id}`), ...rules.zones.map((z) => `zone:${z.id}`)];
  const chosen = useSignal("");
  const length = useSignal(0);
  const data = useSignal<Data | null>(null);
  const note = useSignal("");
  const what = all.includes(chosen.value) ? chosen.value : (all[0] ?? "");
  const [, seconds, step] = SPANS[length.value]!;

  useEffect(() => {
    if (!what) return;
    const [kind, ...rest] = what.split(":");
    const name = rest.join(":");
    let history = true;
    let gone = false;
    const look = async () => {
      if (!awake.value) return;
      const to = Date.now() / 1000;
      if (history) {
        try {
          const from = Math.floor((to - seconds) / step) * step;
          const times = { from: new Date(from * 1000).toISOString(), bucket_s: step };
          const found = await ask<{ buckets: Bucket[] }>(`/v1/history/counts${query({ camera, [kind!]: name, ...times })}`);
          if (gone) return;
          note.value = "";
          data.value = fill(found.buckets, from, to, step);
          return;
        } catch (problem) {
          if (gone) return;
          history = !(problem instanceof ApiError && ["no-history", "not-found"].includes(problem.kind));
          if (history) {
            note.value = words(problem);
            return;
          }
        }
      }
      const { since, step: own, buckets } = sampled(camera, kind as "line" | "zone", name);
      const from = Math.min(since, to - 120);
      note.value = `The service keeps no history: counts since ${moment(new Date(since * 1000).toISOString())}, when this page was opened.`;
      data.value = fill(buckets, from, to, own);
    };
    void look();
    const timer = setInterval(() => void look(), 5000);
    return () => {
      gone = true;
      clearInterval(timer);
    };
  }, [camera, what, length.value]);

  const line = what.startsWith("line:");
  return (
    <section class="panel" aria-labelledby="over-time">
      <div class="row">
        <h2 id="over-time">Over time</h2>
        {all.length > 0 && (
          <span class="row end">
            <select aria-label="Line or zone" value={what} onChange={(event) => (chosen.value = event.currentTarget.value)}>
              {all.map((value) => (
                <option key={value} value={value}>
                  {value.slice(5)}
                </option>
              ))}
            </select>
            <select aria-label="Time" value={length.value} onChange={(event) => (length.value = Number(event.currentTarget.value))}>
              {SPANS.map(([name], i) => (
                <option key={name} value={i}>
                  {name}
                </option>
              ))}
            </select>
          </span>
        )}
      </div>
      {!what && <p class="quiet">A line or zone shows here how busy it was.</p>}
      {what && data.value && (
        <Chart
          label={`${what.slice(5)} over time`}
          times={data.value.times}
          from={data.value.from}
          to={data.value.to}
          series={[
            { label: line ? "In" : "Came", colour: "--in", values: data.value.first },
            { label: line ? "Out" : "Left", colour: "--out", values: data.value.second },
          ]}
        />
      )}
      {what && note.value && <p class="quiet">{note.value}</p>}
    </section>
  );
}
