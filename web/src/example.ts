/** Example flat and its photographs, shown on the first visit. */

import type { PlanDocument } from "./types";

const PHOTOS = ["kitchen.jpg", "living_room.jpg", "bedroom.jpg", "study.jpg"];

/** Return the plan of the example flat. */
export async function examplePlan(): Promise<PlanDocument> {
  return (await fetch("/web/example-flat.json")).json();
}

/** Return the photographs of the example flat. */
export async function exampleFiles(): Promise<File[]> {
  return Promise.all(PHOTOS.map(async (name) => {
    const response = await fetch(`/web/example-${name}`);
    return new File([await response.blob()], name, { type: "image/jpeg" });
  }));
}
