// The table of joints: readings ten times per second, estimates every two seconds.

import { by, gainIsOff, make, MISSING, number, offsetIsOff, put, signed } from "./format.js";

const OLD = 0.5; // s: readings older than this are not live
const rows = new Map();
let scale = 0.1;
export const shownScale = () => scale;

function row(name) {
  if (rows.has(name)) return rows.get(name);
  const cell = (kind) => make("td", { className: `n ${kind}` }, MISSING);
  const cells = {};
  const line = make("tr", {});
  line.dataset.joint = name;
  line.append(make("th", { scope: "row" }, name));
  for (const [kind, label] of [["position", "Position [rad]"], ["torque", "Sensor [N·m]"], ["model", "Model [N·m]"], ["residual", "Residual [N·m]"]]) {
    cells[kind] = cell(kind);
    cells[kind].dataset.label = label;
    line.append(cells[kind]);
  }
  cells.fill = make("i");
  line.append(make("td", { className: "bar-cell" }, make("span", { className: "bar" }, cells.fill)));
  for (const [kind, label] of [["gain", "Gain change [%, 95 %]"], ["offset", "Offset [N·m, 95 %]"], ["limit", "Noticed from [%, N·m]"]]) {
    cells[kind] = cell(kind);
    cells[kind].dataset.label = label;
    line.append(cells[kind]);
  }
  cells.external = cell("external");
  cells.external.dataset.label = "External [N·m, 95 %]";
  cells.temperature = cell("temperature");
  cells.temperature.dataset.label = "Temperature [°C]";
  cells.drive = make("td", { className: "drive" });
  line.append(cells.external, cells.temperature, cells.drive);
  by("joints").tBodies[0].append(line);
  rows.set(name, { line, cells });
  return rows.get(name);
}

function nice(largest) {
  const ten = 10 ** Math.floor(Math.log10(largest));
  return [1, 2, 5, 10].map((step) => step * ten).find((value) => value >= largest);
}

export function showJoints(joints, moving = false) {
  by("joints").classList.toggle("moving", moving);
  put(by("moving"), moving ? "The arm moves; residuals are meaningful again when it rests." : "");
  const largest = Math.max(...joints.map((joint) => Math.abs(joint.residual ?? 0)), 0.1);
  scale = largest > scale || largest < scale / 4 ? nice(largest) : scale;
  put(by("bar-scale"), `±${scale} N·m`);
  by("joints").classList.toggle("untouched", joints.every((joint) => (joint.external_bound ?? null) === null));
  by("joints").classList.toggle("cold", joints.every((joint) => joint.temperature === null));
  for (const joint of joints) {
    const { cells } = row(joint.joint);
    const bound = joint.external_bound ?? 0;
    interval(cells.external, joint.external_torque ?? null, bound / 1.96, 2, Math.abs(joint.external_torque ?? 0) > bound);
    put(cells.temperature, number(joint.temperature, 0));
    put(cells.position, number(joint.position, 3));
    put(cells.torque, number(joint.torque, 2));
    put(cells.model, number(joint.model_torque, 2));
    put(cells.residual, signed(joint.residual, 3));
    const half = Math.min(1, Math.abs(joint.residual ?? 0) / scale) * 50;
    cells.fill.style.left = `${joint.residual < 0 ? 50 - half : 50}%`;
    cells.fill.style.width = `${half}%`;
    const age = joint.sample_age_s;
    const old = age === null || age > OLD;
    put(cells.drive, age === null ? "no readings" : old ? `${joint.state}, ${age.toFixed(1)} s old` : joint.state);
    cells.drive.classList.toggle("is-bad", old || joint.state.startsWith("fault"));
  }
}

export function interval(cell, value, std, digits, off) {
  cell.classList.toggle("off", off);
  const around = std > 0 ? ` ± ${number(1.96 * std, digits)}` : ""; // 0: unchanged, because only the other one drifts
  cell.replaceChildren(signed(value, digits), make("span", { className: "pm" }, around));
}

// Summary of the estimates in one line.
export function verdict(estimates) {
  const drifting = estimates.filter((one) => gainIsOff(one) || offsetIsOff(one)).map((one) => one.joint);
  if (drifting.length) return `${drifting.join(", ")}: the torque sensor has drifted from its calibration.`;
  return estimates.length ? `All ${estimates.length} torque sensors agree with their calibration.` : "";
}

export function showEstimates(estimates) {
  for (const one of estimates) {
    const { line, cells } = row(one.joint);
    interval(cells.gain, 100 * (one.gain - 1), 100 * one.gain_std, 2, gainIsOff(one));
    interval(cells.offset, one.offset, one.offset_std, 3, offsetIsOff(one));
    const gain = one.gain_limit === null ? MISSING : number(100 * one.gain_limit, 2);
    put(cells.limit, `${gain}, ${number(one.offset_limit, 3)}`);
    line.classList.toggle("drifting", gainIsOff(one) || offsetIsOff(one));
    line.title = `${one.samples} rests of the arm used`;
  }
  const rests = estimates[0]?.limit_rests ?? null;
  put(by("limit-rests"), rests === null ? "" : ` A change as large as in the column “Noticed from” is found within ${rests} rests, a larger change sooner.`);
}
