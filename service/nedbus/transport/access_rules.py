"""Access rules of a fleet: the part of a router's configuration file that names the vehicles, made from a list.

Zenoh's access control has no patterns for names, and none for key expressions that contain them: each vehicle needs a
rule, a subject and a policy of its own. These stand between marks in the file; everything else in it stays as it is.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from nedbus.errors import ConfigError
from nedbus.whole_file import whole_file
from nedbus_msgs import DEFAULT_PREFIX, AddressError, check_prefix, check_vehicle

CERTIFICATE_PREFIX: Final = "vehicle-"
"""The common name of a vehicle's certificate is this and its id, so that no vehicle can be named like a reader."""

_VEHICLE_LENGTH: Final = 64 - len(CERTIFICATE_PREFIX)  # X.509's limit of a common name
_BEGIN: Final = "// BEGIN vehicles"
_END: Final = "// END vehicles"
_BLOCK: Final = re.compile(
    rf"(?P<begin>^(?P<indent>[ \t]*){_BEGIN}[^\n]*\n)(?P<content>.*?)(?P<end>^[ \t]*{_END})", re.DOTALL | re.MULTILINE
)
_NAMED: Final = re.compile(rf'^[ \t]*\{{ id: "{CERTIFICATE_PREFIX}([A-Za-z0-9_-]+)", cert_common_names: ', re.MULTILINE)
# What a vehicle sends: data, last values, recovery (@adv), thinned copies (@rate), liveliness, probes of
# `nedbus doctor`, reports of what was rejected, and a status.
_MESSAGES: Final = '["put", "delete", "reply", "declare_queryable", "liveliness_token"]'
_KEYS: Final = (
    "{p}/{v}/**",
    "{p}/{v}/@alive/**",
    "{p}/{v}/**/@adv/**",
    "{p}/{v}/**/@rate/*",
    "{p}/{v}/**/@rate/*/@adv/**",
    "{p}/{v}/@doctor/*",
    "{p}/@rejected/{v}/**",
    "{p}/@service/*/status",
)
_WIDTH: Final = 118  # of a line with many names


@dataclass(frozen=True, slots=True)
class RulesChange:
    """Which vehicles a router's file names, and which of them it did not name before, or names no more."""

    vehicles: tuple[str, ...]
    added: tuple[str, ...]
    removed: tuple[str, ...]


def certificate_name(vehicle: str) -> str:
    """Return the common name of a vehicle's certificate; raise AddressError for what is no vehicle, or too long."""
    check_vehicle(vehicle)
    if len(vehicle) > _VEHICLE_LENGTH:
        raise AddressError("vehicle", vehicle, f"at most {_VEHICLE_LENGTH} characters, for a certificate")
    return CERTIFICATE_PREFIX + vehicle


def read_access_rules(file: Path) -> list[str]:
    """Return the vehicles that a router's file names between its marks; raise ConfigError as `write_access_rules`."""
    return _NAMED.findall(_blocks(_read(file), file)[1]["content"])


def write_access_rules(file: Path, vehicles: Iterable[str], *, prefix: str = DEFAULT_PREFIX) -> RulesChange:
    """Write rules for exactly these vehicles into a router's file, whole or not at all; nothing else in it changes.

    The names are sorted as people do, 2 before 10, and each is written once.

    Raises AddressError for what is no vehicle; ConfigError for no vehicle at all, and for a file that cannot be read or
    written or has no marks, which are those of `config/router-secure.json5`.
    """
    check_prefix(prefix)
    names = sorted(set(vehicles), key=_natural)
    if not names:
        # Zenoh takes no subject without names: the router would not start.
        raise ConfigError.in_file(file, "name at least one vehicle")
    text = _read(file)
    before = set(read_access_rules(file))
    changed = _with_vehicles(text, _blocks(text, file), names, prefix)
    try:
        with whole_file(file, replace=True) as part:
            part.write_text(changed, encoding="utf-8")
            part.chmod(file.stat().st_mode)
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be written: {(exc.strerror or str(exc)).lower()}") from exc
    added = tuple(name for name in names if name not in before)
    return RulesChange(tuple(names), added, tuple(sorted(before - set(names), key=_natural)))


def _read(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be read: {(exc.strerror or str(exc)).lower()}") from exc
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(file, "this is not text in UTF-8") from exc


def _blocks(text: str, file: Path) -> list[re.Match[str]]:
    found = list(_BLOCK.finditer(text))
    if len(found) != len(_SECTIONS):
        reason = (
            f"it has {len(found)} of 3 pairs of lines '{_BEGIN}' and '{_END}', in rules, subjects and policies of"
            " access_control: take config/router-secure.json5 as a start"
        )
        raise ConfigError.in_file(file, reason)
    return found


def _with_vehicles(text: str, blocks: Sequence[re.Match[str]], vehicles: Sequence[str], prefix: str) -> str:
    pieces: list[str] = []
    end = 0
    for block, section in zip(blocks, _SECTIONS, strict=True):
        pieces += [text[end : block.start()], block["begin"]]
        pieces += [f"{block['indent']}{line}\n" for line in section(vehicles, prefix)]
        pieces.append(block["end"])
        end = block.end()
    return "".join([*pieces, text[end:]])


def _rules(vehicles: Sequence[str], prefix: str) -> list[str]:
    lines = []
    for vehicle in vehicles:
        keys = json.dumps([key.format(p=prefix, v=vehicle) for key in _KEYS])
        lines += [
            f'{{ id: "{certificate_name(vehicle)}-in", permission: "allow", flows: ["ingress"],',
            f"  messages: {_MESSAGES},",
            f"  key_exprs: {keys} }},",
        ]
    return lines


def _subjects(vehicles: Sequence[str], _: str) -> list[str]:
    """One subject for what all vehicles may, and one each; Zenoh merges those that are the same certificate."""
    lines = ['{ id: "vehicles", cert_common_names: [']
    line = " "
    for vehicle in vehicles:
        name = f' "{certificate_name(vehicle)}",'
        if len(line) + len(name) > _WIDTH:
            lines.append(line)
            line = " "
        line += name
    lines += [line, "] },"]
    return lines + [f'{{ id: "{name}", cert_common_names: ["{name}"] }},' for name in map(certificate_name, vehicles)]


def _policies(vehicles: Sequence[str], _: str) -> list[str]:
    names = map(certificate_name, vehicles)
    return [f'{{ rules: ["{name}-in"], subjects: ["{name}"] }},' for name in names]


_SECTIONS: Final = (_rules, _subjects, _policies)  # in the order of the file


def _natural(vehicle: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers inside names by their value."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.findall(r"\d+|\D+", vehicle)]
