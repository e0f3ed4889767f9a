import type { ComponentChildren } from "preact";

/** A table with a line for each thing; on a narrow screen the lines become blocks, their cells named by `data-label`. */
export function Table({ heads, more = "", children }: { heads: string[]; more?: string; children: ComponentChildren }) {
  return (
    <div class="wide">
      <table class={`list ${more}`.trim()}>
        <thead>
          <tr>
            {heads.map((name) => (
              <th scope="col" key={name}>
                {name}
              </th>
            ))}
          </tr>
        </thead>
        <tbody>{children}</tbody>
      </table>
    </div>
  );
}
