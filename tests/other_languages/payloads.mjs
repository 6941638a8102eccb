// Print the values of payloads, given in hexadecimal: one line each, separated by spaces, texts in hexadecimal.
import { decodePayload } from "./decode.mjs";

function show(value) {
  if (Array.isArray(value)) return value.map(show).join("");
  if (typeof value === "string") return ` ${Buffer.from(value).toString("hex")}`;
  return Object.is(value, -0) ? " -0" : ` ${value}`;
}
for (const text of process.argv.slice(2)) console.log(show(decodePayload(Buffer.from(text, "hex"))));
