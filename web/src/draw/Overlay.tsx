// Lines, zones and masks over the live picture, and drawing them: with the mouse, a finger, or the arrow keys.

import { useSignal } from "@preact/signals";
import { useEffect, useLayoutEffect, useRef } from "preact/hooks";
import type { Line, Mask, Point, Zone } from "../api";
import { clamp, middle, sides } from "./geometry";
import { leastPoints, MOST_POINTS, type Draft, type Kind, type Rules } from "./rules";

const STEP = 0.005;

interface Props {
  rules: Rules;
  draft: Draft | null;
  change: (draft: Draft) => void;
  finish: () => void;
  cancel: () => void;
  pick?: (kind: Kind, name: string) => void;
  /** Likewise for masks. Without it they are not outlined: the picture shows them. */
  pickMask?: (kind: Kind, name: string) => void;
}

function arrow(key: string, far: boolean): Point | null {
  const by = far ? STEP * 8 : STEP;
  switch (key) {
    case "ArrowLeft":
      return [-by, 0];
    case "ArrowRight":
      return [by, 0];
    case "ArrowUp":
      return [0, -by];
    case "ArrowDown":
      return [0, by];
    default:
      return null;
  }
}

export function Overlay({ rules, draft, change, finish, cancel, pick, pickMask }: Props) {
  const svg = useRef<SVGSVGElement>(null);
  const size = useSignal<Point>([960, 540]);
  /** Where the next point would be put, while drawing. */
  const cursor = useSignal<Point>([0.5, 0.5]);
  const hover = useSignal(false);
  const dragged = useRef<number | null>(null);
  const pressed = useRef<Point | null>(null);

  useEffect(() => {
    const element = svg.current!;
    const fit = () => (size.value = [Math.max(1, element.clientWidth), Math.max(1, element.clientHeight)]);
    const observer = new ResizeObserver(fit);
    observer.observe(element);
    fit();
    return () => observer.disconnect();
  }, []);
  const drawing = draft?.open === true;
  useLayoutEffect(() => {
    if (drawing) svg.current!.focus({ preventScroll: true });
  }, [drawing, draft?.kind]);

  const active = draft !== null;
  useLayoutEffect(() => {
    if (!active) return;
    // Wherever the focus is.
    const escape = (event: KeyboardEvent) => event.key === "Escape" && cancel();
    addEventListener("keydown", escape);
    return () => removeEventListener("keydown", escape);
  }, [active]);

  const [width, height] = size.value;
  const place = (event: PointerEvent): Point => {
    const box = svg.current!.getBoundingClientRect();
    return [clamp((event.clientX - box.left) / box.width), clamp((event.clientY - box.top) / box.height)];
  };
  const near = (a: Point, b: Point) => Math.hypot((a[0] - b[0]) * width, (a[1] - b[1]) * height) < 14;
  const move = (index: number, to: Point) =>
    draft && change({ ...draft, points: draft.points.map((p, i) => (i === index ? to : p)) });

  /** Puts the next point. Two make a line; a zone or mask closes at its first corner. */
  const put = (point: Point) => {
    if (!draft) return;
    const { points, kind } = draft;
    if (kind !== "line" && points.length >= 3 && near(point, points[0]!)) return finish();
    if (points.length > 0 && near(point, points[points.length - 1]!)) return;
    const next = [...points, point];
    const done = (kind === "line" && next.length === 2) || next.length === MOST_POINTS;
    change({ ...draft, points: next, open: !done });
  };

  const down = (event: PointerEvent) => {
    if (!draft || event.button !== 0) return;
    const handle = (event.target as Element).closest("[data-point]");
    if (!draft.open && handle) {
      const index = Number(handle.getAttribute("data-point"));
      if (handle.hasAttribute("data-new")) {
        change({ ...draft, points: draft.points.toSpliced(index, 0, place(event)) });
      } else {
        (handle as SVGElement).focus();
      }
      dragged.current = index;
      svg.current!.setPointerCapture(event.pointerId);
      event.preventDefault();
    } else if (draft.open) {
      pressed.current = place(event);
      cursor.value = pressed.current;
      put(pressed.current);
      svg.current!.setPointerCapture(event.pointerId);
      event.preventDefault();
    }
  };
  const moved = (event: PointerEvent) => {
    if (!draft) return;
    if (dragged.current !== null) move(dragged.current, place(event));
    else if (draft.open) {
      hover.value = true;
      cursor.value = place(event);
    }
  };
  const up = (event: PointerEvent) => {
    // A line may be drawn in one stroke as well as by two clicks.
    if (draft?.open && draft.kind === "line" && pressed.current && !near(pressed.current, place(event))) {
      put(place(event));
    }
    dragged.current = null;
    pressed.current = null;
  };
  const key = (event: KeyboardEvent) => {
    if (!draft) return;
    const target = (event.target as Element).getAttribute("data-point");
    const by = arrow(event.key, event.shiftKey);
    if (draft.open) {
      if (by) {
        hover.value = true;
        cursor.value = [clamp(cursor.value[0] + by[0]), clamp(cursor.value[1] + by[1])];
      } else if (event.key === " " || (event.key === "Enter" && draft.points.length < leastPoints(draft.kind))) {
        put(cursor.value);
      } else if (event.key === "Enter") {
        finish();
      } else if (event.key === "Backspace" && draft.points.length > 0) {
        change({ ...draft, points: draft.points.slice(0, -1) });
      } else return;
      event.preventDefault();
    } else if (target !== null) {
      const index = Number(target);
      const point = draft.points[index]!;
      if (by) move(index, [clamp(point[0] + by[0]), clamp(point[1] + by[1])]);
      else if ((event.key === "Delete" || event.key === "Backspace") && draft.points.length > leastPoints(draft.kind)) {
        change({ ...draft, points: draft.points.toSpliced(index, 1) });
      } else return;
      event.preventDefault();
    }
  };

  const pixel = ([x, y]: Point): Point => [x * width, y * height];
  const path = (points: Point[]) => points.map((p) => pixel(p).map((v) => v.toFixed(1)).join(",")).join(" ");
  const quiet = draft !== null;
  const label = !draft
    ? "Lines, zones and masks"
    : draft.open
      ? `Drawing a ${draft.kind}. Arrow keys move the cross, space puts a point, Enter finishes, Escape stops.`
      : `Changing ${draft.name}. Tab goes from point to point, arrow keys move it, Delete removes it.`;
  return (
    <svg
      ref={svg}
      class={`overlay${draft ? (draft.open ? " drawing" : " editing") : ""}`}
      viewBox={`0 0 ${width} ${height}`}
      role={draft ? "application" : "group"}
      aria-label={label}
      tabindex={drawing ? 0 : undefined}
      onPointerDown={down}
      onPointerMove={moved}
      onPointerUp={up}
      onPointerCancel={up}
      onPointerLeave={() => (hover.value = false)}
      onKeyDown={key}
    >
      {(pickMask ? rules.masks : [])
        .filter((mask) => draft?.kind !== "mask" || draft.was !== mask.id)
        .map((mask) => (
          <AreaShape key={mask.id} kind="mask" area={mask} path={path} pixel={pixel} quiet={quiet} pick={quiet ? undefined : pickMask} />
        ))}
      {rules.zones
        .filter((zone) => draft?.kind !== "zone" || draft.was !== zone.id)
        .map((zone) => (
          <AreaShape key={zone.id} kind="zone" area={zone} path={path} pixel={pixel} quiet={quiet} pick={quiet ? undefined : pick} />
        ))}
      {rules.lines
        .filter((line) => draft?.kind !== "line" || draft.was !== line.id)
        .map((line) => (
          <LineShape key={line.id} line={line} size={size.value} path={path} quiet={quiet} pick={quiet ? undefined : pick} />
        ))}
      {draft && (
        <g class="draft">
          {draft.kind !== "line" && draft.points.length > 2 && !draft.open ? (
            <polygon points={path(draft.points)} class="shape" />
          ) : (
            <polyline
              points={path(drawing && hover.value && draft.points.length ? [...draft.points, cursor.value] : draft.points)}
              class="shape"
            />
          )}
          {draft.kind === "line" && draft.points.length > 1 && <Sides points={draft.points} size={size.value} />}
          {!draft.open && draft.points.length < MOST_POINTS && <Between draft={draft} pixel={pixel} />}
          {draft.points.map((point, index) => {
            const [x, y] = pixel(point);
            return (
              <g
                key={index}
                class="handle"
                data-point={index}
                tabindex={draft.open ? undefined : 0}
                role="button"
                aria-label={`Point ${index + 1} of ${draft.points.length}, ${Math.round(point[0] * 100)} % from the left, ${Math.round(point[1] * 100)} % from the top`}
              >
                <circle cx={x} cy={y} r={18} class="reach" />
                <circle cx={x} cy={y} r={7} class="dot" />
              </g>
            );
          })}
          {drawing && (hover.value || draft.points.length === 0) && <Cross at={pixel(cursor.value)} />}
        </g>
      )}
    </svg>
  );
}

