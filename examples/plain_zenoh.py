"""Read messages with Zenoh and msgpack alone, as a client in any language can.

array[0] is the number of the layout; array[1], array[2], ... are PX4's fields in PX4's order.
"""

import json
import os
import sys
from contextlib import suppress

import msgpack
import zenoh

config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))
try:
    with suppress(KeyboardInterrupt), zenoh.open(config) as session:
        samples = session.declare_subscriber(
            "nedbus/*/vehicle_local_position", zenoh.handlers.RingChannel(100)
        )
        while True:
            sample = samples.recv()
            # texts of others may not be UTF-8
            array = msgpack.unpackb(sample.payload.to_bytes(), raw=True)
            print(
                sample.key_expr, "timestamp", array[1], "x", array[7], "y", array[8], "z", array[9]
            )
except BrokenPipeError:
    os._exit(0)  # the reader, such as `head`, has ended: a normal exit would print the rest
except zenoh.ZError as exc:
    sys.exit(str(exc))
