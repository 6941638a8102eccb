"""Print the messages of a recording: "topic TAB field TAB values" for each field, with mcap-ros2-support."""

import sys
from collections.abc import Sequence
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory  # installed by the test

with Path(sys.argv[1]).open("rb") as file:
    for _, channel, message, decoded in make_reader(
        file, decoder_factories=[DecoderFactory()]
    ).iter_decoded_messages():
        fields: dict[str, object] = {"@times": (message.log_time, message.publish_time)}
        fields |= {name: getattr(decoded, name) for name in decoded.__slots__}
        for name, value in fields.items():
            values = (
                value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
            )
            print(channel.topic, name, " ".join(map(str, values)), sep="\t")  # noqa: T201 - the test reads it
