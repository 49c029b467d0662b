// Table of the services' health.

import { $, element, say } from "./element.js";
import { seconds } from "./words.js";

const body = $("#health tbody");

export function drawHealth({ services }) {
  if (body.children.length !== services.length) {
    const rows = services.map(({ name }) => element("tr", {}, element("th", { scope: "row" }, name)));
    for (const row of rows) row.append(...Array.from({ length: 4 }, () => element("td")));
    body.replaceChildren(...rows);
  }
  services.forEach((one, k) => {
    const [name, health, idle, sends, lost] = body.children[k].children;
    say(name, one.name);
    health.className = one.ailment ? "bad" : "good";
    say(health, one.ailment ?? "works");
    say(idle, one.idle === undefined ? "–" : `${seconds(one.idle)} ago`);
    say(sends, Object.entries(one.rates ?? {}).map(([topic, rate]) => `${topic} ${rate} Hz`).join(", ") || "–");
    say(lost, one.idle === undefined ? "–" : losses(one) || "0");
  });
}

function losses({ dropped, bad, failed }) {
  const counts = Object.entries({ dropped, malformed: bad, failed }).filter(([, count]) => count > 0);
  return counts.map(([how, count]) => `${count} ${how}`).join(", ");
}
