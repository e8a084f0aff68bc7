// The list of events, newest first.

import { by, category, clock, make } from "./format.js";

const SHOWN = 200;
const seen = new Set();

export function showEvent(event) {
  if (seen.has(event.id)) return;
  seen.add(event.id);
  by("no-events").hidden = true;
  const line = make("li", { className: category(event.kind) },
    make("time", { dateTime: event.time }, clock(event.time)),
    make("span", { className: "kind" }, event.joint ? `${event.kind} · ${event.joint}` : event.kind),
    make("div", { className: "text" }, event.text));
  line.dataset.kind = event.kind;
  line.dataset.id = event.id;
  if (Object.keys(event.evidence).length) {
    line.lastChild.append(make("details", {}, make("summary", {}, "evidence"), make("pre", {}, JSON.stringify(event.evidence, null, 1))));
  }
  const list = by("events");
  list.prepend(line);
  while (list.children.length > SHOWN) list.lastElementChild.remove();
}
