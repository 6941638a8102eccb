"""PX4's own definitions of messages, .msg files that a user gives: of messages without a file here, or newer ones."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nedbus.errors import ConfigError
from nedbus.log_event import about
from nedbus_msgs import Definition, bases_of_msg, dds_type, define_msg, hash_of_msg, ros2_type

_log = logging.getLogger(__name__)

Definitions = Mapping[str, Mapping[str, Definition[Any]]]
"""Definitions by the DDS type of the message, and the hash of its ROS 2 type."""


def read_definitions(paths: str) -> Definitions:
    """Read .msg files and folders of them, such as PX4's `msg`, separated by commas.

    Messages of a folder that cannot be carried are left out, and named in the log.

    Raises ConfigError, with line and column, for a file that is not a message, or cannot be read.
    """
    found: dict[str, dict[str, Definition[Any]]] = {}
    left_out: list[str] = []
    for path in (Path(text.strip()).expanduser() for text in paths.split(",") if text.strip()):
        files = sorted([*path.glob("*.msg"), *path.glob("*/*.msg")])
        if not files and path.is_dir():
            reason = "no .msg file is in this folder, nor in those within it: name PX4's folder msg"
            raise ConfigError(str(path), reason, key="msg")
        for file in files or [path]:
            try:
                text = _with_messages_within(file)
                definition, type_hash = define_msg(file.stem, text), hash_of_msg(file.stem, text)
            except (OSError, UnicodeDecodeError) as exc:
                raise ConfigError(str(file), getattr(exc, "strerror", None) or "no UTF-8 text", key="msg") from None
            except ValueError as exc:  # MsgError, and its like
                if file == path:
                    raise ConfigError(str(file), str(exc), key="msg") from None
                left_out.append(f"{file.stem} ({exc})")
                continue
            found.setdefault(dds_type(ros2_type(definition)), {})[type_hash] = definition
    if left_out:
        extra = about("damaged", source="px4-zenoh")
        _log.info("px4-zenoh: not carried, of %s: %.2000s", paths, ", ".join(left_out), extra=extra)
    return found


def _with_messages_within(file: Path) -> str:
    """Return a .msg file followed by those beside it that it contains, in the form of ROS 2."""
    text, added = file.read_text(), set[str]()
    while missing := {base for base in bases_of_msg(text) - added if file.with_name(f"{base}.msg").is_file()}:
        added |= missing
        for base in sorted(missing):
            text += f"\n{'=' * 80}\nMSG: px4_msgs/{base}\n{file.with_name(f'{base}.msg').read_text()}"
    return text
