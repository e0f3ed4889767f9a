import { useSignal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { ask, words } from "../api";
import { Dialog } from "./Dialog";

/** Asks whether something is to be deleted, says in its children what goes with it, and has it deleted. */
export function Deletion(props: { name: string; what: string; path: string; close: () => void; gone: () => void; children: ComponentChildren }) {
  const { name, what, path, close, gone, children } = props;
  const error = useSignal("");
  const busy = useSignal(false);
  // What is under way cannot be called off: its end is waited for.
  const keep = () => !busy.value && close();
  const remove = async () => {
    busy.value = true;
    try {
      await ask(path, "DELETE");
      close();
      gone();
    } catch (problem) {
      error.value = words(problem);
      busy.value = false;
    }
  };
  return (
    <Dialog title={`Delete ${name}?`} close={keep}>
      <p>{children}</p>
      <p role="alert" class="bad">
        {error.value}
      </p>
      <div class="row">
        <button type="button" class="danger" disabled={busy.value} onClick={() => void remove()}>
          Delete the {what}
        </button>
        <button type="button" autofocus disabled={busy.value} onClick={keep}>
          Keep it
        </button>
      </div>
    </Dialog>
  );
}
