// Vanishing lines over the photo: two for each axis, with a knob at each end.

import { follow, withCamera } from './handles.js';
import { shape } from './light.js';
import { linesOf, meeting, solved, uprighted } from './vanishing.js';

const NAMES = { a: 'level lines', b: 'level lines across', c: 'upright lines' };
const STEP = 1; // photo pixels by an arrow key; ten with Shift

// The same with other lines, and the camera that they tell; where none does, the camera stays.
function withLines(before, lines) {
  const found = solved(before.camera, before.stance, lines, before.isUpright);
  const changed = found && withCamera(before, found.camera, found.stance);
  return { ...(changed ?? before), lines };
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
        const knob = this.group.appendChild(shape('g', {
          class: `knob end ${axis}`, tabindex: 0, role: 'button', 'data-handle': `${axis}${which}${end}`,
          'aria-label': `End ${end + 1} of line ${which + 1}, ${NAMES[axis]}; arrow keys move it`,
        }));
        knob.append(shape('circle', { class: 'reach', r: 18 }), shape('circle', { r: 6.5 }));
        this.#ends.push({ axis, which, end, knob, line, rim, far });
        this.#drags(knob, axis, which, end);
      }
    }
  }

  #drags(knob, axis, which, end) {
    const moved = (before, by) => {
      const at = before.lines[axis][which][end].map((part, k) => part + by[k]);
      const segments = before.lines[axis].map((segment, k) => (
        k === which ? segment.map((point, i) => (i === end ? at : point)) : segment));
      return withLines(before, { ...before.lines, [axis]: segments });
    };
    knob.addEventListener('pointerdown', (event) => {
      const { clientX, clientY } = event;
      const isOn = follow(knob, event, this.history, 'line', (now) => this.history.move((before) => (
        moved(before, [(now.clientX - clientX) / this.scale, (now.clientY - clientY) / this.scale]))));
      if (isOn) event.stopPropagation();
    });
    knob.addEventListener('keydown', (event) => {
      const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (!way) return;
      event.preventDefault();
      event.stopPropagation();
      const by = way.map((part) => part * STEP * (event.shiftKey ? 10 : 1));
      this.history.once('line key', (before) => moved(before, by));
    });
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
