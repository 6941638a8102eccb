"""LogMessage: a text message from PX4."""

from nedbus_msgs.model import InRange, Layout, Message, Topic
from nedbus_msgs.model.px4_types import Char127, Uint8, field


class LogMessage(Message):
    """A text message from the vehicle, such as "Failsafe activated"; it may contain any characters.

    From a log, it is a logged message, or an event formatted with the log's own metadata; over MAVLink, a STATUSTEXT.
    A message that PX4 sends in several forms is published once.
    Text is truncated to 127 bytes of UTF-8. Messages come in bursts: subscribe in mode "every" to receive all of them.
    """

    TOPICS = (Topic("log_message", 0.0, "the vehicle, on events", on_change=True),)
    LAYOUTS = (Layout("1.13", "*"),)
    RULES = (InRange("severity", 0, 7),)

    EMERGENCY, ALERT, CRITICAL, ERROR, WARNING, NOTICE, INFO, DEBUG = range(8)

    severity: Uint8 = field(
        "Severity: 0 emergency, 1 alert, 2 critical, 3 error, 4 warning, 5 notice, 6 info, 7 debug"
    )
    text: Char127 = field("Text in UTF-8, at most 127 bytes")
