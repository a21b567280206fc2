// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Gestures on the stage: pointer, wheel, two fingers, keys. */

const STILL = 5; // screen pixels: a pointer that moves less is a tap
const STEP = 60; // screen pixels by which an arrow key moves the photograph
const ARROWS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1]};

/**
 * @typedef {object} Tool what a step does with the photograph
 * @property {(pixel: [number, number]) => void} [tap] a tap beside all marks
 * @property {(mark: string, pixel: [number, number]) => ({move: Function, end?: Function} | null)} [grab] a mark, by
 *   its data-mark, is taken and moved
 * @property {(mark: string, by: [number, number]) => void} [nudge] a mark is moved by whole pixels
 * @property {(mark: string, key: string) => boolean} [press] another key on a mark; true: it was used
 */

/**
 * Listen to the stage.
 *
 * @param {import('./view.js').View} view
 * @param {() => Tool | null} tool of the present step
 */
export function listen(view, tool) {
  const pointers = new Map();
  let gesture = null;
  let space = false;
  const {stage} = view;

  function begin(event) {
    if (event.target.closest('.bubble, button, .legend')) return;
    const at = view.under(event);
    pointers.set(event.pointerId, at);
    stage.setPointerCapture(event.pointerId);
    if (pointers.size === 2) {
      gesture?.held?.end?.();
      gesture = {kind: 'pinch'};
      return;
    }
    if (pointers.size > 2) return;
    const mark = event.target.closest('[data-mark]');
    const held =
      event.button === 0 && !space && mark ? tool()?.grab?.(mark.dataset.mark, view.pixel(...at)) : null;
    if (held) mark.focus?.({preventScroll: true});
    else if (!mark) stage.focus({preventScroll: true});
    gesture = {
      kind: held ? 'hold' : 'press',
      held,
      start: at,
      moved: false,
      may: event.button === 0 && !space,
    };
    event.preventDefault();
  }

  function move(event) {
    const before = pointers.get(event.pointerId);
    if (!before || !gesture) return;
    const at = view.under(event);
    pointers.set(event.pointerId, at);
    if (gesture.kind === 'pinch') {
      const other = [...pointers.entries()].find(([id]) => id !== event.pointerId)?.[1];
      if (!other) return;
      const middle = [(at[0] + other[0]) / 2, (at[1] + other[1]) / 2];
      const spread = (pointer) => Math.max(1, Math.hypot(pointer[0] - other[0], pointer[1] - other[1]));
      view.pan((at[0] - before[0]) / 2, (at[1] - before[1]) / 2);
      view.zoom(spread(at) / spread(before), ...middle);
      return;
    }
    gesture.moved ||= Math.hypot(at[0] - gesture.start[0], at[1] - gesture.start[1]) > STILL;
    if (!gesture.moved) return;
    if (gesture.kind === 'hold') gesture.held.move(view.pixel(...at));
    else view.pan(at[0] - before[0], at[1] - before[1]);
    stage.classList.toggle('panning', gesture.kind === 'press');
  }

  function end(event) {
    const at = pointers.get(event.pointerId);
    pointers.delete(event.pointerId);
    if (!gesture || pointers.size) return;
    const done = gesture;
    gesture = null;
    stage.classList.remove('panning');
    if (done.kind === 'hold') done.held.end?.(done.moved);
    else if (
      done.kind === 'press' &&
      !done.moved &&
      done.may &&
      event.type === 'pointerup' &&
      at &&
      view.covers(...at)
    ) {
      tool()?.tap?.(view.pixel(...at));
    }
  }

  function key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const mark = event.target.closest?.('[data-mark]')?.dataset.mark;
    const arrow = ARROWS[event.key];
    let used = true;
    if (mark && arrow && tool()?.nudge)
      tool().nudge(
        mark,
        arrow.map((axis) => axis * (event.shiftKey ? 10 : 1)),
      );
    else if (mark && tool()?.press?.(mark, event.key)) used = true;
    else if (event.target !== stage && !mark) used = false;
    else if (arrow) view.pan(...arrow.map((axis) => -axis * STEP));
    else if (event.key === '+' || event.key === '=') view.zoom(1.25);
    else if (event.key === '-') view.zoom(0.8);
    else if (event.key === '0') view.fit();
    else if (event.key === ' ') space = true;
    else if (event.key === 'Enter' && event.target === stage) {
      tool()?.tap?.(view.pixel(view.room.width / 2, view.room.height / 2));
    } else used = false;
    if (used) event.preventDefault();
  }

  stage.addEventListener('pointerdown', begin);
  stage.addEventListener('pointermove', move);
  stage.addEventListener('pointerup', end);
  stage.addEventListener('pointercancel', end);
  stage.addEventListener(
    'wheel',
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      view.zoom(
        Math.exp(-Math.max(-200, Math.min(200, event.deltaY * lines)) * (event.ctrlKey ? 0.01 : 0.0018)),
        ...view.under(event),
      );
    },
    {passive: false},
  );
  stage.addEventListener('keydown', key);
  stage.addEventListener('keyup', (event) => {
    if (event.key === ' ') space = false;
  });
  stage.addEventListener('contextmenu', (event) => {
    if (event.target.closest('[data-mark]')) event.preventDefault();
  });
}
