/** "Will it work here?": the probability by place that a photograph is found, as a layer of the map. */

import { api } from "./api";
import { button, byId, h, s, show } from "./dom";
import { type Cells, cellSize, cellsOf, roomPictures } from "./heat";
import { clearError, showError } from "./notices";
import { percent } from "./plain_words";
import type { Localisability, Plan } from "./types";

type Condition = keyof Localisability["probability"];

const PHOTOGRAPHS = {
  phone: "a phone photograph",
  three_phone: "three phone photographs from one spot, turning",
  sphere: "a 360° photograph",
};
// Places whose squared distance (m²) to a cell differs by less than this count about equally.
const SOFT_M2 = 1;
const OPACITY = 0.92;

export class LocalisabilityLayer {
  readonly element = s("g");
  private readonly panel = byId("localisability");
  private readonly open = button("Will it work here?", () => void this.toggle(), {
    id: "localisability-open",
    "aria-pressed": "false",
    title: "Shows where photographs will be found, predicted from the plan",
  });
  private readonly photograph = h(
    "select",
    { id: "localisability-photograph" },
    ...Object.entries(PHOTOGRAPHS).map(([value, label]) => h("option", { value }, label)),
  );
  private readonly known = h("input", { type: "checkbox", id: "localisability-heading" });
  private readonly share = h("p", { class: "share", role: "status" });
  private readonly state = h("span", {});
  private readonly progress = h(
    "p",
    { class: "hint progress", id: "localisability-progress", hidden: true },
    h("progress", { "aria-label": "Prediction" }),
    this.state,
  );
  private readonly advice = h("ul");
  private plan: Plan | null = null;
  private found: Localisability | null = null;
  /** Prediction under way. */
  private running: symbol | null = null;

  /** `store` returns the plan that is shown, stored if it is an example. */
  constructor(private readonly store: () => Promise<Plan>) {
    byId("map-actions").prepend(this.open);
    show(
      this.panel,
      h(
        "div",
        { class: "fields" },
        h("label", { for: this.photograph.id }, "Probability of finding"),
        this.photograph,
        h("label", { class: "inline" }, this.known, " heading known"),
      ),
      this.share,
      this.progress,
      h("span", { class: "ramp", "aria-hidden": "true" }),
      h("ul", { class: "ticks" }, ...["0 %", "50 %", "100 %"].map((tick) => h("li", {}, tick))),
      this.advice,
    );
    for (const field of [this.photograph, this.known]) field.addEventListener("change", () => this.draw());
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** Set the plan that is shown; the prediction of another revision is closed. */
  setPlan(plan: Plan | null): void {
    if (plan?.revision !== this.plan?.revision) {
      this.close();
      this.stop();
      this.found = null;
    }
    this.plan = plan;
    // The service predicts the current revision only.
    this.open.disabled = plan?.status === "superseded";
  }

  close(): void {
    this.panel.hidden = true;
    this.open.setAttribute("aria-pressed", "false");
    this.draw();
  }

  private async toggle(): Promise<void> {
    if (!this.panel.hidden) return this.close();
    if (this.running !== null) this.unfold();
    if (this.open.hasAttribute("aria-busy")) return;
    clearError(byId("plan-error"));
    this.open.setAttribute("aria-busy", "true");
    let { plan } = this,
      own: symbol | null = null;
    try {
      plan = await this.store();
      own = this.running = Symbol();
      this.open.setAttribute("aria-busy", "true");
      this.unfold();
      await this.predict(plan, own);
    } catch (error) {
      if (this.plan?.revision !== plan?.revision) return;
      if (this.found === null) this.close();
      showError(byId("plan-error"), error);
    } finally {
      if (this.running === own) this.stop();
    }
  }

  private unfold(): void {
    this.panel.hidden = false;
    this.open.setAttribute("aria-pressed", "true");
    this.draw();
  }

  /** Forget the prediction under way, which may be of another plan. */
  private stop(): void {
    this.running = null;
    this.progress.hidden = true;
    this.open.removeAttribute("aria-busy");
  }

  /** Predict roughly at first, in a fifth of the time, then fully; stop for another plan and if the user closes the map. */
  private async predict(plan: Plan, own: symbol): Promise<void> {
    for (const coarse of [true, false]) {
      if (this.found !== null && (coarse || !this.found.coarse)) continue;
      const found = await this.timed(coarse, own, api.localisability(plan.id, coarse));
      if (this.running !== own || this.plan?.revision !== found.revision) return;
      this.found = found;
      this.draw();
      if (this.panel.hidden) return;
    }
  }

  /** Show the step of a prediction and its seconds until it is there. */
  private async timed<T>(coarse: boolean, own: symbol, predicting: Promise<T>): Promise<T> {
    const begin = Date.now();
    const tell = (): void => {
      if (this.running !== own) return;
      const step = coarse ? "Step 1 of 2: a rough map" : "Step 2 of 2: more places; the map is rough as yet";
      this.state.textContent = `${step}, ${Math.round((Date.now() - begin) / 1000)} s`;
      this.progress.hidden = false;
    };
    tell();
    const ticking = setInterval(tell, 1000);
    try {
      return await predicting;
    } finally {
      clearInterval(ticking);
    }
  }

  private draw(): void {
    const { found, plan } = this,
      isShown = !this.panel.hidden && found !== null && plan !== null;
    // The map of an answer would cover it.
    byId("plan-panel").classList.toggle("predicted", isShown);
    if (!isShown) return [this.element, this.share, this.advice].forEach((part) => show(part));
    const heading = this.known.checked ? "known" : "unknown",
      condition = `${this.photograph.value}_${heading}_heading` as Condition;
    const within = Math.max(1, found.spacing_m);
    show(
      this.share,
      "In all of the plan: ",
      h("strong", {}, percent(found.probability[condition])),
      ` within ${within} m. Predicted ${found.coarse ? "roughly " : ""}from the plan, without any photograph.`,
    );
    show(this.advice, ...found.advice.map((sentence) => h("li", {}, `${sentence}.`)));
    const cell = cellSize(plan.plan);
    const fields = plan.plan.rooms.map((room, index) => {
      const cells = cellsOf(room, cell);
      return { ...cells, values: shadesOf(cells, found, found.rooms[index]!.id, condition) };
    });
    show(
      this.element,
      roomPictures("localisability", fields, () => OPACITY),
    );
  }
}

/** Return the probability of every cell, as in lalaloc_core/draw/heat.py: the mean of its room's places by distance. */
function shadesOf({ box, columns, rows }: Cells, found: Localisability, room: string, condition: Condition) {
  const shades = new Float64Array(columns * rows).fill(found.probability[condition]);
  const places = found.places.filter((place) => place.room === room);
  if (places.length === 0) return shades;
  return shades.map((_, index) => {
    const x = box.x + ((index % columns) + 0.5) * (box.width / columns);
    const y = -box.y - (Math.floor(index / columns) + 0.5) * (box.height / rows);
    let sum = 0,
      total = 0;
    for (const { x_m, y_m, probability } of places) {
      const weight = ((x_m - x) ** 2 + (y_m - y) ** 2 + SOFT_M2) ** -2;
      sum += weight * probability[condition];
      total += weight;
    }
    return sum / total;
  });
}
