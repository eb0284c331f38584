// What is dragged over the photo: horizon, ring, size, foot. Positions are pixels of the stage.

import { clamp, corners, groundPoint, horizonRow, isShown, levelled, lowered, placed, pointSeen, project, zoomed } from './camera.js';
import { takeTyped } from './history.js';

const RIM = 14; // handles stay this far inside the stage
const APART = 26; // between the middles of an object's knobs
const LEAST_RING = 44; // radius on the screen, however small the object is
const FARTHEST = 400; // camera heights
const CARRIED = 4; // how many times as far a change of the camera may carry the object
const LOWEST = 0.97; // of the photo's height: the lowest row where such a change sets it
const BESIDE = 34; // between the object's box and its knobs beside it
const ROOMY = 480; // a narrower stage has them there
const ICONS = {
  pitch: 'M0-5V5M-2.6-2.6 0-5.2 2.6-2.6M-2.6 2.6 0 5.2 2.6 2.6',
  roll: 'M-4.5 2A5 5 0 0 1 4.5 2M4.9-1.4 4.6 2.2 1.2 1.4',
  fov: 'M-5 0H5M-2.6-2.6-5.2 0-2.6 2.6M2.6-2.6 5.2 0 2.6 2.6',
  size: 'M-4 4 4-4M.4-4H4V-.4M-.4 4H-4V.4',
  turn: 'M-4 1.5A4.3 4.3 0 1 1 0 4.3M-1.8 2.6 0 4.4-1.8 6.2',
  foot: 'M0-5V5M-5 0H5M-1.8-3.4 0-5.2 1.8-3.4M-1.8 3.4 0 5.2 1.8 3.4M-3.4-1.8-5.2 0-3.4 1.8M3.4-1.8 5.2 0 3.4 1.8',
};
const NAMES = {
  pitch: 'Horizon, up and down', roll: 'Tilt of the horizon, right end', tilt: 'Tilt of the horizon, left end',
  fov: 'Field of view', size: 'Size of the object', turn: 'Turn of the object', foot: 'Place of the object',
};

