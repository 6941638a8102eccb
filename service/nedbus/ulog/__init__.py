"""ULog, PX4's log format: an incremental parser for files and streams, and the definitions of logged messages."""

from .definitions import LoggedStream
from .layout import PayloadField, PayloadLayout
from .parser import UlogParser
from .records import (
    Damage,
    Data,
    Dropout,
    Format,
    Header,
    Information,
    LoggedText,
    MultiInformation,
    Parameter,
    ParameterDefault,
    Record,
    Subscription,
    Sync,
    UlogError,
    Unsubscription,
    Value,
)
from .texts import SPOKEN, TextLimit, Texts, to_statement

__all__ = [
    "SPOKEN", "Damage", "Data", "Dropout", "Format", "Header", "Information", "LoggedStream", "LoggedText",
    "MultiInformation", "Parameter", "ParameterDefault", "PayloadField", "PayloadLayout", "Record", "Subscription",
    "Sync", "TextLimit", "Texts", "UlogError", "UlogParser", "Unsubscription", "Value", "to_statement",
]  # fmt: skip
