// The arm from its model, as it stands now: links as tubes, joints as drums in the colour of their residual.

import { get } from "./api.js";
import { by, put, signed } from "./format.js";
import { add, after, perpendicular, ball, cross, dot, drum, length, moved, rotated, STAND, sub, times, tube } from "./solids.js";

const STEP = Math.PI / 12; // of the buttons
const MARGIN = 22; // px around the arm
const view = { turn: 0.7, tilt: 0.35 };
let shape = null; // {up, joints, bodies}
let fit = null; // {x, y, scale}
let last = null; // {joints, scale, moving}
let drawnKey = "";
let drawnAt = -Infinity;

// Faces with every joint at its reference: bodies[0] is the base, bodies[i] moves with joint i − 1.
function solid({ up, joints }) {
  const far = joints.reduce((sum, joint) => sum + joint.link.slice(1).reduce((all, corner, k) => all + length(sub(corner, joint.link[k])), 0), 0);
  const radius = (k) => far * (0.036 - 0.018 * (k / joints.length));
  const bodies = [[]];
  if (length(joints[0].point) > 0.1 * far) bodies[0] = tube([0, 0, 0], joints[0].point, radius(0)).map((face) => ({ ...face, joint: null }));
  joints.forEach((joint, k) => {
    const r = radius(k), before = joints.slice(0, k).filter((other) => length(sub(other.point, joint.point)) < r).length;
    const own = drum(joint.point, joint.axis, r * 1.3 * 0.85 ** before, r * 1.2 * 1.4 ** before).map((face) => ({ ...face, joint: k }));
    const parts = joint.link.slice(1).flatMap((corner, i) => [...tube(joint.link[i], corner, 0.62 * r), ...ball(corner, 0.62 * r)]);
    bodies.push([...parts.map((face) => ({ ...face, joint: null })), ...own]);
  });
  return { up, joints, bodies };
}

export async function initArm() {
  const answer = await get("/api/arm");
  if (!answer.joints.length) return;
  shape = solid(answer);
  by("arm-section").hidden = false;
  const canvas = by("arm-view");
  for (const button of by("arm-turn").children) {
    button.addEventListener("click", () => turn(Number(button.dataset.turn) * STEP, Number(button.dataset.tilt) * STEP));
  }
  let from = null;
  canvas.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
  canvas.addEventListener("pointermove", (event) => {
    if (!from) return;
    turn((from[0] - event.clientX) / 120, (event.clientY - from[1]) / 120);
    from = [event.clientX, event.clientY];
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => { from = null; });
  new ResizeObserver(() => redraw()).observe(canvas);
}

function turn(by_, tilt) {
  view.turn += by_;
  view.tilt = Math.min(1.5, Math.max(-1.5, view.tilt + tilt));
  fit = null;
  redraw();
}

function redraw() {
  drawnKey = "";
  drawnAt = -Infinity;
  if (last) showArm(last.joints, last.scale, last.moving);
}

// Residuals up to `scale` [N·m] are between the good and the bad colour; a residual of a moving arm counts nothing.
export function showArm(joints, scale, moving) {
  last = { joints, scale, moving };
  if (!shape || document.hidden || performance.now() - drawnAt < 100) return;
  if (joints.some((joint) => joint.position === null)) return;
  const key = JSON.stringify([joints.map((joint) => [joint.position.toFixed(3), (joint.residual ?? 0).toFixed(2)]), scale, moving]);
  if (key === drawnKey) return;
  [drawnKey, drawnAt] = [key, performance.now()];
  paint(joints, scale, moving);
  const worst = joints.reduce((one, other) => (Math.abs(other.residual ?? 0) > Math.abs(one.residual ?? 0) ? other : one));
  const words = moving ? "moving" : worst.residual === null ? "no model yet" : `largest residual ${worst.joint}, ${signed(worst.residual, 2)} N·m`;
  const label = `The arm as it stands now: ${words}`;
  if (by("arm-view").getAttribute("aria-label") !== label) by("arm-view").setAttribute("aria-label", label);
  put(by("arm-words"), words);
  put(by("arm-scale"), `${scale} N·m`);
}

function motions(joints) {
  const found = [STAND];
  shape.joints.forEach((joint, k) => found.push(after(found[k], joint.axis, joint.point, joints[k].position - joint.reference)));
  return found;
}

// Right, upwards and towards the eye, seen from `view`.
function axes() {
  const { up } = shape, ahead = perpendicular(up), side = cross(up, ahead);
  const level = add(times(Math.cos(view.turn), ahead), times(Math.sin(view.turn), side));
  const eye = add(times(Math.cos(view.tilt), level), times(Math.sin(view.tilt), up));
  const right = cross(up, level);
  return [right, cross(eye, right), eye];
}

const parse = (colour) => (colour.length === 4 ? [...colour.slice(1)].map((c) => parseInt(c + c, 16)) : [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16)));
const mix = (one, other, share) => one.map((value, k) => value + (other[k] - value) * share);
const shaded = (colour, light) => `rgb(${colour.map((value) => Math.round(Math.min(255, value * light))).join(" ")})`;

