import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, cameraPath, words, type Camera } from "../api";
import { advice } from "../format";
import { LiveView } from "../live/LiveView";
import { cameraHref, go } from "../route";
import { refresh } from "../state";
import { Dialog } from "../ui/Dialog";
import { FormEnd } from "../ui/FormEnd";
import { CameraFields, type Fields } from "./CameraForm";

const LOOK_MS = 400;

/** Adds a camera, then watches it connect, and says why when it does not. */
export function AddCamera({ close }: { close: () => void }) {
  const fields = useSignal<Fields>({ id: "", url: "", transport: "", looped: true });
  const error = useSignal("");
  const busy = useSignal(false);
  /** The camera that was added and is being tried. */
  const tried = useSignal<Camera | null>(null);

  const add = async () => {
    busy.value = true;
    error.value = "";
    const { id, url, transport, looped } = fields.value;
    try {
      const body = { id: id.trim(), url: url.trim(), loop: looped, ...(transport && { transport }) };
      tried.value = await ask<Camera>("/v1/cameras", "POST", body);
    } catch (problem) {
      error.value = words(problem);
    } finally {
      busy.value = false;
    }
  };
  const remove = async (after: () => void) => {
    busy.value = true;
    try {
      await ask(cameraPath(tried.value!.id), "DELETE");
      after();
    } catch (problem) {
      error.value = words(problem);
    } finally {
      busy.value = false;
      refresh();
    }
  };
  const leave = () => {
    refresh();
    close();
  };

  const id = tried.value?.id;
  useEffect(() => {
    if (id === undefined) return;
    const timer = setInterval(
      () =>
        ask<Camera>(cameraPath(id)).then(
          (camera) => {
            if (tried.value) tried.value = camera;
          },
          (problem) => (error.value = words(problem)),
        ),
      LOOK_MS,
    );
    return () => clearInterval(timer);
  }, [id]);

  const camera = tried.value;
  if (!camera) {
    return (
      <Dialog title="Add a camera" close={close}>
        <form
          onSubmit={(event) => {
            event.preventDefault();
            void add();
          }}
        >
          <CameraFields fields={fields} />
          <FormEnd error={error.value} busy={busy.value} send="Connect" cancel={close} />
        </form>
      </Dialog>
    );
  }
  const works = camera.state === "live" || camera.state === "ended";
  const failed = !works && (camera.state === "failed" || camera.last_error !== null);
  return (
    <Dialog title={`Camera ${camera.id}`} close={leave}>
      <div class="trial" data-result={works ? "works" : failed ? "failed" : "trying"}>
        {works && (
          <>
            <p role="status" class="good">
              It works: {camera.width} × {camera.height} pixels
              {camera.fps ? `, ${Math.round(camera.fps)} pictures a second` : ""}.
            </p>
            <LiveView camera={camera} />
            <div class="row">
              <button
                type="button"
                class="main"
                onClick={() => {
                  leave();
                  go(cameraHref(camera.id));
                }}
              >
                Open it and draw a line
              </button>
              <button type="button" onClick={leave}>
                Done
              </button>
            </div>
          </>
        )}
        {failed && (
          <>
            <p role="alert" class="bad">
              No connection: {camera.last_error}
            </p>
            <p>{advice(camera.last_error_kind)}</p>
            <p class="quiet">{camera.state === "failed" ? "" : "It is tried again and again; once the camera answers, it appears here."}</p>
            <div class="row">
              <button type="button" class="main" disabled={busy.value} onClick={() => void remove(() => (tried.value = null))}>
                Change the address
              </button>
              <button type="button" onClick={leave}>
                Keep it
              </button>
              <button type="button" class="danger" disabled={busy.value} onClick={() => void remove(close)}>
                Remove it
              </button>
            </div>
          </>
        )}
        {!works && !failed && (
          <>
            <p role="status">
              <span class="spinner" aria-hidden="true" />
              Connecting to the camera…
            </p>
            <div class="row">
              <button type="button" onClick={leave}>
                Go on in the background
              </button>
              <button type="button" disabled={busy.value} onClick={() => void remove(() => (tried.value = null))}>
                Stop
              </button>
            </div>
          </>
        )}
        <p role="alert" class="bad">
          {error.value}
        </p>
      </div>
    </Dialog>
  );
}
