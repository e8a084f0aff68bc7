// SVG plots: gain and offset of one joint, one above the other, and the events, all on one time axis.

const LEFT = 46, RIGHT = 6, PANEL = 62, GAP = 20, AXIS = 20;

export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

const STEPS = [10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 43200, 86400, 172800, 604800, 1209600, 2592000];

function timeTicks([from, to], width) {
  const most = Math.max(2, Math.floor(width / 75));
  const step = 1000 * (STEPS.find((seconds) => (to - from) / 1000 / seconds <= most) ?? 7776000);
  const zone = new Date(from).getTimezoneOffset() * 60000;
  const ticks = [];
  for (let at = Math.ceil((from - zone) / step) * step + zone; at <= to; at += step) ticks.push([at, label(at, step)]);
  return ticks;
}

function label(at, step) {
  const time = new Date(at);
  if (step >= 86400000) return time.toLocaleDateString([], { day: "numeric", month: "short" });
  const two = (value) => String(value).padStart(2, "0");
  return `${two(time.getHours())}:${two(time.getMinutes())}${step < 60000 ? `:${two(time.getSeconds())}` : ""}`;
}

const across = (range, width) => (time) => LEFT + ((time - range[0]) / (range[1] - range[0])) * (width - LEFT - RIGHT);

function axis(range, width, top, bottom) {
  const x = across(range, width);
  return timeTicks(range, width - LEFT - RIGHT).flatMap(([at, text]) => [
    svg("line", { class: "grid", x1: x(at), x2: x(at), y1: top, y2: bottom }),
    svg("text", { x: x(at), y: bottom + 14, "text-anchor": x(at) > width - 20 ? "end" : "middle" }, text),
  ]);
}

// One quantity with its 95 % band; points are {time, value, std, record}; `half` is the half height of the axis.
function panel(points, range, width, top, half, name, digits, unit) {
  const x = across(range, width), middle = top + PANEL / 2;
  const y = (value) => middle - (Math.max(-1.05, Math.min(1.05, value / half)) * PANEL) / 2;
  const group = svg("g", {});
  for (const [value, text] of [[half, `+${half.toFixed(digits)}`], [0, unit], [-half, `−${half.toFixed(digits)}`]]) {
    group.append(svg("line", { class: value ? "grid" : "zero", x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value) }));
    group.append(svg("text", { x: LEFT - 5, y: y(value) + 4, "text-anchor": "end" }, text));
  }
  const place = (time, value) => `${x(time).toFixed(1)},${y(value).toFixed(1)}`;
  for (const piece of pieces(points)) {
    const upper = piece.map((p) => place(p.time, p.value + 1.96 * p.std));
    const lower = piece.map((p) => place(p.time, p.value - 1.96 * p.std)).reverse();
    group.append(svg("polygon", { class: `band ${name}`, points: [...upper, ...lower].join(" ") }));
    group.append(svg("polyline", { class: `line ${name}`, points: piece.map((p) => place(p.time, p.value)).join(" ") }));
  }
  return group;
}

// A new record begins a new line: estimates before and after are relative to different calibrations.
function pieces(points) {
  const found = [];
  for (const point of points) {
    if (!found.length || found.at(-1).at(-1).record !== point.record) found.push([]);
    found.at(-1).push(point);
  }
  return found;
}

function marks(events, range, width, top, bottom) {
  const x = across(range, width);
  return events.map((event) => svg("line", { class: `event ${event.category}`, x1: x(event.at), x2: x(event.at), y1: top, y2: bottom },
    svg("title", {}, event.title)));
}

export function drawJoint(figure, name, width, range, points, events, halves) {
  const height = 2 * PANEL + GAP + AXIS + 6, bottom = height - AXIS;
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": name });
  const of = (key, shift, factor) => points.map((p) => ({ time: p.at, value: factor * (p[key] - shift), std: factor * p[`${key}_std`], record: p.record }));
  drawing.append(
    ...axis(range, width, 6, bottom),
    panel(of("gain", 1, 100), range, width, 6, halves.gain, "gain", halves.gain < 1 ? 1 : 0, "%"),
    panel(of("offset", 0, 1), range, width, 6 + PANEL + GAP, halves.offset, "offset", halves.offset < 1 ? 2 : 0, "N·m"),
    ...marks(events, range, width, 2, bottom),
  );
  figure.replaceChildren(drawing);
}

const LANES = ["fault", "drift", "load", "change"];

// All events of the arm, one lane per colour.
export function drawTimeline(figure, width, range, events) {
  const lane = 15, height = LANES.length * lane + AXIS + 4, bottom = height - AXIS, x = across(range, width);
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "img", "aria-label": `Events over time: ${events.length || "none"}` });
  drawing.append(...axis(range, width, 0, bottom));
  LANES.forEach((name, index) => {
    const y = lane * (index + 0.5) + 2;
    drawing.append(svg("text", { x: LEFT - 5, y: y + 4, "text-anchor": "end" }, name));
    drawing.append(svg("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y, y2: y }));
    for (const event of events.filter((one) => one.category === name)) {
      drawing.append(svg("circle", { class: `dot ${name}`, cx: x(event.at), cy: y, r: 5 }, svg("title", {}, event.title)));
    }
  });
  figure.replaceChildren(drawing);
}
