import { useSignal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { ask, cameraPath, words, type Heat } from "../api";
import { awake } from "../state";

const LOOK_MS = 3000;

/** Where people stood: blue for a little, red for long, over the picture. */
export function HeatMap({ camera }: { camera: string }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const error = useSignal("");
  useEffect(() => {
    const look = () => {
      if (!awake.value) return;
      ask<Heat>(cameraPath(camera, "heatmap")).then(
        (heat) => {
          error.value = "";
          if (canvas.current) paint(canvas.current, heat);
        },
        (problem) => (error.value = words(problem)),
      );
    };
    look();
    const timer = setInterval(look, LOOK_MS);
    return () => clearInterval(timer);
  }, [camera]);
  return (
    <>
      <canvas class="heat" ref={canvas} width={64} height={36} role="img" aria-label="Heat map: where people stood" />
      {error.value && <p class="note">{error.value}</p>}
    </>
  );
}

function paint(canvas: HTMLCanvasElement, { columns, rows, seconds }: Heat): void {
  canvas.width = columns;
  canvas.height = rows;
  const context = canvas.getContext("2d")!;
  const picture = context.createImageData(columns, rows);
  const most = Math.max(1, ...seconds);
  seconds.forEach((value, i) => {
    // The square root shows where few were as well.
    const part = Math.sqrt(value / most);
    picture.data[i * 4] = 255 * Math.min(1, part * 2);
    picture.data[i * 4 + 1] = 255 * Math.max(0, 1 - Math.abs(part - 0.5) * 2);
    picture.data[i * 4 + 2] = 255 * Math.max(0, 1 - part * 2);
    picture.data[i * 4 + 3] = value > 0 ? 60 + 150 * part : 0;
  });
  context.putImageData(picture, 0, 0);
}
