"""The root of the error tree, and the errors that nedbus_msgs raises; `nedbus.errors` shows the whole tree."""

from collections.abc import Sequence

from .limits import SHOWN_VALUE
from .text import counted


class NedbusError(Exception):
    """Base of all errors that nedbus raises on purpose; picklable, for process pools."""

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.args), self.__dict__


def _rebuild(kind: type[NedbusError], arguments: tuple[object, ...]) -> NedbusError:
    # bypasses the constructor, which would format the text again
    return kind.__new__(kind, *arguments)


class ArgumentError(NedbusError, ValueError):
    """Raised for an invalid argument of a call, such as `mode`, `max_rate` or `on`; `given` is its value."""

    def __init__(
        self, what: str, given: object, expected: str, *, problem: str = "is not valid"
    ) -> None:
        super().__init__(f"{what} {given!r:.{SHOWN_VALUE}} {problem}: expected {expected}")
        self.given = given


class AddressError(ArgumentError):
    """Raised when a vehicle, topic, instance or key expression cannot name a stream."""


class LayoutError(NedbusError, ValueError):
    """Raised when a layout is unknown."""


class DecodeError(NedbusError, ValueError):
    """Raised when a payload is not a valid message of the type `message`; `reason`: the cause, in one line."""

    def __init__(self, reason: str, message: str = "message") -> None:
        super().__init__(f"not a {message}: {reason}")
        self.reason = reason


class UnknownLayoutError(DecodeError):
    """Raised when a payload has a layout number that this version does not support.

    `layout`: that number; `count`: the number of fields after it; `known`: the numbers that can be decoded.
    """

    def __init__(self, layout: int, count: int, known: Sequence[int], message: str) -> None:
        readable = ", ".join(map(str, known))
        fields = counted(count, "field")
        super().__init__(
            f"unknown layout {layout} with {fields} (known: {readable}); update nedbus_msgs",
            message,
        )
        self.layout = layout
        self.count = count
        self.known = tuple(known)


class InvalidMessageError(NedbusError, ValueError):
    """Raised when a message to publish has an unknown or missing field, or a value of a wrong type, or breaks a rule.

    `reason`: one line with each invalid field, the broken rule and the value.
    `violations`: pairs of field and broken rule, without the value; `index`: position of the message in an array.
    """

    def __init__(
        self,
        reason: str,
        violations: Sequence[tuple[str, str]],
        *,
        message: str,
        index: int | None = None,
    ) -> None:
        if index is None:
            where = ""
        else:
            where = f" at index {index}"
        super().__init__(f"not a valid {message}{where}: {reason}")
        self.reason = reason
        self.violations = tuple(violations)
        self.index = index


class EncodeError(NedbusError, ValueError):
    """Raised when unvalidated values cannot be encoded: a value does not fit its field, or their number is wrong."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(
            f"the message cannot be encoded ({reason}); create it with {message}(...), which validates it"
        )
