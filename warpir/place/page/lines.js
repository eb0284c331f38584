// Lines over the photo with a knob at each end: two for each axis, which tell the camera, and one over
// something of known length, which tells its height.

import { lengthSeen } from './camera.js';
import { follow, shape, withCamera } from './handles.js';
import { linesOf, meeting, solved, uprighted } from './vanishing.js';

const NAMES = { a: 'level lines', b: 'level lines across', c: 'upright lines' };
const STEP = 1; // photo pixels by an arrow key; ten with Shift

// The same with other lines, and the camera that they tell; where none does, the camera stays.
function withLines(before, lines) {
  const found = solved(before.camera, before.stance, lines, before.isUpright);
  const changed = found && withCamera(before, found.camera, found.stance);
  return { ...(changed ?? before), lines };
}

const movedEnd = (segment, end, by) => segment.map((point, k) => (k === end ? point.map((part, i) => part + by[i]) : point));

// A knob of an `owner` with group, history and scale, that is dragged and moved by the arrow keys;
// `moved` gives the state with its end moved by some photo pixels.
export function endOf(owner, kind, handle, name, moved) {
  const knob = owner.group.appendChild(shape('g', {
    class: `knob end ${kind}`, tabindex: 0, role: 'button', 'data-handle': handle, 'aria-label': `${name}; arrow keys move it`,
  }));
  knob.append(shape('circle', { class: 'reach', r: 18 }), shape('circle', { r: 6.5 }));
  knob.addEventListener('pointerdown', (event) => {
    const { clientX, clientY } = event;
    const isOn = follow(knob, event, owner.history, 'line', (now) => owner.history.move((before) => (
      moved(before, [(now.clientX - clientX) / owner.scale, (now.clientY - clientY) / owner.scale]))));
    if (isOn) event.stopPropagation();
  });
  knob.addEventListener('keydown', (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!way) return;
    event.preventDefault();
    event.stopPropagation();
    const by = way.map((part) => part * STEP * (event.shiftKey ? 10 : 1));
    owner.history.once('line key', (before) => moved(before, by));
  });
  return knob;
}

export class Lines {
  #ends = [];

