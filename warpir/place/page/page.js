// The page: one state, changed by handles, keys and fields, drawn by the stage, saved by warpir.

import { fieldOfView, focalLength, project, STEEPEST, sunAxis, zoomed } from './camera.js';
import { follow, Handles, shifted, stoodAt, withCamera } from './handles.js';
import { Stage } from './stage.js';

const $ = (id) => document.getElementById(id);
const LUMINANCE = [0.2126, 0.7152, 0.0722];
const FILM_DIAGONAL = 43.267; // of 36 x 24 mm
const PAUSE = 600; // ms between two keys that undo takes back one by one

const dot = (a, b) => a.reduce((sum, part, k) => sum + part * b[k], 0);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const wrapped = (angle) => ((((angle + 180) % 360) + 360) % 360) - 180;
const plain = (x, digits) => Number(x.toFixed(digits));

const start = await (await fetch('start.json')).json();
const radianceOf = (light) => (light.sky === 'custom' ? light.custom : start.sky_radiance[light.sky]);
// A sun's strength counts in what the sky gives on the ground; under a black one as --sun has it.
const sunUnit = (light) => Math.PI * dot(radianceOf(light), LUMINANCE) || 1;
export const stage = new Stage($('canvas'));
export let state = opening(start);
const history = { past: [], future: [], before: null, name: '', last: 0 };

function opening({ camera, stance, stand, rotate_y: turn, size, sun, sky, keeps_light: isKept, sun_to_sky: usual }) {
  const custom = Array.isArray(sky) ? sky : null;
  const light = { azimuth: sun[0], elevation: sun[1], sky: custom ? 'custom' : sky, custom, skyStrength: 1, isKept };
  const sunStrength = sun[2] === null ? usual : sun[2] / sunUnit(light);
  return { camera, stance, stand, turn, size, light: { ...light, sunStrength } };
}

// ---------------------------------------------------------------- changes, and taking them back

const gesture = {
  get isOn() {
    return history.before !== null;
  },
  begin(name) {
    // Keys that follow each other, and a field that is dragged, are one step.
    const isSame = name === history.name && performance.now() - history.last < PAUSE;
    if (!isSame) history.past.push(state);
    history.before = state;
    history.name = '';
    $('stage').classList.add('dragging');
  },
  move(change) {
    const next = change(history.before);
    if (!next) return;
    show(next);
    readOut();
  },
  end(name = '') {
    if (history.past.at(-1) === state) history.past.pop();
    else history.future = [];
    Object.assign(history, { before: null, name, last: performance.now() });
    $('stage').classList.remove('dragging');
    $('readout').hidden = true;
    showHistory();
  },
};

function once(name, change) {
  if (history.before) return;
  gesture.begin(name);
  gesture.move(change);
  gesture.end(name);
}

function step(from, to) {
  if (!from.length || history.before) return;
  to.push(state);
  history.name = '';
  show(from.pop());
  showHistory();
}

function showHistory() {
  $('undo').disabled = !history.past.length;
  $('redo').disabled = !history.future.length;
}

// ----------------------------------------------------------------------------------- the light

const pixels = await photoPixels();

async function photoPixels() {
  const photo = $('photo');
  await photo.decode();
  const width = Math.min(512, photo.naturalWidth);
  const height = Math.max(1, Math.round((width * photo.naturalHeight) / photo.naturalWidth));
  const brush = Object.assign(document.createElement('canvas'), { width, height })
    .getContext('2d', { willReadFrequently: true });
  brush.drawImage(photo, 0, 0, width, height);
  return { width, height, codes: brush.getImageData(0, 0, width, height).data };
}

