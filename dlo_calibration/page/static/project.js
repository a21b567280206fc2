// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/**
 * The project: the document that the page edits, and the state that the server derives from it.
 *
 * Each edit is shown at once and sent; while one is under way, later ones wait and are sent together.
 */

const RETRY = 1500; // ms until a lost connection is tried again
const MERGED = 1200; // ms within which edits of one kind are one step of undo
const MOST_STEPS = 200; // of undo

/** Emits `change` whenever the page must be drawn again. */
export class Project extends EventTarget {
  state = null; // the newest of the server
  document = null; // with edits that the server has not seen yet
  problem = null; // {text, place}: why the last edit or request was refused, and the place of the page for it
  notice = null; // a warning about the whole project, e.g. that another window changed it
  connected = true;
  #undo = [];
  #redo = [];
  #last = {merge: null, time: 0};
  #sending = false;
  #waiting = false;
  #asking = 0; // requests on their way that may change the state
  #later = null; // a state that came while an edit or request was on its way
  #place = '';

  /** Read the state, and follow the server's events. */
  async open() {
    const events = new EventSource('api/events');
    events.addEventListener('state', (event) => this.#take(JSON.parse(event.data)));
    events.addEventListener('calibration', (event) => {
      if (!this.state) return;
      this.state.calibration = {...this.state.calibration, ...JSON.parse(event.data)};
      this.#changed();
    });
    events.addEventListener('information', (event) => {
      const {trial, ...information} = JSON.parse(event.data);
      if (this.state?.trials[trial])
        this.state.trials[trial].information = information.information ?? information;
      this.#changed();
    });
    events.addEventListener('advice', (event) => {
      if (!this.state) return;
      this.state.advice = JSON.parse(event.data).advice;
      this.#changed();
    });
    events.addEventListener('films', (event) => {
      const {id, progress} = JSON.parse(event.data);
      if (this.state?.films[id]) this.state.films[id].progress = progress;
      this.#changed();
    });
    events.onerror = () => this.#connection(false);
    events.onopen = () => {
      if (!this.connected) this.#again();
    };
    await this.#again();
  }

  /** @param {string} id @returns {object | undefined} the photograph in the document */
  photograph(id) {
    return this.document.photographs.find((photograph) => photograph.id === id);
  }

  /** @param {string} id @returns {object | undefined} what the server knows of a photograph */
  seen(id) {
    return this.state.photographs[id];
  }

  get canUndo() {
    return this.#undo.length > 0;
  }

  get canRedo() {
    return this.#redo.length > 0;
  }

  /**
   * Change the document.
   *
   * @param {(document: object) => void} change alters the copy that it is given
   * @param {{merge?: string, place?: string}} how edits with the same `merge` are undone together: those shortly after
   *   each other, and all if it begins with 'drag'; `place` says where a refusal is shown
   */
  edit(change, {merge = null, place = ''} = {}) {
    const next = structuredClone(this.document);
    change(next);
    const now = Date.now();
    const together =
      merge && merge === this.#last.merge && (merge.startsWith('drag') || now - this.#last.time < MERGED);
    if (!together) this.#remember();
    this.#last = {merge, time: now};
    this.#redo = [];
    this.document = next;
    this.#place = place;
    this.#send();
  }

  undo() {
    this.#step(this.#undo, this.#redo);
  }

  redo() {
    this.#step(this.#redo, this.#undo);
  }

  /** Say that a series of edits that are undone together has ended. */
  settle() {
    this.#last = {merge: null, time: 0};
  }

  /** Forget the last refusal. */
  clear() {
    if (!this.problem && !this.notice) return;
    this.problem = null;
    this.notice = null;
    this.#changed();
  }

  /** Show that something was refused, at a place of the page. */
  refuse(text, place) {
    this.problem = {text, place};
    this.#changed();
  }

  /**
   * Ask the server for something other than an edit.
   *
   * @param {string} path below api/
   * @param {{method?: string, body?: *, name?: string, place?: string}} how `name` is that of an uploaded file
   * @returns {Promise<object | null>} the answer; null: it was refused, and the refusal is shown
   */
  async ask(path, {method = 'POST', body, name, place = ''} = {}) {
    const file = body instanceof Blob;
    this.#asking += method === 'GET' ? 0 : 1;
    const headers = file ? {'X-Name': encodeURIComponent(name)} : {'Content-Type': 'application/json'};
    try {
      const answer = await fetch(`api/${path}`, {
        method,
        headers: method === 'GET' ? {} : headers,
        body: file ? body : body === undefined ? undefined : JSON.stringify(body),
      });
      const answered = await answer.json().catch(() => ({}));
      if (!answer.ok) throw new Error(answered.error ?? `The server answered with ${answer.status}.`);
      if (this.problem?.place === place) this.problem = null;
      const state = answered.state ?? (answered.document ? answered : null);
      if (state) this.#adopt(state);
      return answered;
    } catch (error) {
      const lost = error instanceof TypeError;
      if (lost) this.#connection(false);
      this.refuse(
        lost ? 'The server cannot be reached; try again when the connection is back.' : error.message,
        place,
      );
      return null;
    } finally {
      this.#asking -= method === 'GET' ? 0 : 1;
      this.#catchUp();
    }
  }

  #remember() {
    this.#undo.push(this.document);
    if (this.#undo.length > MOST_STEPS) this.#undo.shift();
  }

  #step(from, to) {
    if (!from.length) return;
    to.push(this.document);
    this.document = from.pop();
    this.settle();
    this.#place = '';
    this.#send();
  }

