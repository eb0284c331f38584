// The page: one state, changed by handles, keys and fields, drawn by the stage, saved by warpir.

import { clamp } from './camera.js';
import { Fields, fromPolar, plain, polar, wrapped } from './fields.js';
import { Handles, shifted, stoodAt, withCamera } from './handles.js';
import { History, takeTyped } from './history.js';
import { Lamps } from './lamps.js';
import { Dial, Lighting, photoPixels } from './light.js';
import { Lines, Ruler } from './lines.js';
import { Mask } from './mask.js';
import { Pictures } from './pictures.js';
import { Stage } from './stage.js';
import { View } from './view.js';

const $ = (id) => document.getElementById(id);

const start = await (await fetch('start.json')).json();
export const stage = drawn();
export let state;
let spacing = 1;
let isDue = false;
let seen; // part of the photo that the room shows, in its pixels

const lighting = new Lighting(start, await photoPixels($('photo')), {
  get state() {
    return state;
  },
  changed: draw,
  ask: (camera) => post('light', sentCamera(camera)),
});
const { camera, stance, stand, rotate_y: turn, size } = start;
const history = new History({ camera, stance, stand, turn, size, light: lighting.opening(), lamps: start.lamps, lines: null, ruler: null, mask: start.has_mask ? [{ isSaved: true }] : [], isUpright: looksUpright() }, {
  show,
  begun: () => $('stage').classList.add('dragging'),
  moved: readOut,
  ended: (canUndo, canRedo) => {
    $('stage').classList.remove('dragging');
    $('readout').hidden = true;
    $('undo').disabled = !canUndo;
    $('redo').disabled = !canRedo;
  },
});
async function image(address) {
  const loaded = Object.assign(new Image(), { src: address });
  await loaded.decode();
  return loaded;
}

function tell(problem) {
  $('problem').textContent = problem;
  $('problem').hidden = !problem;
}

// The stage, or why there is none: without it nothing here can be used.
function drawn() {
  try {
    return new Stage($('canvas'));
  } catch (error) {
    $('loading').textContent = `This browser cannot draw the object: ${error.message} Turn on its graphics acceleration, or open the address in another one.`;
    throw error;
  }
}

// Whether the photo's own camera is level and yet sees the horizon off the middle.
function looksUpright() {
  return Math.abs(stance.pitch) < 0.5 && Math.abs(camera.cy / camera.height - 0.5) > 0.02;
}

const once = (name, change) => history.once(name, change);
state = history.state;
const lamps = new Lamps($('handles'), $('stage'), history, lighting, {
  toggle: $('add-lamp'), options: $('lamp-options'), which: $('lamp-which'), remove: $('remove-lamp'), words: $('lamp-words'), chosen: draw,
  added: (now) => now.lamps.length === 1 && warm(now), // the kernels for lamps
});
let refused = null; // the state in which a field has refused a number
const fields = new Fields(start, lighting, lamps, history, (problem) => {
  tell(problem);
  refused = problem ? state : null;
});
const dial = new Dial($('dial'), lighting, history);
const lines = new Lines($('handles'), $('stage'), history, {
  toggle: $('lines'), upright: $('upright'), options: $('axes'), words: $('lines-words'),
  axes: { a: $('axis-a'), b: $('axis-b'), c: $('axis-c') },
});
const ruler = new Ruler($('handles'), $('stage'), history, {
  toggle: $('ruler'), options: $('ruler-options'), metres: $('metres'), upright: $('standing'), words: $('ruler-words'),
});
const mask = new Mask({
  front: $('front'), toggle: $('paint'), options: $('mask-options'), brush: $('brush'), eraser: $('eraser'),
  width: $('brush-width'), clear: $('clear-mask'),
}, $('photo'), start.has_mask ? await image('mask.png') : null, start.photo, history, $('stage'));
const pictures = new Pictures({
  preview: $('preview'), insert: $('insert'), cancel: $('cancel'), picture: $('picture'), bar: $('bar'),
  words: $('rendering-words'), clock: $('clock'), report: $('report'),
}, {
  get state() {
    return state;
  },
  placement: sentPlacement,
  ask,
  post,
  saved: showSaved,
});
export const handles = new Handles($('handles'), $('stage'), start.asset, history);

