import type { Camera } from "../api";
import { stateWords } from "../format";
import { offline } from "../state";

/** What a camera is doing; while the service does not answer, nobody knows. */
export function State({ camera }: { camera: Camera }) {
  return offline.value ? <span class="state unknown">Unknown</span> : <span class="state">{stateWords(camera)}</span>;
}
