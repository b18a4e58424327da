/** Pictures that lie below plans again without being asked for. */

import { api } from "../api";
import type { Plan } from "../types";
import type { Traced } from "./underlay";

// Note of reports without the angle, by which earlier versions turned the picture.
const TURNED = /\bturned by\b/;
const MAX_KEPT = 4;

export class TracedPictures {
  /** The latest pictures below plans that were stored on this page, by the ids of the plans. */
  private readonly kept = new Map<string, Traced>();

  /** Keep the picture below a plan that is stored. */
  keep(planId: string, traced: Traced | null): void {
    if (traced === null) return;
    this.kept.delete(planId);
    this.kept.set(planId, traced);
    for (const oldest of [...this.kept.keys()].slice(0, -MAX_KEPT)) this.kept.delete(oldest);
  }

  /** Return the picture that a plan was drawn over or read from; null if there is none, or its angle is unknown. */
  async of(plan: Plan): Promise<Traced | null> {
    const kept = this.kept.get(plan.id),
      report = plan.import_report;
    if (kept !== undefined) return kept;
    if (report?.format !== "picture") return null;
    const { metres_per_unit: metresPerPixel, turned_deg: turnedDeg } = report;
    if (turnedDeg === 0 && report.notes.some((note) => TURNED.test(note))) return null;
    return { file: await api.original(plan.id), name: plan.name, metresPerPixel, turnedDeg };
  }
}
