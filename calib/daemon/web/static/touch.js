// What touches the arm: force and moment at the tool ten times per second, contacts and loads as they come.

import { by, clock, make, MISSING, put, signed } from "./format.js";
import { interval } from "./joints.js";

const MOST_CONTACTS = 10;
const toldContacts = new Set();

export function showExternal({ reason, events, wrench, load }) {
  put(by("no-external"), reason && `No external torque: ${reason}.`);
  by("touch").hidden = Boolean(reason);
  events.forEach(addContact);
  showWrench({ wrench, load });
}

export function showWrench({ wrench, load }) {
  put(by("touch-frame"), wrench ? `at ${wrench.joint}` : "");
  for (const quantity of ["force", "moment"]) {
    const cells = by("wrench").querySelector(`[data-wrench=${quantity}]`).querySelectorAll("td");
    cells.forEach((cell, axis) => {
      const value = wrench?.[quantity][axis] ?? null;
      const std = wrench?.[`${quantity}_std`][axis] ?? 0;
      interval(cell, value, std, 1, value !== null && Math.abs(value) > 1.96 * std);
    });
  }
  put(by("taken-up"), (load ?? null) === null ? MISSING : `${signed(load, 2)} kg`);
}

function contactWords({ kind, link, probability, least_force, mass, joints }) {
  const contact = `on link ${link} (${Math.round(100 * probability)} %), at least ${least_force.toFixed(1)} N`;
  const what = kind === "contact" ? contact : `${signed(mass, 2)} kg${kind === "contact or load" ? " if it is a load" : ""}`;
  return `${kind}: ${what}; joints ${joints.join(", ")}`;
}

export function addContact(contact) {
  const key = `${contact.time} ${contact.kind}`;
  if (toldContacts.has(key)) return; // by the stream, and by the answer
  toldContacts.add(key);
  by("no-contacts").hidden = true;
  const list = by("contacts");
  list.prepend(make("li", {}, make("time", { dateTime: contact.time }, clock(contact.time)), contactWords(contact)));
  while (list.children.length > MOST_CONTACTS) list.lastElementChild.remove();
}
