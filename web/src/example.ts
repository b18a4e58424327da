/** Example plans with photographs: a rendered flat, at first by a turn of a phone, and photographed rooms. */

import type { PlanDocument } from "./types";

export interface Example {
  plan: string;
  photos: readonly string[];
}

export const TURN: Example = { plan: "flat.json", photos: ["turn_1.jpg", "turn_2.jpg", "turn_3.jpg", "turn_4.jpg"] };
export const SPHERES: Example = {
  plan: "flat.json",
  photos: ["kitchen.jpg", "living_room.jpg", "bedroom.jpg", "study.jpg"],
};
export const ROOMS: Example = { plan: "rooms.json", photos: ["lythwood_room.jpg"] };

export async function examplePlan({ plan }: Example): Promise<PlanDocument> {
  return (await fetch(`/web/example-${plan}`)).json();
}

export async function exampleFiles({ photos }: Example): Promise<File[]> {
  return Promise.all(
    photos.map(async (name) => {
      const response = await fetch(`/web/example-${name}`);
      return new File([await response.blob()], name, { type: "image/jpeg" });
    }),
  );
}
