import { useSignal } from "@preact/signals";
import { ask, cameraPath, words, type Camera } from "../api";
import { refresh } from "../state";
import { Dialog } from "../ui/Dialog";
import { FormEnd } from "../ui/FormEnd";
import { CameraFields, type Fields } from "./CameraForm";

/** Changes where a camera is. The password of its address is not shown, so an empty field leaves it as it is. */
export function EditCamera({ camera, close }: { camera: Camera; close: () => void }) {
  const fields = useSignal<Fields>({ id: camera.id, url: "", transport: "", looped: true });
  const error = useSignal("");
  const busy = useSignal(false);
  const touched = useSignal(false);
  const save = async () => {
    busy.value = true;
    error.value = "";
    const { url, transport, looped } = fields.value;
    const body = { ...(url.trim() && { url: url.trim() }), ...(transport && { transport }), ...(touched.value && { loop: looped }) };
    try {
      if (Object.keys(body).length) await ask(cameraPath(camera.id), "PATCH", body);
      refresh();
      close();
    } catch (problem) {
      error.value = words(problem);
    } finally {
      busy.value = false;
    }
  };
  return (
    <Dialog title={`Edit ${camera.id}`} close={close}>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void save();
        }}
        onChange={(event) => {
          if ((event.target as HTMLInputElement).name === "loop") touched.value = true;
        }}
      >
        <CameraFields fields={fields} current={camera.url} />
        <p class="quiet">The connection is made anew. Lines, zones, masks and counts stay; people in view get new numbers.</p>
        <FormEnd error={error.value} busy={busy.value} send="Save" cancel={close} />
      </form>
    </Dialog>
  );
}
