// The last ten minutes, or since the start: sensor torque against the model and temperature, joint by joint; to download.

import { blob, get } from "./api.js";
import { by, make, number } from "./format.js";
import { svg } from "./plot.js";

const KEPT = 600; // s
const PAUSE = 2; // s: a line is broken where readings are missing for longer
const MOVING = 0.01; // rad/s: residuals mean something below it
const NEAR = 46, FAR = 6, TORQUE = 68, WARMTH = 30, FOOT = 16;
const CHANNELS = ["position", "torque", "model_torque", "temperature"];
const samples = []; // {at, and of every channel one value a joint}
let names = [];
let span = KEPT;
let liveDrawn = -Infinity;

export function addSample(item) {
  const at = Date.parse(item.time);
  if (samples.length && at <= samples.at(-1).at) return;
  names = item.joints.map((joint) => joint.joint);
  samples.push({ at, ...Object.fromEntries(CHANNELS.map((key) => [key, item.joints.map((joint) => joint[key])])) });
  while (at - samples[0].at > 1000 * KEPT) samples.shift();
}

// What the daemon kept before the page was opened goes in front of what the stream has brought since.
export async function fetchWindow() {
  const kept = await get(`/api/window?limit=${KEPT}`);
  const newest = Date.parse(kept.time), first = samples[0]?.at ?? Infinity;
  const before = kept.t.map((t, row) => ({ at: newest - 1000 * (kept.t.at(-1) - t), ...Object.fromEntries(CHANNELS.map((key) => [key, kept[key][row]])) }));
  samples.unshift(...before.filter((one) => one.at < first));
  names = kept.joints;
  liveDrawn = -Infinity;
  drawLive();
}

// Whether any joint turned faster than MOVING in the last half second, or begins to.
export function moves() {
  const last = samples.at(-1);
  const first = samples.findLastIndex((one) => last.at - one.at >= 500);
  if (first < 0) return false;
  const turned = (one) => last.position.some((position, k) => Math.abs((position ?? 0) - (one.position[k] ?? 0)) > MOVING * (last.at - one.at) / 1000);
  return samples.slice(first, -1).some(turned);
}

// A channel as polylines: the smallest and the largest value of every pixel, so that no peak is lost.
function lines(kind, shown, k, x, y) {
  const parts = [];
  let pixel = null, low, high, last = -Infinity;
  const end = () => {
    if (pixel === null) return;
    const [one, other] = low.at <= high.at ? [low, high] : [high, low];
    for (const each of one === other ? [one] : [one, other]) parts.at(-1).push(`${x(each.at).toFixed(1)},${y(each[kind][k]).toFixed(1)}`);
  };
  for (const each of shown) {
    if (!Number.isFinite(each[kind][k])) continue;
    const at = Math.floor(x(each.at));
    if (at !== pixel || each.at - last > 1000 * PAUSE) {
      end();
      if (each.at - last > 1000 * PAUSE) parts.push([]);
      [pixel, low, high] = [at, each, each];
    }
    if (each[kind][k] < low[kind][k]) low = each;
    if (each[kind][k] > high[kind][k]) high = each;
    last = each.at;
  }
  end();
  return parts.map((points) => svg("polyline", { class: `line ${kind}`, points: points.join(" ") }));
}

function graph(drawing, kinds, shown, k, box, least, digits) {
  let [smallest, largest] = [Infinity, -Infinity];
  for (const each of shown) {
    for (const kind of kinds) {
      const value = each[kind][k];
      if (Number.isFinite(value)) [smallest, largest] = [Math.min(smallest, value), Math.max(largest, value)];
    }
  }
  if (smallest > largest) return;
  const middle = (smallest + largest) / 2, half = Math.max(least, (largest - smallest) * 0.55);
  const y = (value) => (box.top + box.bottom) / 2 - ((value - middle) / half) * (box.bottom - box.top) / 2;
  for (const value of [middle + half, middle - half]) {
    drawing.append(svg("line", { class: "grid", x1: NEAR, x2: box.right, y1: y(value), y2: y(value) }));
    drawing.append(svg("text", { x: NEAR - 5, y: y(value) + 4, "text-anchor": "end" }, number(value, digits).replace(/^−(0\.?0*)$/, "$1")));
  }
  for (const kind of kinds) drawing.append(...lines(kind, shown, k, box.x, y));
}

