import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, cameraPath, words, type Camera, type Counts } from "../api";
import { Overlay } from "../draw/Overlay";
import { RuleForm } from "../draw/RuleForm";
import { draftOf, fetchRules, newDraft, rulesOf, type Draft, type Kind, type Rules } from "../draw/rules";
import { freeName } from "../draw/geometry";
import { advice, number } from "../format";
import { HeatMap } from "../live/HeatMap";
import { LiveView } from "../live/LiveView";
import type { Shown } from "../live/stage";
import { go } from "../route";
import { awake, cameras, mayEdit, mayHide, refresh } from "../state";
import { Deletion } from "../ui/Deletion";
import { EventList } from "../ui/EventList";
import { State } from "../ui/State";
import { CountChart } from "./CountChart";
import { CountPanel } from "./CountPanel";
import { EditCamera } from "./EditCamera";
import { remember } from "./samples";

const COUNT_MS = 1000;
const NOTHING: Rules = { lines: [], zones: [], masks: [] };

/** One camera: its picture, its lines, zones and masks, what they count, what happens. */
export function CameraPage({ id }: { id: string }) {
  const camera = cameras.value?.find((camera) => camera.id === id);
  if (cameras.value === null) return <p class="quiet">Looking for the camera…</p>;
  if (!camera) {
    return (
      <section class="panel empty">
        <h1>There is no camera {id}</h1>
        <p>
          It may have been deleted. <a href="#/">All cameras</a>
        </p>
      </section>
    );
  }
  return <Open key={id} camera={camera} />;
}

function Open({ camera }: { camera: Camera }) {
  const { id } = camera;
  const shown = useSignal<Shown | null>(null);
  const rules = useSignal<Rules>(NOTHING);
  const counts = useSignal<Counts | null>(null);
  const draft = useSignal<Draft | null>(null);
  const heat = useSignal(false);
  const dialog = useSignal<"edit" | "delete" | null>(null);
  const error = useSignal("");

  const loadRules = () =>
    fetchRules(id).then(
      (found) => (rules.value = found),
      (problem) => (error.value = words(problem)),
    );
  useEffect(() => {
    void loadRules();
    let busy = false;
    const look = () => {
      if (busy || !awake.value) return;
      busy = true;
      ask<Counts>(cameraPath(id, "counts"))
        .then(
          (found) => {
            remember(found);
            counts.value = found;
            // Somebody else may draw at the same time.
            const names = (what: object) => Object.keys(what).sort().join();
            const known = rules.value;
            if (
              names(found.lines) !== known.lines.map((l) => l.id).sort().join() ||
              names(found.zones) !== known.zones.map((z) => z.id).sort().join()
            ) {
              void loadRules();
            }
          },
          () => undefined,
        )
        .finally(() => (busy = false));
    };
    look();
    const timer = setInterval(look, COUNT_MS);
    return () => clearInterval(timer);
  }, [id]);

  const begin = (kind: Kind) => {
    const taken = rulesOf(rules.value, kind).map((rule) => rule.id);
    draft.value = newDraft(kind, freeName(kind, taken));
  };
  const pick = (kind: Kind, name: string) => {
    const rule = rulesOf(rules.value, kind).find((rule) => rule.id === name);
    if (rule) draft.value = draftOf(kind, rule);
  };
  const done = () => {
    draft.value = null;
    void loadRules();
  };
  const pause = async () => {
    error.value = "";
    try {
      await ask(cameraPath(id), "PATCH", { paused: camera.state !== "paused" });
    } catch (problem) {
      error.value = words(problem);
    }
    refresh();
  };

  const now = draft.value;
  const paused = camera.state === "paused";
  return (
    <div class="camera" data-camera={id} data-state={camera.state}>
      <div class="title">
        <a href="#/" class="back">
          All cameras
        </a>
        <h1>{id}</h1>
        <State camera={camera} />
        {mayEdit.value && (
          <div class="row end">
            <button type="button" onClick={() => void pause()}>
              {paused ? "Resume" : "Pause"}
            </button>
            <button type="button" onClick={() => (dialog.value = "edit")}>
              Edit
            </button>
            <button type="button" class="danger" onClick={() => (dialog.value = "delete")}>
              Delete
            </button>
          </div>
        )}
      </div>
      {error.value && (
        <p role="alert" class="bad">
          {error.value}
        </p>
      )}
      {camera.last_error && !paused && camera.state !== "live" && (
        <p role="status" class="banner">
          <strong>{camera.last_error}</strong> {advice(camera.last_error_kind)}
        </p>
      )}
      <div class="stage">
        <div>
          <LiveView camera={camera} shown={(what) => (shown.value = what)}>
            {heat.value && <HeatMap camera={id} />}
            <Overlay
              rules={rules.value}
              draft={now}
              change={(to) => (draft.value = to)}
              finish={() => (draft.value = now && { ...now, open: false })}
              cancel={done}
              pick={mayEdit.value ? pick : undefined}
              pickMask={mayHide.value ? pick : undefined}
            />
          </LiveView>
          <div class="row tools">
            {mayEdit.value && (
              <>
                <button type="button" class="main" disabled={now !== null} onClick={() => begin("line")}>
                  Draw a line
                </button>
                <button type="button" class="main" disabled={now !== null} onClick={() => begin("zone")}>
                  Draw a zone
                </button>
              </>
            )}
            {mayHide.value && (
              <>
                <button type="button" disabled={now !== null} onClick={() => begin("mask")}>
                  Hide a part
                </button>
                {rules.value.masks.map(({ id }) => (
                  <button key={id} type="button" disabled={now !== null} aria-label={`Change mask ${id}`} onClick={() => pick("mask", id)}>
                    {id}
                  </button>
                ))}
              </>
            )}
            <button type="button" aria-pressed={heat.value} onClick={() => (heat.value = !heat.value)}>
              Heat map
            </button>
            <Figures camera={camera} shown={shown.value} />
          </div>
        </div>
        {now ? (
          <RuleForm camera={id} draft={now} change={(to) => (draft.value = to)} done={done} />
        ) : (
          <CountPanel counts={counts.value} shown={shown.value} pick={mayEdit.value ? pick : undefined} />
        )}
      </div>
      <div class="columns">
        <CountChart camera={id} rules={rules.value} />
        <section class="panel" aria-labelledby="events">
          <h2 id="events">Events</h2>
          <EventList camera={id} limit={50} />
        </section>
      </div>
      {dialog.value === "edit" && <EditCamera camera={camera} close={() => (dialog.value = null)} />}
      {dialog.value === "delete" && (
        <Deletion
          name={camera.id}
          what="camera"
          path={cameraPath(camera.id)}
          close={() => (dialog.value = null)}
          gone={() => {
            refresh();
            go("#/");
          }}
        >
          The camera, its lines and zones and their counts are forgotten.
        </Deletion>
      )}
    </div>
  );
}

/** The picture's figures, small. */
function Figures({ camera, shown }: { camera: Camera; shown: Shown | null }) {
  const dropped = Object.values(camera.dropped).reduce((sum, n) => sum + n, 0);
  const facts: [string, string][] = [
    ["Shown", shown?.rate ? `${shown.rate.toFixed(0)}/s` : "-"],
    ["Camera", camera.fps === null ? "-" : `${camera.fps.toFixed(0)}/s`],
    ["Delay", shown?.delay === null || !shown ? "-" : `${shown.delay} ms`],
    ["Size", camera.width ? `${camera.width} × ${camera.height}` : "-"],
    ["Dropped", number(dropped)],
  ];
  return (
    <dl class="figures end">
      {facts.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}
