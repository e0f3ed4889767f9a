import type { Signal } from "@preact/signals";
import { NameField } from "../ui/NameField";

/** What the form for a camera holds. */
export interface Fields {
  id: string;
  url: string;
  transport: "" | "tcp" | "udp";
  looped: boolean;
}

/** The fields of a camera; its name is asked for only where it is new. */
export function CameraFields(props: { fields: Signal<Fields>; current?: string }) {
  const { fields, current } = props;
  const set = (change: Partial<Fields>) => (fields.value = { ...fields.value, ...change });
  return (
    <>
      {current === undefined && <NameField name="id" value={fields.value.id} set={(id) => set({ id })} first placeholder="gate" />}
      <label>
        {current === undefined ? "Address" : "New address (empty: stays as it is)"}
        <input
          name="url"
          required={current === undefined}
          inputMode="url"
          spellcheck={false}
          autocapitalize="off"
          autocomplete="off"
          placeholder={current ?? "rtsp://user:password@192.168.1.20/stream1"}
          value={fields.value.url}
          onInput={(event) => set({ url: event.currentTarget.value })}
        />
      </label>
      {current === undefined && (
        <p class="quiet">
          The address of the camera's video, as its manual tells it. A video file works as well: <code>/home/me/film.mp4</code>
        </p>
      )}
      <details>
        <summary>More</summary>
        <label>
          Send the video over
          <select
            name="transport"
            value={fields.value.transport}
            onChange={(event) => set({ transport: event.currentTarget.value as Fields["transport"] })}
          >
            <option value="">{current === undefined ? "whatever works" : "as it is"}</option>
            <option value="tcp">TCP: loses nothing</option>
            <option value="udp">UDP: a little faster</option>
          </select>
        </label>
        <label class="check">
          <input
            type="checkbox"
            name="loop"
            checked={fields.value.looped}
            onChange={(event) => set({ looped: event.currentTarget.checked })}
          />
          A video file begins again at its end
        </label>
      </details>
    </>
  );
}