// What warpir answers to a request. Here and below the error's message is for the user.
async function ask(address, request = {}) {
  try {
    return await fetch(address, request);
  } catch {
    throw new Error('warpir.place is not running any more.');
  }
}

// Send values to warpir; returns its answer.
async function post(address, values) {
  const answer = await ask(address, {
    method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(values),
  });
  if (answer.ok) return answer.json();
  if (answer.status !== 422) throw new Error('warpir.place had a fault of its own; its terminal says more.');
  const { where, what, advice } = await answer.json();
  throw new Error(`${where}: ${what}${advice ? ` – ${advice}` : ''}`);
}

// --------------------------------------------------------------------------------- the drawing

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
    stage.setLight(lighting.onStage(state));
    stage.setLamps(state.lamps);
    const more = stage.render();
    handles.draw(state, seen);
    lines.draw(state);
    ruler.draw(state);
    lamps.draw(state);
    mask.draw(state);
    pictures.draw(state);
    handles.say(fields.spoken(state));
    fields.show(state);
    dial.draw(state);
    showPanel();
    lighting.follow(state);
    if (more) draw();
  });
}

function showPanel() {
  const light = lighting.shown(state);
  $('lens').textContent = fields.about(state, spacing);
  $('camera-words').hidden = state.camera !== camera || state.stance !== stance;
  $('keep-light').checked = state.light.isKept;
  $('light').dataset.source = lighting.source;
  if (light.sky === 'custom' && !skies.querySelector('[value=custom]')) skies.append(new Option(start.sky instanceof Array ? 'Custom' : 'As estimated', 'custom'));
  skies.value = light.sky;
  if ($('light-words').textContent !== lighting.words) $('light-words').textContent = lighting.words;
  $('done').hidden = !$('command').textContent || state !== saved;
}

// What of the camera is an estimate, and how far it may be off; the view across, as its field is.
function estimated(numbers) {
  const [across, upright] = [camera.width / camera.fx, camera.height / camera.fy].map((side) => Math.sin(2 * Math.atan(side / 2)));
  const names = { pitch_deg: ['pitch', 1], roll_deg: ['roll', 1], vfov_deg: ['view', across / upright] };
  const parts = Object.entries(names).filter(([name]) => numbers[name].source === 'estimate')
    .map(([name, [word, factor]]) => `${word} ± ${plain(numbers[name].sigma * factor, 1)}°`);
  return parts.length ? `Estimated from the photo: ${parts.join(', ')}.` : '';
}

function readOut() {
  const { pitch, roll, fov } = Object.fromEntries(Object.entries(fields.byName).map(([name, field]) => [name, field.get(state)]));
  const { ahead, right } = polar(state);
  $('readout').textContent = `pitch ${pitch.toFixed(1)}°  roll ${roll.toFixed(1)}°  view ${fov.toFixed(0)}°  ·  ${ahead.toFixed(2)} m ahead, ${right.toFixed(2)} m right  ·  ${plain(state.size, 3)} m, turned ${wrapped(state.turn).toFixed(0)}°`;
  $('readout').hidden = false;
}

// A choice of skies.
const skies = document.createElement('select');
skies.id = 'sky';
for (const name of Object.keys(start.sky_radiance)) skies.append(new Option(name[0].toUpperCase() + name.slice(1), name));
skies.addEventListener('change', () => once('sky', (before) => lighting.set(before, { sky: skies.value })));
const skyRow = Object.assign(document.createElement('div'), { className: 'field' });
skyRow.append(Object.assign(document.createElement('label'), { textContent: 'Colours', htmlFor: 'sky' }), skies);
$('light-fields').append(skyRow);
$('keep-light').addEventListener('change', ({ target }) => once('keep', (before) => (
  target.checked ? lighting.set(before, {}) : { ...before, light: { ...before.light, isKept: false } })));

