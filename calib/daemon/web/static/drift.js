// Gain and offset over time: fetching, caching and redrawing.

import { get } from "./api.js";
import { by, category, gainIsOff, make, number, offsetIsOff, signed } from "./format.js";
import { drawJoint, drawTimeline } from "./plot.js";

const POINTS = 120; // per joint, in one request
const MOST = 1500; // per joint, cached until everything is fetched again, thinned
const history = new Map();
const events = [];
const live = new Map(); // the present estimate: the last point of each line
let seconds = 600;
let now = Date.now();
let begun = Infinity; // when the daemon started
let drawn = false;

export const setNow = (time) => { now = Date.parse(time); };

export function setLive(estimates, status) {
  for (const one of estimates) live.set(one.joint, { ...one, at: Date.parse(status.time), record: status.records.calibration });
  begun = Date.parse(status.time) - 1000 * status.uptime_s;
  drawn = false;
}

export function addEvent(event) {
  if (events.some((one) => one.id === event.id)) return;
  const title = `${event.time} ${event.kind} ${event.joint ?? ""} ${event.text}`;
  events.push({ id: event.id, at: Date.parse(event.time), kind: event.kind, joint: event.joint, category: category(event.kind), title });
  drawn = false;
}

export const overviewQuery = () => `seconds=${seconds}&limit=${POINTS}`;

export function setHistory(points) {
  history.clear();
  take(points);
}

const since = () => (seconds ? new Date(now - 1000 * seconds).toISOString() : "");

// Fetches the whole time range again; the caller draws.
export async function fetchHistory() {
  setHistory(await get(`/api/history?limit=${POINTS}&from=${encodeURIComponent(since())}`));
}

// Fetches points newer than the cached ones; the caller draws.
export async function fetchNew() {
  const newest = Math.max(0, ...[...history.values()].map((points) => points.at(-1).at));
  if (!newest || [...history.values()].some((points) => points.length > MOST)) return fetchHistory();
  take(await get(`/api/history?from=${new Date(newest).toISOString()}`));
}

function take(points) {
  for (const point of points) {
    const kept = history.get(point.joint) ?? [];
    const at = Date.parse(point.time);
    if (kept.length && at <= kept.at(-1).at) continue;
    kept.push({ ...point, at });
    history.set(point.joint, kept);
    drawn = false;
  }
}

// The chosen time, or less: from the start of the daemon, or of what is known from before it.
function range() {
  const first = Math.min(now - 60000, begun, ...[...history.values()].map((points) => points[0].at), ...events.map((event) => event.at));
  return [seconds ? Math.max(first, now - 1000 * seconds) : first, now];
}

function niceHalf(values, least) {
  const wanted = Math.max(least, 1.15 * Math.max(0, ...values));
  const ten = 10 ** Math.floor(Math.log10(wanted));
  return [1, 1.5, 2, 3, 5, 7, 10].map((step) => step * ten).find((value) => value >= wanted * 0.999);
}

// One scale for all joints, which makes a drifting one conspicuous.
function halves(shown) {
  const all = shown.flatMap(([, points]) => points);
  const middle = (key) => all.map((p) => p[key]).sort((a, b) => a - b)[Math.floor(all.length / 2)] ?? 0;
  const gain = niceHalf(all.map((p) => 100 * Math.abs(p.gain - 1) + 100 * middle("gain_std")), 0.5);
  const offset = niceHalf(all.map((p) => Math.abs(p.offset) + middle("offset_std")), 0.1);
  return { gain, offset };
}

function figure(name) {
  const id = `chart-${name}`;
  let card = document.getElementById(id);
  if (!card) {
    card = make("div", { className: "chart", id }, make("h3", {}, make("b", {}, name), make("span", {})), make("figure"));
    card.dataset.joint = name;
    by("charts").append(card);
  }
  return card;
}

export function draw() {
  const span = range();
  const near = events.filter((event) => event.at >= span[0] && event.at <= span[1]);
  const names = [...new Set([...live.keys(), ...history.keys()])];
  const shown = names.map((name) => [name, [...(history.get(name) ?? []), ...(live.has(name) ? [live.get(name)] : [])].filter((point) => point.at >= span[0])]);
  const scale = halves(shown);
  drawTimeline(by("timeline"), by("timeline").clientWidth || 600, span, near);
  for (const [name, points] of shown) {
    const card = figure(name), last = points.at(-1);
    if (!last) continue;
    card.classList.toggle("drifting", gainIsOff(last) || offsetIsOff(last));
    const change = `${signed(100 * (last.gain - 1), 2)} ± ${number(196 * last.gain_std, 2)} %, `
      + `${signed(last.offset, 3)} ± ${number(1.96 * last.offset_std, 3)} N·m`;
    card.querySelector("h3 span").textContent = change;
    const own = near.filter((event) => event.category && (event.joint === null || event.joint === name));
    drawJoint(card.querySelector("figure"), `${name}, gain and offset over time: now ${change}`, card.clientWidth || 340, span, points, own, scale);
  }
  drawn = true;
}

export const drawIfChanged = () => drawn || draw();

export function initRanges() {
  for (const button of by("ranges").children) {
    button.setAttribute("aria-pressed", String(Number(button.dataset.seconds) === seconds));
    button.addEventListener("click", async () => {
      seconds = Number(button.dataset.seconds);
      for (const other of by("ranges").children) other.setAttribute("aria-pressed", String(other === button));
      await fetchHistory();
      draw();
    });
  }
  new ResizeObserver(() => draw()).observe(by("charts"));
}