// Luminance of the photo's lit ground round the object, as warpir/lighting/scene_light.py measures it.
function groundLevel({ camera, stance, stand, size }) {
  const sides = start.asset.high.map((top, k) => top - start.asset.low[k]);
  const reach = (size * Math.hypot(...sides)) / Math.max(...sides);
  const levels = [];
  for (let ring = 0; ring < 16; ring += 1) {
    for (let k = 0; k < 32; k += 1) {
      const [radius, angle] = [reach * (0.2 + (1.3 * ring) / 15), (k * Math.PI) / 16];
      const point = [stand.x + radius * Math.cos(angle), 0, stand.z + radius * Math.sin(angle)];
      const [u, v] = project(camera, stance, point) ?? [-1, -1];
      const column = Math.floor((u * pixels.width) / camera.width);
      const row = Math.floor((v * pixels.height) / camera.height);
      if (column < 0 || row < 0 || column >= pixels.width || row >= pixels.height) continue;
      const first = 4 * (row * pixels.width + column);
      const linear = [0, 1, 2].map((c) => (pixels.codes[first + c] / 255) ** 2.2);
      levels.push(dot(linear, LUMINANCE));
    }
  }
  if (!levels.length) return 0.25;
  levels.sort((a, b) => a - b);
  return clamp(levels[Math.floor(0.75 * (levels.length - 1))], 1e-3, 0.9);
}

// Sun and sky as warpir/lighting/scene_light.py makes them of --sun and --sky, at its automatic exposure.
function lightOf(current) {
  const { light } = current;
  const radiance = radianceOf(light).map((part) => part * light.skyStrength);
  const color = start.sun_color[light.sky] ?? start.sun_color.clear;
  const brightness = dot(color, LUMINANCE);
  const sun = color.map((part) => (light.sunStrength * sunUnit(light) * part) / brightness);
  const world = sunAxis(light.azimuth, light.elevation);
  const rows = start.ground_to_world;
  const axis = [0, 1, 2].map((k) => rows[0][k] * world[0] + rows[1][k] * world[1] + rows[2][k] * world[2]);
  const fromSun = dot(sun, LUMINANCE) * Math.max(axis[1], 0);
  const total = Math.PI * dot(radiance, LUMINANCE) + fromSun || 1; // of no light there are no shares
  const gain = (groundLevel(current) * Math.PI) / (start.ground_albedo * total);
  const bounce = [0, 1, 2].map((k) =>
    (start.ground_albedo / Math.PI) * (Math.PI * radiance[k] + sun[k] * Math.max(world[1], 0)));
  const scaled = (parts) => parts.map((part) => part * gain);
  return { axis, sun: scaled(sun), sky: scaled(radiance), bounce: scaled(bounce), sunShare: fromSun / total };
}

// ---------------------------------------------------------------------------------- the fields

// The object's place as one speaks of it: how far ahead of the camera, and how far to its right.
function polar({ stance, stand }) {
  const [s, c] = [Math.sin((stance.heading * Math.PI) / 180), Math.cos((stance.heading * Math.PI) / 180)];
  const [x, z] = [stand.x - stance.x, stand.z - stance.z];
  return { ahead: -s * x - c * z, right: c * x - s * z };
}

function fromPolar(before, { ahead, right }) {
  const { stance } = before;
  const [s, c] = [Math.sin((stance.heading * Math.PI) / 180), Math.cos((stance.heading * Math.PI) / 180)];
  const stand = { x: stance.x + c * right - s * ahead, z: stance.z - s * right - c * ahead };
  return { ...before, stand };
}

