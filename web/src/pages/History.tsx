import { useSignal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { ApiError, ask, query, words, type GakpEvent, type PastTrack } from "../api";
import { fetchRules, type Rules } from "../draw/rules";
import { EVENT_TYPES, eventWords, moment, span } from "../format";
import { cameraHref } from "../route";
import { cameras, maySee } from "../state";
import { Table } from "../ui/Table";
import { PathDrawing } from "./PathDrawing";

interface Search {
  what: "tracks" | "events";
  camera: string;
  from: string;
  to: string;
  rule: string;
  type: string;
  least: string;
}

const EMPTY: Search = { what: "tracks", camera: "", from: "", to: "", rule: "", type: "", least: "" };
const PAGE = 50;

/** A form's local time as the API wants it. */
const instant = (local: string): string => (local ? new Date(local).toISOString() : "");

function parameters(search: Search): Record<string, string | undefined> {
  const [kind, ...rest] = search.rule.split(":");
  return {
    camera: search.camera,
    from: instant(search.from),
    to: instant(search.to),
    ...(kind ? { [kind]: rest.join(":") } : {}),
    ...(search.what === "events" ? { type: search.type } : { min_s: search.least }),
  };
}

/** Who was seen and what happened: by time, camera, line and zone. */
export function History() {
  const form = useSignal<Search>(EMPTY);
  /** What the results below were asked with. */
  const asked = useSignal<Search>(EMPTY);
  const rules = useSignal<Rules | null>(null);
  const tracks = useSignal<PastTrack[]>([]);
  const events = useSignal<GakpEvent[]>([]);
  const next = useSignal<string | undefined>(undefined);
  const problem = useSignal("");
  const missing = useSignal(false);
  const busy = useSignal(false);
  const searched = useSignal(false);
  const set = (change: Partial<Search>) => (form.value = { ...form.value, ...change });

  const search = async (cursor?: string) => {
    const what = cursor ? asked.value : form.value;
    asked.value = what;
    busy.value = true;
    try {
      const where = `/v1/history/${what.what}${query({ ...parameters(what), limit: PAGE, cursor })}`;
      const found = await ask<{ tracks?: PastTrack[]; events?: GakpEvent[]; next?: string }>(where);
      tracks.value = [...(cursor ? tracks.value : []), ...(found.tracks ?? [])];
      events.value = [...(cursor ? events.value : []), ...(found.events ?? [])];
      next.value = found.next;
      problem.value = "";
      missing.value = false;
      searched.value = true;
    } catch (error) {
      missing.value = error instanceof ApiError && ["no-history", "not-found"].includes(error.kind);
      problem.value = words(error);
    } finally {
      busy.value = false;
    }
  };
  useEffect(() => void search(), []);
  const { camera } = form.value;
  useEffect(() => {
    rules.value = null;
    if (camera) fetchRules(camera).then((found) => (rules.value = found), () => undefined);
  }, [camera]);

  const shown = asked.value;
  const files = query(parameters(shown));
  return (
    <>
      <div class="title">
        <h1>History</h1>
      </div>
      <form
        class="panel search"
        aria-label="Search the history"
        onSubmit={(event) => {
          event.preventDefault();
          void search();
        }}
      >
        <label>
          Search for
          <select name="what" value={form.value.what} onChange={(event) => set({ what: event.currentTarget.value as Search["what"] })}>
            <option value="tracks">who was seen</option>
            <option value="events">what happened</option>
          </select>
        </label>
        <label>
          Camera
          <select name="camera" value={camera} onChange={(event) => set({ camera: event.currentTarget.value, rule: "" })}>
            <option value="">all</option>
            {cameras.value?.map(({ id }) => (
              <option key={id} value={id}>
                {id}
              </option>
            ))}
          </select>
        </label>
        <label>
          Line or zone
          <select name="rule" value={form.value.rule} disabled={!camera} onChange={(event) => set({ rule: event.currentTarget.value })}>
            <option value="">{camera ? "any" : "choose a camera first"}</option>
            {rules.value?.lines.map(({ id }) => (
              <option key={`line:${id}`} value={`line:${id}`}>
                across {id}
              </option>
            ))}
            {rules.value?.zones.map(({ id }) => (
              <option key={`zone:${id}`} value={`zone:${id}`}>
                in {id}
              </option>
            ))}
          </select>
        </label>
        <label>
          From
          <input name="from" type="datetime-local" step="1" value={form.value.from} onInput={(event) => set({ from: event.currentTarget.value })} />
        </label>
        <label>
          To
          <input name="to" type="datetime-local" step="1" value={form.value.to} onInput={(event) => set({ to: event.currentTarget.value })} />
        </label>
        {form.value.what === "tracks" ? (
          <label>
            Seen for at least, seconds
            <input name="least" type="number" min="0" step="any" value={form.value.least} onInput={(event) => set({ least: event.currentTarget.value })} />
          </label>
        ) : (
          <label>
            Kind of event
            <select name="type" value={form.value.type} onChange={(event) => set({ type: event.currentTarget.value })}>
              <option value="">all</option>
              {EVENT_TYPES.map(([value, name]) => (
                <option key={value} value={value}>
                  {name}
                </option>
              ))}
            </select>
          </label>
        )}
        <button type="submit" class="main" disabled={busy.value}>
          Search
        </button>
      </form>
      {problem.value && (
        <section class="panel" role="alert">
          {missing.value ? (
            <>
              <h2>The history cannot be searched</h2>
              <p>{problem.value}</p>
              <p class="quiet">Whoever runs this service can change that, under [history] in its configuration.</p>
            </>
          ) : (
            <p class="bad">{problem.value}</p>
          )}
        </section>
      )}
      {searched.value && !problem.value && (
        <section class="panel" aria-label="Results" aria-busy={busy.value}>
          <div class="row">
            <h2>
              <span role="status">
                {shown.what === "tracks" ? tracks.value.length : events.value.length}
                {next.value ? " newest" : ""} found
              </span>
            </h2>
            <span class="row end">
              <a class="button" download href={`/v1/history/${shown.what}.csv${files}`}>
                Download as CSV
              </a>
              {shown.what === "tracks" && shown.camera && (
                <a class="button" download href={`/v1/history/tracks.txt${files}`}>
                  As MOTChallenge
                </a>
              )}
            </span>
          </div>
          {shown.what === "tracks" ? <Tracks tracks={tracks.value} /> : <Happened events={events.value} />}
          {next.value && (
            <button type="button" disabled={busy.value} onClick={() => void search(next.value)}>
              Show more
            </button>
          )}
        </section>
      )}
    </>
  );
}

function Tracks({ tracks }: { tracks: PastTrack[] }) {
  if (!tracks.length) return <p class="quiet">Nobody was seen like that. Leave fields empty to search wider.</p>;
  const pictures = maySee.value && tracks.some((track) => track.snapshot);
  return (
    <Table heads={["Path", ...(pictures ? ["Picture"] : []), "Camera", "Who", "First seen", "Last seen", "For", "Sure"]} more="tracks">
      {tracks.map((track) => (
        <tr key={`${track.camera} ${track.epoch} ${track.id}`}>
          <td>
            <PathDrawing track={track} />
          </td>
          {pictures && (
            <td>{track.snapshot && <img src={track.snapshot} alt={`${track.class} ${track.id}`} loading="lazy" />}</td>
          )}
          <td data-label="Camera">
            <a href={cameraHref(track.camera)}>{track.camera}</a>
          </td>
          <td data-label="Who">
            {track.class} {track.id}
          </td>
          <td data-label="First seen">{moment(track.first)}</td>
          <td data-label="Last seen">{track.ended ? moment(track.last) : `${moment(track.last)}, not ended`}</td>
          <td data-label="For">{span(track.seconds)}</td>
          <td data-label="Sure">{Math.round(track.confidence * 100)} %</td>
        </tr>
      ))}
    </Table>
  );
}

function Happened({ events }: { events: GakpEvent[] }) {
  if (!events.length) return <p class="quiet">Nothing of that kind has happened. Leave fields empty to search wider.</p>;
  return (
    <ol class="events" aria-label="What happened" tabindex={0}>
      {events.map((event) => (
        <li key={event.id} data-type={event.type}>
          <time dateTime={event.time}>{moment(event.time)}</time>
          <a href={cameraHref(event.camera)}>{event.camera}</a>
          <span>{eventWords(event)}</span>
        </li>
      ))}
    </ol>
  );
}
