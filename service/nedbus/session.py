"""Zenoh sessions: the client of a script, the router of a daemon; the one place for zenoh.Config and ZError."""

from __future__ import annotations

import json
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Final, TypeVar

import zenoh

from .errors import ClosedError, ConfigError, ConnectError, ListenError, NedbusError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

_ENDPOINT = re.compile(r"(?:tcp|tls|udp|ws|quic)/\S+:\d{1,5}(?:[?#]\S*)?|unixsock-stream/\S+")
_PAUSES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # s between the first tries to connect
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_ANSWERS: Final = 10_000
_T = TypeVar("_T")

Session = zenoh.Session
RawSample = zenoh.Sample

# What holds for every session of ours. Shared memory costs 351 sessions per router and gains nothing at 244 bytes.
# Gossip and multicast would let peers find each other and bypass the router.
# Longer queues than Zenoh's own take up the bursts of a fleet, where two batches are full in a moment.
# A side that says nothing for as long as its lease is given up: a frozen host, a cut cable.
# Sessions do not stamp: a publisher stamps each message itself, so that a router never replaces a stamp.
_COMMON: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "timestamping/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/lease": 5000,
    "transport/link/tx/queue/size/data_high": 4,
    "transport/link/tx/queue/size/data": 4,
}


@dataclass(frozen=True, slots=True)
class Tls:
    """Files in PEM for `tls/` endpoints: the authority to trust, and who this client is, where a router asks for it."""

    ca: Path
    certificate: Path | None = None
    key: Path | None = None

    def settings(self) -> dict[str, object]:
        """Return Zenoh's settings; raise ConfigError for a file that cannot be read or is half of a pair."""
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("tls", "a certificate needs its key, and a key its certificate: give both or none")
        for path in (self.ca, self.certificate, self.key):
            if path is not None and not os.access(path, os.R_OK):
                raise ConfigError("tls", f"{path} cannot be read: is it there, and may this user read it?")
        own = {"connect_certificate": str(self.certificate), "connect_private_key": str(self.key), "enable_mtls": True}
        return {"root_ca_certificate": str(self.ca), **(own if self.certificate else {})}


def open_client(
    endpoints: Sequence[str], *, timeout: float, tls: Tls | None = None, stop: threading.Event | None = None
) -> Session:
    """Open a session as a client of the first router that answers; Ctrl-C, or setting `stop`, ends the wait.

    It reconnects by itself whenever the link breaks.

    Raises ConnectError when no endpoint answers within `timeout` seconds, ConfigError for a malformed endpoint or a
    TLS file that cannot be read.
    """
    check_endpoints(endpoints, where="connect")
    settings: dict[str, object] = {
        **_COMMON,
        **({"transport/link/tls": tls.settings()} if tls is not None else {}),
        "mode": "client",
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": 0,
        "connect/retry": _RETRY,
        "listen/endpoints": [],
        # Nobody on the network is trusted: the largest answer that is expected is a status of many sources.
        "transport/link/rx/max_message_size": 2**18,
    }
    start = time.monotonic()
    stop = stop or threading.Event()
    for pause in chain(_PAUSES, repeat(1.0)):
        # An endpoint that accepts and then says nothing may not use up more than the time that there is.
        left = start + timeout - time.monotonic()
        settings["transport/unicast/open_timeout"] = round(1000 * min(3.0, max(0.2, left)))
        try:
            return zenoh.open(_insert(zenoh.Config(), settings, where="connect"))
        except zenoh.ZError:
            left = start + timeout - time.monotonic()
            if left <= 0 or stop.wait(min(left, pause)):
                break
    raise ConnectError(endpoints, timeout)


def open_router(*, listen: Sequence[str] = (), connect: Sequence[str] = (), config_file: Path | None = None) -> Session:
    """Open a session that is itself a router, by default on loopback, or as a JSON5 file says that `zenohd` reads too.

    Endpoints that are given replace those of the file, as the flags of `zenohd` do.

    Raises ListenError when it cannot listen, ConfigError for a malformed endpoint or file.
    """
    check_endpoints(listen, where="listen")
    check_endpoints(connect, where="connect")
    if config_file is not None:
        given = {"listen/endpoints": list(listen), "connect/endpoints": list(connect)}
        config = _read_config(config_file)
        _insert(config, {name: endpoints for name, endpoints in given.items() if endpoints}, where="listen")
        listen = listen or (f"what {config_file} names",)
    else:
        listen = listen or (DEFAULT_ENDPOINT,)
        settings = {
            **_COMMON,
            "mode": "router",
            "scouting/delay": 0,  # nobody is scouted, so there is nobody to wait 0.5 s for
            "listen/endpoints": list(listen),
            "connect/endpoints": list(connect),
            "connect/retry": _RETRY,
            "adminspace/enabled": True,
            "transport/unicast/accept_pending": 1000,
            "transport/link/rx/max_message_size": 2**20,
        }
        config = _insert(zenoh.Config(), settings, where="listen")
    try:
        return zenoh.open(config)
    except zenoh.ZError as exc:
        raise ListenError(listen, _first_sentence(exc)) from exc


