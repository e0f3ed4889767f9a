#!/usr/bin/env node
// Prints who is where, who crosses a line, and at the end how many did:
// `example.js http://127.0.0.1:8080 [--token T] [--camera gate]... [--messages N] [--crossings N]`

import { parseArgs } from "node:util";
import { answer, Client, Refused } from "gakp-client";

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: {
    token: { type: "string", default: process.env["GAKP_TOKEN"] ?? "" },
    camera: { type: "string", multiple: true, default: [] },
    // The end comes after so many; 0: never.
    messages: { type: "string", default: "0" },
    crossings: { type: "string", default: "0" },
  },
});
const gakp = new Client(positionals[0] ?? "http://127.0.0.1:8080", {
  token: values.token,
  interrupted: (why) => console.error(`trying again: ${why.message}`),
});
const camera = values.camera ?? [];
const done = new AbortController();

async function tracks(left: number): Promise<void> {
  for await (const { message } of gakp.tracks({ camera, state: ["confirmed"] }, done)) {
    if (message.case === "gap") {
      console.error(`lost ${message.value.first}..${message.value.last} of ${message.value.camera}`);
    } else if (message.case === "frame") {
      const frame = message.value;
      for (const track of frame.tracks) {
        const box = [track.x, track.y, track.w, track.h].map((pixels) => pixels.toFixed(1)).join(" ");
        console.log(`${frame.camera} ${frame.epoch} ${frame.seq} ${track.id} ${box}`);
      }
      if (--left === 0) break;
    }
  }
}

async function crossings(left: number): Promise<void> {
  for await (const event of gakp.events({ camera, type: ["line.crossed"] }, done)) {
    if ("gap" in event) {
      console.error(`missed ${event.gap.missed} events`);
      continue;
    }
    console.log(`crossing ${event.id} ${event.camera} ${event.track} ${event.line} ${event.direction}`);
    if (--left === 0) break;
  }
}

async function counts(): Promise<void> {
  const { cameras } = await answer(gakp.rest.GET("/v1/cameras"));
  for (const { id } of cameras.filter(({ id }) => camera.length === 0 || camera.includes(id))) {
    const { lines } = await answer(gakp.rest.GET("/v1/cameras/{id}/counts", { params: { path: { id } } }));
    for (const [line, count] of Object.entries(lines)) console.log(`count ${id} ${line} ${count.in} ${count.out}`);
  }
}

// Into `head`, say.
process.stdout.on("error", () => process.exit());
process.on("SIGINT", () => done.abort());
try {
  // The end of one is the end of both, also if it is an error.
  const streams = [tracks(Number(values.messages)), crossings(Number(values.crossings))];
  await Promise.race(streams).finally(() => done.abort());
  await Promise.all(streams);
  await counts();
} catch (error) {
  if (!(error instanceof Refused)) throw error;
  console.error(`refused: ${error.detail}`);
  process.exitCode = 1;
}
