// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

/** Files that were dropped onto the page. */

/** @returns {Promise<File[]>} the files that were dropped, those of folders too, in the order of their names */
export async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.some((entry) => entry.isDirectory)) return [...transfer.files];
  const files = [];
  for (const entry of entries) await collect(entry, files);
  return files.sort((a, b) => a.name.localeCompare(b.name, undefined, {numeric: true}));
}

async function collect(entry, files, depth = 0) {
  if (entry.isFile) {
    files.push(
      await new Promise((resolve, reject) => {
        entry.file(resolve, reject);
      }),
    );
  } else if (depth < 3) {
    const reader = entry.createReader();
    for (;;) {
      // a reader gives at most 100 entries at once
      const some = await new Promise((resolve, reject) => {
        reader.readEntries(resolve, reject);
      });
      if (!some.length) return;
      for (const child of some) await collect(child, files, depth + 1);
    }
  }
}
