import type { Counts } from "../api";
import type { Kind } from "../draw/rules";
import { many, moment, number, span } from "../format";
import { counted } from "../live/LiveView";
import type { Shown } from "../live/stage";

/** What lines and zones have counted, beside the picture. */
export function CountPanel(props: { counts: Counts | null; shown: Shown | null; pick?: (kind: Kind, name: string) => void }) {
  const { counts, shown, pick } = props;
  const seen = counted(shown);
  const lines = Object.entries(counts?.lines ?? {});
  const zones = Object.entries(counts?.zones ?? {});
  const name = (kind: Kind, id: string) =>
    pick ? (
      <button type="button" class="link" title={`Change ${id}`} onClick={() => pick(kind, id)}>
        {id}
      </button>
    ) : (
      id
    );
  return (
    <section class="panel counts" aria-labelledby="counts">
      <h2 id="counts">Counts</h2>
      <p class="now">
        {seen.length === 0 ? (
          <span class="quiet">Nobody is in view.</span>
        ) : (
          seen.map(([what, n]) => (
            <span key={what}>
              <strong>{many(n, what)}</strong> in view
            </span>
          ))
        )}
      </p>
      {lines.length > 0 && (
        <table>
          <thead>
            <tr>
              <th scope="col">Line</th>
              <th scope="col">In</th>
              <th scope="col">Out</th>
            </tr>
          </thead>
          <tbody>
            {lines.map(([id, count]) => (
              <tr key={id} data-line={id}>
                <th scope="row">{name("line", id)}</th>
                <td class="in">{number(count.in)}</td>
                <td class="out">{number(count.out)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {zones.length > 0 && (
        <table>
          <thead>
            <tr>
              <th scope="col">Zone</th>
              <th scope="col">Inside</th>
              <th scope="col">Came</th>
              <th scope="col">Stay</th>
            </tr>
          </thead>
          <tbody>
            {zones.map(([id, count]) => (
              <tr key={id} data-zone={id} data-crowded={count.crowded || undefined}>
                <th scope="row">
                  {name("zone", id)}
                  {count.crowded && <span class="chip alarm">crowded</span>}
                </th>
                <td>{number(count.occupancy)}</td>
                <td>{number(count.entries)}</td>
                <td>{count.mean_dwell_s === null ? "-" : span(count.mean_dwell_s)}</td>
              </tr>
            ))}
          </tbody>
        </table>
      )}
      {counts && lines.length + zones.length === 0 && (
        <p class="quiet">
          {pick
            ? "Draw a line to count who crosses it, or a zone to see how many are in it and how long they stay."
            : "No lines or zones are drawn on this camera."}
        </p>
      )}
      {counts && lines.length + zones.length > 0 && <p class="quiet">Counted since {moment(counts.since)}</p>}
    </section>
  );
}
