// The panel's fields: a slider and a number for each value of the state.

import { clamp, fieldOfView, focalLength, STEEPEST, zoomed } from './camera.js';
import { withCamera } from './handles.js';

const FILM_DIAGONAL = 43.267; // of 36 x 24 mm

export const wrapped = (angle) => ((((angle + 180) % 360) + 360) % 360) - 180;
export const plain = (x, digits) => Number(x.toFixed(digits));

// The object's place as one speaks of it: how far ahead of the camera, and how far to its right.
export function polar({ stance, stand }) {
  const [s, c] = [Math.sin((stance.heading * Math.PI) / 180), Math.cos((stance.heading * Math.PI) / 180)];
  const [x, z] = [stand.x - stance.x, stand.z - stance.z];
  return { ahead: -s * x - c * z, right: c * x - s * z };
}

export function fromPolar(before, { ahead, right }) {
  const { stance } = before;
  const [s, c] = [Math.sin((stance.heading * Math.PI) / 180), Math.cos((stance.heading * Math.PI) / 180)];
  const stand = { x: stance.x + c * right - s * ahead, z: stance.z - s * right - c * ahead };
  return { ...before, stand };
}

const posed = (change) => (before, value) => withCamera(before, before.camera, { ...before.stance, ...change(value) });

// Each field: its range, how it is read from a state and what it makes of one; `name` is read aloud.
// What is typed may exceed the slider's where that is logarithmic, wraps or is open.
function described(start, lighting, lamps) {
  const lit = (name) => ({
    get: (now) => lighting.shown(now)[name],
    set: (before, value) => lighting.set(before, { [name]: value }),
  });
  const ofLamp = (name) => ({
    log: true, get: (now) => lamps.get(now, name), set: (before, value) => lamps.set(before, name, value),
  });
  const { size, stance: { height } } = start;
  return {
    object: {
      size: { label: 'Size', name: 'Size', unit: 'm', low: size / 100, high: size * 100, log: true, get: (now) => now.size, set: (before, metres) => ({ ...before, size: metres }) },
      turn: { label: 'Turn', name: 'Turn', unit: '°', low: -180, high: 180, digits: 1, wrap: true, get: (now) => wrapped(now.turn), set: (before, turn) => ({ ...before, turn }) },
      ahead: { label: 'Ahead', name: 'Metres ahead', unit: 'm', low: 0.3 * height, high: 60 * height, log: true, get: (now) => polar(now).ahead, set: (before, ahead) => fromPolar(before, { ...polar(before), ahead }) },
      right: { label: 'Right', name: 'Metres to the right', unit: 'm', low: -10 * height, high: 10 * height, isOpen: true, digits: 2, get: (now) => polar(now).right, set: (before, right) => fromPolar(before, { ...polar(before), right }) },
    },
    camera: {
      pitch: { label: 'Pitch', name: 'Pitch, up is positive', unit: '°', low: -STEEPEST, high: STEEPEST, digits: 2, get: (now) => now.stance.pitch, set: posed((pitch) => ({ pitch })) },
      roll: { label: 'Roll', name: 'Roll', unit: '°', low: -45, high: 45, digits: 2, get: (now) => now.stance.roll, set: posed((roll) => ({ roll })) },
      fov: {
        label: 'View', name: 'Horizontal field of view', unit: '°', low: 3, high: 168, digits: 1, get: (now) => fieldOfView(now.camera),
        set: (before, fov) => {
          const { camera, stance } = zoomed(before.camera, before.stance, focalLength(before.camera, fov));
          return withCamera(before, camera, stance);
        },
      },
      height: { label: 'Height', name: 'Camera height', unit: 'm', low: height / 30, high: height * 30, log: true, get: (now) => now.stance.height, set: posed((metres) => ({ height: metres })) },
    },
    sun: {
      azimuth: { label: 'Azimuth', name: 'Azimuth of the sun, clockwise from ahead', unit: '°', low: -180, high: 180, digits: 0, wrap: true, ...lit('azimuth') },
      elevation: { label: 'Elevation', name: 'Elevation of the sun', unit: '°', low: -10, high: 90, digits: 0, ...lit('elevation') },
    },
    light: {
      sunStrength: { label: 'Sun', name: 'Strength of the sun', unit: '×', low: 0, high: 20, digits: 1, ...lit('sunStrength') },
      skyStrength: { label: 'Sky', name: 'Strength of the sky', unit: '×', low: 0.05, high: 4, digits: 2, ...lit('skyStrength') },
    },
    lamp: {
      distance: { label: 'Distance', name: 'Distance of the lamp from the camera', unit: 'm', low: 0.1 * height, high: 60 * height, ...ofLamp('distance') },
      radius: { label: 'Radius', name: 'Radius of the lamp', unit: 'm', low: 0.003 * height, high: height, ...ofLamp('radius') },
      power: { label: 'Power', name: 'Power of the lamp, 40 is white at 1 m', unit: '', low: 0.01 * height ** 2, high: 1e4 * height ** 2, ...ofLamp('power') },
    },
  };
}

