// Print the values of a log: a line "topic TAB field TAB values" for each field of all messages, with px4-ulog.
use px4_ulog::full_parser::{read_file, SomeVec};
use std::{env, error::Error};

fn join<T: ToString>(values: impl IntoIterator<Item = T>) -> String {
    values.into_iter().map(|value| value.to_string()).collect::<Vec<_>>().join(" ")
}

fn main() -> Result<(), Box<dyn Error>> {
    for (topic, instances) in read_file(&env::args().nth(1).ok_or("no file")?)?.messages {
        for (instance, fields) in instances {
            for (field, values) in fields {
                let text = match values {
                    SomeVec::Int8(v) => join(v),
                    SomeVec::UInt8(v) => join(v),
                    SomeVec::Int16(v) => join(v),
                    SomeVec::UInt16(v) => join(v),
                    SomeVec::Int32(v) => join(v),
                    SomeVec::UInt32(v) => join(v),
                    SomeVec::Int64(v) => join(v),
                    SomeVec::UInt64(v) => join(v),
                    SomeVec::Float(v) => join(v.into_iter().map(f64::from)),
                    SomeVec::Double(v) => join(v),
                    SomeVec::Bool(v) => join(v),
                    SomeVec::Char(v) => join(v.into_iter().map(u32::from)),
                };
                println!("{topic}/{}\t{field}\t{text}", instance.value());
            }
        }
    }
    Ok(())
}
