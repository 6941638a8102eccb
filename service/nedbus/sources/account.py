"""Detect the events of all vehicles in a log or a recording, by replaying it."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, cast

from nedbus import recording
from nedbus.errors import InvalidMessageError
from nedbus.events import EKF_SELECTOR, Account, Times
from nedbus_msgs import BY_TOPIC, TOPICS, Address, codec_of, upgrade_fields

from .kinds import parse_source, source_text_of_file
from .options import RecordedOptions
from .source import ReplayRun, ReplaySource, SourceMessage

KEPT_OF_FILE: Final = 100_000
"""Events kept per file; the oldest are discarded."""

_CHECK_INTERVAL: Final = 0.5  # s of flight time between checks for silent streams and settled events
_SETTLE_TIME: Final = 10.0  # s after the last message; events that have not settled by then are reported as they are


@dataclass(frozen=True, slots=True)
class FileAccount:
    """The events of a whole file. Times are seconds since its first message; `end` is the time of the last one."""

    account: Account
    times: Times
    end: float
    warnings: tuple[str, ...]


class _EventOptions(RecordedOptions):
    """Options of a replay for its events: all known topics, and the one that names the EKF in use."""

    @property
    def chosen_topics(self) -> Collection[str]:
        """The topics to deliver."""
        return {*TOPICS, EKF_SELECTOR}


def open_file(path: Path, *, vehicle: str | None = None) -> ReplayRun:
    """Open a .ulg or .mcap file for its events, as `read_account` does."""
    spec = parse_source(source_text_of_file(path, vehicle=vehicle))
    spec = replace(spec, options=_EventOptions(vehicle=vehicle))
    return cast("ReplaySource", spec.open_source(vehicle="1")).open()


def read_account(path: Path, *, vehicle: str | None = None) -> FileAccount:
    """Return the events of a .ulg or .mcap file; `vehicle` renames the vehicle of a file that has only one.

    Raises ConfigError or SourceError if the file cannot be read.
    """
    run = open_file(path, vehicle=vehicle)
    account, due = Account(KEPT_OF_FILE), 0.0
    for message, _, _ in follow(run.messages, account):
        due = message.due
    for index, event in enumerate(account.events):  # before the first message that gave the time since boot
        known = account.vehicles.get(event.vehicle)
        if event.boot is None and known is not None and known.boot is not None:
            account.events[index] = replace(event, boot=known.boot + event.time - known.time)
    return FileAccount(account, times_of(path, run.addresses), due, run.warnings)


def times_of(path: Path, addresses: Iterable[Address]) -> Times:
    """Return the offsets of a file's times to UTC, for each vehicle whose messages contain UTC."""
    vehicles = {address.vehicle for address in addresses}
    found = {name: recording.utc_of(path, vehicle=name) for name in vehicles}
    return Times(offsets={name: utc.offset_us / 1e6 for name, utc in found.items() if utc is not None})


def follow(
    messages: Iterable[SourceMessage], account: Account
) -> Iterator[tuple[SourceMessage, str | None, bytes | None]]:
    """Add the messages of a replay to an account; yield each with its rejection reason or its payload."""
    checked = due = 0.0
    for message in messages:
        if message.dropout:
            account.add_dropout(message.address.vehicle, message.dropout, due)
        due, reason, payload = message.due, message.error, None
        while due - checked >= _CHECK_INTERVAL:
            checked += _CHECK_INTERVAL
            account.update(checked)
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
    account.update(due)
    account.settle(due + _SETTLE_TIME)
