/** Page at /pin: a plan or venue, a folder of photographs, and a pin for each. */

import { api, key } from "./api";
import { button, byId, download, h, named, s, show } from "./dom";
import { acceptChoice, acceptDrops, isPicture } from "./drops";
import { connectKeyDialog } from "./key_dialog";
import { attempt, connectNumbers, InputError, say } from "./notices";
import { type CardActions, cardOf, markCurrent, movedOf, sureOf, warningsOf } from "./pin_card";
import { type Drawn, drawn, keep } from "./pin_drawn";
import { Floors, folderOption, listPlaces, type Row } from "./pin_floors";
import { fanned, type PinActions, pinOf } from "./pin_map";
import { added, photographsOf, saveCopies, type Thumbnail, thumbnailOf, wantedOf } from "./pin_photographs";
import { showPages } from "./pin_print";
import { folderWords, plainWords } from "./plain_words";
import { boxOf, drawNames, drawPlan, lostAreas, unitOf } from "./plan_drawing";
import type { Plan } from "./types";
import type { Schemas } from "../../clients/typescript/src/index";
import { pause } from "../../clients/typescript/src/transport";

type Correction = Partial<Schemas["CorrectionDocument"]>;

const POLL_MS = 700;
const RADIUS = 1.5;
const OUTDATED = "by an earlier model; to pin them anew, choose the plan and add the photographs again";
const FILES = { GeoJSON: "application/geo+json", CSV: "text/csv", SVG: "image/svg+xml" } as const;
// Groups of the list, by the state of the pins.
const GROUPS = [
  ["To check", ["uncertain"]],
  ["Set aside", ["set_aside"]],
  ["Pinned", ["sure", "corrected"]],
  ["Waiting", ["waiting"]],
] as const;

class PinPage {
  private readonly svg = byId("plan") as unknown as SVGSVGElement;
  private readonly base = s("g");
  private readonly names = s("g");
  private readonly pins = s("g");
  private readonly error = byId("pin-error");
  private readonly filter = byId<HTMLSelectElement>("room-filter");
  private readonly choice = byId<HTMLSelectElement>("plan-choice");
  private readonly saved = h("optgroup", { label: "Saved folders" });
  private readonly levels = byId<HTMLSelectElement>("level-choice");
  private readonly thumbnails = new Map<string, Thumbnail>();
  private readonly files = new Map<string, File>();
  private readonly done: { id: string; before: Correction | null }[] = [];
  private readonly floors = new Floors();
  private readonly cards = new Map<string, Drawn<HTMLElement>>();
  private readonly drawnPins = new Map<string, Drawn<SVGElement | null>>();
  private shown: string | null = null;
  private requests = 0;
  private title = "";
  private reading = "";
  private waiting: File[] = [];
  private album: Schemas["AlbumAnswer"] | null = null;
  private rows: Row[] = [];
  private polling: Promise<void> | null = null;

