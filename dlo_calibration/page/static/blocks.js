// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** The trials of a film as blocks on its time line, whose edges can be dragged. */

import {h} from './dom.js';

const FAR = 10; // images that an arrow key with Shift moves an edge
const EDGES = {start: 'Start', end: 'End'};

/**
 * @typedef {object} Block a trial on the time line
 * @property {string} title e.g. `Trial 1`
 * @property {boolean} used
 * @property {number} start [s]
 * @property {number} end [s]
 * @property {{start: [number, number], end: [number, number]}} limits of both edges [s]
 */

/**
 * @param {{duration: number, step: number, blocks: Block[], onshow: Function, onuse: Function, onmove: Function,
 *   onmoved: Function}} given `step` is the time between two images [s]; `onshow(k)` shows a block, `onuse(k, used)`
 *   uses it or not, `onmove(k, edge, time)` moves an edge, and `onmoved()` ends a movement
 * @returns {object} the description of the blocks
 */
export function timeBlocks({duration, step, blocks, onshow, onuse, onmove, onmoved}) {
  const share = (time) => `${(100 * time) / duration}%`;
  return h(
    'div.blocks',
    {role: 'group', 'aria-label': 'Trials on the time line'},
    blocks.flatMap((block, k) => [
      h(
        'button.block',
        {
          key: `block${k}`,
          type: 'button',
          class: `${block.used ? 'used' : 'unused'} lane${k % 2}`, // rests of neighbours overlap
          style: {left: share(block.start), width: share(block.end - block.start)},
          title: `${block.title}, ${block.start.toFixed(1)} to ${block.end.toFixed(1)} s`,
          'aria-label': `${block.title}${block.used ? '' : ', not used'}. Delete leaves it out.`,
          onclick: () => onshow(k),
          onkeydown: ({key}) => (key === 'Delete' || key === 'Backspace') && onuse(k, false),
        },
        block.title,
      ),
      ...Object.keys(EDGES).map((edge) => {
        const [low, high] = block.limits[edge];
        const move = (time) => onmove(k, edge, Math.min(Math.max(time, low), high));
        return h('button.edge', {
          key: `${edge}${k}`,
          type: 'button',
          class: `${edge} lane${k % 2}`,
          style: {left: share(block[edge])},
          role: 'slider',
          'aria-label': `${EDGES[edge]} of ${block.title}`,
          'aria-valuemin': low,
          'aria-valuemax': high,
          'aria-valuenow': block[edge],
          'aria-valuetext': `${block[edge].toFixed(2)} seconds`,
          onpointerdown: ({currentTarget, pointerId}) => currentTarget.setPointerCapture(pointerId),
          onpointermove: ({clientX, currentTarget, pointerId}) => {
            if (!currentTarget.hasPointerCapture(pointerId)) return;
            const {left, width} = currentTarget.parentElement.getBoundingClientRect();
            move(((clientX - left) / width) * duration);
          },
          onlostpointercapture: onmoved,
          onkeydown: (event) => {
            const by = {ArrowLeft: -step, ArrowDown: -step, ArrowRight: step, ArrowUp: step}[event.key];
            if (!by) return;
            event.preventDefault();
            move(block[edge] + by * (event.shiftKey ? FAR : 1));
            onmoved();
          },
        });
      }),
    ]),
  );
}
