import { useSignal } from "@preact/signals";
import type { Camera } from "../api";
import { many, number } from "../format";
import { counted, LiveView } from "../live/LiveView";
import type { Shown } from "../live/stage";
import { cameraHref } from "../route";
import { cameras, mayEdit, maySee } from "../state";
import { State } from "../ui/State";
import { AddCamera } from "./AddCamera";

/** All cameras at once; the way to the first one where there is none. */
export function Cameras() {
  const adding = useSignal(false);
  const all = cameras.value;
  const live = all?.filter((camera) => camera.state === "live").length ?? 0;
  return (
    <>
      <div class="title">
        <h1>Cameras</h1>
        {all && all.length > 0 && (
          <p class="quiet">
            {number(live)} of {number(all.length)} live
          </p>
        )}
        {mayEdit.value && all && all.length > 0 && (
          <button type="button" class="main end" onClick={() => (adding.value = true)}>
            Add a camera
          </button>
        )}
      </div>
      {!maySee.value && (
        <p class="quiet">Your token may not see pictures, so you see where people are on a plain ground.</p>
      )}
      {all === null && <p class="quiet">Looking for the cameras…</p>}
      {all?.length === 0 && (
        <section class="panel empty">
          <h2>No camera yet</h2>
          {mayEdit.value ? (
            <>
              <p>Add your first camera to see who walks where. All it takes is a name and the camera's address, such as</p>
              <p>
                <code>rtsp://user:password@192.168.1.20/stream1</code>
              </p>
              <p class="quiet">The address is in the camera's manual or its settings, mostly under RTSP or ONVIF.</p>
              <button type="button" class="main" onClick={() => (adding.value = true)}>
                Add the first camera
              </button>
            </>
          ) : (
            <p>Somebody with an operator's token can add one.</p>
          )}
        </section>
      )}
      <ul class="grid" aria-label="Cameras">
        {all?.map((camera) => (
          <Card key={camera.id} camera={camera} />
        ))}
      </ul>
      {adding.value && <AddCamera close={() => (adding.value = false)} />}
    </>
  );
}

function Card({ camera }: { camera: Camera }) {
  const shown = useSignal<Shown | null>(null);
  const seen = camera.state === "live" || camera.state === "ended" ? counted(shown.value) : [];
  return (
    <li class="card" data-camera={camera.id} data-state={camera.state}>
      <LiveView camera={camera} shown={(now) => (shown.value = now)} />
      <div class="head">
        <a href={cameraHref(camera.id)}>{camera.id}</a>
        <span class="chips">
          {seen.map(([name, n]) => (
            <span class="chip" key={name}>
              {many(n, name)}
            </span>
          ))}
        </span>
        <State camera={camera} />
      </div>
      {camera.last_error && camera.state !== "live" && camera.state !== "paused" && <p class="error">{camera.last_error}</p>}
    </li>
  );
}
