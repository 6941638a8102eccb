// Print the messages of a log: a line "topic TAB field TAB values" for each field, with yule_log.
use std::{env, error::Error, fs::File, io::BufReader};
use yule_log::builder::ULogParserBuilder;
use yule_log::model::{inst::FieldValue, msg::UlogMessage};

fn show(value: &FieldValue) -> String {
    match value {
        FieldValue::ScalarU8(v) => v.to_string(),
        FieldValue::ScalarU16(v) => v.to_string(),
        FieldValue::ScalarU32(v) => v.to_string(),
        FieldValue::ScalarU64(v) => v.to_string(),
        FieldValue::ScalarI8(v) => v.to_string(),
        FieldValue::ScalarI16(v) => v.to_string(),
        FieldValue::ScalarI32(v) => v.to_string(),
        FieldValue::ScalarI64(v) => v.to_string(),
        FieldValue::ScalarF32(v) => (*v as f64).to_string(),
        FieldValue::ScalarF64(v) => v.to_string(),
        FieldValue::ScalarBool(v) => v.to_string(),
        FieldValue::ScalarChar(v) => v.as_u8().to_string(),
        other => other.to_scalars().unwrap_or_default().iter().map(show).collect::<Vec<_>>().join(" "),
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let file = BufReader::new(File::open(env::args().nth(1).ok_or("no file")?)?);
    for message in ULogParserBuilder::new(file).include_timestamp(true).build()? {
        let UlogMessage::LoggedData(logged) = message? else { continue };
        let stream = format!("{}/{}", logged.data.name, logged.data.multi_id_index.unwrap_or(0));
        for field in &logged.data.fields {
            println!("{stream}\t{}\t{}", field.name, show(&field.value));
        }
    }
    Ok(())
}
