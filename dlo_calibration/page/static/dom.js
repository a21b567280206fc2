// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/**
 * Descriptions of elements, and a patch that brings the page into agreement with them.
 *
 * Everything on the page is described anew at each change; only differences are changed, so that the focus and
 * unfinished input stay.  Texts become text nodes: nothing from the server is ever markup.
 */

const SVG = 'http://www.w3.org/2000/svg';
const PROPERTIES = new Set([
  'value',
  'checked',
  'disabled',
  'selected',
  'indeterminate',
  'multiple',
  'muted',
]);

/** @typedef {{tag: string, key?: string, attributes: object, children: Array}} Description */

/**
 * Describe an element.
 *
 * @param {string} tag with classes, such as 'p.note.small'
 * @param {object} attributes attributes; `key` keeps an element the same when its place changes, functions `on…`
 *   are listeners, `style` is an object of properties; null and false leave an attribute out
 * @param {...*} children descriptions, texts, arrays of them; null keeps a place empty
 * @returns {Description}
 */
export function h(tag, attributes = {}, ...children) {
  const [name, ...classes] = tag.split('.');
  const given = {...attributes};
  if (classes.length) given.class = [...classes, given.class].filter(Boolean).join(' ');
  const {key} = given;
  delete given.key;
  return {tag: name, key, attributes: given, children: children.flat(Infinity)};
}

/**
 * Make the children of an element agree with descriptions.
 *
 * @param {Element} parent
 * @param {Array} children descriptions, texts, null
 */
export function patch(parent, children) {
  const keyed = new Map();
  for (const node of parent.childNodes) if (node.ownKey !== undefined) keyed.set(node.ownKey, node);
  let at = parent.firstChild;
  for (const child of children) {
    let node = child?.key === undefined ? at : keyed.get(child.key);
    if (!node || !agrees(node, child)) node = created(child, parent);
    if (node === at) at = at.nextSibling;
    else placed(parent, node, at);
    update(node, child);
  }
  while (at) {
    const next = at.nextSibling;
    at.remove();
    at = next;
  }
}

/** Put an element before another one; the focus stays in it. */
function placed(parent, node, at) {
  const focused = node.contains(document.activeElement) ? document.activeElement : null;
  parent.insertBefore(node, at);
  focused?.focus({preventScroll: true});
}

const empty = (child) => child === null || child === undefined || child === false;

function agrees(node, child) {
  if (empty(child)) return node.nodeType === Node.COMMENT_NODE;
  if (typeof child !== 'object') return node.nodeType === Node.TEXT_NODE;
  return node.nodeType === Node.ELEMENT_NODE && node.localName === child.tag && node.ownKey === child.key;
}

function created(child, parent) {
  if (empty(child)) return document.createComment('');
  if (typeof child !== 'object') return document.createTextNode('');
  const inside = child.tag === 'svg' || (parent.namespaceURI === SVG && parent.localName !== 'foreignObject');
  const node = inside ? document.createElementNS(SVG, child.tag) : document.createElement(child.tag);
  node.ownKey = child.key;
  return node;
}

function update(node, child) {
  if (empty(child)) return;
  if (typeof child !== 'object') {
    if (node.data !== String(child)) node.data = String(child);
    return;
  }
  const before = node.ownAttributes ?? {};
  const {value, ...others} = child.attributes;
  for (const name of Object.keys(before)) if (!(name in child.attributes)) set(node, name, null);
  for (const [name, attribute] of Object.entries(others))
    if (before[name] !== attribute || PROPERTIES.has(name)) set(node, name, attribute);
  node.ownAttributes = child.attributes;
  patch(node, child.children);
  if (value !== undefined) set(node, 'value', value); // after the options of a select
}

function set(node, name, value) {
  if (name.startsWith('on')) {
    node[name] = value;
  } else if (name === 'style') {
    for (const [property, text] of Object.entries(value ?? {})) node.style.setProperty(property, text);
  } else if (PROPERTIES.has(name) && name in node) {
    if (node[name] !== value && !(name === 'value' && node.inHand)) node[name] = value ?? '';
  } else if (value === null || value === undefined || value === false) {
    node.removeAttribute(name);
  } else {
    node.setAttribute(name, value === true ? '' : value);
  }
}

// Unfinished input is not overwritten.
document.addEventListener(
  'input',
  (event) => {
    event.target.inHand = true;
  },
  true,
);
for (const kind of ['change', 'focusout']) {
  document.addEventListener(
    kind,
    (event) => {
      event.target.inHand = false;
    },
    true,
  );
}
