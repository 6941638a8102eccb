// Print the messages of a recording: a line "topic TAB times TAB type TAB definition TAB payload" for each.
use std::{env, error::Error, fs};

fn hex(data: &[u8]) -> String {
    data.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    let file = fs::read(env::args().nth(1).ok_or("no file")?)?;
    for message in mcap::MessageStream::new(&file)? {
        let message = message?;
        let schema = message.channel.schema.clone().ok_or("no schema")?;
        let times = format!("{} {}", message.log_time, message.publish_time);
        println!("{}\t{}\t{}\t{}\t{}", message.channel.topic, times, schema.name, hex(&schema.data), hex(&message.data));
    }
    Ok(())
}
