// Reads the Prometheus text of `/metrics`.

export interface Sample {
  labels: Record<string, string>;
  value: number;
}

export type Metrics = Map<string, Sample[]>;

export function parse(text: string): Metrics {
  const metrics: Metrics = new Map();
  for (const line of text.split("\n")) {
    const found = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})? (\S+)/.exec(line);
    if (!found) continue;
    const labels: Record<string, string> = {};
    for (const [, key, value] of (found[2] ?? "").matchAll(/(\w+)="((?:[^"\\]|\\.)*)"/g)) labels[key!] = value!;
    const list = metrics.get(found[1]!) ?? [];
    list.push({ labels, value: Number(found[3]!.replace("Inf", "Infinity")) });
    metrics.set(found[1]!, list);
  }
  return metrics;
}

const matches = (sample: Sample, labels: Record<string, string>): boolean =>
  Object.entries(labels).every(([key, value]) => sample.labels[key] === value);

/** The sum of a metric's series that have these labels; `null` when there is none. */
export function sum(metrics: Metrics, name: string, labels: Record<string, string> = {}): number | null {
  const found = metrics.get(name)?.filter((sample) => matches(sample, labels));
  return found?.length ? found.reduce((total, { value }) => total + value, 0) : null;
}

/** How much a counter has grown since `before`, in a second; `null` without a past. */
export function rate(now: Metrics, before: Metrics | null, seconds: number, name: string, labels = {}): number | null {
  if (!before || seconds <= 0) return null;
  const [a, b] = [sum(before, name, labels), sum(now, name, labels)];
  return a === null || b === null ? null : Math.max(0, b - a) / seconds;
}

/** A histogram's quantile over what came since `before`, or over all; `null` when nothing came. */
export function quantile(now: Metrics, before: Metrics | null, name: string, part: number, labels = {}): number | null {
  const upTo = new Map<number, number>();
  for (const [metrics, sign] of [
    [now, 1],
    [before, -1],
  ] as const) {
    for (const sample of metrics?.get(`${name}_bucket`) ?? []) {
      if (!matches(sample, labels)) continue;
      const edge = sample.labels.le === "+Inf" ? Infinity : Number(sample.labels.le);
      upTo.set(edge, (upTo.get(edge) ?? 0) + sign * sample.value);
    }
  }
  const edges = [...upTo].sort(([a], [b]) => a - b);
  const total = edges[edges.length - 1]?.[1] ?? 0;
  if (total <= 0) return null;
  const rank = total * part;
  let [below, edge] = [0, 0];
  for (const [upper, count] of edges) {
    if (count >= rank) {
      if (upper === Infinity) return edge;
      return count > below ? edge + ((upper - edge) * (rank - below)) / (count - below) : upper;
    }
    [below, edge] = [count, upper];
  }
  return edge;
}
