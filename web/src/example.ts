/** What the first visitor finds: a flat and photographs of it. */

import type { PlanDocument } from "./types";

const PHOTOS = ["kitchen.jpg", "living_room.jpg", "bedroom.jpg", "study.jpg"];

/** The plan of the example flat. */
export async function examplePlan(): Promise<PlanDocument> {
  return (await fetch("/web/example-flat.json")).json();
}

/** Its photographs. */
export async function exampleFiles(): Promise<File[]> {
  return Promise.all(PHOTOS.map(async (name) => {
    const response = await fetch(`/web/example-${name}`);
    return new File([await response.blob()], name, { type: "image/jpeg" });
  }));
}
