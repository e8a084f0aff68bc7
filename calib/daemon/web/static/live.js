// The last minutes as the stream brought them: sensor torque against the model, joint by joint, and the window as a file.

import { by, make, number } from "./format.js";
import { svg } from "./plot.js";

const KEPT = 600; // s
const SPAN = 60; // s
const MOVING = 0.01; // rad/s: residuals mean something below it
const NEAR = 46, FAR = 6, TALL = 78, FOOT = 64;
const samples = []; // {at, joints}

export function addSample(item) {
  const at = Date.parse(item.time);
  if (samples.length && at <= samples.at(-1).at) return;
  samples.push({ at, joints: item.joints });
  while (at - samples[0].at > 1000 * KEPT) samples.shift();
}

// Whether any joint turned faster than MOVING between the newest samples, half a second apart.
export function moves() {
  const last = samples.at(-1);
  const before = last && samples.findLast((one) => last.at - one.at >= 500);
  if (!before) return false;
  const seconds = (last.at - before.at) / 1000;
  return last.joints.some((joint, k) => Math.abs((joint.position ?? 0) - (before.joints[k]?.position ?? 0)) / seconds > MOVING);
}

function line(kind, shown, k, x, y) {
  const points = shown.filter((one) => Number.isFinite(one.joints[k]?.[kind]));
  const text = points.map((one) => `${x(one.at).toFixed(1)},${y(one.joints[k][kind]).toFixed(1)}`).join(" ");
  return svg("polyline", { class: `line ${kind}`, points: text });
}

function drawOne(card, shown, k, name) {
  const width = card.clientWidth || 340, [from, to] = [shown.at(-1).at - 1000 * SPAN, shown.at(-1).at];
  const values = shown.flatMap((one) => [one.joints[k].torque, one.joints[k].model_torque]).filter(Number.isFinite);
  if (!values.length) return;
  const middle = (Math.min(...values) + Math.max(...values)) / 2;
  const half = Math.max(0.5, (Math.max(...values) - Math.min(...values)) * 0.55);
  const x = (at) => NEAR + ((at - from) / (to - from)) * (width - NEAR - FAR);
  const y = (value) => 34 - ((value - middle) / half) * 28;
  const now = shown.at(-1).joints[k];
  const label = `${name}: sensor ${number(now.torque, 2)}, model ${number(now.model_torque, 2)} N·m`;
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${TALL}`, height: TALL, role: "img", "aria-label": label });
  for (const value of [middle + half, middle, middle - half]) {
    drawing.append(svg("line", { class: "grid", x1: NEAR, x2: width - FAR, y1: y(value), y2: y(value) }));
    drawing.append(svg("text", { x: NEAR - 5, y: y(value) + 4, "text-anchor": "end" }, number(value, half < 20 ? 1 : 0).replace(/^−(0\.?0*)$/, "$1")));
  }
  for (const [ago, anchor] of [[SPAN, "start"], [SPAN / 2, "middle"], [0, "end"]]) {
    drawing.append(svg("text", { x: x(to - 1000 * ago), y: FOOT + 12, "text-anchor": anchor }, ago ? `−${ago} s` : "now"));
  }
  drawing.append(line("model_torque", shown, k, x, y), line("torque", shown, k, x, y));
  card.querySelector("h3 span").textContent = `${number(now.torque, 2)} / ${number(now.model_torque, 2)} N·m`;
  card.querySelector("figure").replaceChildren(drawing);
}

export function drawLive() {
  const last = samples.at(-1);
  if (!last) return;
  const shown = samples.filter((one) => last.at - one.at <= 1000 * SPAN);
  last.joints.forEach((joint, k) => {
    const id = `live-${joint.joint}`;
    let card = document.getElementById(id);
    if (!card) {
      card = make("div", { className: "chart", id }, make("h3", {}, make("b", {}, joint.joint), make("span", {})), make("figure"));
      by("live").append(card);
    }
    drawOne(card, shown, k, joint.joint);
  });
}

// The window as a recording that armlink loads: t, q_i, tau_i, and the model's torque beside them.
export function windowCsv() {
  const names = samples.at(-1)?.joints.map((_, k) => k + 1) ?? [];
  const columns = [["q", "position"], ["tau", "torque"]];
  const head = ["t", ...columns.flatMap(([prefix]) => names.map((k) => `${prefix}_${k}`)), ...names.map((k) => `model_${k}`)];
  const cell = (value) => (Number.isFinite(value) ? value : "nan");
  const rows = samples.map((one) => [
    ((one.at - samples[0].at) / 1000).toFixed(3),
    ...columns.flatMap(([, key]) => one.joints.map((joint) => cell(joint[key]))),
    ...one.joints.map((joint) => cell(joint.model_torque)),
  ]);
  return [head, ...rows].map((row) => row.join(",")).join("\n") + "\n";
}

export function initLive() {
  by("download").addEventListener("click", () => {
    const url = URL.createObjectURL(new Blob([windowCsv()], { type: "text/csv" }));
    make("a", { href: url, download: `armlink-${new Date(samples.at(-1)?.at ?? 0).toISOString().slice(0, 19).replaceAll(":", "")}.csv` }).click();
    setTimeout(() => URL.revokeObjectURL(url), 1000);
  });
}
