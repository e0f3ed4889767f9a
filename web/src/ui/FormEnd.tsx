import type { ComponentChildren } from "preact";

/** The end of a form: what went wrong, the button that sends it, the one that does not; more buttons after them. */
export function FormEnd(props: { error: string; busy: boolean; send: string; cancel: () => void; children?: ComponentChildren }) {
  return (
    <>
      <p role="alert" class="bad">
        {props.error}
      </p>
      <div class="row">
        <button type="submit" class="main" disabled={props.busy}>
          {props.send}
        </button>
        <button type="button" onClick={props.cancel}>
          Cancel
        </button>
        {props.children}
      </div>
    </>
  );
}
