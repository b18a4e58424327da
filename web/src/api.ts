/** Client of the service's API; every request of the pages adds the API key here. */

import type { Answer, Fault, Layout, Plan, PlanDocument, PlanList, Problem, SequenceAnswer, Session, SessionDocument, Venue, VenueList, VenuePlanDocument, VenuePlanList } from "./types";

const KEY = "lalaloc-key";

/** Error answer of the service. */
export class ServiceError extends Error {
  constructor(
    readonly status: number,
    readonly title: string,
    readonly detail: string,
    readonly faults: Fault[] = [],
    readonly slug = "",
    readonly retryAfterS: number | null = null,
    /** Levels of a plan file, of which the request must name one. */
    readonly levels: string[] = [],
  ) {
    super(detail ? `${title}: ${detail}` : title);
  }
}

/** API key, kept until the tab is closed. */
export const key = {
  get: (): string | null => sessionStorage.getItem(KEY),
  set: (value: string): void => sessionStorage.setItem(KEY, value),
  remove: (): void => sessionStorage.removeItem(KEY),
};

type AskForKey = () => Promise<boolean>;
let askForKey: AskForKey | null = null;

/** Register the dialog that asks for a key; its promise is false if the user gives none. */
export function onKeyNeeded(ask: AskForKey): void {
  askForKey = ask;
}

/** Send a request; after 401, send it again with the key that the user gives. */
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
      throw new ServiceError(0, "The service does not answer", "Check that it is running and that the network works, then try again.");
    }
    if (response.ok || response.status === 304) return response;
    const failure = await errorOf(response);
    const hasChanged = key.get() !== sent && key.get() !== null;
    if (response.status !== 401 || askForKey === null || (!hasChanged && !(await askForKey()))) throw failure;
  }
}

async function errorOf(response: Response): Promise<ServiceError> {
  const after = Number(response.headers.get("retry-after"));
  try {
    const problem: Problem = await response.json();
    const slug = String(problem.type ?? "").split(":").pop() ?? "";
    return new ServiceError(response.status, problem.title, problem.detail, problem.errors ?? [], slug, after || null, problem.levels ?? []);
  } catch {
    return new ServiceError(response.status, `The service answered ${response.status}`, response.statusText);
  }
}

async function json<T>(path: string, options?: RequestInit): Promise<T> {
  return (await request(path, options)).json();
}

async function planOf(response: Response): Promise<Plan> {
  return { ...(await response.json()), etag: response.headers.get("etag") ?? "" };
}

const path = (id: string): string => `/floorplans/${encodeURIComponent(id)}`;
const revisionQuery = (revision?: string): string => (revision ? `?revision=${encodeURIComponent(revision)}` : "");

function form(fields: Record<string, string>, name: string, ...files: File[]): FormData {
  const body = new FormData();
  for (const [field, value] of Object.entries(fields)) body.set(field, value);
  for (const file of files) body.append(name, file);
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
    return planOf(await request(path(id) + revisionQuery(revision)));
  },

  async layout(id: string, revision?: string): Promise<Layout> {
    return json(`${path(id)}/layout${revisionQuery(revision)}`);
  },

  /** Upload a plan as a file; `fields` are import options. */
  async uploadPlan(file: File, fields: Record<string, string> = {}): Promise<Plan> {
    return planOf(await request("/floorplans", { method: "POST", body: form(fields, "file", file) }));
  },

  /** Return the uploaded file of a plan's current revision. */
  async original(id: string): Promise<Blob> {
    return (await request(`${path(id)}/original`)).blob();
  },

  async createPlan(document: PlanDocument): Promise<Plan> {
    const headers = { "Content-Type": "application/json" };
    return planOf(await request("/floorplans", { method: "POST", headers, body: JSON.stringify(document) }));
  },

  /** Store a new revision; fails with 412 if `etag` is not that of the latest one. */
  async replacePlan(id: string, document: PlanDocument, etag: string): Promise<Plan> {
    const headers = { "Content-Type": "application/json", "If-Match": etag };
    return planOf(await request(path(id), { method: "PUT", headers, body: JSON.stringify(document) }));
  },

  async deletePlan(id: string): Promise<void> {
    await request(path(id), { method: "DELETE" });
  },

  async localise(fields: Record<string, string>, photo: File, signal?: AbortSignal): Promise<Answer> {
    return json("/localise", { method: "POST", body: form(fields, "photo", photo), signal });
  },

  /** Localise photographs of one visit, in the order in which they were taken. */
  async localiseSequence(fields: Record<string, string>, photos: File[], signal?: AbortSignal): Promise<SequenceAnswer> {
    return json("/localise/sequence", { method: "POST", body: form(fields, "photo", ...photos), signal });
  },

  /** Return the answer to a query as a picture: the photograph with the layout, and the plan with the place. */
  async picture(fields: Record<string, string>, photo: File): Promise<Blob> {
    const { include: _, ...query } = fields;
    const response = await request("/localise", {
      method: "POST", headers: { Accept: "image/png" }, body: form(query, "photo", photo),
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

  /** Upload a file with several levels: each becomes a plan, and all of them a venue. */
  async uploadLevels(file: File, fields: Record<string, string>): Promise<{ id: string; name: string }> {
    return json("/venues", { method: "POST", body: form(fields, "file", file) });
  },

  async venue(id: string): Promise<Venue> {
    return json(`/venues/${encodeURIComponent(id)}`);
  },

  /** Return the first page of a venue's plans, from the lowest level up. */
  async venuePlans(id: string): Promise<VenuePlanList> {
    return json(`/venues/${encodeURIComponent(id)}/plans?limit=500`);
  },

  /** Begin to follow a camera in a plan or venue. */
  async beginSession(document: Partial<SessionDocument>): Promise<Session> {
    const headers = { "Content-Type": "application/json" };
    return json("/sessions", { method: "POST", headers, body: JSON.stringify(document) });
  },

  async session(id: string): Promise<Session> {
    return json(`/sessions/${encodeURIComponent(id)}`);
  },

  /** Send the next photograph of a session. */
  async addPhotograph(id: string, fields: Record<string, string>, photo: File): Promise<Session> {
    return json(`/sessions/${encodeURIComponent(id)}/photographs`, { method: "POST", body: form(fields, "photo", photo) });
  },

  async endSession(id: string): Promise<void> {
    await request(`/sessions/${encodeURIComponent(id)}`, { method: "DELETE" });
  },

  async answer(id: string): Promise<Answer> {
    return json(`/answers/${encodeURIComponent(id)}`);
  },
};
