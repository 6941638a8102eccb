// Test nedbus's wire format against docs/vectors.json: npm install @msgpack/msgpack, node vectors.mjs vectors.json
import { readFileSync } from "node:fs";
import { decode } from "@msgpack/msgpack";

const TAGS = { int8: 0xd0, uint8: 0xcc, int16: 0xd1, uint16: 0xcd, int32: 0xd2, uint32: 0xce, int64: 0xd3, uint64: 0xcf, float32: 0xca, float64: 0xcb };
const vectors = JSON.parse(readFileSync(process.argv[2], "utf8"));

// "float32[4]" is the base float32 with length 4; "char[8]" is one text of 8 bytes.
function parseType(text) {
  const [, base, length] = /^(\w+?)(?:\[(\d+)\])?$/.exec(text);
  return { base, length: Number(length ?? 0), isArray: length !== undefined && base !== "char" };
}

function decodeValue(value, { base, length }) {
  if (base === "bool") {
    if (typeof value !== "boolean") throw new Error("type");
    return value;
  }
  if (base === "char") {
    if (!(value instanceof Uint8Array)) throw new Error("type");
    const end = value.indexOf(0);
    const text = end < 0 ? value : value.subarray(0, end);
    if (text.length > length) throw new Error("type");
    return new TextDecoder().decode(text).replaceAll("\ufffd", "?");
  }
  if (typeof value !== "number" && typeof value !== "bigint") throw new Error("type");
  if (base === "float32") return Math.fround(Number(value));
  if (base === "float64") return Number(value);
  const bits = BigInt(/\d+/.exec(base)[0]);
  const least = base[0] === "u" ? 0n : -(1n << (bits - 1n));
  const integer = BigInt(value); // throws for a fraction
  if (integer < least || integer >= least + (1n << bits)) throw new Error("type");
  return bits === 64n ? integer : Number(integer);
}

export function decodeMessage(message, payload) {
  // Texts stay bytes, because they may be invalid UTF-8; 64-bit integers become BigInt.
  const array = decode(payload, { useBigInt64: true, rawStrings: true });
  const layout = Array.isArray(array) ? array.shift() : undefined;
  if (typeof layout !== "number" && typeof layout !== "bigint") throw new Error("array");
  const fields = vectors.definitions[`${message}/${layout}`];
  if (!fields) throw new Error("layout");
  if (array.length !== fields.length) throw new Error("count");
  return array.map((value, index) => {
    const type = parseType(fields[index][1]);
    if (!type.isArray) return decodeValue(value, type);
    if (!Array.isArray(value) || value.length !== type.length) throw new Error("type");
    return value.map((each) => decodeValue(each, type));
  });
}

export function encodeMessage(message, layout, values) {
  const fields = vectors.definitions[`${message}/${layout}`];
  const view = new DataView(new ArrayBuffer(4096));
  let offset = 0;
  const put = (method, size, value) => { view[method](offset, value); offset += size; };
  const header = (count) => {
    if (count < 16) put("setUint8", 1, 0x90 | count);
    else { put("setUint8", 1, 0xdc); put("setUint16", 2, count); }
  };
  put("setUint8", 1, 0xdc); // always array 16, for any number of fields
  put("setUint16", 2, fields.length + 1);
  put("setUint8", 1, layout);
  const putValue = (value, { base, length }) => {
    if (base === "bool") put("setUint8", 1, value ? 0xc3 : 0xc2);
    else if (base === "char") {
      put("setUint8", 1, 0xda); // str 16 of the full length, padded with NUL
      put("setUint16", 2, length);
      new Uint8Array(view.buffer).set(new TextEncoder().encode(value), offset);
      offset += length;
    } else {
      put("setUint8", 1, TAGS[base]);
      const size = Number(/\d+/.exec(base)[0]) / 8;
      const method = { uint: "setUint", int: "setInt", float: "setFloat" }[/^[a-z]+/.exec(base)[0]] + 8 * size;
      if (size === 8 && base !== "float64") put(base === "uint64" ? "setBigUint64" : "setBigInt64", 8, value);
      else put(method, size, value);
    }
  };
  fields.forEach(([, text], index) => {
    const type = parseType(text);
    if (!type.isArray) return putValue(values[index], type);
    header(type.length);
    for (const each of values[index]) putValue(each, type);
  });
  return new Uint8Array(view.buffer, 0, offset);
}

// The fields that the source did not provide, from the hexadecimal mask of the encoding.
export function missingFields(encoding, names) {
  const mask = BigInt(`0x${/;missing=([0-9a-f]+)/.exec(encoding)?.[1] ?? "0"}`);
  return names.filter((_, index) => (mask >> BigInt(index)) & 1n);
}

function fromJson(value, type) {
  if (Array.isArray(value)) return value.map((each) => fromJson(each, type));
  if (type.base.endsWith("int64")) return BigInt(value);
  return type.base.startsWith("float") ? Number(value) : value;
}

const same = (one, other) => Array.isArray(one) ? one.length === other.length && one.every((each, i) => same(each, other[i])) : Object.is(one, other);
const bytes = (hex) => Uint8Array.from(Buffer.from(hex, "hex"));
const check = (condition, name) => { if (!condition) throw new Error(`vector "${name}" fails`); };

for (const vector of [...vectors.exact, ...vectors.decode]) {
  const fields = vectors.definitions[`${vector.message}/${vector.layout}`];
  const values = fields.map(([, type], index) => fromJson(vector.values[index], parseType(type)));
  check(same(decodeMessage(vector.message, bytes(vector.payload)), values), vector.name);
  if (!vector.encoding) continue;
  check(Buffer.from(encodeMessage(vector.message, vector.layout, values)).toString("hex") === vector.payload, vector.name);
  check(same(missingFields(vector.encoding, fields.map(([name]) => name)), vector.missing), vector.name);
}
for (const vector of vectors.reject.filter((each) => each.why !== "rule")) {
  let isRejected = false;
  try { decodeMessage(vector.message, bytes(vector.payload)); } catch { isRejected = true; }
  check(isRejected, vector.name);
}
console.log(`${vectors.exact.length} exact, ${vectors.decode.length} decoded, ${vectors.reject.length} rejected`);