// ------------------------------------------------------------------------ pointer, wheel and keys

const canvas = $('canvas');
const view = new View($('room'), $('stage'), canvas, start.photo, {
  changed: (part, [width, height]) => {
    seen = part;
    stage.setWindow(part, width, height, Math.min(window.devicePixelRatio, 2));
    $('zoom-fit').textContent = `${Math.round(100 * view.scale)} %`;
    draw();
  },
  pressed: (event) => history.isOn || lamps.press(event, canvas) || mask.press(event) || (handles.isOnObject(event) && handles.drag(event, canvas, 'foot')),
  cancel: () => history.cancel(),
});
$('zoom-in').addEventListener('click', () => view.step(1));
$('zoom-out').addEventListener('click', () => view.step(-1));
$('zoom-fit').addEventListener('click', () => view.fit());
canvas.addEventListener('pointermove', (event) => canvas.classList.toggle('grabs', Boolean(handles.isOnObject(event))));
canvas.addEventListener('dblclick', (event) => {
  if (mask.isPainting || event.timeStamp - lamps.addedAt < 1000) return;
  const box = $('stage').getBoundingClientRect();
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
const VIEWS = {
  z: () => view.step(1), x: () => view.step(-1), 0: () => view.fit(),
  i: () => view.pan(0, -1), k: () => view.pan(0, 1), j: () => view.pan(-1, 0), l: () => view.pan(1, 0),
};
// A handle that has the focus gives the arrows its own meaning, right that of up and left of down.
const ON_HANDLE = { pitch: ['w', 's'], roll: ['a', 'd'], tilt: ['d', 'a'], turn: ['q', 'e'], size: ['+', '-'] };
const UP_DOWN = { arrowup: 0, arrowright: 0, arrowdown: 1, arrowleft: 1 };

window.addEventListener('keydown', (event) => {
  const key = event.key.toLowerCase();
  if (event.ctrlKey || event.metaKey) {
    if ('zys'.includes(key)) takeTyped();
    if (key === 'z') (event.shiftKey ? history.redo() : history.undo());
    else if (key === 'y') history.redo();
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
    once('fov key', (before) => fields.byName.fov.set(before, clamp(fields.byName.fov.get(before) * factor, fields.byName.fov.low, fields.byName.fov.high)));
  } else if (key === 'g') {
    $('guides').click();
  } else if (VIEWS[key]) {
    VIEWS[key]();
  } else {
    const change = KEYS[ON_HANDLE[handle]?.[UP_DOWN[key]] ?? key];
    if (!change) return;
    once(`key ${key}`, change(by));
  }
  $('readout').hidden = false;
  event.preventDefault();
});
// Half of the world writes 1,5: a number's field may leave the comma out, and make 15 of it.
window.addEventListener('beforeinput', (event) => {
  if (event.target.type !== 'number' || !event.data?.includes(',')) return;
  event.preventDefault();
  document.execCommand('insertText', false, event.data.replaceAll(',', '.'));
});
window.addEventListener('keyup', () => {
  $('readout').hidden = true;
});

// ------------------------------------------------------------------------------- panel and saving

$('undo').addEventListener('click', () => history.undo());
$('redo').addEventListener('click', () => history.redo());
$('guides').addEventListener('click', () => {
  const isShown = $('guides').getAttribute('aria-pressed') !== 'true';
  $('guides').setAttribute('aria-pressed', String(isShown));
  stage.grid.visible = isShown;
  $('handles').style.display = isShown ? '' : 'none';
  draw();
});
// Painting, and G, hide the handles that these are about.
for (const tool of ['lines', 'ruler', 'add-lamp']) {
  $(tool).addEventListener('click', () => {
    if (mask.isPainting) $('paint').click();
    if ($('guides').getAttribute('aria-pressed') !== 'true') $('guides').click();
  });
}
$('save').addEventListener('click', save);
$('copy').addEventListener('click', async () => {
  await navigator.clipboard.writeText($('command').textContent);
  $('copy').textContent = 'Copied';
  setTimeout(() => { $('copy').textContent = 'Copy'; }, 1500);
});

// What warpir/place/session.py reads.
function sentCamera({ camera: { fx, fy, cx, cy }, stance: pose }) {
  return { fx, fy, cx, cy, stance: pose };
}

function sentPlacement(now) {
  return {
    ...sentCamera(now), stand: now.stand, rotate_y: wrapped(now.turn), size: now.size, ...lighting.saved(now), lamps: now.lamps, mask: mask.sent(now),
  };
}

// So that the next preview does not wait: read, loaded and compiled is what it needs.
function warm(now) {
  post('warm', sentPlacement(now)).catch(() => {}); // the preview tells
}

let saved = state;
let isSaving = false; // the button is not disabled then: it would lose the focus

function showSaved(sent, command) {
  $('command').textContent = command;
  saved = sent;
  draw();
  others?.postMessage('saved');
}

async function save() {
  if ($('save').disabled || isSaving) return;
  const sent = state;
  isSaving = true;
  $('command').textContent = '';
  if (state !== refused) tell(''); // else what is saved is not what was typed
  $('done').hidden = true;
  try {
    const { command } = await post('save', sentPlacement(sent));
    showSaved(sent, command);
  } catch (error) {
    refused = null;
    tell(`Not saved: ${error.message}`);
  }
  isSaving = false;
}

// A page that is loaded again, also by a browser that was short of memory, goes on where it was, by
// a change that undo takes back. The address has the session's token, and storage may be refused.
const KEPT = `placing ${location.pathname}`;

// Another tab of this session saves into the same file.
let others = null;
try {
  others = new BroadcastChannel(KEPT);
  others.onmessage = () => {
    saved = null;
    draw();
    tell('Another tab has saved its placement; a save here replaces that.');
  };
} catch { /* refused with storage: then no tab is told */ }

function keep() {
  try {
    sessionStorage.removeItem(KEPT);
    sessionStorage.setItem(KEPT, JSON.stringify({ state, isSaved: state === saved }));
  } catch { /* a mask may be too much for it */ }
}

function goOn() {
  try {
    const kept = JSON.parse(sessionStorage.getItem(KEPT));
    const first = (name) => (JSON.stringify(kept.state[name]) === JSON.stringify(state[name]) ? state : kept.state)[name];
    if (kept && JSON.stringify(kept.state) !== JSON.stringify(state)) {
      history.once('loaded again', () => ({ ...kept.state, camera: first('camera'), stance: first('stance') }));
      if (kept.isSaved) saved = state;
    }
  } catch { /* then it begins anew */ }
  for (const kind of ['visibilitychange', 'pagehide']) window.addEventListener(kind, keep);
}

window.addEventListener('beforeunload', (event) => {
  if (state !== saved) event.preventDefault();
});

$('camera-words').textContent = estimated(start.camera_numbers);
$('title').textContent = `${start.asset.name} in ${start.photo.name}`;
$('title').title = $('title').textContent;
$('notes').hidden = !start.assumed.length;
for (const line of start.assumed) $('assumed').append(Object.assign(document.createElement('li'), { textContent: line }));

try {
  await stage.load('asset.glb', start.asset);
  $('loading').hidden = true;
  $('save').disabled = $('preview').disabled = $('insert').disabled = false;
  view.show();
  new ResizeObserver(() => view.show()).observe($('room'));
  goOn();
  warm(state);
  pictures.follow();
} catch (error) {
  $('loading').textContent = `The object cannot be shown: ${error.message}`;
}