function made(tag, attributes) {
  return Object.assign(document.createElement(tag), attributes);
}

// Why a field does not take what was typed; empty where it does, or where nothing was.
function refusal({ entry, name, unit, low, high, log, wrap, isOpen }) {
  const typed = entry.valueAsNumber;
  const expects = (what) => `${name}: expected ${what}${Number.isNaN(typed) ? '' : ` (found ${typed})`}.`;
  if (entry.validity.badInput) return expects('a number');
  if (log) return typed <= 0 ? expects('more than 0') : '';
  return !wrap && !isOpen && (typed < low || typed > high) ? expects(`${plain(low, 2)} to ${plain(high, 2)} ${unit}`) : '';
}

export class Fields {
  // `tell` shows a problem, or none where its words are empty.
  constructor(start, lighting, lamps, history, tell) {
    Object.assign(this, { start, history, tell });
    const groups = described(start, lighting, lamps);
    this.byName = Object.assign({}, ...Object.values(groups));
    for (const [group, members] of Object.entries(groups)) {
      const parent = document.getElementById(`${group}-fields`);
      for (const [name, field] of Object.entries(members)) parent.append(this.#row(name, field));
    }
  }

  #row(name, field) {
    const row = made('div', { className: 'field' });
    const slide = made('input', { type: 'range', min: 0, max: 1000, step: 1, id: `${name}-slide` });
    slide.setAttribute('aria-label', field.name);
    const entry = made('input', { type: 'number', id: name, step: 'any' });
    entry.setAttribute('aria-label', field.unit ? `${field.name} [${field.unit}]` : field.name);
    Object.assign(field, { slide, entry });
    const { low, high, log } = field;
    field.share = (value) => 1000 * clamp(log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low), 0, 1);
    this.#slides(name, field);
    // A redraw, as when an estimate arrives, leaves what is being typed.
    entry.addEventListener('input', () => { field.isTyped = true; });
    entry.addEventListener('blur', () => { field.isTyped = false; });
    entry.addEventListener('change', () => {
      field.isTyped = false;
      const typed = entry.valueAsNumber;
      const problem = refusal(field);
      this.tell(problem);
      if (Number.isFinite(typed) && !problem) this.history.once(`${name} typed`, (before) => field.set(before, typed));
      // What was refused, and what changed nothing, is shown as it was.
      this.show(this.history.state);
    });
    row.append(made('label', { textContent: field.label, htmlFor: name }), slide, entry, made('span', { className: 'unit', textContent: field.unit }));
    return row;
  }

  #slides(name, field) {
    const { slide, low, high, log } = field;
    const { history } = this;
    const value = (share) => (log ? low * (high / low) ** (share / 1000) : low + ((high - low) * share) / 1000);
    let isHeld = false;
    const release = () => {
      if (isHeld && history.isOn) history.end(name);
      isHeld = false;
    };
    slide.addEventListener('input', () => {
      if (!history.isOn) {
        history.begin(name);
        isHeld = true;
      }
      history.move((before) => field.set(before, value(Number(slide.value))));
    });
    // A slider that was dragged away and back has not changed: no `change` comes.
    for (const kind of ['change', 'keyup', 'blur']) slide.addEventListener(kind, release);
    for (const kind of ['pointerup', 'pointercancel']) window.addEventListener(kind, release);
  }

  show(state) {
    for (const field of Object.values(this.byName)) {
      const value = field.get(state);
      if (value === null) field.text = '';
      else field.text = field.log ? String(plain(value, clamp(2 - Math.floor(Math.log10(Math.abs(value) || 1)), 0, 5))) : String(plain(value, field.digits));
      if (document.activeElement !== field.slide) field.slide.value = field.share(value ?? field.low);
      field.slide.setAttribute('aria-valuetext', `${field.text} ${field.unit}`);
      if (!field.isTyped) field.entry.value = field.text;
    }
  }

  // What the camera and the object come to, in words.
  about({ camera, size }, spacing) {
    const { low, high } = this.start.asset;
    const millimetres = (camera.fx * FILM_DIAGONAL) / Math.hypot(camera.width, camera.height);
    const sides = high.map((top, k) => top - low[k]);
    const box = sides.map((side) => plain((side * size) / Math.max(...sides), 2)).join(' × ');
    return `${millimetres.toFixed(0)} mm on 35 mm film · grid ${plain(spacing, 3)} m · object ${box} m`;
  }

  // Each handle's value, for those who do not see it.
  spoken(state) {
    const of = { pitch: 'pitch', roll: 'roll', tilt: 'roll', fov: 'fov', size: 'size', turn: 'turn', foot: 'ahead' };
    return Object.fromEntries(Object.entries(of).map(([handle, name]) => {
      const field = this.byName[name];
      const now = plain(field.get(state), 4);
      return [handle, { text: `${now} ${field.unit}`, now, low: plain(field.low, 4), high: plain(field.high, 4) }];
    }));
  }
}
