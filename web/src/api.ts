/** The service's API: every request of the pages goes through here, with the key where there is one. */

import type { Answer, Fault, Layout, Plan, PlanDocument, PlanList, Problem, Venue, VenueList, VenuePlanDocument, VenuePlanList } from "./types";

const KEY = "lalaloc-key";

/** Why a request was refused, in the service's own words. */
export class Refusal extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    readonly detail: string,
    readonly faults: Fault[] = [],
    readonly slug = "",
    readonly retryAfterS: number | null = null,
  ) {
    super(detail ? `${title}: ${detail}` : title);
  }
}

/** The API key, which is gone when the tab is closed. */
export const key = {
  get: (): string | null => sessionStorage.getItem(KEY),
  set: (value: string): void => sessionStorage.setItem(KEY, value),
  forget: (): void => sessionStorage.removeItem(KEY),
};

type AskForKey = (why: string) => Promise<boolean>;
let askForKey: AskForKey | null = null;

/** Say who asks for a key when one is needed; the promise is false when none is given. */
export function onKeyNeeded(ask: AskForKey): void {
  askForKey = ask;
}

/** Send a request; what needs a key is sent again once there is one. */
export async function request(path: string, options: RequestInit = {}): Promise<Response> {
  for (;;) {
    const headers = new Headers(options.headers);
    const sent = key.get();
    if (sent !== null) headers.set("Authorization", `Bearer ${sent}`);
    let response: Response;
    try {
      response = await fetch(path, { ...options, headers });
    } catch (error) {
      if (error instanceof DOMException && error.name === "AbortError") throw error;
      throw new Refusal(0, "The service does not answer", "is it running, and is the network there? Try again.");
    }
    if (response.ok || response.status === 304) return response;
    const refusal = await refusalOf(response);
    const another = key.get() !== sent && key.get() !== null;
    if (response.status !== 401 || askForKey === null || (!another && !(await askForKey(refusal.detail)))) throw refusal;
  }
}

async function refusalOf(response: Response): Promise<Refusal> {
  const after = Number(response.headers.get("retry-after"));
  try {
    const problem: Problem = await response.json();
    const slug = String(problem.type ?? "").split(":").pop() ?? "";
    return new Refusal(response.status, problem.title, problem.detail, problem.errors ?? [], slug, after || null);
  } catch {
    return new Refusal(response.status, `The service answered ${response.status}`, response.statusText);
  }
}

async function json<T>(path: string, options?: RequestInit): Promise<T> {
  return (await request(path, options)).json();
}

async function planOf(response: Response): Promise<Plan> {
  return { ...(await response.json()), etag: response.headers.get("etag") ?? "" };
}

const path = (id: string): string => `/floorplans/${encodeURIComponent(id)}`;
const at = (revision?: string): string => (revision ? `?revision=${encodeURIComponent(revision)}` : "");

function form(fields: Record<string, string>, name: string, file: File): FormData {
  const body = new FormData();
  for (const [field, value] of Object.entries(fields)) body.set(field, value);
  body.set(name, file);
  return body;
}

export const api = {
  async plans(name = "", cursor: string | null = null): Promise<PlanList> {
    const query = new URLSearchParams({ limit: "50" });
    if (name) query.set("name", name);
    if (cursor) query.set("cursor", cursor);
    return json(`/floorplans?${query}`);
  },

  async plan(id: string, revision?: string): Promise<Plan> {
    return planOf(await request(path(id) + at(revision)));
  },

  async layout(id: string, revision?: string): Promise<Layout> {
    return json(`${path(id)}/layout${at(revision)}`);
  },

  /** Upload a plan as a file; `fields` are options of the import. */
  async uploadPlan(file: File, fields: Record<string, string> = {}): Promise<Plan> {
    return planOf(await request("/floorplans", { method: "POST", body: form(fields, "file", file) }));
  },

  /** The file that a plan's revision was uploaded as. */
  async original(id: string): Promise<Blob> {
    return (await request(`${path(id)}/original`)).blob();
  },

  async createPlan(document: PlanDocument): Promise<Plan> {
    const headers = { "Content-Type": "application/json" };
    return planOf(await request("/floorplans", { method: "POST", headers, body: JSON.stringify(document) }));
  },

  /** Store a new revision; refused with 412 when the plan has another than that of `etag` by now. */
  async replacePlan(id: string, document: PlanDocument, etag: string): Promise<Plan> {
    const headers = { "Content-Type": "application/json", "If-Match": etag };
    return planOf(await request(path(id), { method: "PUT", headers, body: JSON.stringify(document) }));
  },

  async deletePlan(id: string): Promise<void> {
    await request(path(id), { method: "DELETE" });
  },

  async localise(fields: Record<string, string>, panorama: File, signal?: AbortSignal): Promise<Answer> {
    return json("/localise", { method: "POST", body: form(fields, "panorama", panorama), signal });
  },

  /** The answer to a question as the service draws it: the photograph with the layout, and the plan with the place. */
  async picture(fields: Record<string, string>, panorama: File): Promise<Blob> {
    const { include: _, ...asked } = fields;
    const response = await request("/localise", {
      method: "POST", headers: { Accept: "image/png" }, body: form(asked, "panorama", panorama),
    });
    return response.blob();
  },

  async venues(name = ""): Promise<VenueList> {
    const query = new URLSearchParams({ limit: "50" });
    if (name) query.set("name", name);
    return json(`/venues?${query}`);
  },

  async createVenue(name: string, plans: VenuePlanDocument[]): Promise<Venue> {
    const headers = { "Content-Type": "application/json" };
    return json("/venues", { method: "POST", headers, body: JSON.stringify({ name, plans }) });
  },

  async venue(id: string): Promise<Venue> {
    return json(`/venues/${encodeURIComponent(id)}`);
  },

  /** The plans of a venue from the lowest level up, as many as fit on a page. */
  async venuePlans(id: string): Promise<VenuePlanList> {
    return json(`/venues/${encodeURIComponent(id)}/plans?limit=500`);
  },

  async answer(id: string): Promise<Answer> {
    return json(`/answers/${encodeURIComponent(id)}`);
  },
};
