// The pinhole camera of warpir/scene/camera.py over a level ground: the same numbers, the same pixels.
// Ground frame: right-handed, +Y up, metres, the ground is y = 0; the camera looks along its -Z.
// Pixels of the upright photo: origin top left, v down. Angles are degrees.

export const RADIANS = Math.PI / 180;
export const STEEPEST = 89;
export const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
export const dot = (a, b) => a.reduce((sum, part, k) => sum + part * b[k], 0);
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const steep = (pitch) => clamp(pitch, -STEEPEST, STEEPEST);

// Camera to ground frame, rows of turn_y(heading) turn_x(pitch) turn_z(roll).
export function rotation(stance) {
  const [h, p, r] = [stance.heading, stance.pitch, stance.roll].map((a) => a * RADIANS);
  const [ch, sh, cp, sp] = [Math.cos(h), Math.sin(h), Math.cos(p), Math.sin(p)];
  const [cr, sr] = [Math.cos(r), Math.sin(r)];
  return [
    [ch * cr + sh * sp * sr, -ch * sr + sh * sp * cr, sh * cp],
    [cp * sr, cp * cr, -sp],
    [-sh * cr + ch * sp * sr, sh * sr + ch * sp * cr, ch * cp],
  ];
}

// Camera to ground frame as 16 numbers, column by column.
export function pose(stance) {
  const [a, b, c] = rotation(stance);
  return [
    a[0], b[0], c[0], 0, a[1], b[1], c[1], 0, a[2], b[2], c[2], 0,
    stance.x, stance.height, stance.z, 1,
  ];
}

// OpenGL's projection with the camera's own focal lengths and principal point, column by column.
export function projection(camera, near, far) {
  const { width, height, fx, fy, cx, cy } = camera;
  return [
    (2 * fx) / width, 0, 0, 0,
    0, (2 * fy) / height, 0, 0,
    1 - (2 * cx) / width, (2 * cy) / height - 1, -(far + near) / (far - near), -1,
    0, 0, (-2 * far * near) / (far - near), 0,
  ];
}

// Pixel of a point of the ground frame; null behind the camera.
export function project(camera, stance, point) {
  const turn = rotation(stance);
  const offset = [point[0] - stance.x, point[1] - stance.height, point[2] - stance.z];
  const local = [0, 1, 2].map((k) => turn.reduce((sum, row, i) => sum + row[k] * offset[i], 0));
  if (local[2] >= -1e-9) return null;
  return [
    camera.cx - (camera.fx * local[0]) / local[2],
    camera.cy + (camera.fy * local[1]) / local[2],
  ];
}

// Whether the photo shows a point, given its pixel or null.
export function isShown(camera, pixel) {
  return pixel && pixel[0] >= 0 && pixel[0] <= camera.width && pixel[1] >= 0 && pixel[1] <= camera.height;
}

// Direction through a pixel, not of unit length.
export function ray(camera, stance, u, v) {
  const local = [(u - camera.cx) / camera.fx, -(v - camera.cy) / camera.fy, -1];
  return rotation(stance).map((row) => row[0] * local[0] + row[1] * local[1] + row[2] * local[2]);
}

// Where a pixel shows the ground, [x, z]; null at and above the horizon.
export function groundPoint(camera, stance, u, v) {
  const direction = ray(camera, stance, u, v);
  if (direction[1] >= -1e-9) return null;
  const reach = -stance.height / direction[1];
  return [stance.x + reach * direction[0], stance.z + reach * direction[2]];
}

// The point that a pixel shows at a distance from the camera [m]; nearer where the ray would come
// lower than `least` above the ground.
export function pointSeen(camera, stance, [u, v], distance, least) {
  const direction = ray(camera, stance, u, v);
  const down = -direction[1] / Math.hypot(...direction);
  const most = down > 0 && stance.height > least ? (stance.height - least) / down : Infinity;
  const reach = Math.min(distance, most) / Math.hypot(...direction);
  return [stance.x, stance.height, stance.z].map((part, k) => part + reach * direction[k]);
}

