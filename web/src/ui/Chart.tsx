import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";

export interface Series {
  label: string;
  /** A custom property of the style sheet. */
  colour: string;
  values: number[];
}

/** Bars over time. `times` are seconds since 1970. */
export function Chart(props: { times: number[]; series: Series[]; label: string; from: number; to: number }) {
  const host = useRef<HTMLDivElement>(null);
  const { times, series, from, to } = props;
  const names = series.map((s) => s.label).join();
  const plot = useRef<uPlot | null>(null);
  const range = useRef<[number, number]>([from, to]);
  range.current = [from, to];

  useEffect(() => {
    const element = host.current!;
    const make = () => {
      plot.current?.destroy();
      const style = getComputedStyle(element);
      const of = (name: string) => style.getPropertyValue(name).trim();
      const axis = { stroke: of("--quiet"), grid: { stroke: of("--line"), width: 1 }, ticks: { stroke: of("--line"), width: 1 } };
      const bars = series.length > 1 ? 0.4 : 0.8;
      plot.current = new uPlot(
        {
          width: Math.max(200, element.clientWidth),
          height: 180,
          cursor: { drag: { x: false, y: false } },
          legend: { live: true },
          scales: {
            x: { range: () => range.current },
            y: { range: (_, __, max) => [0, Math.max(4, Math.ceil((max ?? 0) * 1.1))] },
          },
          axes: [axis, { ...axis, size: 44, incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000] }],
          series: [
            {},
            ...series.map((s, i) => ({
              label: s.label,
              stroke: of(s.colour),
              fill: of(s.colour),
              width: 0,
              points: { show: false },
              paths: uPlot.paths.bars!({ size: [bars, 24], align: series.length > 1 ? (i === 0 ? -1 : 1) : 0 }),
            })),
          ],
        },
        [times, ...series.map((s) => s.values)],
        element,
      );
    };
    make();
    const sizes = new ResizeObserver(() => plot.current?.setSize({ width: Math.max(200, element.clientWidth), height: 180 }));
    sizes.observe(element);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", make);
    return () => {
      dark.removeEventListener("change", make);
      sizes.disconnect();
      plot.current?.destroy();
      plot.current = null;
    };
  }, [names]);
  useEffect(() => plot.current?.setData([times, ...series.map((s) => s.values)]), [times, ...series.map((s) => s.values), from, to]);

  const sums = series.map((s) => `${s.label} ${s.values.reduce((a, b) => a + b, 0)}`).join(", ");
  return <div class="chart" ref={host} role="img" aria-label={`${props.label}: ${sums}`} />;
}
