import { useComputed, useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ask, query, words, type GakpEvent } from "../api";
import { eventWords, moment } from "../format";
import { cameraHref } from "../route";
import { stream, type Link } from "../socket";
import { awake } from "../state";

/** What happens at lines and in zones, the newest first, as it happens. */
export function EventList(props: { camera?: string; type?: string; limit: number }) {
  const { camera, type, limit } = props;
  const events = useSignal<GakpEvent[]>([]);
  const link = useSignal<Link>("connecting");
  const error = useSignal("");
  const seen = useComputed(() => events.value.length);

  useEffect(() => {
    events.value = [];
    let stop: (() => void) | null = null;
    let gone = false;
    const take = (found: GakpEvent[]) => {
      // An answer to what is no longer asked.
      if (gone) return;
      const known = new Set(events.value.map((event) => event.id));
      const fresh = found.filter((event) => !known.has(event.id));
      if (fresh.length) events.value = [...fresh, ...events.value].slice(0, limit);
    };
    const load = () =>
      ask<{ events: GakpEvent[] }>(`/v1/events${query({ camera, type, limit })}`).then(
        (found) => {
          error.value = "";
          take(found.events);
        },
        (problem) => (error.value = words(problem)),
      );
    const decide = () => {
      if (!awake.value) {
        stop?.();
        stop = null;
      } else if (!stop) {
        stop = stream(`/v1/events/live${query({ camera, type })}`, {
          // What happened before, and while nobody was listening.
          link: (now) => {
            link.value = now;
            if (now === "open") void load();
          },
          message: (data) => {
            const event = JSON.parse(data as string) as GakpEvent;
            if (event.id) take([event]);
          },
        });
      }
    };
    const unsubscribe = awake.subscribe(decide);
    return () => {
      gone = true;
      unsubscribe();
      stop?.();
    };
  }, [camera, type, limit]);

  return (
    <>
      {link.value === "lost" && (
        <p class="bad" role="status">
          Connection lost. Connecting again…
        </p>
      )}
      {error.value && (
        <p class="bad" role="alert">
          {error.value}
        </p>
      )}
      {seen.value === 0 && !error.value && (
        <p class="quiet">Nothing yet. Events come when somebody crosses a line or comes into a zone.</p>
      )}
      <ol class="events" aria-label="Events, the newest first" tabindex={0}>
        {events.value.map((event) => (
          <li key={event.id} data-type={event.type} data-direction={event.direction}>
            {/* A film's own clock begins in 1970 and says nothing. */}
            <time dateTime={event.time}>{event.clock === "media" ? "film" : moment(event.time)}</time>
            {!camera && <a href={cameraHref(event.camera)}>{event.camera}</a>}
            <span>{eventWords(event)}</span>
          </li>
        ))}
      </ol>
    </>
  );
}