  // `page` has the elements of the panel: toggle, axes (checkboxes by axis), upright, words.
  constructor(svg, stage, history, page) {
    Object.assign(this, { svg, stage, history, page });
    this.group = svg.appendChild(shape('g', { class: 'lines' }));
    for (const axis of Object.keys(NAMES)) this.#axis(axis);
    page.toggle.addEventListener('click', () => history.once('lines', (before) => (
      before.lines ? { ...before, lines: null } : this.#begun(before, ['a', 'b']))));
    for (const [axis, box] of Object.entries(page.axes)) {
      box.addEventListener('change', () => history.once('axes', (before) => {
        const axes = Object.keys(NAMES).filter((other) => (other === axis ? box.checked : before.lines[other]));
        return axes.length < 2 ? null : this.#begun(before, axes);
      }) ?? this.draw(history.state));
    }
    page.upright.addEventListener('change', () => history.once('upright', (before) => {
      const found = uprighted(before.camera, before.stance, page.upright.checked);
      const changed = found && withCamera(before, found.camera, found.stance);
      return changed && { ...changed, isUpright: page.upright.checked };
    }) ?? this.draw(history.state));
  }

  // Axes that are shown already keep their lines; new ones begin as the camera sees them.
  #begun(before, axes) {
    const fresh = linesOf(before.camera, before.stance, axes);
    const kept = Object.entries(fresh).map(([axis, segments]) => [axis, segments && (before.lines?.[axis] ?? segments)]);
    return { ...before, lines: Object.fromEntries(kept) };
  }

  #axis(axis) {
    for (const which of [0, 1]) {
      const far = this.group.appendChild(shape('path', { class: `far ${axis}` }));
      const rim = this.group.appendChild(shape('path', { class: 'rim', 'stroke-width': 4.5 }));
      const line = this.group.appendChild(shape('path', { class: `axis ${axis}` }));
      for (const end of [0, 1]) {
        const name = `End ${end + 1} of line ${which + 1}, ${NAMES[axis]}`;
        const knob = endOf(this, axis, `${axis}${which}${end}`, name, (before, by) => {
          const segments = before.lines[axis].map((segment, k) => (k === which ? movedEnd(segment, end, by) : segment));
          return withLines(before, { ...before.lines, [axis]: segments });
        });
        this.#ends.push({ axis, which, end, knob, line, rim, far });
      }
    }
  }

  draw({ camera, stance, lines, isUpright }) {
    this.scale = this.stage.getBoundingClientRect().width / camera.width;
    this.stage.classList.toggle('lined', Boolean(lines));
    this.group.style.display = lines ? '' : 'none';
    const { toggle, axes, upright, words, options } = this.page;
    toggle.setAttribute('aria-pressed', String(Boolean(lines)));
    options.hidden = !lines;
    upright.checked = isUpright;
    words.textContent = '';
    if (!lines) return;
    for (const [axis, box] of Object.entries(axes)) box.checked = Boolean(lines[axis]);
    if (!solved(camera, stance, lines, isUpright)) {
      words.textContent = isUpright && !(lines.a && lines.b) ? 'An upright photo needs both kinds of level lines.'
        : 'No camera sees these as right angles: the last one that did stays.';
    }
    for (const { axis, which, end, knob, line, rim, far } of this.#ends) {
      const isShown = Boolean(lines[axis]);
      for (const part of [knob, line, rim, far]) part.style.display = isShown ? '' : 'none';
      if (!isShown) continue;
      const points = lines[axis][which].map((point) => point.map((part) => part * this.scale));
      knob.setAttribute('transform', `translate(${points[end]})`);
      for (const path of [line, rim]) path.setAttribute('d', `M${points[0]}L${points[1]}`);
      const [x, y, w] = meeting(lines[axis], camera) ?? [0, 0, 0];
      const to = [x, (y * camera.fy) / camera.fx].map((part) => part * camera.width * this.scale);
      far.setAttribute('d', w ? `M${points[0]}L${to}` : '');
    }
  }
}

// The same with the camera so high that the ruler's segment is as long as it is said to be.
function measured(before, ruler) {
  const length = lengthSeen(before.camera, before.stance, ruler.ends, ruler.isUpright);
  const height = length && (before.stance.height * ruler.metres) / length;
  const changed = height && withCamera(before, before.camera, { ...before.stance, height });
  return { ...(changed || before), ruler };
}

export class Ruler {
  // `page` has toggle, options, metres, upright and words.
  constructor(svg, stage, history, page) {
    Object.assign(this, { stage, history, page });
    this.group = svg.appendChild(shape('g', { class: 'ruler' }));
    this.rim = this.group.appendChild(shape('path', { class: 'rim', 'stroke-width': 4.5 }));
    this.line = this.group.appendChild(shape('path', { class: 'axis r' }));
    this.ends = [0, 1].map((end) => endOf(this, 'r', `r${end}`, `End ${end + 1} of the known length`, (before, by) => (
      measured(before, { ...before.ruler, ends: movedEnd(before.ruler.ends, end, by) }))));
    page.toggle.addEventListener('click', () => history.once('ruler', (before) => ({ ...before, ruler: before.ruler ? null : this.#begun(before) })));
    page.metres.addEventListener('input', () => { this.isTyped = true; });
    page.metres.addEventListener('blur', () => { this.isTyped = false; });
    page.metres.addEventListener('change', () => {
      this.isTyped = false;
      const metres = page.metres.valueAsNumber;
      if (metres > 0) history.once('metres', (before) => measured(before, { ...before.ruler, metres }));
      this.draw(history.state);
    });
    page.upright.addEventListener('change', () => history.once('standing', (before) => (
      measured(before, { ...before.ruler, isUpright: page.upright.checked }))));
  }

  // As long as the camera sees it now, so that nothing changes yet.
  #begun({ camera, stance }) {
    const ends = [[0.3, 0.85], [0.3, 0.5]].map(([u, v]) => [u * camera.width, v * camera.height]);
    return { ends, isUpright: true, metres: lengthSeen(camera, stance, ends, true) ?? 1 };
  }

  draw({ camera, stance, ruler }) {
    const { toggle, options, metres, upright, words } = this.page;
    this.scale = this.stage.getBoundingClientRect().width / camera.width;
    this.stage.classList.toggle('measured', Boolean(ruler));
    toggle.setAttribute('aria-pressed', String(Boolean(ruler)));
    options.hidden = !ruler;
    this.group.style.display = ruler ? '' : 'none';
    if (!ruler) return;
    if (!this.isTyped) metres.value = Number(ruler.metres.toFixed(3));
    upright.checked = ruler.isUpright;
    words.textContent = lengthSeen(camera, stance, ruler.ends, ruler.isUpright) ? ''
      : 'The lower end must lie on the ground, below the horizon; of a length on the ground both.';
    const points = ruler.ends.map((point) => point.map((part) => part * this.scale));
    for (const path of [this.line, this.rim]) path.setAttribute('d', `M${points[0]}L${points[1]}`);
    for (const [k, knob] of this.ends.entries()) knob.setAttribute('transform', `translate(${points[k]})`);
  }
}
