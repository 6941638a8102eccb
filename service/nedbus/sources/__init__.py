"""Sources of messages: `parse_source` parses a string such as `ulog:flight.ulg?speed=2&vehicle=7`.

`__all__` is public: a survey of a MAVLink link, which shows who sends what on it before a source uses it.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .kinds import SOURCE_KINDS, parse_source
from .log_header import expected_header
from .mavlink.link import LinkAddress, parse_link
from .source import (
    LinkCopies,
    LinkLoad,
    LiveItem,
    LiveSource,
    Rejection,
    ReplayRun,
    ReplaySource,
    Source,
    SourceMessage,
    UnavailableTopics,
)

if TYPE_CHECKING:
    from .mavlink.survey import LinkSurvey, SystemTraffic, survey_link
else:
    _SURVEY = ("LinkSurvey", "SystemTraffic", "survey_link")
    __getattr__ = lazy_exports(__name__, dict.fromkeys(_SURVEY, ("mavlink", "mavlink.survey")))

__all__ = [
    "LinkAddress",
    "LinkSurvey",
    "SystemTraffic",
    "expected_header",
    "parse_link",
    "survey_link",
]
