// One state, the changes to it, and taking them back. A state is never written, only replaced.

const PAUSE = 600; // ms between two keys that undo takes back one by one

// Let what is being typed count before what follows; the field keeps the focus.
export function takeTyped() {
  const field = document.activeElement;
  if (!field?.matches('input[type=number]')) return;
  field.blur();
  field.focus();
}

export class History {
  #past = [];
  #future = [];
  #before = null;
  #name = '';
  #last = 0;

  // `page` has show(state), begun(), moved(state), ended(canUndo, canRedo).
  constructor(state, page) {
    this.state = state;
    this.page = page;
  }

  // Whether a gesture goes on: from its beginning to its end all changes are one step.
  get isOn() {
    return this.#before !== null;
  }

  begin(name) {
    // Keys that follow each other, and a field that is dragged, are one step.
    const isSame = name === this.#name && performance.now() - this.#last < PAUSE;
    if (!isSame) this.#past.push(this.state);
    this.#before = this.state;
    this.#name = '';
    this.page.begun();
  }

  // Replace the state by a change of that at the gesture's beginning; null changes nothing. Nor
  // does a gesture that was cancelled meanwhile.
  move(change) {
    if (!this.isOn) return;
    const next = change(this.#before);
    if (!next) return;
    this.#show(next);
    this.page.moved(next);
  }

  end(name = '') {
    if (!this.isOn) return;
    if (this.#past.at(-1) === this.state) this.#past.pop();
    else this.#future = [];
    this.#before = null;
    this.#name = name;
    this.#last = performance.now();
    this.#ended();
  }

  // End a gesture as if it had not begun.
  cancel() {
    if (!this.isOn) return;
    this.#show(this.#before);
    this.end();
  }

  once(name, change) {
    if (this.isOn) return;
    this.begin(name);
    this.move(change);
    this.end(name);
  }

  undo() {
    this.#step(this.#past, this.#future);
  }

  redo() {
    this.#step(this.#future, this.#past);
  }

  #step(from, to) {
    if (!from.length || this.isOn) return;
    to.push(this.state);
    this.#name = '';
    this.#show(from.pop());
    this.#ended();
  }

  #show(state) {
    this.state = state;
    this.page.show(state);
  }

  #ended() {
    this.page.ended(this.#past.length > 0, this.#future.length > 0);
  }
}
