// The page: the daemon's state at a glance. All data come from the API; it sends nothing but decisions.

import { blob, forgetToken, get, stream, token } from "./api.js";
import { addEvent, draw, drawIfChanged, fetchNew, initRanges, overviewQuery, setHistory, setLive, setNow } from "./drift.js";
import { showEvent } from "./events.js";
import { by, clock, duration, put, whole } from "./format.js";
import { initArm, showArm } from "./arm.js";
import { showEstimates, showJoints, shownScale, verdict } from "./joints.js";
import { addSample, drawLive, fetchWindow, initLive, moves } from "./live.js";
import { fetchProposals, showProposals } from "./proposals.js";
import { addContact, showExternal, showWrench } from "./touch.js";

const SLOW = 2000; // ms between updates of what changes slowly
let status = null;
let connected = false;
let summary = "";

const WORDS = { lost: "NO CONNECTION", fault: "FAULT", alarm: "ALARM", decide: "DECISION NEEDED" };

// The daemon's own state; while it observes, also an open alarm or a pending decision.
function shownState(state) {
  if (!connected) return "lost";
  if (state !== "observing") return state;
  if (status?.pending_proposals) return "decide";
  return status?.held ? "alarm" : state;
}

function showState(state, detail) {
  const shown = shownState(state);
  const own = {
    alarm: "Sensors and model disagree: the cause is being determined, and estimates are paused.",
    decide: `${summary} A new calibration waits for your decision.`,
    observing: summary,
  };
  document.body.dataset.state = shown;
  put(by("state-word"), WORDS[shown] ?? shown);
  put(by("detail"), detail || own[shown] || "");
  by("detail").classList.toggle("calm", !detail && shown === "observing");
  document.title = `${WORDS[shown] ?? shown} · ${status?.arm ?? "armlink"}`;
}

function showBus(bus) {
  const cell = (name, text, bad, good) => {
    const box = document.querySelector(`[data-bus=${name}]`);
    put(box.querySelector("dd"), text);
    box.classList.toggle("is-bad", Boolean(bad));
    box.classList.toggle("is-good", Boolean(good));
  };
  cell("connected", bus.connected ? "answering" : "silent", !bus.connected, bus.connected);
  cell("rate_hz", `${bus.rate_hz.toFixed(0)} Hz`);
  cell("load", `${(100 * bus.load).toFixed(0)} %`, bus.load > 0.8);
  cell("frames", whole(bus.frames));
  for (const name of ["missed", "late", "errors"]) cell(name, whole(bus[name]), bus[name] > 0);
}

function showStatus() {
  put(by("arm"), status.arm);
  put(by("serial"), status.serial);
  put(by("version"), `armlink ${status.version}`);
  const { calibration, gravity } = status.records;
  put(by("records"), calibration ? ` (record ${calibration}, gravity ${gravity ?? "none"})` : ", of which there is none yet: sweep and calibrate first");
  showState(status.state, status.detail || status.bus.fault || "");
  showBus(status.bus);
  showLink();
  by("forget").hidden = token() === null;
  by("openapi").hidden = token() !== null; // a link cannot send a token
  if (status.report && !by("report").dataset.there) showReport();
}

function showLink() {
  if (!status || !connected) return;
  const listens = status.listen_only ? "listens only" : "commands the bus";
  put(by("link"), `live · policy ${status.policy} · ${listens} · running for ${duration(status.uptime_s)} · ${whole(status.rows)} rests used`);
}

function showReport() {
  const paragraph = by("report");
  paragraph.dataset.there = "yes";
  const link = Object.assign(document.createElement("a"), { href: "/api/report", target: "_blank", rel: "noopener", textContent: "Open the newest report" });
  link.addEventListener("click", async (event) => {
    if (token() === null) return; // the Unix socket needs none: an ordinary link
    event.preventDefault();
    const file = Object.assign(document.createElement("a"), { href: URL.createObjectURL(await blob("/api/report")), download: "armlink-report.html" });
    file.click();
    URL.revokeObjectURL(file.href);
  });
  paragraph.replaceChildren(link);
}

const on = {
  open() {
    connected = true;
    if (status) showStatus();
  },
  lost(why) {
    connected = false;
    showState("lost", `No connection to the daemon: ${why}. The values below are old. The page tries to reconnect.`);
    put(by("link"), status ? `last contact ${clock(status.time)}` : "");
  },
  joints(item) {
    setNow(item.time);
    if (status.state !== item.state) status.detail = ""; // it belonged to the previous state
    status = { ...status, state: item.state, bus: item.bus, time: item.time };
    addSample(item);
    showJoints(item.joints, moves());
    showWrench(item);
    showArm(item.joints, shownScale(), moves());
    if (!document.hidden) drawLive();
    showBus(item.bus);
    showState(item.state, item.bus.fault || status.detail || "");
  },
  contact({ contact }) {
    addContact(contact);
  },
  event({ event }) {
    addEvent(event);
    showEvent(event);
    slowly().catch(() => {});
  },
};

async function slowly() {
  const asked = [get("/api/status"), get("/api/estimates"), get("/api/external"), fetchProposals(), fetchNew()];
  const [now, estimates, external] = await Promise.all(asked);
  status = now;
  summary = verdict(estimates);
  setNow(status.time);
  showStatus();
  showEstimates(estimates);
  showExternal(external);
  setLive(estimates, status);
  drawIfChanged();
}

async function forEver() {
  for (;;) {
    await new Promise((wake) => setTimeout(wake, SLOW));
    if (connected && !document.hidden) await slowly().catch(() => {}); // the stream reports that the daemon is gone
  }
}

async function start() {
  by("forget").addEventListener("click", () => { forgetToken(); location.reload(); });
  const all = await get(`/api/overview?${overviewQuery()}`);
  status = all.status;
  connected = true;
  summary = verdict(all.estimates);
  setNow(status.time);
  showStatus();
  showJoints(all.joints);
  showEstimates(all.estimates);
  showExternal(all.external);
  showProposals(all.proposals);
  setLive(all.estimates, status);
  setHistory(all.history);
  for (const event of all.events) { addEvent(event); showEvent(event); }
  draw();
  initRanges();
  initLive();
  document.body.dataset.shown = Math.round(performance.now()); // ms until everything was shown
  stream(on, status.last_event);
  for (const more of [fetchWindow, initArm]) more().catch((error) => console.warn(error.message)); // the rest is there without
  forEver();
}

function startUntilItWorks() {
  start().catch((error) => {
    on.lost(error.message);
    setTimeout(startUntilItWorks, 2000);
  });
}

startUntilItWorks();