def listened_by(config_file: Path) -> tuple[str, ...]:
    """Return the endpoints that a router of this file listens on; raise ConfigError for a malformed file."""
    found = json.loads(_read_config(config_file).get_json("listen/endpoints"))
    return tuple(found.get("router", ()) if isinstance(found, dict) else found or ())


def check_endpoints(endpoints: Sequence[str], *, where: str) -> None:
    """Raise ConfigError unless each of these is a Zenoh endpoint."""
    for endpoint in endpoints:
        if not _ENDPOINT.fullmatch(endpoint):
            raise ConfigError(where, f"{endpoint!r} is no endpoint: write PROTOCOL/HOST:PORT, as in {DEFAULT_ENDPOINT}")


@contextmanager
def while_open(session: Session) -> Iterator[None]:
    """Translate what Zenoh raises: ClosedError when the session was closed, else NedbusError with Zenoh's reason."""
    try:
        yield
    except zenoh.ZError as exc:
        raise translate(exc, session) from exc


def translate(error: zenoh.ZError, session: Session) -> NedbusError:
    """Return what `while_open` raises for this error."""
    return ClosedError() if session.is_closed() else NedbusError(f"Zenoh refuses: {_first_sentence(error)}")


def query(session: Session, key_expr: str, *, timeout: float, newest: bool = True) -> list[RawSample]:
    """Return what is answered within `timeout` seconds: the newest answer for each key, or all answers.

    At most 10,000 answers are taken; more are nobody's honest work.
    """
    mode = zenoh.ConsolidationMode.LATEST if newest else zenoh.ConsolidationMode.NONE
    with while_open(session):
        replies = session.get(key_expr, target=zenoh.QueryTarget.ALL, consolidation=mode, timeout=_in_range(timeout))
        return [reply.ok for reply in islice(replies, _ANSWERS) if reply.ok is not None]


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of all liveliness tokens that match, each once, sorted."""
    with while_open(session):
        replies = session.liveliness().get(key_expr, timeout=_in_range(timeout))
        return sorted({str(reply.ok.key_expr) for reply in islice(replies, _ANSWERS) if reply.ok is not None})


def ask_all(session: Session, key: str, *, timeout: float, priority: zenoh.Priority) -> bool:
    """Return whether all who answer on a key did so within `timeout` seconds; also when there is nobody."""
    with while_open(session):
        replies = session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            timeout=_in_range(timeout),
            priority=priority,
            congestion_control=zenoh.CongestionControl.DROP,  # a question that waits for room could cut a link
        )
        return all(reply.ok is not None for reply in replies)


def receive(handler: zenoh.Handler[_T]) -> list[_T]:
    """Wait for something, and return all that is there, up to 4096; empty once the subscriber is undeclared."""
    batch: list[_T] = []
    with suppress(zenoh.ZError):
        batch.append(handler.recv())
        while len(batch) < 4096 and (item := handler.try_recv()) is not None:
            batch.append(item)
    return batch


def _in_range(timeout: float) -> float:
    """Return a time that Zenoh takes: it knows neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)


def _insert(config: zenoh.Config, settings: Mapping[str, object], *, where: str) -> zenoh.Config:
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as exc:
            raise ConfigError(where, f"{value!r} is nothing that Zenoh takes as {key}") from exc
    return config


def _read_config(path: Path) -> zenoh.Config:
    if path.suffix not in {".json5", ".json", ".yaml", ".yml"}:
        raise ConfigError.in_file(path, "a Zenoh configuration is a .json5, .json, .yaml or .yml file")
    if not path.is_file():
        raise ConfigError.in_file(path, "there is no such file")
    try:
        config = zenoh.Config.from_file(path)
        if config.get_json("mode") == "null":
            config.insert_json5("mode", '"router"')  # as zenohd does
    except zenoh.ZError as exc:
        text = str(exc)
        place = re.search(r"line: (\d+), column: (\d+)", text) or re.search(r"--> (\d+):(\d+)", text)
        line, column = map(int, place.groups()) if place else (None, None)
        raise ConfigError.in_file(path, _reason(text), line=line, column=column) from exc
    for name, value in json.loads(config.get_json("transport/link/tls")).items():
        # Zenoh would say only that there is no such file, and not which.
        if name.endswith(("_certificate", "_private_key")) and value and not os.access(value, os.R_OK):
            raise ConfigError.in_file(path, f"{name}: {value} cannot be read: is it there, and may this user read it?")
    return config


def _reason(text: str) -> str:
    """Return what is wrong, without the parser's drawing and its source paths."""
    found = re.search(r'msg: "(.*?)(?: at /|", location)', text, re.DOTALL) or re.search(
        r"= (.*?) at /", text, re.DOTALL
    )
    return found[1].replace("`", "'") if found else "this is no Zenoh configuration"


def _first_sentence(error: zenoh.ZError) -> str:
    """Return the reason that the system gave, or all of the text without source paths."""
    text = re.sub(r" at /\S+", "", str(error)).strip()
    found = re.search(r": ([A-Z][a-z][^:\[\]]*) \(os error", text)
    return found[1].lower() if found else text
