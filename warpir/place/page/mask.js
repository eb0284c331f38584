// What stands in front of the object: painted over the photo with a brush and an eraser. Strokes are
// part of the state; the photo's own pixels are shown where they lie, as warpir shows them.

import { follow } from './handles.js';

const SIDE = 2048; // longest side of the mask [pixels]; warpir brings it to the photo's size
const TINT = 'rgb(255 70 40 / 0.4)';

export class Mask {
  #drawn = [];
  #isTinted = false;

  // `elements` has front (the canvas over the object), toggle, options, brush, eraser, width, clear;
  // `saved` is an image of what was painted before, the first stroke of the state, or null.
  constructor(elements, photo, saved, size, history, stage) {
    Object.assign(this, elements, { photo, saved, history, stage });
    this.scale = Math.min(1, SIDE / Math.max(size.width, size.height));
    const [width, height] = [size.width, size.height].map((side) => Math.max(1, Math.round(side * this.scale)));
    this.canvas = Object.assign(document.createElement('canvas'), { width, height });
    Object.assign(this.front, { width, height });
    this.size = size;
    this.toggle.addEventListener('click', () => this.#turn(!this.isPainting));
    for (const tool of [this.brush, this.eraser]) {
      tool.addEventListener('click', () => {
        for (const other of [this.brush, this.eraser]) other.setAttribute('aria-pressed', String(other === tool));
      });
    }
    this.clear.addEventListener('click', () => history.once('clear', (before) => (before.mask.length ? { ...before, mask: [] } : null)));
  }

  get isPainting() {
    return this.toggle.getAttribute('aria-pressed') === 'true';
  }

  #turn(isOn) {
    this.toggle.setAttribute('aria-pressed', String(isOn));
    this.options.hidden = !isOn;
    this.stage.classList.toggle('painting', isOn);
    this.draw(this.history.state);
  }

  // Begin a stroke where a pointer was pressed; returns whether it paints.
  press(pressed) {
    if (!this.isPainting) return false;
    const box = this.stage.getBoundingClientRect();
    const at = ({ clientX, clientY }) => [
      ((clientX - box.left) / box.width) * this.size.width, ((clientY - box.top) / box.height) * this.size.height,
    ];
    // The brush is as wide on the screen whatever the zoom.
    const radius = ((Number(this.width.value) / 2) * this.size.width) / box.width;
    const points = [at(pressed)];
    const isErased = this.eraser.getAttribute('aria-pressed') === 'true';
    const paint = () => this.history.move((before) => ({
      ...before, mask: [...before.mask, { points: [...points], radius, isErased }],
    }));
    const isOn = follow(pressed.target, pressed, this.history, 'mask', (event) => {
      points.push(at(event));
      paint();
    });
    if (isOn) paint();
    return isOn;
  }

  #stroke(brush, { points, radius, isErased, isSaved }) {
    if (isSaved) {
      brush.globalCompositeOperation = 'source-over';
      brush.drawImage(this.saved, 0, 0, this.canvas.width, this.canvas.height);
      return;
    }
    const [first, ...others] = points.map((point) => point.map((part) => part * this.scale));
    Object.assign(brush, { lineWidth: 2 * radius * this.scale, lineCap: 'round', lineJoin: 'round' });
    brush.globalCompositeOperation = isErased ? 'destination-out' : 'source-over';
    brush.strokeStyle = '#fff';
    brush.beginPath();
    brush.moveTo(...first);
    brush.lineTo(...first);
    for (const point of others) brush.lineTo(...point);
    brush.stroke();
  }

  draw({ mask }) {
    const isKnown = mask === this.#drawn && this.#isTinted === this.isPainting;
    this.clear.disabled = !mask.length;
    if (isKnown) return;
    const { width, height } = this.canvas;
    const brush = this.canvas.getContext('2d');
    // Strokes only come on top, but for undo: what is there already need not be painted again. The
    // last one grows while it is painted.
    const kept = this.#drawn.slice(0, -1);
    const goesOn = kept.length < mask.length && kept.every((stroke, k) => stroke === mask[k])
      && (this.#drawn.length <= mask.length) && this.#grows(mask);
    if (!goesOn) {
      brush.globalCompositeOperation = 'source-over';
      brush.clearRect(0, 0, width, height);
    }
    for (const stroke of goesOn ? mask.slice(kept.length) : mask) this.#stroke(brush, stroke);
    this.#drawn = mask;
    this.#isTinted = this.isPainting;
    const front = this.front.getContext('2d');
    front.globalCompositeOperation = 'source-over';
    front.clearRect(0, 0, width, height);
    if (!mask.length) return;
    front.drawImage(this.canvas, 0, 0);
    front.globalCompositeOperation = 'source-in';
    front.drawImage(this.photo, 0, 0, width, height);
    if (!this.isPainting) return;
    front.globalCompositeOperation = 'source-atop';
    front.fillStyle = TINT;
    front.fillRect(0, 0, width, height);
  }

  // Whether the last stroke that is drawn is the beginning of that at its place.
  #grows(mask) {
    const last = this.#drawn.at(-1);
    const next = mask[this.#drawn.length - 1];
    return !last || last === next || (!last.isSaved && last.isErased === next.isErased && last.radius === next.radius
      && last.points.length <= next.points.length && last.points.every((point, k) => point === next.points[k]));
  }

  // A PNG in base64, white where the photo stays in front; null where nothing is painted.
  sent({ mask }) {
    this.draw({ mask });
    if (!mask.length) return null;
    const { width, height } = this.canvas;
    const sheet = Object.assign(document.createElement('canvas'), { width, height });
    const brush = sheet.getContext('2d');
    brush.fillRect(0, 0, width, height);
    brush.drawImage(this.canvas, 0, 0);
    return sheet.toDataURL('image/png').replace(/^.*,/, '');
  }
}
