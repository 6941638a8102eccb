// Print the messages of a recording: a line "topic TAB field TAB values" for each field, with @mcap/core and Foxglove's decoder.
import { readFileSync } from "node:fs";
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { decompress } from "fzstd";

const file = readFileSync(process.argv[2]);
const readable = {
  size: async () => BigInt(file.length),
  read: async (offset, size) => new Uint8Array(file.subarray(Number(offset), Number(offset + size))),
};
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: { zstd: (data) => decompress(data) } });
const decoders = new Map();
const show = (value) => (Object.is(value, -0) ? "-0" : String(value));
for await (const message of reader.readMessages()) {
  const { topic, schemaId } = reader.channelsById.get(message.channelId);
  if (topic.endsWith("/log")) continue; // ROS 2's Log, a copy for Foxglove's panel
  if (!decoders.has(schemaId)) {
    const definition = new TextDecoder().decode(reader.schemasById.get(schemaId).data);
    decoders.set(schemaId, new MessageReader(parse(definition, { ros2: true })));
  }
  console.log(`${topic}\t@times\t${message.logTime} ${message.publishTime}`);
  for (const [name, value] of Object.entries(decoders.get(schemaId).readMessage(message.data))) {
    console.log(`${topic}\t${name}\t${typeof value === "object" ? [...value].map(show).join(" ") : show(value)}`);
  }
}
