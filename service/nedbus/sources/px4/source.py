"""Receive from PX4's Zenoh module, and from any other publisher of px4_msgs over rmw_zenoh."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from nedbus.errors import ConfigError, ConnectError, SourceError
from nedbus.log_event import about
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.source import Absence, Rejection, SourceMessage
from nedbus.transport import Session, Tls, check_endpoints, open_client
from nedbus_msgs import Definition, bases_of_msg, dds_type, define_msg, hash_of_msg, ros2_type

from .node import Px4ZenohNode
from .streams import Definitions, StreamRegistry

_log = logging.getLogger(__name__)

_CONNECT_TIMEOUT: Final = 0.5  # s; the service must be able to stop within 1 s, and it retries


class Px4ZenohSource:
    """All publishers of px4_msgs at a router: the service's own, which has the endpoints `routers`, or another one."""

    def __init__(
        self, endpoint: str, options: Px4ZenohOptions, vehicle: str, routers: tuple[str, ...], tls: Tls | None
    ) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else routers
        self._is_own = not endpoint or endpoint in routers
        self._tls = tls
        self._options = options
        self._given = _read_definitions(options.msg)
        self._vehicle = options.vehicle or vehicle

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Receive; raise SourceError if no router answers."""
        with ExitStack() as closing:
            if router is not None and self._is_own:
                # A separate client would lose the messages that do not fit the queue of its link.
                session = router
            else:
                try:
                    session = open_client(self._endpoints, timeout=_CONNECT_TIMEOUT, tls=self._tls)
                except ConnectError as exc:
                    reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
                    raise SourceError(f"px4-zenoh:{' or '.join(self._endpoints)}", reason) from exc
                closing.callback(session.close)
            streams = StreamRegistry(self._options, vehicle=self._vehicle, given=self._given)
            node = Px4ZenohNode(session, streams, domain=self._options.domain)
            closing.callback(node.close)
            yield from node.run()  # a session that loses its router reconnects by itself


def _read_definitions(paths: str) -> Definitions:
    """Read .msg files and folders of them, such as PX4's `msg`, separated by commas.

    Messages in a folder that cannot be carried are skipped and logged.

    Raises ConfigError for a file that is not a message, with line and column, or cannot be read.
    """
    found: dict[str, dict[str, Definition[Any]]] = {}
    left_out: list[str] = []
    for path in (Path(text.strip()).expanduser() for text in paths.split(",") if text.strip()):
        files = sorted([*path.glob("*.msg"), *path.glob("*/*.msg")])
        if not files and path.is_dir():
            reason = "there is no .msg file in this folder or its subfolders: give PX4's folder msg"
            raise ConfigError(str(path), reason, key="msg")
        for file in files or [path]:
            try:
                text = _with_messages_within(file)
                definition, type_hash = define_msg(file.stem, text), hash_of_msg(file.stem, text)
            except OSError as exc:
                raise ConfigError(str(file), exc.strerror or str(exc), key="msg") from None
            except ValueError as exc:  # such as MsgError
                if file == path:
                    raise ConfigError(str(file), str(exc), key="msg") from None
                left_out.append(f"{file.stem} ({exc})")
                continue
            found.setdefault(dds_type(ros2_type(definition)), {})[type_hash] = definition
    if left_out:
        extra = about("damaged", source="px4-zenoh")
        _log.info("px4-zenoh: messages in %s that cannot be carried: %.2000s", paths, ", ".join(left_out), extra=extra)
    return found


def _with_messages_within(file: Path) -> str:
    """Return a .msg file followed by the nested messages that lie beside it, in the format of ROS 2."""
    text = new = _read_text(file)
    added = set[str]()
    while missing := {base for base in bases_of_msg(new) - added if file.with_name(f"{base}.msg").is_file()}:
        added |= missing
        files = {base: _read_text(file.with_name(f"{base}.msg")) for base in sorted(missing)}
        new = "".join(f"\n{'=' * 80}\nMSG: px4_msgs/{base}\n{each}" for base, each in files.items())
        text += new
    return text


def _read_text(file: Path) -> str:
    """Return a text in UTF-8, with or without a byte order mark, or in Latin-1."""
    content = file.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")
