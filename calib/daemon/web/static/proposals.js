// Proposals: pending ones, the confirmation dialog, and decided ones.

import { get, post } from "./api.js";
import { by, clock, make, number, signed } from "./format.js";

const NAME = "armlink-name";

// The change; if only the gain or only the offset drifts, the other has a standard deviation of 0.
function change(one) {
  const gain = `gain ${signed(100 * (one.gain - 1), 2)} ± ${number(196 * one.gain_std, 2)} %`;
  const offset = `offset ${signed(one.offset, 3)} ± ${number(1.96 * one.offset_std, 3)} N·m`;
  return [one.gain_std > 0 && gain, one.offset_std > 0 && offset].filter(Boolean).join(", ");
}

const percent = (share) => (share > 0.999 ? "above 99.9 %" : `${(100 * share).toFixed(1)} %`);

function pending(one) {
  const button = (verb, title, className) => {
    const made = make("button", { className, textContent: title, ariaLabel: `${title} ${one.joint}` });
    made.addEventListener("click", () => decide(one, verb));
    return made;
  };
  const card = make("div", { className: "proposal" },
    make("div", {},
      make("p", { className: "what" }, `${one.joint} has drifted: ${change(one)}`),
      make("p", { className: "quiet" }, `found at ${clock(one.time)} from ${one.rows} rests of the arm, with confidence ${percent(one.confidence)}; `
        + `record ${one.record} would replace record ${one.base}`)),
    make("div", { className: "row" }, button("approve", "Approve", "main"), button("reject", "Reject", "")));
  card.dataset.proposal = one.id;
  return card;
}

// What speaks for it, for who decides away from the arm: numbers, and the joint's estimate over time as the page draws it.
function evidence(one) {
  const facts = [
    ["change", change(one)], ["rests of the arm", String(one.rows)], ["confidence", percent(one.confidence)],
    ["found", clock(one.time)], ["record", `${one.record} replaces ${one.base}`],
  ];
  const list = make("dl", {}, ...facts.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))));
  const drawn = document.getElementById(`chart-${one.joint}`)?.querySelector("svg")?.cloneNode(true);
  return drawn ? [list, drawn] : [list];
}

function decide(one, verb) {
  const dialog = by("ask-decision");
  by("decision-title").textContent = verb === "approve" ? `Write the new calibration to ${one.joint}?` : `Reject the proposal for ${one.joint}?`;
  by("decision-text").textContent = verb === "approve"
    ? `Record ${one.record} is written to the drive and read back: ${change(one)}. The arm does not move. A roll-back undoes the change.`
    : `The change (${change(one)}) is not corrected, and nothing is written.`;
  by("decision-evidence").replaceChildren(...evidence(one));
  by("decision-yes").textContent = verb === "approve" ? "Approve" : "Reject";
  by("decision-error").textContent = "";
  by("by").value = localStorage.getItem(NAME) ?? "";
  by("decision-yes").onclick = async (event) => {
    event.preventDefault();
    const name = by("by").value.trim();
    if (name) localStorage.setItem(NAME, name);
    try {
      await post(`/api/proposals/${one.id}/${verb}`, { hash: one.hash, ...(name && { by: name }) });
      dialog.close();
      await fetchProposals();
    } catch (error) {
      by("decision-error").textContent = error.message;
    }
  };
  by("decision-no").onclick = () => dialog.close();
  dialog.showModal();
}

export const fetchProposals = async () => showProposals(await get("/api/proposals"));

let shown = "";

// What is unchanged stays as it is, and the button that has the keyboard's focus keeps it: it would be lost with its element.
export function showProposals(all) {
  const said = JSON.stringify(all);
  if (said === shown) return;
  shown = said;
  const open = all.filter((one) => one.state === "pending"), list = by("proposal-list");
  const focused = list.contains(document.activeElement) ? document.activeElement.ariaLabel : null;
  by("proposals").hidden = open.length === 0;
  list.replaceChildren(...open.map(pending));
  if (focused) [...list.querySelectorAll("button")].find((one) => one.ariaLabel === focused)?.focus();
  const done = all.filter((one) => one.state !== "pending").slice(0, 10);
  by("decided").hidden = done.length === 0;
  by("decided-list").replaceChildren(...done.map((one) => {
    const who = one.decided_by ? ` by ${one.decided_by}, ${clock(one.decided_at)}` : "";
    const line = make("li", {}, make("b", {}, one.state), `${who}: ${one.joint}, ${change(one)}${one.note ? ` (${one.note})` : ""}`);
    line.dataset.proposal = one.id;
    return line;
  }));
}
