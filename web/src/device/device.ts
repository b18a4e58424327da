/** Box “Keep this photograph on my device”: features are computed in a worker and sent instead of photographs. */

import type { Picture } from "../../../clients/typescript/src/index";
import { api, ServiceError } from "../api";
import { byId } from "../dom";
import { InputError } from "../notices";
import type { Stated } from "./lens";
import type { Manifest } from "./model";
import type { Result, Task } from "./worker";

const WORKER = "/web/on_device.js",
  KEPT = "lalaloc-on-device";
// Fields that features contain; queries with features refuse them.
const CAMERA = ["projection", "hfov_deg", "pitch_deg", "roll_deg"] as const;
const LOADING = "Loading the image encoder (once)…",
  COMPUTING = "Computing the features…";

/** Return the fields that a query with features has, and those about the camera. */
export function splitFields(fields: Readonly<Record<string, string>>): {
  query: Record<string, string>;
  stated: Stated;
} {
  const isStated = ([name]: [string, string]): boolean => (CAMERA as readonly string[]).includes(name);
  const all = Object.entries(fields);
  return {
    query: Object.fromEntries(all.filter((pair) => !isStated(pair))),
    stated: Object.fromEntries(all.filter(isStated)),
  };
}

class Device {
  private readonly box = byId<HTMLInputElement>("on-device");
  private readonly state = byId("on-device-state");
  private started: Promise<void> | null = null;
  private worker: Worker | null = null;
  private manifest: Promise<Manifest> | null = null;
  /** Features of photographs, by their statements and model. */
  private known = new WeakMap<File, { stated: string; features: Blob }>();
  /** Photographs are encoded one after the other. */
  private last: Promise<unknown> = Promise.resolve();

  constructor() {
    this.box.checked = localStorage.getItem(KEPT) !== null;
    this.box.addEventListener("change", () => {
      if (this.box.checked) localStorage.setItem(KEPT, "yes");
      else localStorage.removeItem(KEPT);
      this.describe();
    });
    this.describe();
  }

  /** True if photographs must not be sent. */
  get isOn(): boolean {
    return this.box.checked;
  }

  /** Tick and lock the box if the service takes features only; nothing is sent before that is known. */
  start(): Promise<void> {
    return (this.started ??= api.limits().then(
      ({ require_features: isRequired }) => {
        if (isRequired) this.box.checked = this.box.disabled = true;
        this.describe();
      },
      (error: unknown) => {
        this.started = null;
        throw error;
      },
    ));
  }

  /**
   * Send a query with photographs, or with their features; once more if the service has got another model meanwhile.
   * `send` takes pictures, and the fields of the query that belong to them.
   */
  async send<T>(
    files: File[],
    fields: Readonly<Record<string, string>>,
    send: (pictures: Picture[], fields: Record<string, string>) => Promise<T>,
  ): Promise<T> {
    await this.start();
    if (!this.isOn) return send(files, { ...fields });
    const { query, stated } = splitFields(fields);
    for (let isRepeated = false; ; isRepeated = true) {
      const pictures: Picture[] = [];
      for (const file of files) pictures.push({ features: await this.features(file, stated) });
      try {
        return await send(pictures, query);
      } catch (error) {
        if (!(error instanceof ServiceError) || error.slug !== "foreign-features") throw error;
        this.manifest = null;
        this.known = new WeakMap();
        if (isRepeated) throw error;
      }
    }
  }

  /** Return the features of a photograph. */
  private features(file: File, stated: Stated): Promise<Blob> {
    const next = this.last
      .catch(() => undefined)
      .then(async () => {
        const statements = JSON.stringify(stated),
          known = this.known.get(file);
        if (known?.stated === statements) return known.features;
        const features = new Blob([await this.encoded(file, stated)]);
        this.known.set(file, { stated: statements, features });
        return features;
      });
    this.last = next;
    return next;
  }

  private async encoded(file: File, stated: Stated): Promise<Uint8Array<ArrayBuffer>> {
    if (typeof OffscreenCanvas === "undefined" || typeof DecompressionStream === "undefined") {
      throw new InputError(
        "This browser is too old to compute features. Update it, or use the command line (lalaloc encode).",
      );
    }
    try {
      this.describe(this.manifest === null ? LOADING : COMPUTING);
      this.manifest ??= api
        .modelFile("manifest.json")
        .then((content) => JSON.parse(new TextDecoder().decode(content)) as Manifest);
      return await this.work({ kind: "encode", file, stated, manifest: await this.manifest });
    } catch (error) {
      this.manifest = null;
      throw error;
    } finally {
      this.describe();
    }
  }

  /** Give the worker a photograph, and the files that it needs. */
  private work(task: Task): Promise<Uint8Array<ArrayBuffer>> {
    const worker = (this.worker ??= new Worker(WORKER, { type: "module" }));
    return new Promise((done, fail) => {
      const give = (message: Task, parts: Transferable[]): void => worker.postMessage(message, parts);
      const stop = (error: unknown): void => {
        // A worker that waits for a file, or has failed, does not go on.
        worker.terminate();
        this.worker = null;
        fail(error);
      };
      worker.onerror = (event) =>
        stop(new Error(`the features could not be computed: ${event.message || "the worker did not start"}`));
      worker.onmessage = ({ data }: MessageEvent<Result>) => {
        if (data.kind === "done") done(data.features);
        else if (data.kind === "failed" && data.isInput) fail(new InputError(data.message));
        else if (data.kind === "failed") stop(new Error(data.message));
        else {
          this.describe(LOADING);
          api.modelFile(data.name).then((content) => {
            this.describe(COMPUTING);
            give({ kind: "file", content }, [content]);
          }, stop);
        }
      };
      give(task, []);
    });
  }

  private describe(progress: string | null = null): void {
    const locked = this.box.disabled ? "This service takes no photographs. " : "";
    this.state.textContent = !this.isOn
      ? ""
      : (progress ??
        `${locked}Only features are sent: the room’s shape, doors, windows and type, objects that tell the type, and the camera’s lens and tilt. The first photograph loads 11 to 19 MB.`);
  }
}

export const device = new Device();
