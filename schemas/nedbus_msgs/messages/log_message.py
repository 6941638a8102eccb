"""LogMessage: a text of PX4."""

from nedbus_msgs.model import InRange, Layout, Message, Topic
from nedbus_msgs.model.px4_types import Char127, Uint8, field


class LogMessage(Message):
    """A statement of the vehicle in its own words, such as "Failsafe activated"; any characters may occur in it.

    From a log it is what PX4 printed, and what it sent as an event, in the words of the log's own metadata; over
    MAVLink, a STATUSTEXT. A statement that PX4 makes in several forms is published once.
    Text is cut after 127 bytes of UTF-8. Statements come in bursts: subscribe in mode "every" to get each of them.
    """

    TOPICS = (Topic("log_message", 0.0, "the vehicle, when it has something to say", on_change=True),)
    LAYOUTS = (Layout("1.13", "*"),)
    RULES = (InRange("severity", 0, 7),)

    EMERGENCY, ALERT, CRITICAL, ERROR, WARNING, NOTICE, INFO, DEBUG = range(8)

    severity: Uint8 = field("Severity: 0 emergency, 1 alert, 2 critical, 3 error, 4 warning, 5 notice, 6 info, 7 debug")
    text: Char127 = field("Text in UTF-8, at most 127 bytes")
