// Test nedbus's wire format against docs/vectors.json: cargo add rmpv, cargo add serde_json -F float_roundtrip,
// cargo run -- vectors.json
use rmpv::Value;
use serde_json::Value as Json;
use std::error::Error;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

// "float32[4]" is the base float32 with length 4; "char[8]" is one text of 8 bytes.
struct Type {
    base: String,
    length: usize,
    size: usize,
    is_array: bool,
}

fn parse_type(text: &str) -> Result<Type> {
    let (base, rest) = text.split_once('[').unwrap_or((text, "0]"));
    let length = rest.trim_end_matches(']').parse()?;
    let bits = base.trim_start_matches(|c: char| c.is_alphabetic());
    let size = if bits.is_empty() { length } else { bits.parse::<usize>()? / 8 };
    Ok(Type { base: base.to_string(), length, size, is_array: length > 0 && base != "char" })
}

// A float of vectors.json: NaN and the infinities are strings.
fn to_float(value: &Json) -> Result<f64> {
    match value.as_str() {
        Some("NaN") => Ok(f64::NAN),
        Some("Infinity") => Ok(f64::INFINITY),
        Some(_) => Ok(f64::NEG_INFINITY),
        None => Ok(value.as_f64().ok_or("float")?),
    }
}

// An integer of vectors.json: 64-bit integers are strings.
fn to_integer(value: &Json) -> Result<i128> {
    match value.as_str() {
        Some(text) => Ok(text.parse()?),
        None => Ok(value.as_i64().ok_or("integer")?.into()),
    }
}

fn put_value(out: &mut Vec<u8>, value: &Json, kind: &Type) -> Result<()> {
    match kind.base.as_str() {
        "bool" => out.push(if value.as_bool() == Some(true) { 0xc3 } else { 0xc2 }),
        "char" => {
            // str 16 of the full length, padded with NUL
            let mut text = value.as_str().ok_or("text")?.as_bytes().to_vec();
            text.resize(kind.length, 0);
            out.push(0xda);
            out.extend((kind.length as u16).to_be_bytes());
            out.extend(text);
        }
        "float32" => {
            out.push(0xca);
            out.extend((to_float(value)? as f32).to_be_bytes());
        }
        "float64" => {
            out.push(0xcb);
            out.extend(to_float(value)?.to_be_bytes());
        }
        base => {
            let first = if base.starts_with('u') { 0xcc } else { 0xd0 };
            out.push(first + kind.size.trailing_zeros() as u8);
            out.extend(&to_integer(value)?.to_be_bytes()[16 - kind.size..]);
        }
    }
    Ok(())
}

fn encode(fields: &[Json], layout: u8, values: &[Json]) -> Result<Vec<u8>> {
    let mut out = vec![0xdc]; // always array 16
    out.extend((fields.len() as u16 + 1).to_be_bytes());
    out.push(layout);
    for (field, value) in fields.iter().zip(values) {
        let kind = parse_type(field[1].as_str().ok_or("type")?)?;
        if !kind.is_array {
            put_value(&mut out, value, &kind)?;
            continue;
        }
        if kind.length < 16 {
            out.push(0x90 | kind.length as u8);
        } else {
            out.push(0xdc);
            out.extend((kind.length as u16).to_be_bytes());
        }
        for each in value.as_array().ok_or("array")? {
            put_value(&mut out, each, &kind)?;
        }
    }
    Ok(out)
}

