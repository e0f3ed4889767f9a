import { useSignal } from "@preact/signals";
import { words } from "../api";
import { FormEnd } from "../ui/FormEnd";
import { NameField } from "../ui/NameField";
import { leastPoints, remove, save, type Draft } from "./rules";

/** What is being drawn, beside the picture: what to do next, its name and settings, save or not. */
export function RuleForm(props: {
  camera: string;
  draft: Draft;
  change: (draft: Draft) => void;
  done: () => void;
}) {
  const { camera, draft, change, done } = props;
  const error = useSignal("");
  const busy = useSignal(false);
  const what = draft.kind;

  const attempt = async (action: () => Promise<void>) => {
    busy.value = true;
    error.value = "";
    try {
      await action();
      done();
    } catch (problem) {
      error.value = words(problem);
    } finally {
      busy.value = false;
    }
  };

  if (draft.open) {
    const left = leastPoints(what) - draft.points.length;
    const hint =
      what === "line"
        ? draft.points.length === 0
          ? "Click where the line begins on the picture."
          : "Now click where it ends."
        : left > 0
          ? `Click the corners of the ${what} on the picture. ${left} more at least.`
          : "Click more corners, or the first one again to finish.";
    return (
      <section class="panel rule-form" aria-label={`Draw a ${what}`}>
        <h2>Draw a {what}</h2>
        <p role="status">{hint}</p>
        <p class="quiet">By keyboard: arrow keys move the cross, space puts a point, Enter finishes.</p>
        <div class="row">
          {what !== "line" && (
            <button type="button" class="main" disabled={left > 0} onClick={() => change({ ...draft, open: false })}>
              Finish
            </button>
          )}
          <button type="button" onClick={done}>
            Cancel
          </button>
        </div>
      </section>
    );
  }
  return (
    <form
      class="panel rule-form"
      aria-label={draft.was ? `Change ${what} ${draft.was}` : `New ${what}`}
      onSubmit={(event) => {
        event.preventDefault();
        void attempt(() => save(camera, draft));
      }}
    >
      <h2>{draft.was ? `Change ${draft.was}` : `New ${what}`}</h2>
      <p class="quiet">Drag the points on the picture; pull a small one to add another.</p>
      <NameField value={draft.name} set={(name) => change({ ...draft, name })} />
      {what === "line" ? (
        <button type="button" onClick={() => change({ ...draft, points: draft.points.toReversed() })}>
          Swap in and out
        </button>
      ) : what === "mask" ? (
        <label>
          How it hides
          <select
            name="style"
            value={draft.style}
            onChange={(event) => change({ ...draft, style: event.currentTarget.value as Draft["style"] })}
          >
            <option value="fill">black</option>
            <option value="pixelate">coarse blocks</option>
          </select>
        </label>
      ) : (
        <div class="pair">
          <label>
            Tell who stays longer than, seconds
            <input
              name="loiter"
              type="number"
              min="0.1"
              step="any"
              placeholder="never"
              value={draft.loiter}
              onInput={(event) => change({ ...draft, loiter: event.currentTarget.value })}
            />
          </label>
          <label>
            Crowded with more than
            <input
              name="capacity"
              type="number"
              min="0"
              step="1"
              placeholder="never"
              value={draft.capacity}
              onInput={(event) => change({ ...draft, capacity: event.currentTarget.value })}
            />
          </label>
        </div>
      )}
      {what === "mask" ? (
        <p class="quiet">Nobody sees what is under it, in no picture. People there are tracked and counted all the same.</p>
      ) : (
        <label>
          What has to be {what === "line" ? "across" : "inside"}
          <select
            name="anchor"
            value={draft.anchor}
            onChange={(event) => change({ ...draft, anchor: event.currentTarget.value as Draft["anchor"] })}
          >
            <option value="foot">the feet</option>
            <option value="centre">the middle of the body</option>
          </select>
        </label>
      )}
      {draft.was && what !== "mask" && <p class="quiet">What is changed counts from zero again.</p>}
      <FormEnd error={error.value} busy={busy.value} send="Save" cancel={done}>
        {draft.was && (
          <button
            type="button"
            class="danger end"
            disabled={busy.value}
            onClick={() => void attempt(() => remove(camera, what, draft.was))}
          >
            Delete
          </button>
        )}
      </FormEnd>
    </form>
  );
}
