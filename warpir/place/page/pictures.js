// Pictures that warpir renders for the page: a preview over the photo, and the full insertion.

const PAUSE = 300; // ms between two questions how far it is
const STAGES = { starting: 'Starting', reading: 'Reading', light: 'Estimating the light', picture: 'Rendering' };

export class Pictures {
  #polls = false;
  #asked = null; // the state whose preview this page waits for

  // `elements` has preview, insert, cancel, picture, bar, words, clock, report; `page` has state,
  // placement(state), ask(address), post(address, values), saved(state, command).
  constructor(elements, page) {
    Object.assign(this, elements, { page });
    this.preview.addEventListener('click', () => this.#begin('preview'));
    this.insert.addEventListener('click', () => this.#begin('insert'));
    this.cancel.addEventListener('click', () => page.post('cancel', {}).catch(() => {}));
  }

  // The picture belongs to one state: of any other it is not shown.
  draw(state) {
    const isOld = state !== this.of;
    this.picture.hidden = isOld || !this.picture.src;
    this.picture.closest('#stage').classList.toggle('rendered', !this.picture.hidden);
  }

  async #begin(kind) {
    if (!this.bar.hidden) return; // one at a time; the button is not disabled: it would lose the focus
    const { state } = this.page;
    this.report.hidden = true;
    this.#show({ state: 'running', kind, line: 'starting', share: null, seconds: 0 });
    try {
      const begun = await this.page.post(kind, this.page.placement(state));
      if (begun.command) this.page.saved(state, begun.command);
      this.#asked = kind === 'preview' ? state : null;
      await this.#wait();
    } catch (error) {
      this.#fail(error);
      this.follow(); // what is in the way
    }
  }

  #fail({ message }) {
    this.#show({ state: 'failed', problem: message });
  }

  // Show how far that is which another page has begun, or this one before it was loaded again.
  async follow() {
    this.#asked = null;
    const now = await this.page.ask('progress.json').then((answer) => answer.json(), () => ({}));
    if (now.state === 'running') await this.#wait().catch((error) => this.#fail(error));
  }

  async #wait() {
    if (this.#polls) return;
    this.#polls = true;
    try {
      for (;;) {
        const now = await (await this.page.ask('progress.json')).json();
        this.#show(now);
        if (now.state !== 'running') break;
        await new Promise((resolve) => { setTimeout(resolve, PAUSE); });
      }
    } finally {
      this.#polls = false;
    }
  }

  #show({ state, kind, line, share, seconds, problem, address }) {
    const isRunning = state === 'running';
    if (!isRunning && document.activeElement === this.cancel) this.preview.focus();
    this.bar.hidden = this.cancel.hidden = !isRunning;
    for (const button of [this.preview, this.insert]) button.setAttribute('aria-disabled', isRunning);
    if (share === null || share === undefined) this.bar.removeAttribute('value');
    else this.bar.value = share;
    this.words.classList.toggle('warn', state === 'failed');
    if (isRunning) this.#say(`${STAGES[line] ?? line} …`, ` ${Math.round(seconds)} s`);
    else if (state === 'failed') this.#say(problem);
    else if (state === 'cancelled') this.#say('Cancelled.');
    else if (kind === 'insert') {
      this.#say(`Inserted in ${seconds} s. `);
      this.report.href = address;
      this.report.hidden = false;
    } else if (this.#asked) {
      const isNow = this.#asked === this.page.state;
      this.#say(`Preview, ${seconds} s: the composite at low quality${isNow ? '. Any change hides it.' : ' before your last change. Undo shows it.'}`);
      this.of = this.#asked;
      this.picture.src = address;
      this.picture.decode().then(() => this.draw(this.page.state), () => {});
    } else this.#say(''); // of another page
  }

  // Words that a screen reader says once, and a clock that it leaves alone.
  #say(words, clock = '') {
    if (this.words.textContent !== words) this.words.textContent = words;
    this.clock.textContent = clock;
  }
}