  async #send() {
    this.#changed();
    this.#waiting = true;
    if (this.#sending) return;
    this.#sending = true;
    while (this.#waiting) {
      this.#waiting = false;
      const sent = this.document;
      try {
        const answer = await fetch('api/document', {
          method: 'PUT',
          headers: {'Content-Type': 'application/json'},
          body: JSON.stringify({revision: this.state.revision, document: sent}),
        });
        this.#answered(answer.status, await answer.json(), sent);
      } catch {
        this.#connection(false);
        this.#waiting = true;
        await new Promise((resolve) => {
          setTimeout(resolve, RETRY);
        });
      }
    }
    this.#sending = false;
    this.#catchUp();
    this.#changed();
  }

  /** Take the state that came meanwhile, if it is newer than the answers. */
  #catchUp() {
    const later = this.#later;
    if (!later || this.#sending || this.#asking) return;
    this.#later = null;
    if (later.revision >= this.state.revision) this.#take(later);
  }

  #answered(status, answered, sent) {
    this.connected = true;
    if (status === 409 && answered.state) {
      this.#foreign(answered.state);
    } else if (status !== 200) {
      this.document = this.state.document;
      this.#undo.pop();
      this.settle();
      this.#waiting = false;
      this.problem = {text: answered.error ?? `The server answered with ${status}.`, place: this.#place};
    } else {
      this.problem = null;
      this.state = answered;
      if (this.document === sent) this.document = answered.document;
    }
    this.#changed();
  }

  /** Take a state that the server sent by itself. */
  #take(state) {
    if (this.#sending || this.#asking) {
      this.#later = state;
    } else if (!this.state || state.revision === this.state.revision) {
      this.state = state;
      this.document = state.document;
      this.#changed();
    } else if (state.revision > this.state.revision) {
      this.#foreign(state);
    }
  }

  /** Take the state after a request of this page; the request can be undone. */
  #adopt(state) {
    if (state.revision !== this.state.revision) {
      this.#remember();
      this.#redo = [];
      this.settle();
    }
    this.state = state;
    this.document = state.document;
    this.#changed();
  }

  /** Take a state from another window: earlier edits of this page cannot be undone in it. */
  #foreign(state) {
    const other = JSON.stringify(state.document) !== JSON.stringify(this.document);
    this.state = state;
    this.document = state.document;
    this.#waiting = false;
    if (other) {
      this.#undo = [];
      this.#redo = [];
      this.notice = 'The project was changed in another window; you see its newest state.';
    }
    this.#changed();
  }

  async #again() {
    try {
      const answer = await fetch('api/state');
      if (!answer.ok) throw new Error(String(answer.status));
      const state = await answer.json();
      this.connected = true;
      if (this.state && !this.#sending) this.#take(state);
      else if (!this.state) {
        this.state = state;
        this.document = state.document;
        this.notice = state.warnings?.join(' ') || null; // of the project's files
      }
      this.#changed();
    } catch {
      this.#connection(false);
      setTimeout(() => this.#again(), RETRY);
    }
  }

  #connection(here) {
    if (this.connected === here) return;
    this.connected = here;
    this.#changed();
  }

  #changed() {
    this.dispatchEvent(new Event('change'));
  }
}