const posed = (change) => (before, value) => withCamera(before, before.camera, { ...before.stance, ...change(value) });
// Who sets the light wants it; until then it is a guess that only serves to look at.
const lit = (name) => ({
  get: (now) => now.light[name],
  set: (before, value) => ({ ...before, light: { ...before.light, isKept: true, [name]: value } }),
});
const height = start.stance.height;
const FIELDS = {
  object: {
    size: { label: 'Size', unit: 'm', low: start.size / 100, high: start.size * 100, log: true, get: (now) => now.size, set: (before, size) => ({ ...before, size }) },
    turn: { label: 'Turn', unit: '°', low: -180, high: 180, digits: 1, wrap: true, get: (now) => wrapped(now.turn), set: (before, turn) => ({ ...before, turn }) },
    ahead: { label: 'Ahead', unit: 'm', low: 0.3 * height, high: 60 * height, log: true, get: (now) => polar(now).ahead, set: (before, ahead) => fromPolar(before, { ...polar(before), ahead }) },
    right: { label: 'Right', unit: 'm', low: -10 * height, high: 10 * height, digits: 2, get: (now) => polar(now).right, set: (before, right) => fromPolar(before, { ...polar(before), right }) },
  },
  camera: {
    pitch: { label: 'Pitch', unit: '°', low: -STEEPEST, high: STEEPEST, digits: 2, get: (now) => now.stance.pitch, set: posed((pitch) => ({ pitch })) },
    roll: { label: 'Roll', unit: '°', low: -45, high: 45, digits: 2, get: (now) => now.stance.roll, set: posed((roll) => ({ roll })) },
    fov: {
      label: 'View', unit: '°', low: 6, high: 140, digits: 1, get: (now) => fieldOfView(now.camera),
      set: (before, fov) => {
        const { camera, stance } = zoomed(before.camera, before.stance, focalLength(before.camera, fov));
        return withCamera(before, camera, stance);
      },
    },
    height: { label: 'Height', unit: 'm', low: height / 30, high: height * 30, log: true, get: (now) => now.stance.height, set: posed((metres) => ({ height: metres })) },
  },
  sun: {
    azimuth: { label: 'Azimuth', unit: '°', low: -180, high: 180, digits: 0, wrap: true, ...lit('azimuth') },
    elevation: { label: 'Elevation', unit: '°', low: -10, high: 90, digits: 0, ...lit('elevation') },
  },
  light: {
    sunStrength: { label: 'Sun', unit: '×', low: 0, high: 20, digits: 1, ...lit('sunStrength') },
    skyStrength: { label: 'Sky', unit: '×', low: 0.05, high: 4, digits: 2, ...lit('skyStrength') },
  },
};
const NAMED = {
  size: 'Size', turn: 'Turn', ahead: 'Metres ahead', right: 'Metres to the right', pitch: 'Pitch, up is positive', roll: 'Roll',
  fov: 'Horizontal field of view', height: 'Camera height', azimuth: 'Azimuth of the sun, clockwise from ahead',
  elevation: 'Elevation of the sun', sunStrength: 'Strength of the sun', skyStrength: 'Strength of the sky',
};
const fields = Object.assign({}, ...Object.values(FIELDS));
for (const [group, members] of Object.entries(FIELDS)) {
  for (const [name, field] of Object.entries(members)) $(`${group}-fields`).append(makeField(name, field));
}

function makeField(name, field) {
  const row = document.createElement('div');
  row.className = 'field';
  const label = Object.assign(document.createElement('label'), { textContent: field.label, htmlFor: name });
  const slide = Object.assign(document.createElement('input'), { type: 'range', min: 0, max: 1000, step: 1, id: `${name}-slide` });
  slide.setAttribute('aria-label', NAMED[name]);
  const entry = Object.assign(document.createElement('input'), { type: 'number', id: name, step: 'any' });
  entry.setAttribute('aria-label', `${NAMED[name]} [${field.unit}]`);
  const unit = Object.assign(document.createElement('span'), { className: 'unit', textContent: field.unit });
  const { low, high, log } = field;
  field.share = (value) => 1000 * clamp(log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low), 0, 1);
  const value = (share) => (log ? low * (high / low) ** (share / 1000) : low + ((high - low) * share) / 1000);
  let isHeld = false;
  const release = () => {
    if (isHeld && history.before) gesture.end(name);
    isHeld = false;
  };
  slide.addEventListener('input', () => {
    if (!history.before) {
      gesture.begin(name);
      isHeld = true;
    }
    gesture.move((before) => field.set(before, value(Number(slide.value))));
  });
  // A slider that was dragged away and back has not changed: no `change` comes.
  for (const kind of ['change', 'keyup', 'blur']) slide.addEventListener(kind, release);
  for (const kind of ['pointerup', 'pointercancel']) window.addEventListener(kind, release);
  entry.addEventListener('change', () => {
    const typed = entry.valueAsNumber;
    const isGood = Number.isFinite(typed) && (!log || typed > 0) && (log || field.wrap || (typed >= low && typed <= high));
    if (isGood) once(`${name} typed`, (before) => field.set(before, typed));
    else showFields();
  });
  Object.assign(field, { slide, entry });
  row.append(label, slide, entry, unit);
  return row;
}

