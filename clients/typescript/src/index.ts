/** Client of the LaLaLoc service for browsers and Node. Units are in the names; headings are degrees. */

import type { components, operations } from "../generated/api.js";
import { ServiceError } from "./errors.js";
import { endOf, type ImportStep, linesOf, NDJSON, pause, upload } from "./transport.js";

export { ServiceError } from "./errors.js";
export type { ImportStep } from "./transport.js";
/** Schemas of the API by name. */
export type Schemas = components["schemas"];
/** A stored plan; `etag` is the entity tag of its revision, for `replacePlan`. */
export type Plan = Schemas["FloorPlanAnswer"] & { etag: string };
type Text = Readonly<Record<string, string>>;
type Form<Name extends keyof operations> = operations[Name] extends {
  requestBody?: { content: { "multipart/form-data": infer Body } };
}
  ? Partial<Omit<Body, "photo" | "features" | "film" | "panorama" | "file">>
  : never;
/** Fields of a form; lists and objects are sent as JSON, undefined and null are left out. */
export type Fields<Name extends keyof operations> = Form<Name> | Text;

/** Photograph, or its features instead, with which it stays on the device: docs/reference/features.md. */
export type Picture = Blob | { features: Blob };

/** Picture of a turn with its heading relative to the other pictures, clockwise, as a gyroscope or `lalaloc encode --turn` tells it; null: unknown. */
export interface TurnPicture {
  picture: Picture;
  headingDeg: number | null;
}

export interface ClientOptions {
  /** Address of the service. Default: the server of the page. */
  baseUrl?: string;
  /** API key, or a function that returns the current one. */
  apiKey?: string | (() => string | null);
  /** Timeout of each attempt, its answer included. Default: 120 s. */
  timeoutMs?: number;
  /** Attempts of a request that is answered 429 or 503, the first included. Default: 4. */
  attempts?: number;
  /** Time after which no further attempt begins. Default: 60 s. */
  retryMs?: number;
  /** Called after 401 with its error; the request is sent again with the current key if it returns true. */
  onUnauthenticated?: (failure: ServiceError) => Promise<boolean>;
}

export interface CallOptions {
  signal?: AbortSignal | null;
  /** Overrides the client's; 0: no timeout. */
  timeoutMs?: number;
  /** Called as the upload proceeds, in browsers. */
  onProgress?: (sentBytes: number, totalBytes: number) => void;
  /** Called with every step of an import as it begins; a service of an older version calls it never. */
  onStep?: (step: ImportStep) => void;
}

/** Connection to a service. Every method throws `ServiceError`, or the reason of an aborted `signal`. */
export class Client {
  constructor(private readonly options: ClientOptions = {}) {}

  /** Send a request, again after 429 and 503 as the options allow; return an answer of success. */
  async request(path: string, init: RequestInit & CallOptions = {}): Promise<Response> {
    const begin = Date.now();
    for (let attempt = 1; ;) {
      const sent = this.key();
      const response = await endOf(await this.send(path, init, sent), init.onStep);
      if (response.ok || response.status === 304) return response;
      const failure = await ServiceError.of(response);
      if (response.status === 401 && (await this.hasNewKey(sent, failure))) continue;
      const isBusy = response.status === 429 || response.status === 503;
      const waitMs = isBusy ? this.waitMs(failure.retryAfterS, attempt++, Date.now() - begin) : null;
      if (waitMs === null) throw failure;
      await pause(waitMs, init.signal);
    }
  }

  /** Send a request and return the JSON of its answer. */
  async json<T>(path: string, init?: RequestInit & CallOptions): Promise<T> {
    return (await this.request(path, init)).json();
  }