function palette() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(["good", "warn", "bad", "soft", "line", "ink", "card"].map((name) => [name, parse(style.getPropertyValue(`--${name}`).trim())]));
}

function colourOf(residual, scale, moving, colours) {
  if (moving || residual === null) return mix(colours.soft, colours.card, 0.3);
  const share = Math.min(1, Math.abs(residual) / scale);
  return share < 0.5 ? mix(colours.good, colours.warn, 2 * share) : mix(colours.warn, colours.bad, 2 * share - 1);
}

function fitted(points, width, height) {
  const bounds = [0, 1].map((k) => [Math.min(...points.map((p) => p[k])), Math.max(...points.map((p) => p[k]))]);
  const [wide, tall] = bounds.map(([low, high]) => high - low);
  const scale = Math.min((width - 2 * MARGIN) / Math.max(wide, 1e-3), (height - 2 * MARGIN) / Math.max(tall, 1e-3));
  const inside = fit && points.every((p) => Math.abs(p[0] - fit.x) * fit.scale < width / 2 - 4 && Math.abs(p[1] - fit.y) * fit.scale < height / 2 - 4);
  if (!inside || scale > 1.3 * fit.scale) fit = { x: (bounds[0][0] + bounds[0][1]) / 2, y: (bounds[1][0] + bounds[1][1]) / 2, scale };
}

function paint(joints, scale, moving) {
  const canvas = by("arm-view"), pixel = window.devicePixelRatio || 1;
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return;
  [canvas.width, canvas.height] = [width * pixel, height * pixel];
  const context = canvas.getContext("2d"), colours = palette(), [right, up, eye] = axes(), stands = motions(joints);
  const flat = (p) => [dot(p, right), dot(p, up), dot(p, eye)];
  const place = (p) => [width / 2 + (p[0] - fit.x) * fit.scale, height / 2 - (p[1] - fit.y) * fit.scale];
  const light = add(add(times(-0.35, right), times(0.6, up)), times(0.72, eye));
  const body = mix(colours.line, colours.soft, 0.35);
  const own = joints.map((joint) => colourOf(joint.residual, scale, moving, colours));
  const faces = shape.bodies.flatMap((of, k) => of.map((face) => {
    const normal = rotated(stands[k], face.normal);
    if (dot(normal, eye) < -0.05) return null;
    const points = face.points.map((p) => flat(moved(stands[k], p)));
    const depth = points.reduce((sum, p) => sum + p[2], 0) / points.length;
    return { points, depth, colour: shaded(face.joint === null ? body : own[face.joint], 0.62 + 0.42 * Math.max(0, dot(normal, light))) };
  })).filter(Boolean).sort((one, other) => one.depth - other.depth);
  fitted(faces.flatMap((face) => face.points), width, height);
  context.scale(pixel, pixel);
  for (const face of faces) fill(context, face, place);
  if (!moving) labels(context, joints, scale, stands, (p) => place(flat(p)), colours);
}

function fill(context, { points, colour }, place) {
  context.beginPath();
  points.forEach((p, k) => (k ? context.lineTo(...place(p)) : context.moveTo(...place(p))));
  context.closePath();
  context.fillStyle = context.strokeStyle = colour;
  context.fill();
  context.stroke(); // closes the seams between faces
}

// Names and residuals of the joints that are off, none on top of another.
function labels(context, joints, scale, stands, place, colours) {
  context.font = "600 12px system-ui, sans-serif";
  context.lineWidth = 4;
  context.strokeStyle = `rgb(${colours.card.join(" ")})`;
  context.fillStyle = `rgb(${colours.ink.join(" ")})`;
  const used = [];
  joints.forEach((joint, k) => {
    if (joint.residual === null || Math.abs(joint.residual) < scale / 2) return;
    let [x, y] = place(moved(stands[k + 1], shape.joints[k].point));
    const text = `${joint.joint} ${signed(joint.residual, 2)}`;
    x = Math.min(x + 16, context.canvas.clientWidth - context.measureText(text).width - 4);
    while (used.some((one) => Math.abs(one[1] - y) < 15 && Math.abs(one[0] - x) < 100)) y += 15;
    used.push([x, y]);
    context.strokeText(text, x, y);
    context.fillText(text, x, y);
  });
}
