"""All errors that nedbus raises on purpose.

    NedbusError
    ├── the caller's arguments
    │   ├── ArgumentError (ValueError)       an invalid argument, such as mode, max_rate or on
    │   │   └── AddressError                 ... a vehicle, topic, instance, key or prefix
    │   ├── LayoutError (ValueError)         an unknown layout
    │   ├── InvalidMessageError (ValueError) publishing a message with an invalid field
    │   ├── EncodeError (ValueError)         a message that bypassed validation
    │   ├── AddressInUseError (ValueError)   two publishers of one address on one bus or service
    │   ├── ConfigError (ValueError)         an invalid setting, flag or line of a file
    │   ├── PkiError                         a key or certificate that cannot be created
    │   └── OutputError (OSError)            a recording, plot or other file that cannot be written
    ├── the network
    │   ├── ConnectError (ConnectionError)   nothing answers at the endpoints
    │   ├── ListenError (OSError)            cannot listen on the endpoint: port in use, ...
    │   ├── NoDataError (TimeoutError)       nothing arrived in time
    │   ├── RefusedError (PermissionError)   the router's access rules drop what this process publishes
    │   ├── ClosedError (RuntimeError)       the bus, subscription, publisher or flight is closed
    │   ├── ReceiveError (RuntimeError)      a subscription whose session or thread failed
    │   └── ForkError (RuntimeError)         this process was forked from a connected one
    └── the data
        ├── DecodeError (ValueError)         a payload that is not a valid message
        │   └── UnknownLayoutError           ... with a layout newer than this version of nedbus
        └── SourceError                      a source that cannot be opened or read

`VehicleLocalPosition(...)` and `to_message` raise Pydantic's ValidationError, which is also a ValueError.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from pathlib import Path

from nedbus_msgs import (
    Address,
    AddressError,
    ArgumentError,
    DecodeError,
    EncodeError,
    InvalidMessageError,
    LayoutError,
    NedbusError,
    UnknownLayoutError,
)

__all__ = [
    "AddressError", "AddressInUseError", "ArgumentError", "ClosedError", "ConfigError", "ConnectError", "DecodeError",
    "EncodeError", "ForkError", "InvalidMessageError", "LayoutError", "ListenError", "NedbusError", "NoDataError",
    "OutputError", "PkiError", "ReceiveError", "RefusedError", "SourceError", "UnknownLayoutError", "system_reason",
]  # fmt: skip


def system_reason(error: OSError) -> str:
    """Return the reason of an error of the operating system as messages name it, such as "no space left on device"."""
    return (error.strerror or str(error)).lower()


class AddressInUseError(NedbusError, ValueError):
    """Raised for a second publisher of the same address on one bus, or in one service."""

    def __init__(self, address: Address) -> None:
        super().__init__(
            f"this process already publishes {address}: use another vehicle for one of the publishers"
        )
        self.address = address


class ConfigError(NedbusError, ValueError):
    """Raised for an invalid setting; `where` is the flag, the environment variable, or file, line and column.

    `key`: the invalid option, if the setting is a source.
    """

    def __init__(self, where: str, reason: str, *, key: str = "") -> None:
        super().__init__(f"{where}: {reason}")
        self.where = where
        self.reason = reason
        self.key = key

    @classmethod
    def in_file(
        cls, path: Path, reason: str, *, line: int | None = None, column: int | None = None
    ) -> ConfigError:
        """Return the error for a position in a file."""
        position = f", line {line}, column {column}" if line else ""
        return cls(f"{path}{position}", reason)

    @classmethod
    def in_text(cls, path: Path, reason: str, text: str, index: int) -> ConfigError:
        """Return the error for an index into the text of a file; -1, as `str.find` returns, names only the file."""
        if index < 0:
            return cls.in_file(path, reason)
        line = text.count("\n", 0, index) + 1
        column = index - text.rfind("\n", 0, index)
        return cls.in_file(path, reason, line=line, column=column)


class ConnectError(NedbusError, ConnectionError):
    """Raised when no endpoint answers in time; `advice`: the remedy, if the cause is known."""

    def __init__(
        self, endpoints: Sequence[str], seconds: float, reason: str = "", *, advice: str = ""
    ) -> None:
        self.endpoints = tuple(endpoints)
        tried = f"tried for {seconds:.3g} s" + (f", {reason}" if reason else "")
        where = " or ".join(endpoints)
        if advice:
            super().__init__(
                f"no Zenoh session at {where} ({tried}): {advice}; run 'nedbus doctor' to check it"
            )
        elif any(endpoint.startswith(("tls/", "quic/")) for endpoint in endpoints):
            advice = reason or (
                "check that tls_ca signed the router's certificate and tls_certificate, that none of them has expired,"
                " and that the router's certificate names the host of the endpoint"
            )
            super().__init__(
                f"no TLS connection to {where}: {advice}; run 'nedbus doctor' to find the cause"
            )
        else:
            super().__init__(
                f"nothing answers at {where} ({tried}): start 'nedbus serve' or a Zenoh router there, or name another"
                ' endpoint with --connect, connect("tcp/HOST:PORT") or NEDBUS_CONNECT; a router at its session'
                " limit does not answer either; run 'nedbus doctor' to find the cause"
            )


class ListenError(NedbusError, OSError):
    """Raised when a router cannot listen on an endpoint."""

    def __init__(
        self,
        endpoints: Sequence[str],
        reason: str,
        *,
        hint: str = "choose another endpoint with --listen, or join the router that runs there with --connect",
    ) -> None:
        super().__init__(f"cannot listen on {' and '.join(endpoints)} ({reason}): {hint}")
        self.endpoints = tuple(endpoints)


class NoDataError(NedbusError, TimeoutError):
    """Raised when no message arrives in time."""

    def __init__(self, what: str, seconds: float) -> None:
        super().__init__(
            f"nothing arrived on {what} within {seconds:.3g} s: 'nedbus list' shows the published streams"
        )


class PkiError(NedbusError):
    """Raised when a key or certificate cannot be created, read or renewed, or would overwrite an existing one."""


class OutputError(NedbusError, OSError):
    """Raised when a file cannot be written; messages flushed to a recording before the error remain readable."""

    def __init__(self, path: Path, error: OSError) -> None:
        hints = {
            errno.EEXIST: "choose another name, or remove the file",
            errno.ENOSPC: "free some space, or write to another disk",
            errno.ESTALE: "the written data is lost; write to a folder that is not cleaned up",
        }
        hint = hints.get(
            error.errno or 0, "check that its folder exists and is writable by this user"
        )
        super().__init__(f"{path} cannot be written ({system_reason(error)}): {hint}")
        self.path = path


class ClosedError(NedbusError, RuntimeError):
    """Raised when a bus, a subscription, a publisher or a flight is used after it was closed."""

    def __init__(self) -> None:
        super().__init__("the bus, subscription, publisher or flight is closed: open a new one")


class RefusedError(NedbusError, PermissionError):
    """Raised when the access rules of the router drop what this process publishes for a vehicle; Zenoh reports nothing.

    `vehicle`: the refused vehicle. `certificate`: the file of the certificate that may not publish it.
    """

    def __init__(self, vehicle: str, certificate: object) -> None:
        super().__init__(
            f"the router refuses messages of vehicle {vehicle}, so they reach no reader: its access rules must allow"
            f" them for the certificate {certificate} ('nedbus pki rules', docs/security.md)"
        )
        self.vehicle = vehicle
        self.certificate = certificate


class ReceiveError(NedbusError, RuntimeError):
    """Raised when a subscription ends although neither it nor its bus was closed."""

    def __init__(self, what: str, reason: str) -> None:
        super().__init__(
            f"{what}: the subscription failed ({reason}); close the bus, then connect and subscribe again"
        )


class ForkError(NedbusError, RuntimeError):
    """Raised when nedbus is used in a process forked from a connected one, in which Zenoh would hang."""

    def __init__(self) -> None:
        super().__init__(
            "this process was forked from one with a Zenoh session: start processes with"
            " multiprocessing.get_context('spawn') or subprocess, or connect only after the fork"
        )


class SourceError(NedbusError):
    """Raised when a source cannot be opened or read."""

    def __init__(self, source: str, reason: str) -> None:
        super().__init__(f"{source}: {reason}")
        self.source = source
        self.reason = reason
