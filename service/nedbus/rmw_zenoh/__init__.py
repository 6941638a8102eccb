"""ROS 2 over Zenoh without ROS: keys, attachments and liveliness tokens of rmw_zenoh, for a session of your own.

    with bus.open_session() as session, translate_zenoh_errors():
        for text in token_keys(session, px4_publishers_key_expr(domain=0), timeout=1.0):
            print(PublisherToken.parse(text).key.topic)

A node that publishes declares a `node_token`, and for each topic the token and the key of a `TopicKey`; each message
has an `Attachment`. `encode_with` and `hash_of` of `nedbus_msgs` give payload and hash.
"""

from nedbus.transport import (
    BRIDGED_ENCODING,
    NO_HASH,
    Attachment,
    PublisherToken,
    TopicKey,
    gid_of_token,
    node_token,
    px4_publishers_key_expr,
    token_keys,
    translate_zenoh_errors,
)

__all__ = [
    "BRIDGED_ENCODING",
    "NO_HASH",
    "Attachment",
    "PublisherToken",
    "TopicKey",
    "gid_of_token",
    "node_token",
    "px4_publishers_key_expr",
    "token_keys",
    "translate_zenoh_errors",
]
