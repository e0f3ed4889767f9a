import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, webhookPath, words, type Webhook, type WebhookTrial } from "../api";
import { EVENT_TYPES, moment, number } from "../format";
import { awake, cameras } from "../state";
import { Deletion } from "../ui/Deletion";
import { Dialog } from "../ui/Dialog";
import { FormEnd } from "../ui/FormEnd";
import { NameField } from "../ui/NameField";
import { Table } from "../ui/Table";

const LOOK_MS = 3000;

/** Who is told what happens, and how that fares. For those who may change it. */
export function Webhooks() {
  const hooks = useSignal<Webhook[] | null>(null);
  const error = useSignal("");
  const adding = useSignal(false);
  const deleting = useSignal<string | null>(null);
  /** What came of trying one, by its name. */
  const trials = useSignal<Record<string, string>>({});
  const look = async () => {
    try {
      hooks.value = (await ask<{ webhooks: Webhook[] }>("/v1/webhooks")).webhooks;
      error.value = "";
    } catch (problem) {
      error.value = words(problem);
    }
  };
  useEffect(() => {
    void look();
    const timer = setInterval(() => void (awake.value && look()), LOOK_MS);
    return () => clearInterval(timer);
  }, []);
  const tell = (name: string, what: string) => (trials.value = { ...trials.value, [name]: what });
  const attempt = async (name: string) => {
    tell(name, "Trying...");
    try {
      const trial = await ask<WebhookTrial>(webhookPath(name, "test"), "POST");
      tell(name, trial.delivered ? `It took a test message in ${trial.took_ms.toFixed(0)} ms.` : `It did not work: ${trial.error}.`);
    } catch (problem) {
      tell(name, words(problem));
    }
    void look();
  };
  return (
    <section class="panel" aria-labelledby="receivers">
      <div class="title">
        <h2 id="receivers">Sent to other systems</h2>
        <button type="button" class="end" onClick={() => (adding.value = true)}>
          Add a receiver
        </button>
      </div>
      {error.value && (
        <p role="alert" class="bad">
          {error.value}
        </p>
      )}
      {hooks.value?.length === 0 && <p class="quiet">Nobody yet. A receiver is a web address to which each event is posted as it happens.</p>}
      {hooks.value && hooks.value.length > 0 && (
        <Table heads={["Receiver", "Address", "Is told", "Delivered", "Waiting", "Lost", "Last trouble", "Try or delete"]}>
          {hooks.value.map((hook) => (
            <tr key={hook.name}>
              <th scope="row">{hook.name}</th>
              <td data-label="Address">
                {hook.url}
                {hook.signed && " (signed)"}
              </td>
              <td data-label="Is told">{wants(hook)}</td>
              <td data-label="Delivered">{number(hook.delivered)}</td>
              <td data-label="Waiting">{number(hook.pending)}</td>
              <td data-label="Lost">{number(hook.failed)}</td>
              <td data-label="Last trouble">
                {hook.last_error ? `${hook.last_error}, ${hook.last_error_time ? moment(hook.last_error_time) : ""}` : "none"}
              </td>
              <td data-label="Try or delete">
                <span class="row">
                  <button type="button" aria-label={`Try ${hook.name}`} onClick={() => void attempt(hook.name)}>
                    Try
                  </button>
                  {hook.source === "api" ? (
                    <button type="button" class="danger" aria-label={`Delete ${hook.name}`} onClick={() => (deleting.value = hook.name)}>
                      Delete
                    </button>
                  ) : (
                    <span class="quiet">of the configuration</span>
                  )}
                </span>
                <span role="status">{trials.value[hook.name]}</span>
              </td>
            </tr>
          ))}
        </Table>
      )}
      {deleting.value !== null && (
        <Deletion
          name={deleting.value}
          what="receiver"
          path={webhookPath(deleting.value)}
          close={() => (deleting.value = null)}
          gone={() => void look()}
        >
          It is told nothing more. What waits for it, and the secret that its messages are signed with, are forgotten.
        </Deletion>
      )}
      {adding.value && (
        <AddWebhook
          close={() => {
            adding.value = false;
            void look();
          }}
        />
      )}
    </section>
  );
}

function wants(hook: Webhook): string {
  const types = hook.types.map((type) => EVENT_TYPES.find(([value]) => value === type)?.[1] ?? type);
  const what = types.length ? types.join(", ") : "everything";
  return hook.cameras.length ? `${what} at ${hook.cameras.join(", ")}` : what;
}

/** `whsec_` and the base64 of 32 random bytes. */
function newSecret(): string {
  return `whsec_${btoa(String.fromCharCode(...crypto.getRandomValues(new Uint8Array(32))))}`;
}

function AddWebhook({ close }: { close: () => void }) {
  const fields = useSignal({ name: "", url: "", camera: "", type: "", signed: true });
  const secret = useSignal("");
  const error = useSignal("");
  const busy = useSignal(false);
  const set = (change: Partial<typeof fields.value>) => (fields.value = { ...fields.value, ...change });
  const save = async () => {
    const { name, url, camera, type, signed } = fields.value;
    const signing = signed ? newSecret() : "";
    busy.value = true;
    error.value = "";
    try {
      const body = { name, url: url.trim(), cameras: camera ? [camera] : [], types: type ? [type] : [], ...(signing && { secret: signing }) };
      await ask("/v1/webhooks", "POST", body);
      if (signing) secret.value = signing;
      else close();
    } catch (problem) {
      error.value = words(problem);
    } finally {
      busy.value = false;
    }
  };
  if (secret.value) {
    return (
      <Dialog title="Receiver added" close={close}>
        <p>Give the receiver this secret, with which it tells that a message is from here. It is not shown again.</p>
        <p>
          <code>{secret.value}</code>
        </p>
        <div class="row">
          <button type="button" class="main" autofocus onClick={close}>
            I have it
          </button>
        </div>
      </Dialog>
    );
  }
  return (
    <Dialog title="Add a receiver" close={close}>
      <form
        onSubmit={(event) => {
          event.preventDefault();
          void save();
        }}
      >
        <NameField value={fields.value.name} set={(name) => set({ name })} first placeholder="alarm" />
        <label>
          Address
          <input
            name="url"
            required
            inputMode="url"
            spellcheck={false}
            autocapitalize="off"
            autocomplete="off"
            placeholder="https://hooks.example/gakp"
            value={fields.value.url}
            onInput={(event) => set({ url: event.currentTarget.value })}
          />
        </label>
        <label>
          Tell it
          <select name="type" value={fields.value.type} onChange={(event) => set({ type: event.currentTarget.value })}>
            <option value="">everything</option>
            {EVENT_TYPES.map(([value, name]) => (
              <option key={value} value={value}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <label>
          At
          <select name="camera" value={fields.value.camera} onChange={(event) => set({ camera: event.currentTarget.value })}>
            <option value="">all cameras</option>
            {cameras.value?.map(({ id }) => (
              <option key={id} value={id}>
                {id}
              </option>
            ))}
          </select>
        </label>
        <label class="check">
          <input
            type="checkbox"
            name="signed"
            checked={fields.value.signed}
            onChange={(event) => set({ signed: event.currentTarget.checked })}
          />
          Sign messages, so that the receiver can tell that they are from here
        </label>
        <FormEnd error={error.value} busy={busy.value} send="Add" cancel={close} />
      </form>
    </Dialog>
  );
}
