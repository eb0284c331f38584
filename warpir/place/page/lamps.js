// Lamps near the object: clicked in the photo, shown with a line down to the ground below them. Their
// places are in the ground frame; a photo does not tell how far away they are.

import { clamp, groundPoint, pointSeen, project, ray } from './camera.js';
import { follow, shape } from './handles.js';
import { endOf } from './lines.js';

const CEILING = 2.4; // where a lamp hangs that is above the horizon [m]
const HIGHER = 1; // than a camera that is near that ceiling or above it [m]
const FARTHEST = 20; // camera heights, of a lamp that was clicked or dragged
const RADIUS = 0.05; // [m]
const SHARE = 0.5; // of the ground's level in the photo, that a new lamp gives the ground below the object
const LEAST_COSINE = 0.2; // of its light there: one that is low would need to be too strong
const SPOT = 2; // pixels of the small photo round the click whose mean is the lamp's colour
const BESIDE = 30; // from the lamp to its knob on the screen: the knob would hide what is to be met
const BELOW = 24; // from the ground below it to that knob
const LEVEL_LEAST = 0.1; // camera heights: a lamp that is nearer, seen from above, is not dragged along its ray

const away = ({ stance }, { center }) => Math.hypot(center[0] - stance.x, center[1] - stance.height, center[2] - stance.z);
const replaced = (before, index, change) => ({
  ...before, lamps: before.lamps.map((lamp, k) => (k === index ? { ...lamp, ...change(lamp) } : lamp)),
});

// A new lamp where a pixel shows it.
function lampAt(state, pixel, lighting) {
  const { camera, stance, stand } = state;
  const direction = ray(camera, stance, ...pixel);
  const rise = direction[1] / Math.hypot(...direction);
  const ceiling = Math.max(CEILING, stance.height + HIGHER);
  const level = rise > 0 ? ceiling : RADIUS;
  const reach = (level - stance.height) / rise;
  const distance = reach > 0 ? Math.min(reach, FARTHEST * stance.height) : stance.height;
  const center = pointSeen(camera, stance, pixel, distance, RADIUS);
  // Ground of albedo a at a distance d shows a cos P / (4 pi^2 d^2); that is to be its share of what
  // the photo shows there.
  const d = Math.hypot(center[0] - stand.x, center[1], center[2] - stand.z);
  const cosine = Math.max(center[1] / d, LEAST_COSINE);
  const wanted = SHARE * lighting.groundLevel(state);
  const power = (wanted * 4 * Math.PI ** 2 * d ** 2) / (lighting.start.ground_albedo * cosine);
  return { center, radius: RADIUS, power, color: colorAt(camera, pixel, lighting.pixels) };
}

// Mean of the photo's linear colour round a pixel, its largest channel 1.
function colorAt(camera, [u, v], { width, height, codes }) {
  const [column, row] = [Math.floor((u * width) / camera.width), Math.floor((v * height) / camera.height)];
  const sum = [0, 0, 0];
  for (let y = Math.max(row - SPOT, 0); y <= Math.min(row + SPOT, height - 1); y += 1) {
    for (let x = Math.max(column - SPOT, 0); x <= Math.min(column + SPOT, width - 1); x += 1) {
      for (const c of [0, 1, 2]) sum[c] += (codes[4 * (y * width + x) + c] / 255) ** 2.2;
    }
  }
  const most = Math.max(...sum);
  return most > 0 ? sum.map((part) => part / most) : [1, 1, 1];
}

export class Lamps {
  #chosen = 0;
  #marks = [];