export function shape(tag, attributes, text = '') {
  const element = document.createElementNS('http://www.w3.org/2000/svg', tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.textContent = text;
  return element;
}

// A knob beside another: farther out where it would lie on it.
function outside([x, y], [u, v]) {
  const away = Math.hypot(x - u, y - v);
  if (away >= APART) return [x, y];
  return away ? [u + ((x - u) * APART) / away, v + ((y - v) * APART) / away] : [u, v + APART];
}

// A knob above another: higher up where it would lie on it.
function above([x, y], [u, v]) {
  const clear = Math.sqrt(Math.max(APART ** 2 - (x - u) ** 2, 0));
  return [x, Math.abs(y - v) < clear ? v - clear : y];
}

// The same with the camera changed: what stood at a pixel of the ground goes on standing there, so
// far as that does not carry it off: then it stands lower in the photo, at `CARRIED` times its
// distance. Null where the photo shows no such ground: the change is not for this object.
export function withCamera(unchanged, camera, stance) {
  const before = { ...unchanged, lamps: carriedLamps(unchanged, camera, stance) };
  const { stand } = before;
  const foot = project(before.camera, before.stance, [stand.x, 0, stand.z]);
  if (!isShown(camera, foot)) return { ...before, camera, stance };
  const away = (point, from) => Math.hypot(point[0] - from.x, point[1] - from.z) / from.height;
  const most = Math.min(CARRIED * Math.max(away([stand.x, stand.z], before.stance), 1), FARTHEST);
  const pointAt = (v) => {
    const point = groundPoint(camera, stance, foot[0], v);
    return point && away(point, stance) <= most * (1 + 1e-9) ? point : null;
  };
  let point = pointAt(foot[1]);
  if (!point) {
    // Nearer ground is lower, but for a camera on its head: the lowest row is the nearest there is.
    let [far, near] = [foot[1], LOWEST * camera.height];
    if (near <= far || !pointAt(near)) return null;
    for (let k = 0; k < 40; k += 1) {
      const row = (far + near) / 2;
      if (pointAt(row)) near = row;
      else far = row;
    }
    point = pointAt(near);
  }
  return { ...before, camera, stance, stand: { x: point[0], z: point[1] } };
}

// Lamps that the photo shows stay where it shows them, as many camera heights away as they were.
function carriedLamps(before, camera, stance) {
  const { x, z, height } = before.stance;
  return before.lamps.map((lamp) => {
    const pixel = project(before.camera, before.stance, lamp.center);
    if (!isShown(camera, pixel)) return lamp;
    const away = Math.hypot(lamp.center[0] - x, lamp.center[1] - height, lamp.center[2] - z);
    return { ...lamp, center: pointSeen(camera, stance, pixel, (away * stance.height) / height, lamp.radius ?? 0) };
  });
}

// The same with the object's foot at a pixel of the photo; as it was where that shows no ground.
export function stoodAt(before, u, v) {
  const { camera, stance } = before;
  const point = groundPoint(camera, stance, u, v);
  if (!point || Math.hypot(point[0] - stance.x, point[1] - stance.z) > FARTHEST * stance.height) return null;
  return { ...before, stand: { x: point[0], z: point[1] } };
}

// The same with the horizon some rows lower, or as far as the object allows: of an upright photo by
// its principal point.
export function shifted(before, rows) {
  const { camera, stance } = before;
  const by = (share) => (before.isUpright
    ? withCamera(before, { ...camera, cy: camera.cy + share * rows }, stance)
    : withCamera(before, camera, lowered(camera, stance, share * rows)));
  const all = by(1);
  if (all) return all;
  let [good, bad] = [0, 1];
  for (let k = 0; k < 20; k += 1) {
    const share = (good + bad) / 2;
    if (by(share)) good = share;
    else bad = share;
  }
  return by(good);
}

// The same with the horizon through two pixels.
function tilted(before, one, other) {
  const { camera, stance } = before;
  const changed = levelled(camera, stance, one, other);
  if (!before.isUpright) return withCamera(before, camera, changed);
  const level = { ...stance, roll: changed.roll };
  return withCamera(before, { ...camera, cy: camera.cy + one[1] - horizonRow(camera, level, one[0]) }, level);
}

// Let an element follow the pointer that was pressed on it until it is released; returns whether it
// does. Other buttons do nothing, nor do other fingers while a gesture goes on.
export function follow(element, pressed, gesture, name, moved, released = () => {}) {
  if (pressed.button !== 0 || gesture.isOn) return false;
  takeTyped();
  element.setPointerCapture(pressed.pointerId);
  gesture.begin(name);
  const move = (event) => {
    if (event.pointerId === pressed.pointerId) moved(event);
  };
  const end = (event) => {
    if (event.pointerId !== pressed.pointerId) return;
    element.removeEventListener('pointermove', move);
    for (const kind of ['pointerup', 'pointercancel']) element.removeEventListener(kind, end);
    gesture.end();
    released();
  };
  element.addEventListener('pointermove', move);
  for (const kind of ['pointerup', 'pointercancel']) element.addEventListener(kind, end);
  return true;
}

export class Handles {
  // `gesture` has begin(), move(change from the state at its beginning), end(), isOn.
  constructor(svg, stage, box, gesture) {
    Object.assign(this, { svg, stage, box, gesture });
    this.horizon = this.#line('horizon', 2);
    this.ring = this.#line('ring', 2);
    this.knobs = {};
    // What is later lies on top: the object's handles go where it goes.
    for (const name of ['tilt', 'pitch', 'fov', 'roll', 'size', 'foot', 'turn']) this.#knob(name);
    this.#drags(this.horizon.hit, 'pitch');
    this.#drags(this.ring.hit, 'turn');
  }

  #line(kind, width) {
    const group = this.svg.appendChild(shape('g', { class: kind }));
    const part = (name, extra) => group.appendChild(shape('path', { class: name, ...extra }));
    return {
      group,
      rim: part('rim', { 'stroke-width': width + 2.5 }),
      line: part('line', { 'stroke-width': width }),
      hit: part('hit', {}),
    };
  }

  #knob(name) {
    const group = this.svg.appendChild(shape('g', {
      class: 'knob', tabindex: 0, role: 'slider', 'aria-label': NAMES[name], 'data-handle': name,
    }));
    const icon = shape('path', { d: ICONS[name === 'tilt' ? 'roll' : name] });
    group.append(shape('circle', { class: 'reach', r: 20 }), shape('circle', { r: 11 }), icon);
    this.knobs[name] = group;
    this.#drags(group, name);
  }

  // Let an element be dragged: the state at the beginning and both pointers give the new one.
  #drags(element, name) {
    element.addEventListener('pointerdown', (event) => {
      if (!this.drag(event, element, name)) return;
      event.preventDefault();
      event.stopPropagation();
      if (element.tabIndex >= 0) element.focus({ focusVisible: false });
    });
  }

  drag(event, element, name) {
    const from = this.#pixel(event);
    return follow(element, event, this.gesture, name, (moved) => {
      const to = this.#pixel(moved);
      this.gesture.move((before) => this.#dragged(name, before, from, to));
    });
  }

  #pixel(event) {
    const box = this.stage.getBoundingClientRect();
    return [(event.clientX - box.left) / this.scale, (event.clientY - box.top) / this.scale];
  }

  #dragged(name, before, from, to) {
    const { camera, stance, stand } = before;
    const [du, dv] = [to[0] - from[0], to[1] - from[1]];
    const foot = project(camera, stance, [stand.x, 0, stand.z]);
    if (name === 'pitch') return shifted(before, dv);
    if (name === 'roll' || name === 'tilt') {
      // The middle of what is seen of the horizon stays; this end follows the pointer.
      const [row, { middle }] = [horizonRow(camera, stance, from[0]), this];
      return tilted(before, [middle, horizonRow(camera, stance, middle)], [from[0], row + dv]);
    }
    if (name === 'fov') {
      // What is under the pointer goes with it: away from the principal point the view narrows.
      const reach = Math.max(Math.abs(from[0] - camera.cx), camera.width / 10);
      const factor = Math.max((reach + du * (from[0] < camera.cx ? -1 : 1)) / reach, 0.1);
      const fx = clamp(camera.fx * factor, camera.width / 20, camera.width * 20);
      const changed = zoomed(camera, stance, fx);
      return withCamera(before, changed.camera, changed.stance);
    }
    if (!foot) return before;
    if (name === 'foot') return stoodAt(before, foot[0] + du, foot[1] + dv);
    if (this.isBeside && name === 'turn') return { ...before, turn: before.turn + 0.8 * du * this.scale };
    if (this.isBeside && name === 'size') return { ...before, size: before.size * Math.exp((-dv * this.scale) / 90) };
    if (name === 'size') {
      const height = Math.max(foot[1] - from[1], 8 / this.scale);
      return { ...before, size: before.size * Math.max((height - dv) / height, 0.02) };
    }
    const [a, b] = [from, to].map(([u, v]) => {
      // Above the horizon no ground is seen: the angle on the screen has to do.
      const point = groundPoint(camera, stance, u, v);
      return point ? Math.atan2(point[0] - stand.x, point[1] - stand.z) : null;
    });
    if (a === null || b === null) return before;
    return { ...before, turn: before.turn + ((b - a) * 180) / Math.PI };
  }

  // Whether a pointer is on the object.
  isOnObject(event) {
    const [u, v] = this.#pixel(event);
    const [left, top, right, bottom] = this.bounds ?? [1, 1, 0, 0];
    const slack = 10 / this.scale;
    return u > left - slack && u < right + slack && v > top - slack && v < bottom + slack;
  }

  // `seen` is the part of the photo that is shown, in its pixels.
  draw(state, seen) {
    const { camera, stance, stand, turn, size } = state;
    this.scale = this.stage.getBoundingClientRect().width / camera.width;
    this.middle = seen.x + seen.width / 2;
    const onStage = (pixel) => pixel && pixel.map((part) => part * this.scale);
    const low = [seen.x, seen.y].map((part) => part * this.scale + RIM);
    const high = [seen.x + seen.width, seen.y + seen.height].map((part) => part * this.scale - RIM);
    const inside = (at) => at.map((part, k) => clamp(part, low[k], high[k]));
    const put = (name, pixel) => {
      this.knobs[name].style.display = pixel ? '' : 'none';
      if (pixel) this.knobs[name].setAttribute('transform', `translate(${inside(pixel)})`);
    };
    const draw = (line, path) => {
      for (const part of ['rim', 'line', 'hit']) line[part].setAttribute('d', path);
    };

    const at = corners(this.box, placed(this.box, stand, turn, size)).map((p) => project(camera, stance, p));
    this.bounds = at.every(Boolean) ? [
      Math.min(...at.map((p) => p[0])), Math.min(...at.map((p) => p[1])),
      Math.max(...at.map((p) => p[0])), Math.max(...at.map((p) => p[1])),
    ] : null;
    this.isBeside = Boolean(this.bounds) && this.stage.parentElement.clientWidth < ROOMY;
    const level = (share) => {
      const u = seen.x + share * seen.width;
      return onStage([u, horizonRow(camera, stance, u)]);
    };
    draw(this.horizon, `M${level(0)}L${level(1)}`);
    // On a phone they leave the object free.
    const free = (...shares) => shares.map(level).find((pixel) => !this.isBeside || !this.#isOver(inside(pixel))) ?? level(shares[0]);
    put('pitch', free(0.5, 0.3, 0.7, 0.2, 0.85));
    put('fov', free(0.76, 0.82, 0.18));
    put('tilt', level(0.06));
    put('roll', level(0.94));
    const { foot, onRing } = this.#drawRing(state, draw, onStage);
    if (this.isBeside) this.#putBeside(put, state, low, high);
    else this.#putAround(put, state, onStage(foot), onStage(onRing), onStage);
  }

  // Whether a place on the stage is on the object, or so near that a knob would be.
  #isOver([x, y]) {
    const [left, top, right, bottom] = this.bounds.map((part) => part * this.scale);
    return x > left - RIM && x < right + RIM && y > top - RIM && y < bottom + RIM;
  }

  #drawRing({ camera, stance, stand, turn, size }, draw, onStage) {
    const away = Math.hypot(stand.x - stance.x, stance.height, stand.z - stance.z);
    const side = Math.max(...this.box.high.map((top, k) => top - this.box.low[k]));
    const across = Math.hypot(this.box.high[0] - this.box.low[0], this.box.high[2] - this.box.low[2]);
    const radius = Math.max((0.62 * across * size) / side, (LEAST_RING * away) / (camera.fx * this.scale));
    const round = (angle) => project(camera, stance, [
      stand.x + radius * Math.sin(angle), 0, stand.z + radius * Math.cos(angle),
    ]);
    const ring = Array.from({ length: 73 }, (_, k) => onStage(round((k * Math.PI) / 36)));
    draw(this.ring, ring.every(Boolean) ? `M${ring.join('L')}Z` : '');
    return { foot: project(camera, stance, [stand.x, 0, stand.z]), onRing: round((turn * Math.PI) / 180) };
  }

  #putAround(put, { camera, stance }, footAt, onRing, onStage) {
    const top = this.bounds ? onStage([(this.bounds[0] + this.bounds[2]) / 2, this.bounds[1]]) : footAt;
    const asideAt = footAt && onRing && outside(onRing, footAt);
    // Above the horizon it could not be dragged.
    const turnAt = asideAt && groundPoint(camera, stance, ...asideAt.map((part) => part / this.scale)) ? asideAt : onRing;
    const lowestFirst = [footAt, turnAt].filter(Boolean).sort((a, b) => b[1] - a[1]);
    put('foot', footAt);
    put('turn', turnAt);
    put('size', top && lowestFirst.reduce(above, [top[0], top[1] - 30]));
  }

  // In a column to the object's right, or to its left where there is no room; below the horizon and
  // what lies on it.
  #putBeside(put, { camera, stance }, low, high) {
    const [left, top, right, bottom] = this.bounds.map((part) => part * this.scale);
    const x = right + BESIDE <= high[0] || left - BESIDE < low[0] ? right + BESIDE : left - BESIDE;
    const step = 42;
    const highest = horizonRow(camera, stance, x / this.scale) * this.scale + APART + step;
    const middle = clamp(Math.max((top + bottom) / 2, highest), low[1] + step, high[1] - step);
    for (const [k, name] of ['size', 'turn', 'foot'].entries()) put(name, [x, middle + (k - 1) * step]);
  }

  // What each handle stands at, for those who do not see it.
  say(values) {
    for (const [name, { text, now, low, high }] of Object.entries(values)) {
      const attributes = { valuetext: text, valuenow: now, valuemin: low, valuemax: high };
      for (const [key, value] of Object.entries(attributes)) this.knobs[name].setAttribute(`aria-${key}`, value);
    }
  }
}
