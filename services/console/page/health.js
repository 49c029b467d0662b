// How every service is, in a table, and in words where something is missing.

import { $, element, say, seconds } from "./element.js";

const body = $("#health tbody");

export function drawHealth({ services }) {
  const names = services.map(({ name }) => name).join();
  if (body.dataset.names !== names) {
    body.dataset.names = names;
    body.replaceChildren(...services.map(({ name }) => element("tr", {}, element("th", { scope: "row" }, name), ...Array.from({ length: 4 }, () => element("td")))));
  }
  services.forEach((one, k) => {
    const [health, idle, sends, lost] = body.children[k].querySelectorAll("td");
    health.className = one.ailment ? "bad" : "good";
    say(health, one.ailment ?? "works");
    say(idle, one.idle === undefined ? "–" : `${seconds(one.idle)} ago`);
    say(sends, Object.entries(one.rates ?? {}).filter(([, rate]) => rate > 0).map(([topic, rate]) => `${topic} ${rate} Hz`).join(", ") || "–");
    say(lost, one.dropped === undefined ? "–" : one.dropped + one.bad + one.failed === 0 ? "nothing" : [[one.dropped, "dropped"], [one.bad, "malformed"], [one.failed, "failed"]].filter(([count]) => count > 0).map(([count, how]) => `${count} ${how}`).join(", "));
  });
}

/** Who of those that something needs is ill, in words; nothing where all work. */
export function illness(health, needed) {
  const ill = health?.services.filter(({ name, ailment }) => ailment && needed.includes(name)) ?? [];
  return ill.map(({ name, ailment }) => `${name}: ${ailment}`).join(", ");
}
