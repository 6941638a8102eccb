"""The events of all vehicles of a file, detected in the messages of its replay."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

from nedbus import recording
from nedbus.errors import InvalidMessageError
from nedbus.events import Account, Times
from nedbus_msgs import BY_TOPIC, Address, codec_of, upgrade_fields

from .source import ReplaySource, SourceMessage
from .spec import parse_source, source_text_of_file

KEPT_OF_FILE: Final = 100_000
"""Events that are kept of a file, the last ones."""

_CHECK_INTERVAL: Final = 0.5  # s of the flight between two checks for silent streams, and for events that settled
_SETTLE_TIME: Final = 10.0  # s after the last message at which unsettled events are reported


@dataclass(frozen=True, slots=True)
class FileAccount:
    """The account of a file at its end: its clock is seconds since the first message; `end`: of the last one."""

    account: Account
    times: Times
    end: float
    warnings: tuple[str, ...]


def read_account(path: Path, *, vehicle: str | None = None) -> FileAccount:
    """Return the events of a .ulg or .mcap file; `vehicle` is that of a log of one vehicle.

    Raises ConfigError and SourceError for a file that cannot be read.
    """
    spec = parse_source(source_text_of_file(path, vehicle=vehicle))
    run = cast("ReplaySource", spec.open_source(vehicle="1")).open()
    account, due = Account(KEPT_OF_FILE), 0.0
    for message, _, _ in follow(run.messages, account):
        due = message.due
    return FileAccount(account, times_of(path, run.addresses), due, run.warnings)


def times_of(path: Path, addresses: Iterable[Address]) -> Times:
    """Return the clock for the times of a file: UTC for each vehicle whose messages contain it."""
    vehicles = {address.vehicle for address in addresses}
    found = {name: recording.utc_of(path, vehicle=name) for name in vehicles}
    return Times(offsets={name: utc.offset_us / 1e6 for name, utc in found.items() if utc is not None})


def follow(
    messages: Iterable[SourceMessage], account: Account
) -> Iterator[tuple[SourceMessage, str | None, bytes | None]]:
    """Add the messages of a replay to an account, and yield each with the reason of its rejection, or its payload."""
    checked = due = 0.0
    for message in messages:
        due, reason, payload = message.due, message.error, None
        while due - checked >= _CHECK_INTERVAL:
            checked += _CHECK_INTERVAL
            account.look(checked)
        if reason is None:
            definition = message.definition or BY_TOPIC[message.address.topic]
            try:
                fields = upgrade_fields(definition, message.fields)
                payload = codec_of(definition).encode_fields(fields)
                account.add(message.address, fields, due)
            except InvalidMessageError as exc:
                reason = exc.reason
        if reason is not None:
            account.reject(message.address, reason, due)
        yield message, reason, payload
    account.look(due)
    account.settle(due + _SETTLE_TIME)