  plans = (name = "", cursor: string | null = null) =>
    this.json<Schemas["FloorPlanList"]>(`/floorplans?${page(name, cursor)}`);
  plan = async (id: string, revision?: string) =>
    planOf(await this.request(of("floorplans", id, revisionQuery(revision))));
  layout = (id: string, revision?: string) =>
    this.json<Schemas["LayoutAnswer"]>(of("floorplans", id, `/layout${revisionQuery(revision)}`));
  /** Predict which photographs of a plan will be found; roughly, in a fifth of the time, if `coarse`. */
  localisability = (id: string, coarse = false, options: CallOptions = {}) =>
    this.json<Schemas["LocalisabilityAnswer"]>(
      of("floorplans", id, `/localisability${coarse ? "?coarse=true" : ""}`),
      options,
    );
  createPlan = async (plan: Schemas["FloorPlanDocument"]) =>
    planOf(await this.request("/floorplans", json("POST", plan)));
  /** Upload a plan as a file; `fields` are import options. */
  uploadPlan = async (file: Blob, fields: Text = {}, options: CallOptions = {}) =>
    planOf(await this.request("/floorplans", { ...options, ...form(fields, "file", file) }));
  /** Store a new revision; fails with 412 if `etag` is not that of the latest one. */
  replacePlan = async (id: string, plan: Schemas["FloorPlanDocument"], etag: string) =>
    planOf(await this.request(of("floorplans", id), json("PUT", plan, { "If-Match": etag })));
  deletePlan = (id: string) => this.delete(of("floorplans", id));
  /** Return the uploaded file of a plan's current revision. */
  original = async (id: string) => (await this.request(of("floorplans", id, "/original"))).blob();
  localise = (fields: Fields<"localise">, photo: Picture, options: CallOptions = {}) =>
    this.json<Schemas["LocaliseAnswer"]>("/localise", { ...options, ...query(fields, photo) });
  /** Localise a film of one slow turn on the spot. */
  localiseFilm = (fields: Fields<"localiseSequence">, film: Blob, options: CallOptions = {}) =>
    this.json<Schemas["SequenceAnswer"]>("/localise/sequence", {
      ...options,
      ...form({ ...fields, motion: "turn" }, "film", film),
    });
  /** Localise photographs of one visit, in the order in which they were taken; all of them as features, or none. */
  localiseSequence = (fields: Fields<"localiseSequence">, photos: Picture[], options: CallOptions = {}) =>
    this.json<Schemas["SequenceAnswer"]>("/localise/sequence", { ...options, ...query(fields, ...photos) });
  /**
   * Localise pictures that were taken while turning on the spot, such as frames of a film that were saved as images. Angles
   * that are all null follow from what photographs show twice; features have no pictures, so state theirs.
   */
  localiseTurn = (fields: Fields<"localiseSequence">, turn: TurnPicture[], options: CallOptions = {}) => {
    const known = turn.some(({ headingDeg }) => headingDeg !== null);
    const angles = known ? { relative_heading_deg: turn.map(({ headingDeg }) => headingDeg) } : {};
    const pictures = turn.map(({ picture }) => picture);
    return this.localiseSequence({ ...fields, motion: "turn", ...angles }, pictures, options);
  };
  /** Localise many photographs, each by itself; yield a line for each, in order, as they are computed. */
  async *localiseBatch(
    fields: Fields<"localiseBatch">,
    photos: Blob[],
    options: CallOptions = {},
  ): AsyncGenerator<Schemas["BatchLine"]> {
    // XMLHttpRequest would return all lines at the end.
    const init = { timeoutMs: 0, ...options, onProgress: undefined, ...form(fields, "photo", ...photos) };
    for await (const line of linesOf(await this.request("/localise/batch", init))) yield JSON.parse(line);
  }
  /** Return the answer to a query as a picture: the photograph with the layout, unless features are sent, and the plan with the place. */
  picture = async ({ include: _, ...fields }: Fields<"localise">, photo: Picture, options: CallOptions = {}) =>
    (await this.request("/localise", { ...options, ...query(fields, photo), headers: { Accept: "image/png" } })).blob();
  answer = (id: string) => this.json<Schemas["LocaliseAnswer"]>(of("answers", id));
  /** Begin a session, which follows one camera. */
  createSession = (session: Schemas["SessionDocument"]) =>
    this.json<Schemas["SessionAnswer"]>("/sessions", json("POST", session));
  session = (id: string) => this.json<Schemas["SessionAnswer"]>(of("sessions", id));
  /** Send the next photograph of a session, with the motion since the one before. */
  addPhotograph = (id: string, fields: Fields<"addPhotograph">, photo: Picture, options: CallOptions = {}) =>
    this.json<Schemas["SessionAnswer"]>(of("sessions", id, "/photographs"), { ...options, ...query(fields, photo) });
  albums = (name = "", cursor: string | null = null) =>
    this.json<Schemas["AlbumList"]>(`/albums?${page(name, cursor)}`);
  /** Create an album, whose photographs are pinned together. */
  createAlbum = (album: Schemas["AlbumDocument"]) => this.json<Schemas["AlbumAnswer"]>("/albums", json("POST", album));
  album = (id: string) => this.json<Schemas["AlbumAnswer"]>(of("albums", id));
  deleteAlbum = (id: string) => this.delete(of("albums", id));
  /** Add photographs to an album; yield a line for each, in order, as they are stored. The same picture is stored once.
   * Those that the service is too busy for are sent again, as the options allow; their lines come last. */
  async *addToAlbum(id: string, photos: Picture[], options: CallOptions = {}): AsyncGenerator<Schemas["AlbumLine"]> {
    let left = photos.map((_, index) => index);
    for (let attempt = 1, waitedMs = 0; left.length > 0; attempt++) {
      const sent = query({}, ...left.map((index) => photos[index]!));
      const init = { timeoutMs: 0, ...options, onProgress: undefined, ...sent };
      const busy: Schemas["AlbumLine"][] = [];
      for await (const text of linesOf(await this.request(of("albums", id, "/photographs"), init))) {
        const line = JSON.parse(text);
        line.index = left[line.index];
        if ((line.retry_after_s ?? null) === null) yield line;
        else busy.push(line);
      }
      const waitMs = this.waitMs(Math.max(0, ...busy.map((line) => line.retry_after_s!)), attempt, waitedMs);
      if (waitMs === null) yield* busy;
      left = waitMs === null ? [] : busy.map(({ index }) => index);
      if (left.length > 0) await pause(waitMs!, options.signal);
      waitedMs += waitMs ?? 0;
    }
  }
  /** Return the photographs of an album with their pins, at most 500. */
  albumPhotographs = (id: string) =>
    this.json<Schemas["AlbumPhotographList"]>(of("albums", id, "/photographs?limit=500"));
  /** Return the pins of an album as a file; a drawing of a venue needs a plan. */
  albumFile = async (id: string, media: "application/geo+json" | "text/csv" | "image/svg+xml", planId?: string) => {
    const path = `/photographs${planId ? `?floorplan_id=${encodeURIComponent(planId)}` : ""}`;
    return (await this.request(of("albums", id, path), { headers: { Accept: media } })).blob();
  };
  /** State where a photograph of an album was taken; null undoes it. The rest is then solved again. */
  correctPhotograph = (id: string, photographId: string, correction: Schemas["CorrectionDocument"] | null) =>
    this.json<Schemas["AlbumPhotographAnswer"]>(
      of("albums", id, `/photographs/${encodeURIComponent(photographId)}`),
      json("PATCH", { correction }),
    );
  deleteAlbumPhotograph = (id: string, photographId: string) =>
    this.delete(of("albums", id, `/photographs/${encodeURIComponent(photographId)}`));
  /** Return a file of the image encoder, with which devices compute features: `manifest.json`, `image_encoder.onnx`, `view_encoder.onnx`. */
  modelFile = async (name: string, options: CallOptions = {}) =>
    (await this.request(of("model", name), options)).arrayBuffer();
  /** Return the limits of the service. */
  limits = () => this.json<Schemas["LimitsAnswer"]>("/limits");
  deleteSession = (id: string) => this.delete(of("sessions", id));
  venues = (name = "", cursor: string | null = null) =>
    this.json<Schemas["VenueList"]>(`/venues?${page(name, cursor)}`);
  venue = (id: string) => this.json<Schemas["VenueSummary"]>(of("venues", id));
  /** Return the first page of a venue's plans, from the lowest level up. */
  venuePlans = (id: string) => this.json<Schemas["VenuePlanList"]>(of("venues", id, "/plans?limit=500"));
  createVenue = (name: string, plans: Schemas["VenuePlanDocument"][]) =>
    this.json<Schemas["VenueSummary"]>("/venues", json("POST", { name, plans }));
  /** Upload a file with several levels: each becomes a plan, and all of them a venue. */
  uploadLevels = (file: Blob, fields: Text = {}, options: CallOptions = {}) =>
    this.json<Schemas["VenueSummary"]>("/venues", { ...options, ...form(fields, "file", file) });

