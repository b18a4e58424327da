/** Server-sent events over fetch, because the browser's EventSource cannot send a key. */

import { request } from "./api";
import type { PlanEvent } from "./types";

const RECONNECT_MS = 2000;

/** Report the progress of a plan until it is in a final state or `signal` aborts. */
export async function followPlan(id: string, report: (event: PlanEvent) => void, signal: AbortSignal): Promise<void> {
  while (!signal.aborted) {
    const response = await request(`/floorplans/${encodeURIComponent(id)}/events`, { signal });
    for await (const event of eventsOf(response)) {
      report(event);
      if (event.status !== "preparing") return;
    }
    // The service ends streams after a while; reconnect.
    await new Promise((done) => setTimeout(done, RECONNECT_MS));
  }
}

async function* eventsOf(response: Response): AsyncGenerator<PlanEvent> {
  if (response.body === null) return;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    text += value;
    const blocks = text.split(/\r?\n\r?\n/);
    text = blocks.pop() ?? "";
    for (const block of blocks) {
      const data = block
        .split(/\r?\n/)
        .filter((line) => line.startsWith("data:"))
        .map((line) => line.slice(5).trim());
      if (data.length > 0) yield JSON.parse(data.join("\n"));
    }
  }
}
