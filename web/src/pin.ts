/** Page at /pin: a plan, a folder of photographs, and a pin for each. */

import { api, ServiceError } from "./api";
import { throughCamera } from "./camera";
import { ARROWS, button, byId, download, followPointer, h, s, show } from "./dom";
import { connectKeyDialog } from "./key_dialog";
import { degrees, layoutLines, radians } from "./layout";
import { clearError, say, showError } from "./notices";
import { acceptDrops } from "./photos";
import { boxOf, drawNames, drawPlan, lostAreas, path } from "./plan_drawing";
import { placeOf } from "./pose_marker";
import { equirectangular } from "./projection";
import type { Layout, Plan, Point } from "./types";
import type { Schemas } from "../../clients/typescript/src/index";

type Row = Schemas["AlbumPhotographAnswer"];
type Correction = Schemas["CorrectionDocument"];
type Place = Schemas["PinPlace"];

const POLL_MS = 700;
const AT_ONCE = 20;
const STEP_M = 0.25;
const TURN_DEG = 15;
const RADIUS = 0.2;
const SHOWN = { width: 400, height: 300 };
const percent = (share: number): string => `${Math.round(100 * share)} %`;
const wait = (milliseconds: number): Promise<void> => new Promise((done) => setTimeout(done, milliseconds));
const FILES = { GeoJSON: "application/geo+json", CSV: "text/csv", SVG: "image/svg+xml" } as const;

class PinPage {
  private readonly svg = byId("plan") as unknown as SVGSVGElement;
  private readonly base = s("g");
  private readonly names = s("g");
  private readonly pins = s("g");
  private readonly error = byId("pin-error");
  private readonly filter = byId<HTMLSelectElement>("room-filter");
  private readonly thumbnails = new Map<string, { url: string; width: number; height: number }>();
  private readonly done: { id: string; before: Correction | null }[] = [];
  private plan: Plan | null = null;
  private layout: Layout | null = null;
  private album: string | null = null;
  private rows: Row[] = [];
  private polling = false;

  async start(): Promise<void> {
    connectKeyDialog();
    this.svg.append(this.base, this.names, this.pins);
    const choice = byId<HTMLSelectElement>("plan-choice");
    choice.addEventListener("change", () => void this.guarded(async () => this.take(await api.plan(choice.value))));
    this.onFiles("plan-file", async ([file]) => this.take(await api.uploadPlan(file!)));
    for (const id of ["photo-files", "photo-folder"]) this.onFiles(id, (files) => this.add(files));
    acceptDrops(byId("folder"), (files) => void this.guarded(() => this.add(files)));
    acceptDrops(byId("place"), (files) => void this.guarded(async () => this.take(await api.uploadPlan(files[0]!))));
    this.filter.addEventListener("change", () => this.draw());
    byId("undo").addEventListener("click", () => void this.guarded(() => this.undo()));
    await this.guarded(async () => {
      const { floorplans } = await api.plans();
      show(choice, ...floorplans.map((plan) => h("option", { value: plan.id }, plan.name)));
      if (floorplans.length > 0) await this.take(await api.plan(floorplans[0]!.id));
    });
  }

  private onFiles(id: string, act: (files: File[]) => Promise<void>): void {
    const input = byId<HTMLInputElement>(id);
    input.addEventListener("change", () => {
      const files = [...(input.files ?? [])];
      input.value = "";
      if (files.length > 0) void this.guarded(() => act(files));
    });
  }

  private async guarded(work: () => Promise<void>): Promise<void> {
    clearError(this.error);
    try {
      await work();
    } catch (failure) {
      showError(this.error, failure);
    }
  }

  /** Show a plan; another plan begins another album. */
  private async take(plan: Plan): Promise<void> {
    this.plan = plan;
    this.layout = await api.layout(plan.id);
    this.album = null;
    this.rows = [];
    this.done.length = 0;
    const box = boxOf(plan.plan, lostAreas(plan));
    this.svg.setAttribute("viewBox", `${box.x} ${box.y} ${box.width} ${box.height}`);
    drawPlan(this.base, plan.plan, lostAreas(plan));
    drawNames(this.names, plan.plan, box, lostAreas(plan));
    const rooms = plan.plan.rooms.map((room, index) =>
      h("option", { value: this.layout!.rooms[index]!.id }, room.name ?? `Room ${index + 1}`),
    );
    show(this.filter, h("option", { value: "" }, "all"), ...rooms);
    this.draw();
  }