  private delete = async (path: string): Promise<void> => void (await this.request(path, { method: "DELETE" }));

  private key = (): string | null =>
    typeof this.options.apiKey === "function" ? this.options.apiKey() : (this.options.apiKey ?? null);

  private async hasNewKey(sent: string | null, failure: ServiceError): Promise<boolean> {
    const ask = this.options.onUnauthenticated;
    return ask !== undefined && ((this.key() !== null && this.key() !== sent) || ask(failure));
  }

  private async send(path: string, init: RequestInit & CallOptions, key: string | null): Promise<Response> {
    const { timeoutMs = this.options.timeoutMs ?? 120_000, onProgress, onStep, signal, ...rest } = init;
    const headers = new Headers(rest.headers);
    if (onStep) headers.set("Accept", `${NDJSON}, application/json;q=0.5`);
    if (key !== null) headers.set("Authorization", `Bearer ${key}`);
    const signals = [...(signal ? [signal] : []), ...(timeoutMs > 0 ? [AbortSignal.timeout(timeoutMs)] : [])];
    const request = { ...rest, headers, signal: AbortSignal.any(signals) };
    const url = (this.options.baseUrl ?? "").replace(/\/$/, "") + path;
    try {
      // XMLHttpRequest would return all lines at the end.
      return await (onProgress && !onStep && typeof XMLHttpRequest !== "undefined"
        ? upload(url, request, onProgress)
        : fetch(url, request));
    } catch {
      signal?.throwIfAborted();
      if (request.signal.aborted)
        throw new ServiceError(0, "The service took too long", `The limit is ${timeoutMs / 1000} s.`);
      throw new ServiceError(
        0,
        "The service does not answer",
        "Check that it is running and that the network works, then try again.",
      );
    }
  }