/** A grip in the middle of each stretch, from which a new point is pulled. */
function Between({ draft, pixel }: { draft: Draft; pixel: (p: Point) => Point }) {
  const { points } = draft;
  const stretches = draft.kind !== "line" ? points.length : points.length - 1;
  return (
    <>
      {Array.from({ length: stretches }, (_, i) => {
        const [x, y] = pixel(middle([points[i]!, points[(i + 1) % points.length]!]));
        return (
          <g key={`new${i}`} class="handle new" data-point={i + 1} data-new="" aria-hidden="true">
            <circle cx={x} cy={y} r={14} class="reach" />
            <circle cx={x} cy={y} r={4.5} class="dot" />
          </g>
        );
      })}
    </>
  );
}

function Cross({ at: [x, y] }: { at: Point }) {
  return <path class="cross" d={`M${x - 12},${y}h24M${x},${y - 12}v24`} aria-hidden="true" />;
}

/** Which way is in, and which is out. */
function Sides({ points, size: [width, height] }: { points: Point[]; size: Point }) {
  const { at, inwards } = sides(points, width, height);
  const side = (way: number, name: string) => {
    const [dx, dy] = [inwards[0] * way, inwards[1] * way];
    const tip: Point = [at[0] + dx * 26, at[1] + dy * 26];
    const wing = (turn: number) => `${tip[0] - dx * 8 - dy * 5 * turn},${tip[1] - dy * 8 + dx * 5 * turn}`;
    return (
      <g class={`side ${name}`}>
        <path d={`M${at[0] + dx * 5},${at[1] + dy * 5}L${tip[0]},${tip[1]}M${wing(1)}L${tip[0]},${tip[1]}L${wing(-1)}`} />
        <text x={tip[0] + dx * (way > 0 ? 14 : 18)} y={tip[1] + dy * 12} text-anchor="middle" dominant-baseline="central">
          {name}
        </text>
      </g>
    );
  };
  return (
    <>
      {side(1, "in")}
      {side(-1, "out")}
    </>
  );
}

