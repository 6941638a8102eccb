"""Samples and batches of messages, messages of sources that are not yet validated, and the status of ULog streams."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .sample import M2, M3, Counts, M_co, Mode, Query, Sample, Subscribe
from .source_message import (
    RecordStream,
    Rejection,
    SourceMessage,
)
from .status import LogStreamStatus, PositionStatus, UntrustedReply

if TYPE_CHECKING:
    from .batch import Batch
else:
    # Lazy: importing NumPy takes longer than all other imports together.
    __getattr__ = lazy_exports(__name__, {"Batch": ("", "batch")})
