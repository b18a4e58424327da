"use strict";

const element = (id) => document.getElementById(id);

function say(text, fault) {
  element("state").textContent = text;
  element("state").className = fault ? "fault" : "";
}

async function call(path, options) {
  const response = await fetch(path, options);
  const answer = await response.json();
  if (!response.ok) throw new Error(`${answer.title}: ${answer.detail}`);
  return answer;
}

async function listPlans(chosen) {
  const { floorplans } = await call("/floorplans?limit=500");
  element("plans").replaceChildren(...floorplans.map((plan) =>
    new Option(`${plan.name} (${plan.rooms} rooms, ${plan.area_m2.toFixed(1)} m², ${plan.status})`, plan.id)));
  if (chosen) element("plans").value = chosen;
  showPreview();
}

function showPreview(answer) {
  const id = element("plans").value;
  element("preview").hidden = !id;
  element("answer").hidden = !answer;
  if (!id) return;
  const marker = new URLSearchParams(answer ? {
    x_m: answer.position.x_m, y_m: answer.position.y_m, heading_deg: answer.heading_deg } : {});
  const [[xx, xy], [, yy]] = answer?.covariance_m2 ?? [[], []];
  if (xx !== undefined) [xx, xy, yy].forEach((value) => marker.append("covariance_m2", value));
  element("preview").src = `/floorplans/${encodeURIComponent(id)}/preview.svg?${marker}`;
  if (answer) element("answer").textContent = JSON.stringify(answer, null, 2);
}

async function attempt(work) {
  try {
    say("…");
    await work();
  } catch (error) {
    say(error.message, true);
  }
}

element("upload").addEventListener("submit", (event) => {
  event.preventDefault();
  attempt(async () => {
    const plan = await call("/floorplans", { method: "POST", body: new FormData(event.target) });
    await listPlans(plan.id);
    say(`“${plan.name}” is stored.`);
  });
});

element("query").addEventListener("submit", (event) => {
  event.preventDefault();
  attempt(async () => {
    const body = new FormData(event.target);
    body.append("floorplan_id", element("plans").value);
    const answer = await call("/localise", { method: "POST", body });
    showPreview(answer);
    const { x_m, y_m } = answer.position;
    const sure = answer.confidence === null ? "" : `, confidence ${Math.round(100 * answer.confidence)} %`;
    const turn = answer.heading_std_deg === null ? "" : ` ± ${answer.heading_std_deg.toFixed(1)}`;
    say(`${answer.room}: x ${x_m.toFixed(2)} m, y ${y_m.toFixed(2)} m, heading ${answer.heading_deg.toFixed(1)}${turn}°${sure}`);
  });
});

element("plans").addEventListener("change", () => showPreview());
attempt(async () => { await listPlans(); say(""); });
