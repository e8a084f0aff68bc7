// Small solid geometry for the drawing of the arm: vectors, rotations about axes in space, tubes, balls and drums.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const times = (s, a) => [s * a[0], s * a[1], s * a[2]];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);
export const unit = (a) => times(1 / (length(a) || 1), a);
export const perpendicular = (a) => unit(cross(a, Math.abs(a[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]));

export const STAND = { turn: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], shift: [0, 0, 0] };
export const rotated = (motion, a) => motion.turn.map((row) => dot(row, a));
export const moved = (motion, p) => add(rotated(motion, p), motion.shift);

// A motion, and before it a rotation by `angle` about the axis through `point` (Rodrigues).
export function after(motion, axis, point, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), [x, y, z] = axis, t = 1 - c;
  const own = [
    [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
    [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
    [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
  ];
  const left = sub(point, own.map((row) => dot(row, point)));
  const columns = [0, 1, 2].map((k) => own.map((row) => row[k]));
  return { turn: motion.turn.map((row) => columns.map((column) => dot(row, column))), shift: moved(motion, left) };
}

const SIDES = 16;
const circle = (centre, axis, radius) => {
  const u = perpendicular(axis), v = cross(axis, u);
  return Array.from({ length: SIDES }, (_, k) => {
    const angle = (2 * Math.PI * k) / SIDES;
    return add(centre, add(times(radius * Math.cos(angle), u), times(radius * Math.sin(angle), v)));
  });
};

// Faces between two circles; {points, normal} as all faces here.
function sleeve(first, second, axis) {
  const middle = (points) => times(1 / points.length, points.reduce(add));
  const centre = middle([...first, ...second]);
  return first.map((_, k) => {
    const next = (k + 1) % SIDES;
    const points = [first[k], first[next], second[next], second[k]];
    const out = sub(middle(points), centre);
    return { points, normal: unit(sub(out, times(dot(out, axis), axis))) };
  });
}

// In short pieces, which are sorted by depth better than long ones.
export function tube(from, to, radius) {
  const axis = unit(sub(to, from)), pieces = Math.max(1, Math.min(10, Math.round(length(sub(to, from)) / radius)));
  const rings = Array.from({ length: pieces + 1 }, (_, k) => circle(add(from, times(k / pieces, sub(to, from))), axis, radius));
  return rings.slice(1).flatMap((ring, k) => sleeve(rings[k], ring, axis));
}

export function drum(centre, axis, radius, half) {
  const ends = [-half, half].map((shift) => circle(add(centre, times(shift, axis)), axis, radius));
  return [...sleeve(...ends, axis), { points: ends[0], normal: times(-1, axis) }, { points: ends[1], normal: axis }];
}

export function ball(centre, radius) {
  const axis = [0, 0, 1], rings = 6;
  const ring = (k) => {
    const angle = Math.PI * (k / rings - 0.5);
    return circle(add(centre, times(radius * Math.sin(angle), axis)), axis, Math.max(1e-6, radius * Math.cos(angle)));
  };
  const faces = Array.from({ length: rings }, (_, k) => sleeve(ring(k), ring(k + 1), axis)).flat();
  return faces.map(({ points }) => ({ points, normal: unit(sub(times(0.25, points.reduce(add)), centre)) }));
}
