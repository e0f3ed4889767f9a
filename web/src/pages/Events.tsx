import { useSignal } from "@preact/signals";
import { EVENT_TYPES } from "../format";
import { cameras, mayEdit } from "../state";
import { EventList } from "../ui/EventList";
import { Webhooks } from "./Webhooks";

export function Events() {
  const camera = useSignal("");
  const type = useSignal("");
  return (
    <>
      <div class="title">
        <h1>Events</h1>
        <span class="row end">
          <select aria-label="Camera" value={camera.value} onChange={(event) => (camera.value = event.currentTarget.value)}>
            <option value="">All cameras</option>
            {cameras.value?.map(({ id }) => (
              <option key={id} value={id}>
                {id}
              </option>
            ))}
          </select>
          <select aria-label="Kind of event" value={type.value} onChange={(event) => (type.value = event.currentTarget.value)}>
            <option value="">All kinds</option>
            {EVENT_TYPES.map(([value, name]) => (
              <option key={value} value={value}>
                {name}
              </option>
            ))}
          </select>
        </span>
      </div>
      <section class="panel" aria-label="Events">
        <EventList camera={camera.value || undefined} type={type.value || undefined} limit={300} />
      </section>
      {mayEdit.value && <Webhooks />}
    </>
  );
}