function LineShape(props: {
  line: Line;
  size: Point;
  path: (points: Point[]) => string;
  quiet: boolean;
  pick?: (kind: Kind, name: string) => void;
}) {
  const { line, size, path, quiet, pick } = props;
  const [x, y] = [line.points[0]![0] * size[0], line.points[0]![1] * size[1]];
  return (
    <g class={`rule line${quiet ? " quiet" : ""}${pick ? " pick" : ""}`} data-line={line.id} onClick={() => pick?.("line", line.id)}>
      <polyline points={path(line.points)} class="reach" />
      <polyline points={path(line.points)} class="shape" />
      {!quiet && <Sides points={line.points} size={size} />}
      <Name text={line.id} x={x} y={y} size={size} />
    </g>
  );
}

function AreaShape(props: {
  kind: "zone" | "mask";
  area: Zone | Mask;
  path: (points: Point[]) => string;
  pixel: (p: Point) => Point;
  quiet: boolean;
  pick?: (kind: Kind, name: string) => void;
}) {
  const { kind, area, path, pixel, quiet, pick } = props;
  const [x, y] = pixel(middle(area.points));
  const name = { [`data-${kind}`]: area.id };
  return (
    <g class={`rule ${kind}${quiet ? " quiet" : ""}${pick ? " pick" : ""}`} {...name} onClick={() => pick?.(kind, area.id)}>
      <polygon points={path(area.points)} class="shape" />
      <text class="name" x={x} y={y} text-anchor="middle" dominant-baseline="central">
        {area.id}
      </text>
    </g>
  );
}

/** A name beside a point, kept within the picture. */
function Name({ text, x, y, size: [width, height] }: { text: string; x: number; y: number; size: Point }) {
  const right = x > width * 0.7;
  return (
    <text
      class="name"
      x={right ? x - 10 : x + 10}
      y={Math.min(height - 10, Math.max(12, y))}
      text-anchor={right ? "end" : "start"}
      dominant-baseline="central"
    >
      {text}
    </text>
  );
}
