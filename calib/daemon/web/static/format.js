// Formatting of numbers and times, and small helpers of the page.

export const MISSING = "–";

export const number = (value, digits) =>
  value === null || value === undefined ? MISSING : value.toFixed(digits).replace("-", "−");

export const signed = (value, digits) =>
  value === null || value === undefined ? MISSING : (value >= 0 ? "+" : "") + number(value, digits);

export const whole = (value) => value.toLocaleString("en-GB").replaceAll(",", "\u202f");

export function duration(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${(seconds / 3600).toFixed(1)} h`;
  return `${Math.round(seconds / 86400)} days`;
}

export const clock = (time) => {
  const at = new Date(time);
  const two = (value) => String(value).padStart(2, "0");
  return `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
};

// A new element: properties, then children (elements or text).
export function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

export const by = (id) => document.getElementById(id);

// Sets text only if it differs, so that ten updates per second do not cause a new layout of unchanged content.
export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

const CATEGORIES = {
  fault: ["fault", "refused", "failed"],
  drift: ["drift", "alarm", "undecided", "proposal", "wear"],
  load: ["payload", "contact", "effect"],
  change: ["recalibration", "approved", "rejected", "roll-back", "check", "sweep", "recovered"],
};

// The colour of an event; empty for those without one (started, stopped, clear, configuration, clock, diagnosis).
export const category = (kind) => Object.keys(CATEGORIES).find((name) => CATEGORIES[name].includes(kind)) ?? "";

// The page marks a drift beyond three standard deviations and beyond the required accuracy of a calibration.
export const GAIN_OFF = 0.003;
export const OFFSET_OFF = 0.05;
export const gainIsOff = (one) => Math.abs(one.gain - 1) > Math.max(GAIN_OFF, 3 * one.gain_std);
export const offsetIsOff = (one) => Math.abs(one.offset) > Math.max(OFFSET_OFF, 3 * one.offset_std);