// Return a decoded value in the form of vectors.json; an error if it does not have the type.
fn checked(value: &Value, kind: &Type) -> Result<Json> {
    if kind.base == "bool" {
        return Ok(value.as_bool().ok_or("type")?.into());
    }
    if kind.base == "char" {
        let Value::String(text) = value else { return Err("type".into()) };
        let bytes = text.as_bytes().split(|byte| *byte == 0).next().unwrap_or_default();
        if bytes.len() > kind.length {
            return Err("type".into());
        }
        return Ok(String::from_utf8_lossy(bytes).replace('\u{fffd}', "?").into());
    }
    if kind.base.starts_with("float") {
        let number = value.as_f64().ok_or("type")?; // also from an integer
        let number = if kind.size == 4 { f64::from(number as f32) } else { number };
        return Ok(match number {
            _ if number.is_nan() => "NaN".into(),
            f64::INFINITY => "Infinity".into(),
            f64::NEG_INFINITY => "-Infinity".into(),
            _ => number.into(),
        });
    }
    let number = value.as_u64().map(i128::from).or(value.as_i64().map(i128::from)).ok_or("type")?;
    let bits = 8 * kind.size;
    let least = if kind.base.starts_with('u') { 0 } else { -(1i128 << (bits - 1)) };
    if number < least || number >= least + (1i128 << bits) {
        return Err("type".into());
    }
    Ok(if bits == 64 { number.to_string().into() } else { Json::from(number as i64) })
}

// Return the values of a payload; an error if the payload is invalid.
fn decode(definitions: &Json, message: &str, payload: &[u8]) -> Result<Json> {
    let mut rest = payload;
    let Value::Array(array) = rmpv::decode::read_value(&mut rest)? else { return Err("array".into()) };
    if !rest.is_empty() {
        return Err("trailing bytes after the array".into());
    }
    let layout = array.first().and_then(Value::as_u64).ok_or("array")?;
    let fields = definitions[format!("{message}/{layout}")].as_array().ok_or("layout")?;
    if array.len() != fields.len() + 1 {
        return Err("count".into());
    }
    let mut values = Vec::new();
    for (field, value) in fields.iter().zip(&array[1..]) {
        let kind = parse_type(field[1].as_str().ok_or("type")?)?;
        values.push(if kind.is_array {
            let parts = value.as_array().filter(|each| each.len() == kind.length).ok_or("type")?;
            Json::Array(parts.iter().map(|each| checked(each, &kind)).collect::<Result<_>>()?)
        } else {
            checked(value, &kind)?
        });
    }
    Ok(Json::Array(values))
}

fn from_hex(vector: &Json) -> Result<Vec<u8>> {
    let hex = vector["payload"].as_str().ok_or("payload")?;
    (0..hex.len()).step_by(2).map(|at| Ok(u8::from_str_radix(&hex[at..at + 2], 16)?)).collect()
}

fn main() -> Result<()> {
    let path = std::env::args().nth(1).ok_or("give the path of vectors.json")?;
    let vectors: Json = serde_json::from_str(&std::fs::read_to_string(path)?)?;
    let definitions = &vectors["definitions"];
    let list = |kind: &str| vectors[kind].as_array().cloned().unwrap_or_default();
    for vector in list("exact").iter().chain(&list("decode")) {
        let message = vector["message"].as_str().ok_or("message")?;
        let values = decode(definitions, message, &from_hex(vector)?)?;
        assert_eq!(values.to_string(), vector["values"].to_string(), "{}", vector["name"]);
    }
    for vector in list("exact") {
        let (message, layout) = (vector["message"].as_str().ok_or("message")?, vector["layout"].as_u64().ok_or("layout")?);
        let fields = definitions[format!("{message}/{layout}")].as_array().ok_or("fields")?;
        let payload = encode(fields, layout as u8, vector["values"].as_array().ok_or("values")?)?;
        assert_eq!(payload, from_hex(&vector)?, "{}", vector["name"]);
    }
    for vector in list("reject") {
        let is_rejected = decode(definitions, vector["message"].as_str().ok_or("message")?, &from_hex(&vector)?).is_err();
        assert!(is_rejected || vector["why"] == "rule", "{}", vector["name"]);
    }
    println!("{} exact, {} decoded, {} rejected", list("exact").len(), list("decode").len(), list("reject").len());
    Ok(())
}