function showFields() {
  for (const field of Object.values(fields)) {
    const value = field.get(state);
    field.text = field.log ? String(plain(value, clamp(2 - Math.floor(Math.log10(Math.abs(value) || 1)), 0, 5))) : String(plain(value, field.digits));
    if (document.activeElement !== field.slide) field.slide.value = field.share(value);
    field.slide.setAttribute('aria-valuetext', `${field.text} ${field.unit}`);
    if (document.activeElement !== field.entry || field.entry.validity.valid) field.entry.value = field.text;
  }
  const { camera, light, size } = state;
  const millimetres = (camera.fx * FILM_DIAGONAL) / Math.hypot(camera.width, camera.height);
  const sides = start.asset.high.map((top, k) => top - start.asset.low[k]);
  const box = sides.map((side) => plain((side * size) / Math.max(...sides), 2)).join(' × ');
  $('lens').textContent = `${millimetres.toFixed(0)} mm on 35 mm film · grid ${plain(spacing, 3)} m · object ${box} m`;
  $('keep-light').checked = light.isKept;
  $('light').classList.toggle('off', !light.isKept);
  $('sky').value = light.sky;
}

// A choice of skies, and the dial: the sun seen from above, ahead is up, the rim is the horizon.
const skies = document.createElement('select');
skies.id = 'sky';
for (const name of [...Object.keys(start.sky_radiance), ...(state.light.custom ? ['custom'] : [])]) {
  skies.append(new Option(name[0].toUpperCase() + name.slice(1), name));
}
skies.addEventListener('change', () => once('sky', (before) => lit('sky').set(before, skies.value)));
const skyRow = Object.assign(document.createElement('div'), { className: 'field' });
skyRow.append(Object.assign(document.createElement('label'), { textContent: 'Colours', htmlFor: 'sky' }), skies);
$('light-fields').append(skyRow);
$('keep-light').addEventListener('change', (event) => once('keep', (before) => lit('isKept').set(before, event.target.checked)));

const dial = $('dial');
const RADIUS = 46;
for (const [kind, radius] of [['sky', RADIUS], ['ring', (RADIUS * 2) / 3], ['ring', RADIUS / 3]]) {
  dial.append(shape('circle', { class: kind, r: radius }));
}
for (const [text, x, y] of [['ahead', 0, -50], ['behind', 0, 58]]) {
  const label = shape('text', { x, y });
  label.textContent = text;
  dial.append(label);
}
const sunDot = dial.appendChild(shape('circle', { class: 'sun', r: 6 }));

