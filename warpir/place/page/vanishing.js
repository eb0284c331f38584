// The camera from vanishing lines, in closed form. Lines that are parallel in the world meet in the
// photo at their vanishing point F = K d, the image of their direction d. Directions a and b that are
// level and at right angles, and c that is vertical, fulfil d_i . d_j = 0 in the camera's frame; with
// square pixels and the principal point P that is (F_i - P) . (F_j - P) + f^2 = 0, which gives f by two
// of them; three give P as well, the orthocentre of their triangle (Caprile and Torre 1990).
// Points are homogeneous, [x, y, w], in pixels over the photo's width: parallel lines meet at w = 0.

import { cross, dot, horizonRow, levelled, RADIANS, rotation } from './camera.js';

const FARTHEST = 50; // widths of the photo: lines that meet beyond count as parallel
const NARROWEST = 20; // focal lengths and photo widths differ by no more than this factor

// Where two segments meet, lengthened; null where they lie on one line.
export function meeting([one, other], camera) {
  const { width, fx, fy } = camera;
  const raised = ([u, v]) => [u / width, (v * fx) / fy / width, 1];
  const line = (segment) => {
    const through = cross(...segment.map(raised));
    const length = Math.hypot(through[0], through[1]);
    return length ? through.map((part) => part / length) : null;
  };
  const [a, b] = [line(one), line(other)];
  if (!a || !b) return null;
  const point = cross(a, b);
  const reach = Math.hypot(point[0], point[1]);
  if (Math.hypot(reach, point[2]) < 1e-9) return null;
  return Math.abs(point[2]) * FARTHEST < reach ? [point[0] / reach, point[1] / reach, 0] : [point[0] / point[2], point[1] / point[2], 1];
}

// The foot of the triangle's heights.
function orthocentre(a, b, c) {
  const [p, q] = [[b[0] - c[0], b[1] - c[1]], [a[0] - c[0], a[1] - c[1]]];
  const [s, t] = [p[0] * a[0] + p[1] * a[1], q[0] * b[0] + q[1] * b[1]];
  const area = p[0] * q[1] - p[1] * q[0];
  return Math.abs(area) < 1e-9 ? null : [(s * q[1] - t * p[1]) / area, (p[0] * t - q[0] * s) / area];
}

// Where the line through two vanishing points crosses a column.
function rowAt(a, b, x) {
  const [p, q, r] = cross(a, b);
  return Math.abs(q) < 1e-9 ? null : -(p * x + r) / q;
}

// Camera and stance that see the lines as they are drawn; null where none does.
//   lines: { a, b, c }, two segments each, or null where an axis is not used
//   isUpright: the photo was taken with a shifted lens or straightened: its plane is vertical
export function solved(camera, stance, lines, isUpright = false) {
  const { width, fx, fy } = camera;
  const aspect = fy / fx;
  const points = Object.fromEntries(['a', 'b', 'c'].map((axis) => [axis, lines[axis] && meeting(lines[axis], camera)]));
  const { a, b } = points;
  const c = isUpright ? null : points.c;
  const used = [a, b, c].filter(Boolean);
  if (used.length < 2) return null;
  let principal = [camera.cx / width, camera.cy / aspect / width];
  if (isUpright) {
    const row = rowAt(a, b, principal[0]);
    if (row === null) return null;
    principal = [principal[0], row];
  } else if (used.length === 3 && used.every((point) => point[2])) {
    principal = orthocentre(a, b, c);
    if (!principal) return null;
  }
  const from = (point) => [point[0] - point[2] * principal[0], point[1] - point[2] * principal[1]];
  const finite = used.filter((point) => point[2]).slice(0, 2).map(from);
  // Where the lines of all axes but one are parallel, no focal length follows.
  const focal = finite.length === 2 ? Math.sqrt(-dot(...finite)) : fx / width;
  if (!(focal > 1 / NARROWEST && focal < NARROWEST)) return null;
  // Directions in the camera's frame: x right, y up, looking along -z.
  const direction = (point) => {
    const [x, y] = from(point);
    const length = Math.hypot(x, y, point[2] * focal);
    return [x / length, -y / length, (-point[2] * focal) / length];
  };
  let up = c ? direction(c) : cross(direction(a), direction(b));
  const before = rotation(stance)[1];
  if (dot(up, before) < 0) up = up.map((part) => -part);
  const length = Math.hypot(...up);
  return {
    camera: { ...camera, fx: focal * width, fy: focal * width * aspect, cx: principal[0] * width, cy: principal[1] * aspect * width },
    stance: { ...stance, pitch: -Math.asin(up[2] / length) / RADIANS, roll: Math.atan2(up[0], up[1]) / RADIANS },
  };
}

// Two segments for each of the wanted axes along which the camera sees them now.
export function linesOf(camera, stance, axes) {
  const { width, height, fx, fy, cx, cy } = camera;
  const turn = (stance.heading + 45) * RADIANS;
  const world = { a: [Math.sin(turn), 0, Math.cos(turn)], b: [Math.cos(turn), 0, -Math.sin(turn)], c: [0, 1, 0] };
  const starts = { a: [[0.3, 0.62], [0.3, 0.86]], b: [[0.7, 0.62], [0.7, 0.86]], c: [[0.12, 0.5], [0.88, 0.5]] };
  const rows = rotation(stance);
  const segment = (axis, [x, y]) => {
    const d = [0, 1, 2].map((k) => dot(world[axis], rows.map((row) => row[k])));
    const [u, v] = [x * width, y * height];
    // The image of a point that moves along d, at a pixel.
    const way = [fx * d[0] + (cx - u) * -d[2], -fy * d[1] + (cy - v) * -d[2]];
    const half = (0.16 * Math.min(width, height)) / Math.hypot(...way);
    return [[u - way[0] * half, v - way[1] * half], [u + way[0] * half, v + way[1] * half]];
  };
  return Object.fromEntries(['a', 'b', 'c'].map((axis) => [axis, axes.includes(axis) ? starts[axis].map((at) => segment(axis, at)) : null]));
}

// The same view as of an upright photo, by a shifted principal point, or by a pitch; the horizon stays.
// Null where the camera is too steep for a shift.
export function uprighted(camera, stance, isUpright) {
  if (isUpright) {
    if (Math.abs(stance.pitch) > 60) return null;
    return { camera: { ...camera, cy: horizonRow(camera, stance, camera.cx) }, stance: { ...stance, pitch: 0 } };
  }
  const ends = [0, camera.width].map((u) => [u, horizonRow(camera, stance, u)]);
  const plain = { ...camera, cx: camera.width / 2, cy: camera.height / 2 };
  return { camera: plain, stance: levelled(plain, stance, ...ends) };
}
