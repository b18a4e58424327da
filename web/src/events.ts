/** Server-sent events over fetch, because the browser's EventSource cannot send a key. */

import { linesOf, pause } from "../../clients/typescript/src/transport";
import { api } from "./api";
import type { PlanEvent } from "./types";

const RECONNECT_MS = 2000;
// The service ends streams after 15 minutes.
const TIMEOUT_MS = 960_000;

/** Yield the events of a plan until it is in a final state or `signal` aborts. */
export async function* eventsOf(id: string, signal: AbortSignal): AsyncGenerator<PlanEvent> {
  const path = `/floorplans/${encodeURIComponent(id)}/events`;
  while (!signal.aborted) {
    const response = await api.request(path, { signal, timeoutMs: TIMEOUT_MS });
    try {
      for await (const line of linesOf(response)) {
        if (!line.startsWith("data:")) continue;
        const event: PlanEvent = JSON.parse(line.slice(5));
        yield event;
        if (event.status !== "preparing") return;
      }
    } catch {
      signal.throwIfAborted();
    }
    // The stream has ended or broken off; reconnect.
    await pause(RECONNECT_MS, signal);
  }
}
