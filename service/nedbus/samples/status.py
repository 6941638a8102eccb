"""Status of ULog streams and of positions sent into vehicles, and the base of all untrusted status replies."""

from contextlib import suppress
from dataclasses import dataclass

from pydantic import ValidationError, ValidatorFunctionWrapHandler, field_validator
from pydantic_core import PydanticUseDefault

from nedbus_msgs.text import counted


class UntrustedReply:
    """Base of untrusted replies: an invalid value becomes the default, and invalid items of a list are dropped."""

    __slots__ = ()

    @field_validator("*", mode="wrap")
    @classmethod
    def _replace_invalid(cls, value: object, validate: ValidatorFunctionWrapHandler) -> object:
        with suppress(ValidationError):
            return validate(value)
        rows: list[object] = []
        for row in value if isinstance(value, list) else ():
            with suppress(ValidationError):
                rows.extend(validate([row]))
        if not rows:
            raise PydanticUseDefault
        return tuple(rows)


@dataclass(frozen=True, slots=True)
class LogStreamStatus(UntrustedReply):
    """The ULog stream that a source with `log=` receives from one vehicle over MAVLink.

    `state`: "streaming" while messages are published from the stream; otherwise they are converted from MAVLink.
    `reason`: why there is no stream, and what to do about it.
    `received`: bytes so far. `rate`: bytes per second over the last second. `delay`: mean age of messages when
    published, by the vehicle's clock [s]; None until the vehicle has answered TIMESYNC.
    `header_time`: time that sending the header took [s]; the log on the SD card has a gap of this length.
    `gaps`: interruptions. `lost`: LOGGING_DATA messages lost. `lost_messages`: ULog messages lost with them, estimated
    from the number of messages per LOGGING_DATA. `undecodable`: data messages without a usable definition.
    `saved`: the path of the saved log. `unsaved`: bytes that could not be saved, although `save=` is set.
    """

    vehicle: str = ""
    state: str = ""
    reason: str = ""
    received: int = 0
    rate: float = 0.0
    delay: float | None = None
    header_time: float | None = None
    gaps: int = 0
    lost: int = 0
    lost_messages: int = 0
    undecodable: int = 0
    saved: str = ""
    unsaved: int = 0

    @property
    def text(self) -> str:
        """All values except the vehicle, in one line; the reason and the file name are untrusted text."""
        lost = f"{self.lost} LOGGING_DATA lost with about {self.lost_messages} messages"
        parts = (
            self.state,
            self.reason,
            f"{self.rate / 1000:.1f} KB/s" if self.received else "",
            "" if self.delay is None else f"delay {self.delay * 1000:.0f} ms",
            "" if self.header_time is None else f"header {self.header_time:.1f} s",
            f"{counted(self.gaps, 'gap')}, {lost}" if self.gaps else "",
            f"{self.undecodable} without a definition" if self.undecodable else "",
            f"saved to {self.saved}" if self.saved else "",
            f"{self.unsaved} bytes not saved" if self.unsaved else "",
        )
        return ", ".join(filter(None, parts))


@dataclass(frozen=True, slots=True)
class PositionStatus(UntrustedReply):
    """The positions that a source with `position=` sends into one vehicle.

    `address`: where they come from. `sender`: their publisher. `clock`: the value of `position_clock`.
    `sent`: number so far; `rate`: per second, 0 while none is sent. `age`: of the last one when it was sent [s].
    `left_out`: numbers of positions not sent, by kind of refusal; `reasons`: their newest texts.
    `warnings`: why the vehicle may not use what is sent.
    """

    vehicle: str = ""
    address: str = ""
    sender: str = ""
    sent: int = 0
    rate: float = 0.0
    age: float | None = None
    clock: str = ""
    left_out: tuple[tuple[str, int], ...] = ()
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """All values except the vehicle, in one line; sender, reasons and warnings are untrusted text."""
        counts = ", ".join(f"{count} {kind}" for kind, count in self.left_out)
        parts = [f"{self.sent} positions of {self.address} sent"]
        if self.sender:
            parts.append(f"from {self.sender}")
        if self.rate:
            parts.append(f"{self.rate:.1f} Hz")
        if self.age is not None:
            parts.append(f"age {1000 * self.age:.0f} ms")
        if counts:
            parts.append(f"left out: {counts}")
        return "; ".join([", ".join(parts), *self.warnings, *self.reasons])