  async start(): Promise<void> {
    connectKeyDialog();
    connectNumbers();
    this.svg.append(this.base, this.names, this.pins);
    this.choice.addEventListener("change", () => void this.guarded(() => this.choose(this.choice.value)));
    this.levels.addEventListener("change", () => void this.guarded(() => this.showPlan(this.levels.value)));
    acceptChoice(byId("plan-file"), ([file]) => void this.guarded(() => this.upload(file!)));
    for (const id of ["photo-files", "photo-folder"])
      acceptChoice(byId(id), (files) => void this.guarded(() => this.add(files)));
    acceptDrops(byId("folder"), (files) => void this.guarded(() => this.addAny(files)));
    acceptDrops(byId("place"), (files) => void this.guarded(() => this.addAny(files, files.length === 1)));
    this.filter.addEventListener("change", () => this.draw());
    byId("undo").addEventListener("click", () => void this.guarded(() => this.undo()));
    addEventListener("keydown", (event) => {
      if (event.key !== "z" || !(event.ctrlKey || event.metaKey) || event.target instanceof HTMLInputElement) return;
      event.preventDefault();
      void this.guarded(() => this.undo());
    });
    // The plan can have been changed in another tab.
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState === "visible") void this.guarded(() => this.refresh());
    });
    addEventListener("beforeprint", () => this.fillPages());
    addEventListener("beforeunload", (event) => this.reading !== "" && event.preventDefault());
    await this.guarded(() => this.begin());
  }

  /** List plans and venues; show the album that the address names, or the newest plan. */
  private async begin(): Promise<void> {
    for (const listRest of await listPlaces(this.choice, this.saved)) void this.guarded(listRest);
    const id = named("album");
    if (id !== null) await this.open(id);
    else if (this.choice.value.startsWith("plan:")) await this.choose(this.choice.value);
  }

  private readonly guarded = (work: () => Promise<void>): Promise<void> => attempt(this.error, work);

  /** Begin a choice; the returned function says whether it is still the last one: answers can overtake each other. */
  private request(): () => boolean {
    const number = ++this.requests;
    return () => number === this.requests;
  }

  /** Show a saved folder, unless another choice is made meanwhile. */
  private async open(id: string): Promise<void> {
    this.choice.value = `album:${id}`;
    const chosen = this.choice.value,
      album = await api.album(id);
    await this.choose(album.venue_id === null ? `plan:${album.floorplan_id}` : `venue:${album.venue_id}`);
    if (this.choice.value !== chosen) return;
    this.album = album;
    await this.polling;
    await this.follow();
  }

  private async choose(value: string): Promise<void> {
    const isLast = this.request(),
      [kind, id] = value.split(":") as [string, string];
    if (kind === "album") return this.open(id);
    if (kind === "plan") return this.take(await api.plan(id), isLast);
    const [venue, { plans }] = await Promise.all([api.venue(id), api.venuePlans(id)]);
    if (!isLast()) return;
    const first = this.floors.takeVenue(id, plans);
    if (first === null) throw new InputError(`The venue ${venue.name} has no plans.`);
    await this.reset(venue.name, first, isLast);
  }

  private async upload(file: File): Promise<void> {
    const before = this.shown,
      isLast = this.request();
    this.shown = null; // Photographs that are chosen meanwhile wait for this plan.
    const plan = await api.uploadPlan(file).finally(() => (this.shown = before));
    this.choice.prepend(h("option", { value: `plan:${plan.id}` }, plan.name));
    if (!isLast()) return;
    this.choice.selectedIndex = 0;
    await this.take(plan, isLast);
  }

  private async take(plan: Plan, isLast: () => boolean): Promise<void> {
    if (!isLast()) return;
    await this.floors.takePlan(plan);
    await this.reset(plan.name, plan.id, isLast);
  }

  /** Begin another album in a plan or venue, unless another one was chosen meanwhile. */
  private async reset(title: string, planId: string, isLast: () => boolean): Promise<void> {
    await this.floors.load([planId]);
    if (!isLast()) return;
    this.title = title;
    this.album = null;
    this.rows = [];
    this.cards.clear();
    this.drawnPins.clear();
    this.done.length = 0;
    history.replaceState(null, "", location.pathname);
    show(byId("problems"));
    show(this.levels, ...this.floors.names.map(([id, name]) => h("option", { value: id }, name)));
    this.levels.hidden = this.floors.venue === null;
    byId("pin-state").textContent = "";
    await this.showPlan(planId);
    await this.add(this.waiting.splice(0));
  }

  private async showPlan(id: string): Promise<void> {
    await this.floors.load([id]);
    const floor = this.floors.get(id);
    if (floor === null) return;
    this.shown = id;
    this.levels.value = id;
    const lost = lostAreas(floor.plan),
      box = boxOf(floor.plan.plan, lost);
    this.svg.setAttribute("viewBox", `${box.x} ${box.y} ${box.width} ${box.height}`);
    drawPlan(this.base, floor.plan.plan, lost);
    drawNames(this.names, floor.plan.plan, box, lost);
    const rooms = floor.plan.plan.rooms.map((room, index) =>
      h("option", { value: floor.layout.rooms[index]!.id }, room.name ?? `Room ${index + 1}`),
    );
    show(this.filter, h("option", { value: "" }, "all"), ...rooms);
    byId<HTMLAnchorElement>("edit-plan").href = `/#plan=${id}${key.inLinks()}`;
    byId("edit-plan").hidden = false;
    this.draw();
  }

  /** Take a plan, photographs, or both. */
  private async addAny(files: File[], isPlan = false): Promise<void> {
    const plans = isPlan ? files : files.filter((file) => !isPicture(file));
    const pictures = files.filter((file) => !plans.includes(file));
    if (plans.length === 1) await this.upload(plans[0]!);
    if (pictures.length > 0 || plans.length > 1) await this.add([...pictures, ...(plans.length > 1 ? plans : [])]);
  }

  /** Add files to the album, which is made for the first ones and named after their folder, else after the plan. */
  private async add(files: File[]): Promise<void> {
    const { photographs, note } = photographsOf(files);
    const tell = (text: string): void => byId("problems").append(h("li", {}, text));
    if (note !== null) tell(note);
    if (photographs.length === 0) return;
    if (this.shown === null) {
      this.waiting.push(...photographs);
      byId("pin-state").textContent = `Choose or upload a floor plan: ${this.waiting.length} photographs wait for it.`;
      return;
    }
    const place = this.floors.venue === null ? { floorplan_id: this.shown } : { venue_id: this.floors.venue };
    let album = this.album;
    if (album === null) {
      const name = photographs[0]!.webkitRelativePath.split("/")[0] || this.title;
      album = this.album = await api.createAlbum({ ...place, name } as Schemas["AlbumDocument"]);
      this.saved.prepend(folderOption(album));
      this.choice.append(this.saved);
      this.choice.value = `album:${album.id}`;
    }
    const most = (await api.limits()).max_album_photographs;
    const wanted = wantedOf(photographs, this.rows, most),
      left = photographs.length - wanted.length;
    if (left > 0) tell(`A folder has at most ${most} photographs; left out: ${left}. Choose the plan again for them.`);
    let sent = 0,
      copies = 0;
    try {
      for await (const { file, line } of added(album.id, wanted)) {
        if (typeof line === "string") tell(`${file.name}: ${line}`);
        else if (!line.photograph) tell(`${file.name}: ${folderWords(line.problem?.detail ?? "not added")}`);
        else {
          if (line.status === 200) copies++;
          // Features have no width: the service cannot tell whose they are.
          if (line.photograph.view.width !== null) this.files.set(line.photograph.id, file);
          const picture = this.thumbnails.has(line.photograph.id) ? null : await thumbnailOf(file);
          if (picture !== null) this.thumbnails.set(line.photograph.id, picture);
        }
        this.reading = `${++sent} of ${wanted.length} photographs read, `;
        byId("pin-state").textContent = `${this.reading}${sureOf(this.rows)} pinned for sure`;
        if (sent % 5 === 0) void this.guarded(() => this.follow());
      }
    } finally {
      this.reading = "";
    }
    if (copies > 0) tell(`Photographs that the folder has already: ${copies}`);
    await this.polling;
    await this.follow();
  }

  /** Read the pins until they are those of the latest change. */
  private follow(): Promise<void> {
    return (this.polling ??= this.poll().finally(() => (this.polling = null)));
  }

  private async poll(): Promise<void> {
    for (let album = this.album, seen = ""; album !== null && album.id === this.album?.id; await pause(POLL_MS)) {
      const now = await api.album(album.id);
      const key = [now.revision, now.solved_revision_number, now.place_revision].join();
      const photographs = key === seen ? this.rows : (await api.albumPhotographs(album.id)).photographs;
      seen = key;
      const places = photographs.flatMap(({ pin }) => [pin?.place ?? [], pin?.suggestions ?? []].flat());
      await this.floors.load(places.map((place) => place.floorplan_id));
      if (album.id !== this.album?.id) return;
      [this.album, this.rows] = [now, photographs];
      history.replaceState(null, "", `#album=${now.id}`);
      const state = now.state === "outdated" ? OUTDATED : plainWords(now.reason ?? now.state);
      if (this.reading === "")
        byId("pin-state").textContent =
          `${sureOf(this.rows)} of ${now.photographs} photographs pinned for sure (${state})`;
      this.draw();
      if (now.state !== "solving") return;
    }
  }

  private async refresh(): Promise<void> {
    if (!(await this.floors.refresh()) || this.shown === null) return;
    this.cards.clear();
    await this.showPlan(this.shown);
    await this.follow();
  }

  private readonly actions: CardActions = {
    choose: (row, { floorplan_id, position, heading_deg }, isKey) =>
      this.state(row, { floorplan_id, position: { x_m: position.x_m, y_m: position.y_m }, heading_deg }, isKey),
    elsewhere: (row, isKey) => this.state(row, { elsewhere: true }, isKey),
    confirm: (row, isKey) => this.state(row, { confirmed: true }, isKey),
    restore: (row) => this.state(row, null, false),
    show: (row) => this.mark(row),
  };

  /** Correct a photograph; by key, go on to the next one. */
  private state(row: Row, correction: Correction | null, isKey: boolean): void {
    void this.guarded(async () => {
      await this.correct(row, correction);
      if (isKey)
        (document.querySelector<HTMLElement>("#photographs .uncertain .card") ?? byId<HTMLElement>("undo")).focus();
    });
  }

  private async correct(row: Row, correction: Correction | null, isUndo = false): Promise<void> {
    if (this.album === null) return;
    await api.correctPhotograph(this.album.id, row.id, correction as Schemas["CorrectionDocument"] | null);
    if (!isUndo) this.done.push({ id: row.id, before: row.correction });
    byId<HTMLButtonElement>("undo").disabled = this.done.length === 0;
    await this.polling;
    await this.follow();
  }

  private async undo(): Promise<void> {
    const last = this.done.pop();
    const row = this.rows.find(({ id }) => id === last?.id);
    if (row === undefined) return;
    await this.correct(row, last!.before, true);
    say("Undone.");
  }

  private draw(): void {
    const room = this.filter.value;
    const shown = this.rows.filter(
      ({ pin }) => room === "" || (pin?.place?.room_id === room && pin.place.floorplan_id === this.shown),
    );
    const focused = document.activeElement?.id;
    keep(
      this.pins,
      this.shown === null ? [] : this.pinsOf(shown, this.shown, { move: this.move, show: this.actions.show }),
    );
    const groups = GROUPS.flatMap(([title, states]) => {
      const own = shown.filter(({ pin }) => (states as readonly string[]).includes(pin?.state ?? "waiting"));
      if (own.length === 0) return [];
      return [h("h3", {}, `${title} (${own.length})`), h("ul", {}, ...own.map((row) => this.card(row)))];
    });
    show(byId("photographs"), ...groups);
    if (focused && document.activeElement?.id !== focused)
      document.getElementById(focused)?.focus({ preventScroll: true });
    const moved = this.rows.map(movedOf).filter((text) => text !== null);
    byId("moved").hidden = moved.length === 0;
    show(byId("moved-list"), ...moved.map((text) => h("li", {}, text)));
    const warnings = [...(this.album?.solution?.warnings ?? []).map(plainWords), ...warningsOf(this.rows)];
    show(byId("album-warnings"), ...warnings.map((text) => h("li", {}, text)));
    byId("keys").hidden = this.rows.length === 0;
    this.drawExports();
  }

  private drawExports(): void {
    const place = byId("exports");
    place.hidden = this.rows.length === 0;
    if (place.childElementCount > 0) return;
    const save = async (name: string, kind: (typeof FILES)[keyof typeof FILES]): Promise<void> => {
      const plan = kind === FILES.SVG && this.floors.venue !== null ? this.shown : null;
      download(await api.albumFile(this.album!.id, kind, plan ?? undefined), `pins.${name.toLowerCase()}`);
    };
    const all = Object.entries(FILES);
    const kinds = all.map(([name, kind]) => button(name, () => void this.guarded(() => save(name, kind))));
    const copy = (): Promise<void> => saveCopies(this.album!.id, this.rows, this.files);
    kinds.push(button("Print", () => print()));
    kinds.push(button("Copies with their place, and a report", () => void this.guarded(copy)));
    show(place, ...kinds);
  }

  /** Return the pins in a plan; without actions, for paper. */
  private pinsOf(rows: Row[], planId: string, act: PinActions | null = null): SVGElement[] {
    const floor = this.floors.get(planId);
    if (floor === null) return [];
    const radius = RADIUS * unitOf(boxOf(floor.plan.plan));
    const own = rows.filter(({ pin }) => pin?.place?.floorplan_id === planId);
    const seen = fanned(own, radius);
    const pins = own.map((row, index) => {
      const make = () => pinOf(row, seen[index]!, radius, this.svg, act);
      return act === null ? make() : drawn(this.drawnPins, row.id, [row.pin, seen[index], radius], make);
    });
    return pins.filter((pin) => pin !== null);
  }

  private readonly move = (row: Row, [x_m, y_m]: [number, number], heading_deg: number | null): void => {
    const floorplan_id = this.shown!;
    void this.guarded(async () => {
      try {
        await this.correct(row, { position: { x_m, y_m }, heading_deg, floorplan_id } as Correction);
      } catch (failure) {
        // Back to where it was.
        this.drawnPins.delete(row.id);
        this.draw();
        throw failure;
      }
    });
  };

  private card(row: Row): HTMLElement {
    const picture = this.thumbnails.get(row.id) ?? null;
    const height = this.album?.solution?.camera_height_m ?? null;
    return drawn(this.cards, row.id, [row.revision, row.pin, picture?.url, height], () =>
      cardOf(row, picture, this.floors, height, this.actions),
    );
  }

  /** Show the plan of a photograph, and mark its pin and card. */
  private mark(row: Row): void {
    const planId = row.pin?.place?.floorplan_id;
    const marked = (): void => markCurrent(row.number);
    if (planId && planId !== this.shown && this.filter.value === "") void this.showPlan(planId).then(marked);
    else marked();
  }

  private fillPages(): void {
    const height = this.album?.solution?.camera_height_m ?? null;
    const pins = (rows: Row[], planId: string): SVGElement[] => this.pinsOf(rows, planId);
    showPages(byId("pages"), this.title, this.rows, this.floors, this.thumbnails, height, pins);
  }
}

void new PinPage().start();
