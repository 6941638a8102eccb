"""ULog, PX4's log format: an incremental parser for files and streams, and the definitions of logged messages."""

from .layout import UNSET_BOOLS
from .log_messages import LOG_MESSAGE, LogMessageBuilder, RateLimit, to_log_text
from .parser import UlogParser
from .records import (
    Damage,
    Data,
    Dropout,
    Header,
    Information,
    LoggedStream,
    LoggedText,
    Parameter,
    Record,
    Subscription,
    UlogError,
)
