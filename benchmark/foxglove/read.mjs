// SPDX-FileCopyrightText: 2026 The dlo_calibration authors
// SPDX-License-Identifier: Apache-2.0

// Prints, as one JSON document, what Foxglove's own readers find in an MCAP file:
// `node read.mjs indexed|streamed FILE.mcap`.

import { parse } from '@foxglove/rosmsg';
import { MessageReader } from '@foxglove/rosmsg2-serialization';
import { McapIndexedReader, McapStreamReader } from '@mcap/core';
import { decompress } from 'fzstd';
import { open, readFile } from 'node:fs/promises';

const decompressHandlers = { zstd: (octets, size) => decompress(octets, new Uint8Array(Number(size))) };

// What JSON cannot hold: typed arrays become arrays, 64 bit integers become numbers.
const plain = (_, value) =>
  ArrayBuffer.isView(value) ? Array.from(value) : typeof value === 'bigint' ? Number(value) : value;

class Decoder {
  readers = new Map();

  decode(schema, data) {
    if (!this.readers.has(schema.id)) {
      const text = new TextDecoder().decode(schema.data);
      this.readers.set(schema.id, new MessageReader(parse(text, { ros2: true })));
    }
    return this.readers.get(schema.id).readMessage(data);
  }
}

// As Foxglove opens a local file: by its index.
async function indexed(path) {
  const file = await open(path);
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const { buffer } = await file.read(new Uint8Array(Number(size)), 0, Number(size), Number(offset));
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const decoder = new Decoder();
  const messages = [];
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    const schema = reader.schemasById.get(channel.schemaId);
    messages.push({ topic: channel.topic, type: schema.name, message: decoder.decode(schema, message.data) });
  }
  await file.close();
  return { profile: reader.header.profile, messages };
}

// As a file without an index is read: from its beginning, up to where it is cut.
async function streamed(path) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(await readFile(path));
  const decoder = new Decoder();
  const schemas = new Map();
  const channels = new Map();
  const messages = [];
  for (let record; (record = reader.nextRecord()); ) {
    if (record.type === 'Schema') {
      schemas.set(record.id, record);
    } else if (record.type === 'Channel') {
      channels.set(record.id, record);
    } else if (record.type === 'Message') {
      const channel = channels.get(record.channelId);
      const schema = schemas.get(channel.schemaId);
      messages.push({ topic: channel.topic, type: schema.name, message: decoder.decode(schema, record.data) });
    }
  }
  return { messages };
}

const [how, path] = process.argv.slice(2);
const found = await { indexed, streamed }[how](path);
process.stdout.write(JSON.stringify(found, plain));