// Length of what a segment of the photo shows [m]: of ground between its ends, or of something upright
// that stands on the ground at the lower end (the ray through the upper one passes the vertical there
// at this height). It grows with the camera's height. Null where the photo shows no such thing.
export function lengthSeen(camera, stance, ends, isUpright) {
  const [low, high] = [...ends].sort((a, b) => b[1] - a[1]);
  const foot = groundPoint(camera, stance, ...low);
  if (!foot) return null;
  if (!isUpright) {
    const other = groundPoint(camera, stance, ...high);
    return other && Math.hypot(other[0] - foot[0], other[1] - foot[1]);
  }
  const [x, y, z] = ray(camera, stance, ...high);
  const reach = ((foot[0] - stance.x) * x + (foot[1] - stance.z) * z) / (x * x + z * z);
  const length = stance.height + reach * y;
  return reach > 0 && length > 0 ? length : null;
}

// Row of the horizon in a column: level directions d fulfil d.y = 0, with the second row of the
// rotation sin(roll) X - cos(roll) Y + tan(pitch) = 0 in X = (u - cx) / fx, Y = (v - cy) / fy.
export function horizonRow(camera, stance, u) {
  const [p, r] = [steep(stance.pitch) * RADIANS, stance.roll * RADIANS];
  const x = (u - camera.cx) / camera.fx;
  return camera.cy + camera.fy * (Math.tan(p) / Math.cos(r) + Math.tan(r) * x);
}

// Pitch and roll of a camera that sees the horizon through two pixels. Two cameras do, one of them
// upside down (roll + 180, -pitch): the one that is nearer to how it stood.
export function levelled(camera, stance, one, other) {
  const [x0, x1] = [one, other].map(([u]) => (u - camera.cx) / camera.fx);
  const [y0, y1] = [one, other].map(([, v]) => (v - camera.cy) / camera.fy);
  const roll = Math.atan2(y1 - y0, x1 - x0);
  const pitch = Math.atan(Math.cos(roll) * y0 - Math.sin(roll) * x0);
  const isOver = Math.cos(roll - stance.roll * RADIANS) < 0;
  const [tilt, sign] = isOver ? [roll - Math.PI * Math.sign(roll || -1), -1] : [roll, 1];
  return { ...stance, pitch: steep((sign * pitch) / RADIANS), roll: tilt / RADIANS };
}

// The horizon by some rows lower: what adds to its row adds to tan(pitch).
export function lowered(camera, stance, rows) {
  const rise = (Math.cos(stance.roll * RADIANS) * rows) / camera.fy;
  const pitch = Math.atan(Math.tan(steep(stance.pitch) * RADIANS) + rise);
  return { ...stance, pitch: steep(pitch / RADIANS) };
}

// Another field of view that leaves the horizon where it is in the photo.
export function zoomed(camera, stance, fx) {
  const pitch = Math.atan((Math.tan(stance.pitch * RADIANS) * camera.fx) / fx) / RADIANS;
  return { camera: { ...camera, fx, fy: (camera.fy * fx) / camera.fx }, stance: { ...stance, pitch } };
}

// Horizontal field of view [deg], as --fov means it, and back.
export const fieldOfView = (camera) => (2 * Math.atan(camera.width / 2 / camera.fx)) / RADIANS;
export const focalLength = (camera, fov) => camera.width / 2 / Math.tan((fov * RADIANS) / 2);

// Asset frame to ground frame, column by column: the centre of its footprint at the stand, its
// lowest point on the ground, turned counter-clockwise seen from above (warpir/scene/placement.py).
export function placed(asset, stand, turn, size) {
  const { low, high } = asset;
  const scale = size / Math.max(...high.map((top, k) => top - low[k]));
  const [c, s] = [Math.cos(turn * RADIANS) * scale, Math.sin(turn * RADIANS) * scale];
  const foot = [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2];
  return [
    c, 0, -s, 0, 0, scale, 0, 0, s, 0, c, 0,
    stand.x - c * foot[0] - s * foot[2], -scale * foot[1], stand.z + s * foot[0] - c * foot[2], 1,
  ];
}

// The eight corners of the asset's bounding box in the ground frame.
export function corners(asset, matrix) {
  const m = matrix;
  return [0, 1, 2, 3, 4, 5, 6, 7].map((bits) => {
    const [x, y, z] = [0, 1, 2].map((k) => (bits >> k) & 1 ? asset.high[k] : asset.low[k]);
    return [0, 1, 2].map((row) => m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row]);
  });
}

// Toward (azimuth, elevation) in the world, as --sun means them.
export function sunAxis(azimuth, elevation) {
  const [a, e] = [azimuth * RADIANS, elevation * RADIANS];
  return [Math.cos(e) * Math.sin(a), Math.sin(e), -Math.cos(e) * Math.cos(a)];
}