  /** Return the time until the next attempt; null if there is none. */
  private waitMs(retryAfterS: number | null, attempt: number, spentMs: number): number | null {
    const { attempts = 4, retryMs = 60_000 } = this.options;
    if (attempt >= attempts) return null;
    // Clients that failed together are spread.
    const waitMs = (retryAfterS === null ? 250 * 2 ** attempt : 1000 * retryAfterS) + 250 * Math.random();
    return spentMs + waitMs <= retryMs ? waitMs : null;
  }
}

const of = (collection: string, id: string, rest = ""): string => `/${collection}/${encodeURIComponent(id)}${rest}`;
const revisionQuery = (revision?: string): string => (revision ? `?revision=${encodeURIComponent(revision)}` : "");
const page = (name: string, cursor: string | null) =>
  new URLSearchParams({ limit: "50", ...(name && { name }), ...(cursor && { cursor }) });

async function planOf(response: Response): Promise<Plan> {
  return { ...(await response.json()), etag: response.headers.get("etag") ?? "" };
}

function json(method: string, document: unknown, headers: Text = {}): RequestInit {
  return { method, headers: { "Content-Type": "application/json", ...headers }, body: JSON.stringify(document) };
}

function query(fields: object, ...pictures: Picture[]): { method: string; body: FormData } {
  const { method, body } = form(fields, "photo");
  for (const picture of pictures) {
    if (picture instanceof Blob) body.append("photo", picture);
    else
      body.append(
        "features",
        picture.features,
        picture.features instanceof File ? picture.features.name : "photo.features",
      );
  }
  return { method, body };
}

function form(fields: object, name: string, ...files: Blob[]): { method: string; body: FormData } {
  const body = new FormData();
  for (const [field, value] of Object.entries(fields)) {
    if (value !== undefined && value !== null)
      body.set(field, typeof value === "object" ? JSON.stringify(value) : String(value));
  }
  for (const file of files) body.append(name, file);
  return { method: "POST", body };
}