  /** Add files to the album of the plan, a few at a time. */
  private async add(files: File[]): Promise<void> {
    if (this.plan === null) throw new Error("Choose or upload a floor plan first.");
    this.album ??= (await api.createAlbum({ floorplan_id: this.plan.id, name: this.plan.name })).id;
    const pictures = files.filter((file) => file.size > 0 && !file.name.startsWith("."));
    for (let first = 0; first < pictures.length; first += AT_ONCE) {
      const part = pictures.slice(first, first + AT_ONCE);
      for await (const line of api.addToAlbum(this.album, part)) {
        const file = part[line.index]!;
        if (line.photograph) await this.keep(line.photograph.id, file);
        else byId("problems").append(h("li", {}, `${file.name}: ${line.problem?.detail ?? "not added"}`));
        byId("pin-state").textContent = `${first + line.index + 1} of ${pictures.length} photographs sent`;
      }
      void this.follow();
    }
  }

  private async keep(id: string, file: File): Promise<void> {
    if (this.thumbnails.has(id)) return;
    try {
      const picture = await createImageBitmap(file);
      this.thumbnails.set(id, { url: URL.createObjectURL(file), width: picture.width, height: picture.height });
      picture.close();
    } catch {
      // A kind of picture that the browser does not show.
    }
  }

  /** Read the pins until they are those of the latest change. */
  private async follow(): Promise<void> {
    if (this.polling) return;
    this.polling = true;
    try {
      for (let state = "solving"; state === "solving" && this.album !== null;) {
        const album = await api.album(this.album);
        state = album.state;
        this.rows = (await api.albumPhotographs(this.album)).photographs;
        const sure = this.rows.filter(({ pin }) => pin?.state === "sure" || pin?.state === "corrected").length;
        const what = state === "failed" ? (album.reason ?? "failed") : state;
        byId("pin-state").textContent = `${sure} of ${album.photographs} photographs pinned for sure (${what})`;
        this.draw();
        if (state === "solving") await wait(POLL_MS);
      }
    } catch (failure) {
      if (failure instanceof ServiceError) showError(this.error, failure);
      else throw failure;
    } finally {
      this.polling = false;
    }
  }

  private async correct(row: Row, correction: Correction | null, isUndo = false): Promise<void> {
    if (!isUndo) this.done.push({ id: row.id, before: row.correction });
    await api.correctPhotograph(this.album!, row.id, correction);
    byId<HTMLButtonElement>("undo").disabled = this.done.length === 0;
    await this.follow();
  }

  private async undo(): Promise<void> {
    const last = this.done.pop();
    const row = this.rows.find(({ id }) => id === last?.id);
    if (row === undefined) return;
    await this.correct(row, last!.before, true);
    say("Undone.");
  }

  private moveTo(row: Row, [x_m, y_m]: Point, heading_deg: number | null): void {
    void this.guarded(() => this.correct(row, { position: { x_m, y_m }, heading_deg } as Correction));
  }

  private draw(): void {
    const room = this.filter.value;
    const shown = this.rows.filter(({ pin }) => room === "" || pin?.place?.room_id === room);
    const focused = document.activeElement?.id;
    show(this.pins, ...shown.map((row) => this.pinOf(row)));
    const rank = ({ pin }: Row): number => (pin?.state === "uncertain" ? 0 : pin?.state === "set_aside" ? 1 : 2);
    const sorted = [...shown].sort((a, b) => rank(a) - rank(b) || a.number - b.number);
    show(byId("photographs"), ...sorted.map((row) => this.card(row)));
    if (focused) document.getElementById(focused)?.focus({ preventScroll: true });
    byId("exports").hidden = this.rows.length === 0;
    const kinds = Object.entries(FILES).map(([name, media]) =>
      button(name, () => {
        void this.guarded(async () => download(await api.albumFile(this.album!, media), `pins.${name.toLowerCase()}`));
      }),
    );
    show(
      byId("exports"),
      ...kinds,
      button("Print", () => print()),
    );
  }

