// Which part of the photo the room shows: zoom and pan, by wheel, fingers, buttons and keys. It is
// no part of the state: undo leaves it alone, and 0 shows the whole photo again.

import { clamp } from './camera.js';

const CLOSEST = 16; // times as large as where the whole photo is seen
const NOTCH = 1.0015; // factor of a wheel's unit
const PINCH = 1.01; // of a touchpad's, which comes as a wheel with Ctrl
const STEP = 1.25; // of a key or a button
const SHIFT = 0.1; // of the room, by a key

export class View {
  zoom = 1;
  #middle = [0.5, 0.5]; // shares of the photo in the room's middle
  #fingers = new Map();
  #isPanning = false;

  // `page` has changed(window, size on the screen), pressed(event): whether something else takes a
  // pointer, and cancel(): ends what that began.
  constructor(room, element, canvas, photo, page) {
    Object.assign(this, { room, element, canvas, photo, page });
    room.addEventListener('wheel', (event) => this.#wheel(event), { passive: false });
    room.addEventListener('pointerdown', (event) => this.#press(event));
    room.addEventListener('pointerdown', (event) => this.#pressSecond(event), true);
    room.addEventListener('pointermove', (event) => this.#move(event));
    for (const kind of ['pointerup', 'pointercancel']) {
      room.addEventListener(kind, (event) => this.#fingers.delete(event.pointerId));
    }
  }

  // Pixels of the screen per pixel of the photo.
  get scale() {
    const { width, height } = this.room.getBoundingClientRect();
    return this.zoom * Math.min(width / this.photo.width, height / this.photo.height);
  }

  show() {
    const { width, height } = this.room.getBoundingClientRect();
    const { scale, element, canvas } = this;
    const size = [this.photo.width * scale, this.photo.height * scale];
    const inRoom = [width, height];
    const at = size.map((side, k) => (
      side <= inRoom[k] ? (inRoom[k] - side) / 2 : clamp(inRoom[k] / 2 - this.#middle[k] * side, inRoom[k] - side, 0)));
    this.#middle = at.map((place, k) => (inRoom[k] / 2 - place) / size[k]);
    const from = at.map((place) => Math.max(0, -place));
    const seen = size.map((side, k) => Math.min(side, inRoom[k] - at[k]) - from[k]);
    const px = (part) => `${part}px`;
    Object.assign(element.style, { left: px(at[0]), top: px(at[1]), width: px(size[0]), height: px(size[1]) });
    Object.assign(canvas.style, { left: px(from[0]), top: px(from[1]), width: px(seen[0]), height: px(seen[1]) });
    const [x, y, w, h] = [...from, ...seen].map((part) => part / scale);
    this.page.changed({ x, y, width: w, height: h }, seen);
  }

  // The whole photo.
  fit() {
    Object.assign(this, { zoom: 1 });
    this.#middle = [0.5, 0.5];
    this.show();
  }

  // Zoom so that what was under one point of the screen is under another then.
  zoomAt(factor, from, to = from) {
    const room = this.room.getBoundingClientRect();
    const box = this.element.getBoundingClientRect();
    const point = [(from[0] - box.left) / box.width, (from[1] - box.top) / box.height];
    this.zoom = clamp(this.zoom * factor, 1, CLOSEST);
    const size = [this.photo.width * this.scale, this.photo.height * this.scale];
    const away = [room.left + room.width / 2 - to[0], room.top + room.height / 2 - to[1]];
    this.#middle = point.map((share, k) => share + away[k] / size[k]);
    this.show();
  }

  #centre() {
    const { left, top, width, height } = this.room.getBoundingClientRect();
    return [left + width / 2, top + height / 2];
  }

  // Zoom by steps about the room's middle.
  step(count) {
    this.zoomAt(STEP ** count, this.#centre());
  }

  // Show what lies beside, by shares of the room.
  pan(right, down) {
    const { width, height } = this.room.getBoundingClientRect();
    const [x, y] = this.#centre();
    this.zoomAt(1, [x, y], [x - SHIFT * right * width, y - SHIFT * down * height]);
  }

  #wheel(event) {
    if (event.shiftKey || event.altKey) return;
    event.preventDefault();
    const unit = event.deltaMode === 1 ? 33 : 1; // lines
    this.zoomAt((event.ctrlKey ? PINCH : NOTCH) ** (-event.deltaY * unit), [event.clientX, event.clientY]);
  }

  #press(event) {
    if (event.target.closest('button, #handles') || this.#fingers.size || event.button > 1) return;
    this.#follow(event, event.button === 1 || !this.page.pressed(event));
  }

  // A second finger zooms wherever it lies, and takes back what the first has moved.
  #pressSecond(event) {
    if (this.#fingers.size !== 1 || event.pointerType !== 'touch') return;
    event.stopPropagation();
    this.page.cancel();
    this.#follow(event, true);
  }

  #follow(event, isPanning) {
    this.#isPanning = isPanning;
    this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
    // What else follows a pointer has captured it, and would not hear that it is released.
    if (isPanning) event.target.setPointerCapture(event.pointerId);
  }

  #move(event) {
    const before = this.#fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    this.#fingers.set(event.pointerId, now);
    if (!this.#isPanning) return;
    const other = [...this.#fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (!other) {
      this.zoomAt(1, before, now);
      return;
    }
    const apart = (a, b) => Math.max(Math.hypot(a[0] - b[0], a[1] - b[1]), 1);
    const between = (a, b) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    this.zoomAt(apart(now, other) / apart(before, other), between(before, other), between(now, other));
  }
}
