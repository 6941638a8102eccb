// Print the messages of a log: a line "topic TAB field TAB values" for each field, with @foxglove/ulog.
import { MessageType, ULog } from "@foxglove/ulog";
import { FileReader } from "@foxglove/ulog/node.js";

const log = new ULog(new FileReader(process.argv[2]));
await log.open();
const show = (value) => (Object.is(value, -0) ? "-0" : String(value));
for await (const message of log.readMessages()) {
  if (message.type !== MessageType.Data) continue;
  const { name, multiId } = log.subscriptions.get(message.msgId);
  for (const [field, value] of Object.entries(message.value)) {
    const values = typeof value === "string" ? [...Buffer.from(value)] : typeof value === "object" ? [...value] : [value];
    console.log(`${name}/${multiId}\t${field}\t${values.map(show).join(" ")}`);
  }
}