  // `page` has toggle, options, which (a list), remove, words, chosen() and added(state).
  constructor(svg, stage, history, lighting, page) {
    Object.assign(this, { stage, history, lighting, page });
    this.group = svg.appendChild(shape('g', { class: 'lamps' }));
    page.toggle.addEventListener('click', ({ detail }) => (detail || this.isAdding ? this.#turn(!this.isAdding) : this.#hang()));
    page.which.addEventListener('change', () => this.#choose(Number(page.which.value)));
    page.remove.addEventListener('click', () => this.#remove(this.#chosen));
  }

  get isAdding() {
    return this.page.toggle.getAttribute('aria-pressed') === 'true';
  }

  #turn(isOn) {
    this.page.toggle.setAttribute('aria-pressed', String(isOn));
    this.stage.classList.toggle('adding', isOn);
    this.draw(this.history.state);
  }

  #choose(index) {
    this.#chosen = index;
    this.page.chosen();
  }

  #remove(index) {
    this.history.once('lamp removed', (before) => ({ ...before, lamps: before.lamps.filter((_, k) => k !== index) }));
    if (!this.history.state.lamps[index]) this.page.toggle.focus(); // what had the focus is gone
  }

  // A key clicks nowhere: its lamp hangs in the photo's upper middle, and arrows move it from there.
  #hang() {
    const count = this.history.state.lamps.length;
    this.#chosen = count;
    this.history.once('lamp', (before) => {
      const { width, height } = before.camera;
      return { ...before, lamps: [...before.lamps, lampAt(before, [width / 2, height / 4], this.lighting)] };
    });
    this.page.added(this.history.state);
    requestAnimationFrame(() => this.#marks[count].knob.focus());
  }

  // The lamp that the fields are about, if any.
  #of({ lamps }) {
    return lamps[clamp(this.#chosen, 0, lamps.length - 1)];
  }

  // A field's value, null where it has none; and the state with another one.
  get(state, name) {
    const lamp = this.#of(state);
    return lamp ? (name === 'distance' ? away(state, lamp) : lamp[name] ?? null) : null;
  }

  set(before, name, value) {
    const lamp = this.#of(before);
    if (!lamp || (name === 'radius' && lamp.radius === undefined)) return null;
    return replaced(before, before.lamps.indexOf(lamp), () => (name === 'distance' ? this.#farther(before, lamp, value) : { [name]: value }));
  }

  // On the same ray of the camera, also of one behind it.
  #farther({ stance }, { center, radius = 0 }, distance) {
    const eye = [stance.x, stance.height, stance.z];
    const offset = center.map((part, k) => part - eye[k]);
    const length = Math.hypot(...offset) || 1;
    const down = -offset[1] / length;
    const most = down > 0 && stance.height > radius ? (stance.height - radius) / down : Infinity;
    return { center: eye.map((part, k) => part + (offset[k] * Math.min(distance, most)) / length) };
  }

  // Put a lamp where a pointer was pressed in the photo, and let it follow; returns whether it does.
  press(pressed, canvas) {
    if (!this.isAdding || pressed.target !== canvas || pressed.button !== 0 || this.history.isOn) return false;
    const box = this.stage.getBoundingClientRect();
    const put = ({ clientX, clientY }) => this.history.move((before) => {
      const scale = before.camera.width / box.width;
      const pixel = [(clientX - box.left) * scale, (clientY - box.top) * scale];
      return { ...before, lamps: [...before.lamps, lampAt(before, pixel, this.lighting)] };
    });
    const count = this.history.state.lamps.length;
    // A second finger cancels it: then the next click adds one.
    const released = () => {
      const isAdded = this.history.state.lamps.length > count;
      this.#turn(!isAdded);
      if (!isAdded) return;
      requestAnimationFrame(() => this.page.options.scrollIntoView({ block: 'nearest' }));
      this.page.added(this.history.state);
    };
    if (!follow(canvas, pressed, this.history, 'lamp', put, released)) return false;
    this.#chosen = count;
    this.addedAt = pressed.timeStamp;
    put(pressed);
    return true;
  }

  // The same with a lamp on its ray where the ground below it is seen at a pixel.
  #above(before, index, pixel) {
    const { camera, stance, lamps } = before;
    const { center } = lamps[index];
    const ground = groundPoint(camera, stance, ...pixel);
    const [right, ahead] = [center[0] - stance.x, center[2] - stance.z];
    const level = Math.hypot(right, ahead);
    if (!ground || level < LEVEL_LEAST * stance.height) return null;
    const wanted = ((ground[0] - stance.x) * right + (ground[1] - stance.z) * ahead) / level;
    if (!(wanted > LEVEL_LEAST * stance.height)) return null;
    const distance = (Math.min(wanted, FARTHEST * stance.height) * away(before, lamps[index])) / level;
    return replaced(before, index, (lamp) => this.#farther(before, lamp, distance));
  }

  // Its knobs: one drags it over the photo, as far away as it is, one along its ray.
  #mark(index) {
    const group = this.group.appendChild(shape('g', {}));
    const parts = Object.fromEntries(['rim', 'stem'].map((name) => [name, group.appendChild(shape('path', { class: name }))]));
    const ring = group.appendChild(shape('circle', { class: 'glow' }));
    const owner = { group, history: this.history, get scale() { return parts.scale; } };
    const knob = endOf(owner, 'lamp', `lamp${index}`, `Lamp ${index + 1}`, (before, by) => {
      const lamp = before.lamps[index];
      const pixel = lamp && project(before.camera, before.stance, lamp.center);
      return pixel && replaced(before, index, ({ radius = 0 }) => ({
        center: pointSeen(before.camera, before.stance, pixel.map((part, k) => part + by[k]), away(before, lamp), radius),
      }));
    });
    const foot = endOf(owner, 'lamp', `below${index}`, `Ground below lamp ${index + 1}`, (before, by) => {
      const { center } = before.lamps[index] ?? {};
      const pixel = center && project(before.camera, before.stance, [center[0], 0, center[2]]);
      return pixel && this.#above(before, index, pixel.map((part, k) => part + by[k]));
    });
    for (const end of [knob, foot]) {
      for (const kind of ['pointerdown', 'focus']) end.addEventListener(kind, () => this.#choose(index));
      end.addEventListener('keydown', ({ key }) => (key === 'Delete' || key === 'Backspace') && this.#remove(index));
    }
    return Object.assign(parts, { group, ring, knob, foot });
  }

  draw({ camera, stance, lamps }) {
    const { toggle, options, which, words } = this.page;
    const { width, height } = this.stage.getBoundingClientRect();
    const scale = width / camera.width;
    this.#chosen = clamp(this.#chosen, 0, Math.max(lamps.length - 1, 0));
    toggle.textContent = this.isAdding ? 'Click a lamp in the photo …' : 'Add a lamp';
    options.hidden = !lamps.length;
    while (this.#marks.length < lamps.length) this.#marks.push(this.#mark(this.#marks.length));
    if (which.length !== lamps.length) which.replaceChildren(...lamps.map((_, k) => new Option(`Lamp ${k + 1}`, k)));
    which.value = this.#chosen;
    for (const [k, mark] of this.#marks.entries()) {
      const at = k < lamps.length ? project(camera, stance, lamps[k].center) : null;
      mark.group.style.display = at ? '' : 'none';
      if (!at) continue;
      const { center, radius = 0, color } = lamps[k];
      const [x, y] = at.map((part) => part * scale);
      const foot = project(camera, stance, [center[0], 0, center[2]])?.map((part) => part * scale);
      const beside = x + BESIDE + 14 <= width ? x + BESIDE : x - BESIDE;
      const isGrounded = foot && foot[0] > 0 && foot[0] < width && foot[1] > 0 && foot[1] < height;
      const below = isGrounded ? Math.min(foot[1] + BELOW, height - 10) : 0;
      // To the knob, down to the ground, a bar where it ends, and to the knob of that.
      const stem = `M${x} ${y}H${beside}${foot ? `M${x} ${y}L${foot}m-7 0h14` : ''}${isGrounded ? `M${foot}V${below}` : ''}`;
      for (const name of ['rim', 'stem']) mark[name].setAttribute('d', stem);
      const size = Math.max(6, (radius * camera.fx * scale) / away({ stance }, lamps[k]));
      const codes = color.map((part) => Math.round(255 * clamp(part, 0, 1) ** (1 / 2.2)));
      for (const [name, value] of Object.entries({ cx: x, cy: y, r: size, fill: `rgb(${codes})` })) mark.ring.setAttribute(name, value);
      mark.knob.setAttribute('transform', `translate(${beside} ${y})`);
      mark.foot.style.display = isGrounded ? '' : 'none';
      if (isGrounded) mark.foot.setAttribute('transform', `translate(${foot[0]} ${below})`);
      mark.group.classList.toggle('chosen', k === this.#chosen);
      mark.scale = scale;
    }
    const lamp = lamps[this.#chosen];
    if (!lamp) return;
    words.textContent = `${lamp.center[1].toFixed(2)} m above the ground. Its shadow: Render here.`;
    options.querySelector('#radius').closest('.field').hidden = lamp.radius === undefined; // of a rectangle
  }
}