function shape(tag, attributes) {
  const element = document.createElementNS('http://www.w3.org/2000/svg', tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

dial.addEventListener('pointerdown', (event) => {
  if (follow(dial, event, gesture, 'dial', pointSun)) pointSun(event);
});

function pointSun({ clientX, clientY }) {
  const box = dial.getBoundingClientRect();
  const [x, y] = [((clientX - box.left) / box.width) * 120 - 60, ((clientY - box.top) / box.height) * 120 - 60];
  const azimuth = wrapped((Math.atan2(x, -y) * 180) / Math.PI - state.stance.heading);
  const elevation = 90 * (1 - Math.min(Math.hypot(x, y) / RADIUS, 1));
  gesture.move((before) => ({ ...before, light: { ...before.light, isKept: true, azimuth, elevation } }));
}

function showDial() {
  const angle = ((state.light.azimuth + state.stance.heading) * Math.PI) / 180;
  const radius = RADIUS * clamp(1 - state.light.elevation / 90, 0, 1.1);
  sunDot.setAttribute('cx', radius * Math.sin(angle));
  sunDot.setAttribute('cy', -radius * Math.cos(angle));
}

// --------------------------------------------------------------------------------- the drawing

let spacing = 1;
let isDue = false;
const handles = new Handles($('handles'), $('stage'), start.asset, gesture);

function show(next) {
  state = next;
  draw();
}

function draw() {
  if (isDue) return;
  isDue = true;
  requestAnimationFrame(() => {
    isDue = false;
    spacing = stage.setCamera(state.camera, state.stance);
    stage.setObject(state.stand, state.turn, state.size);
    stage.setLight(lightOf(state));
    const more = stage.render();
    handles.draw(state);
    handles.say(spoken());
    showFields();
    showDial();
    if (more) draw();
  });
}

function spoken() {
  const of = ({ pitch: 'pitch', roll: 'roll', tilt: 'roll', fov: 'fov', size: 'size', turn: 'turn', foot: 'ahead' });
  return Object.fromEntries(Object.entries(of).map(([handle, name]) => {
    const field = fields[name];
    const now = plain(field.get(state), 4);
    return [handle, { text: `${now} ${field.unit}`, now, low: plain(field.low, 4), high: plain(field.high, 4) }];
  }));
}

function readOut() {
  const { pitch, roll, fov, size, turn } = Object.fromEntries(Object.entries(fields).map(([name, field]) => [name, field.get(state)]));
  const { ahead, right } = polar(state);
  $('readout').textContent = `pitch ${pitch.toFixed(1)}°  roll ${roll.toFixed(1)}°  view ${fov.toFixed(0)}°  ·  ${ahead.toFixed(2)} m ahead, ${right.toFixed(2)} m right  ·  ${plain(size, 3)} m, turned ${turn.toFixed(0)}°`;
  $('readout').hidden = false;
}

function fit() {
  const room = $('room').getBoundingClientRect();
  const { width, height: tall } = start.photo;
  const scale = Math.min(room.width / width, room.height / tall);
  const [w, h] = [width * scale, tall * scale];
  Object.assign($('stage').style, { width: `${w}px`, height: `${h}px`, left: `${(room.width - w) / 2}px`, top: `${(room.height - h) / 2}px` });
  stage.resize(w, h, Math.min(window.devicePixelRatio, 2));
  draw();
}

// ------------------------------------------------------------------------ pointer, wheel and keys

const canvas = $('canvas');
canvas.addEventListener('pointerdown', (event) => {
  if (handles.isOnObject(event)) handles.drag(event, canvas, 'foot');
});
canvas.addEventListener('pointermove', (event) => canvas.classList.toggle('grabs', Boolean(handles.isOnObject(event))));
canvas.addEventListener('dblclick', (event) => {
  const box = canvas.getBoundingClientRect();
  const scale = start.photo.width / box.width;
  once('double click', (before) => stoodAt(before, (event.clientX - box.left) * scale, (event.clientY - box.top) * scale));
});

const turned = (degrees) => (before) => ({ ...before, turn: before.turn + degrees });
const sized = (factor) => (before) => ({ ...before, size: before.size * factor });
const moved = (right, ahead) => (before) => {
  const at = polar(before);
  const step = 0.03 * Math.max(Math.hypot(at.ahead, at.right), 0.1 * before.stance.height);
  return fromPolar(before, { ahead: at.ahead + ahead * step, right: at.right + right * step });
};
const tilted = (degrees) => (before) => withCamera(before, before.camera, { ...before.stance, roll: before.stance.roll + degrees });
const lifted = (rows) => (before) => shifted(before, rows * before.camera.height);

$('stage').addEventListener('wheel', (event) => {
  if (!event.shiftKey && !event.altKey) return;
  event.preventDefault();
  const notches = (event.deltaY || event.deltaX) / 100;
  once(event.shiftKey ? 'wheel turn' : 'wheel size', event.shiftKey ? turned(3 * notches) : sized(0.97 ** notches));
}, { passive: false });

const KEYS = {
  arrowleft: (by) => moved(-by, 0), arrowright: (by) => moved(by, 0), arrowup: (by) => moved(0, by), arrowdown: (by) => moved(0, -by),
  q: (by) => turned(5 * by), e: (by) => turned(-5 * by), '+': (by) => sized(1.03 ** by), '=': (by) => sized(1.03 ** by), '*': (by) => sized(1.03 ** by),
  '-': (by) => sized(1.03 ** -by), _: (by) => sized(1.03 ** -by), w: (by) => lifted(-0.01 * by), s: (by) => lifted(0.01 * by),
  a: (by) => tilted(0.5 * by), d: (by) => tilted(-0.5 * by),
};
// A handle that has the focus gives the arrows its own meaning, right that of up and left of down.
const ON_HANDLE = { pitch: ['w', 's'], roll: ['a', 'd'], tilt: ['d', 'a'], turn: ['q', 'e'], size: ['+', '-'] };
const UP_DOWN = { arrowup: 0, arrowright: 0, arrowdown: 1, arrowleft: 1 };

window.addEventListener('keydown', (event) => {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if (key === 'z') step(...(event.shiftKey ? [history.future, history.past] : [history.past, history.future]));
    else if (key === 'y') step(history.future, history.past);
    else if (key === 's') save();
    else return;
    event.preventDefault();
    return;
  }
  // Fields, lists and buttons have keys of their own.
  if (event.altKey || event.target.closest('input, select, summary, #panel button')) return;
  const handle = event.target.closest('[data-handle]')?.dataset.handle;
  const by = event.shiftKey ? 0.2 : 1;
  if (handle === 'fov' && key.startsWith('arrow')) {
    const factor = 1.01 ** (key === 'arrowleft' || key === 'arrowdown' ? -by : by);
    once('fov key', (before) => fields.fov.set(before, clamp(fields.fov.get(before) * factor, fields.fov.low, fields.fov.high)));
  } else if (key === 'g') {
    $('guides').click();
  } else {
    const change = KEYS[ON_HANDLE[handle]?.[UP_DOWN[key]] ?? key];
    if (!change) return;
    once(`key ${key}`, change(by));
  }
  $('readout').hidden = false;
  event.preventDefault();
});
window.addEventListener('keyup', () => {
  $('readout').hidden = true;
});

// ------------------------------------------------------------------------------- panel and saving

$('undo').addEventListener('click', () => step(history.past, history.future));
$('redo').addEventListener('click', () => step(history.future, history.past));
$('guides').addEventListener('click', () => {
  const isShown = $('guides').getAttribute('aria-pressed') !== 'true';
  $('guides').setAttribute('aria-pressed', String(isShown));
  stage.grid.visible = isShown;
  $('handles').style.display = isShown ? '' : 'none';
  draw();
});
$('save').addEventListener('click', save);
$('copy').addEventListener('click', async () => {
  await navigator.clipboard.writeText($('command').textContent);
  $('copy').textContent = 'Copied';
  setTimeout(() => { $('copy').textContent = 'Copy'; }, 1500);
});

// What warpir/place/session.py reads. Only the proportion of sun and sky counts: the exposure follows.
function spokenPlacement({ camera, stance, stand, turn, size, light }) {
  const custom = light.sky === 'custom' ? light.custom : null;
  const strength = (light.sunStrength * sunUnit(light)) / light.skyStrength;
  const isSunny = light.isKept && strength > 0;
  return {
    fx: camera.fx, fy: camera.fy, stance, stand, rotate_y: wrapped(turn), size,
    sun: isSunny ? [light.azimuth, light.elevation, strength] : null,
    sky: light.isKept ? custom ?? light.sky : null,
  };
}

let saved = state;

async function save() {
  if ($('save').disabled) return;
  const sent = state;
  $('save').disabled = true;
  $('problem').hidden = $('done').hidden = true;
  try {
    const answer = await fetch('save', {
      method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(spokenPlacement(sent)),
    });
    if (answer.ok) {
      $('command').textContent = (await answer.json()).command;
      $('done').hidden = false;
      saved = sent;
    } else if (answer.status === 422) {
      const { where, what, advice } = await answer.json();
      complain(`${where}: ${what}${advice ? ` – ${advice}` : ''}`);
    } else {
      complain('Not saved: warpir.place had a fault of its own; its terminal says more.');
    }
  } catch {
    complain('Not saved: warpir.place is not running any more.');
  }
  $('save').disabled = false;
}

function complain(text) {
  $('problem').textContent = text;
  $('problem').hidden = false;
}

window.addEventListener('beforeunload', (event) => {
  if (state !== saved) event.preventDefault();
});

$('title').textContent = `${start.asset.name} in ${start.photo.name}`;
$('title').title = $('title').textContent;
$('notes').hidden = !start.assumed.length;
for (const line of start.assumed) $('assumed').append(Object.assign(document.createElement('li'), { textContent: line }));

try {
  await stage.load('asset.glb', start.asset);
  $('loading').hidden = true;
  $('save').disabled = false;
  new ResizeObserver(fit).observe($('room'));
} catch (error) {
  $('loading').textContent = `The object cannot be shown: ${error.message}`;
}