const ago = (ms) => (ms < 1000 ? "now" : ms < 120000 ? `−${Math.round(ms / 1000)} s` : `−${(ms / 60000).toFixed(1).replace(".0", "")} min`);

function drawOne(card, shown, k) {
  const name = names[k], now = shown.at(-1), width = card.clientWidth || 340;
  const [from, to] = [Math.min(shown[0].at, now.at - 10000), now.at];
  const warm = shown.some((one) => Number.isFinite(one.temperature[k]));
  const bottom = TORQUE + (warm ? WARMTH : 0);
  const x = (at) => NEAR + ((at - from) / (to - from)) * (width - NEAR - FAR);
  const box = { x, top: 8, bottom: TORQUE - 6, right: width - FAR };
  const degrees = Number.isFinite(now.temperature[k]) ? `, ${number(now.temperature[k], 0)} °C` : "";
  const label = `${name}: sensor ${number(now.torque[k], 2)}, model ${number(now.model_torque[k], 2)} N·m${degrees}`;
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${bottom + FOOT}`, height: bottom + FOOT, role: "img", "aria-label": label });
  graph(drawing, ["torque", "model_torque"], shown, k, box, 0.5, 1);
  if (warm) graph(drawing, ["temperature"], shown, k, { ...box, top: TORQUE + 6, bottom: bottom - 4 }, 2, 0);
  for (const [at, anchor] of [[from, "start"], [(from + to) / 2, "middle"], [to, "end"]]) {
    drawing.append(svg("text", { x: x(at), y: bottom + 12, "text-anchor": anchor }, ago(to - at)));
  }
  card.querySelector("h3 span").textContent = `${number(now.torque[k], 2)} / ${number(now.model_torque[k], 2)} N·m${degrees}`;
  card.querySelector("figure").replaceChildren(drawing);
}

export function drawLive() {
  const last = samples.at(-1);
  if (!last || performance.now() - liveDrawn < (span > 60 ? 2000 : 500)) return; // the stream is faster than eyes
  liveDrawn = performance.now();
  const shown = samples.filter((one) => last.at - one.at <= 1000 * span);
  by("warmth").hidden = !last.temperature.some(Number.isFinite);
  names.forEach((name, k) => {
    const id = `live-${name}`;
    let card = document.getElementById(id);
    if (!card) {
      card = make("div", { className: "chart", id }, make("h3", {}, make("b", {}, name), make("span", {})), make("figure"));
      by("live").append(card);
    }
    drawOne(card, shown, k);
  });
}

async function download(suffix) {
  by("download-error").textContent = "";
  try {
    const url = URL.createObjectURL(await blob(`/api/window.${suffix}?seconds=${span}`));
    const stamp = new Date(samples.at(-1)?.at ?? Date.now()).toISOString().slice(0, 19).replaceAll(/[-:]/g, "");
    make("a", { href: url, download: `armlink-${stamp}Z.${suffix}` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  } catch (error) {
    by("download-error").textContent = error.message;
  }
}

export function initLive() {
  for (const suffix of ["csv", "mcap"]) by(`download-${suffix}`).addEventListener("click", () => download(suffix));
  for (const button of by("live-ranges").children) {
    button.setAttribute("aria-pressed", String(Number(button.dataset.seconds) === span));
    button.addEventListener("click", () => {
      span = Number(button.dataset.seconds);
      for (const other of by("live-ranges").children) other.setAttribute("aria-pressed", String(other === button));
      liveDrawn = -Infinity;
      drawLive();
    });
  }
}