  /** Return the pin of a photograph: drag it, or move it by arrow keys; Page Up and Page Down turn its arrow. */
  private pinOf(row: Row): SVGElement | null {
    const place = row.pin?.place;
    if (!place || place.floorplan_id !== this.plan?.id) return null;
    const { x_m, y_m } = place.position;
    const heading = place.heading_deg;
    const tip = `M${-0.8 * RADIUS} ${-0.7 * RADIUS}L0 ${-2.6 * RADIUS}L${0.8 * RADIUS} ${-0.7 * RADIUS}Z`;
    const arrow = heading === null ? null : s("path", { d: tip, transform: `rotate(${heading})` });
    const label = `Photograph ${row.number}, ${place.room}, ${row.pin!.state}, ${percent(row.pin!.confidence)}`;
    const pin = s(
      "g",
      { class: `pin ${row.pin!.state}`, id: `pin-${row.number}`, tabindex: 0, role: "button", "aria-label": label },
      arrow,
      s("circle", { r: RADIUS }),
      s("text", { y: 0.08 }, row.number),
    );
    const put = ([x, y]: Point): void => pin.setAttribute("transform", `translate(${x} ${-y})`);
    put([x_m, y_m]);
    pin.addEventListener("pointerdown", (event) => {
      let target: Point | null = null;
      followPointer((moved) => put((target = placeOf(this.svg, moved))));
      addEventListener("pointerup", () => target && this.moveTo(row, target, heading), { once: true });
      event.preventDefault();
      pin.focus();
    });
    pin.addEventListener("keydown", (event) => {
      const step = ARROWS[event.key];
      if (step) this.moveTo(row, [x_m + STEP_M * step[0], y_m + STEP_M * step[1]], heading);
      else if (event.key === "PageUp" || event.key === "PageDown")
        this.moveTo(row, [x_m, y_m], ((heading ?? 0) + (event.key === "PageUp" ? TURN_DEG : 360 - TURN_DEG)) % 360);
      else return;
      event.preventDefault();
    });
    return pin;
  }

  private card(row: Row): HTMLElement {
    const { pin } = row;
    const facts =
      pin === null
        ? "waiting"
        : `${pin.place?.room ?? "no room"}, ${percent(pin.confidence)}${pin.reason && `: ${pin.reason}`}`;
    const choices = pin === null || pin.state === "corrected" ? [] : pin.suggestions;
    return h(
      "li",
      { class: `card ${pin?.state ?? ""}` },
      this.shot(row, pin?.place ?? null),
      h(
        "div",
        {},
        h("strong", { class: "name" }, `${row.number} ${row.name ?? ""}`),
        h("p", {}, facts),
        h("p", { class: "hint" }, row.view.taken_at),
      ),
      h(
        "div",
        { class: "choices" },
        ...choices.map((place, index) => {
          const choose = (): void => this.moveTo(row, [place.position.x_m, place.position.y_m], place.heading_deg);
          const label = `Photograph ${row.number}: ${place.room}, ${percent(place.probability)}`;
          const key = h("button", {
            type: "button",
            id: `choice-${row.number}-${index}`,
            "aria-label": label,
            onclick: choose,
          });
          key.append(this.smallPlan(place), `${place.room} ${percent(place.probability)}`);
          return key;
        }),
        pin !== null &&
          pin.state !== "corrected" &&
          button("Elsewhere", () => void this.guarded(() => this.correct(row, { elsewhere: true } as Correction)), {
            id: `elsewhere-${row.number}`,
          }),
        row.correction !== null &&
          button("Remove the correction", () => void this.guarded(() => this.correct(row, null))),
      ),
    );
  }

  /** Return the thumbnail with the walls of a place drawn over it. */
  private shot(row: Row, place: Place | null): HTMLElement {
    const picture = this.thumbnails.get(row.id);
    if (!picture) return h("div", { class: "shot" });
    const size = { width: SHOWN.width, height: (SHOWN.width * picture.height) / picture.width };
    const over = s("svg", { viewBox: `0 0 ${size.width} ${size.height}`, "aria-hidden": true });
    const room = this.layout?.rooms.find(({ id }) => id === place?.room_id);
    if (place && room && place.heading_deg !== null) {
      const turn = radians(place.heading_deg!);
      const height = this.plan?.plan.camera_height_m ?? 1.5;
      const lines = layoutLines(place.position.x_m, place.position.y_m, room, height).map(({ points }) =>
        points.map(([azimuth, elevation]): Point => [
          radians(((degrees(azimuth - turn) + 540) % 360) - 180),
          elevation,
        ]),
      );
      const drawn =
        row.view.projection === "equirectangular" ? equirectangular(lines, size) : throughCamera(lines, row.view, size);
      over.append(s("path", { d: drawn.map((line) => `M${line.map((point) => point.join(" ")).join("L")}`).join("") }));
    }
    return h(
      "div",
      { class: "shot" },
      h("img", { src: picture.url, alt: row.name ?? `Photograph ${row.number}` }),
      over,
    );
  }

  private smallPlan(place: Place): SVGElement {
    const box = boxOf(this.plan!.plan);
    return s(
      "svg",
      { viewBox: `${box.x} ${box.y} ${box.width} ${box.height}`, "aria-hidden": true },
      s("path", {
        class: "solid",
        d: this.plan!.plan.rooms.map((room) => path(room.polygon)).join(""),
        fill: "none",
        "stroke-width": 0.1,
      }),
      s("circle", {
        class: "spot",
        cx: place.position.x_m,
        cy: -place.position.y_m,
        r: 0.05 * Math.max(box.width, box.height),
      }),
    );
  }
}

void new PinPage().start();
