"""Access rules of a fleet: the part of a router's configuration file that names the vehicles, made from a list.

Zenoh's access control has no patterns for names, and none for key expressions that contain them: each vehicle needs a
rule, a subject and a policy of its own. These stand between marks in the file; everything else in it stays as it is.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from nedbus.errors import ConfigError
from nedbus.whole_file import whole_file
from nedbus_msgs import DEFAULT_PREFIX, check_prefix

from .certificate import CERTIFICATE_PREFIX, certificate_name

_BEGIN: Final = "// BEGIN vehicles"
_END: Final = "// END vehicles"
_BLOCK: Final = re.compile(
    rf"(?P<begin>^(?P<indent>[ \t]*){_BEGIN}[^\n]*\n)(?P<content>.*?)(?P<end>^[ \t]*{_END})", re.DOTALL | re.MULTILINE
)
_SUBJECT: Final = re.compile(
    rf'^[ \t]*\{{ id: "{CERTIFICATE_PREFIX}([A-Za-z0-9_-]+)", cert_common_names: ', re.MULTILINE
)
# A vehicle sends: data, last values, retransmissions (@adv), downsampled copies (@rate), liveliness, probes of
# `nedbus doctor`, rejection reports, and a status.
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


def read_access_rules(file: Path) -> list[str]:
    """Return the vehicles that a router's file names between its marks; raise ConfigError as `write_access_rules`."""
    return _SUBJECT.findall(_find_blocks(file)[1]["content"])


def write_access_rules(file: Path, vehicles: Iterable[str], *, prefix: str = DEFAULT_PREFIX) -> None:
    """Write rules for exactly these vehicles into a router's file, whole or not at all; nothing else in it changes.

    Raises AddressError for an invalid vehicle; ConfigError for no vehicle at all, and for a file that cannot be read or
    written or has no marks, which are those of `config/router-secure.json5`.
    """
    check_prefix(prefix)
    names = sorted(set(vehicles))
    if not names:  # Zenoh takes no subject without names: the router would not start
        raise ConfigError.in_file(file, "name at least one vehicle")
    text, sections = _find_blocks(file)[0].string, iter(_sections(names, prefix))

    def fill(block: re.Match[str]) -> str:
        return "".join([block["begin"], *(f"{block['indent']}{line}\n" for line in next(sections)), block["end"]])

    try:
        with whole_file(file, replace=True) as part:
            part.write_text(_BLOCK.sub(fill, text), encoding="utf-8")
            part.chmod(file.stat().st_mode)
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be written: {(exc.strerror or str(exc)).lower()}") from exc


def _find_blocks(file: Path) -> list[re.Match[str]]:
    """Return the blocks between marks: in the rules, the subjects and the policies."""
    try:
        blocks = list(_BLOCK.finditer(file.read_text(encoding="utf-8")))
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be read: {(exc.strerror or str(exc)).lower()}") from exc
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(file, "this is not text in UTF-8") from exc
    if len(blocks) != 3:
        reason = (
            f"it has {len(blocks)} of 3 pairs of lines '{_BEGIN}' and '{_END}', in rules, subjects and policies of"
            " access_control: take config/router-secure.json5 as a start"
        )
        raise ConfigError.in_file(file, reason)
    return blocks


def _sections(vehicles: Sequence[str], prefix: str) -> tuple[list[str], list[str], list[str]]:
    """Return the lines of the rules, the subjects and the policies, in the order of the file.

    One subject is of all vehicles, for what each of them may, and one of each; a certificate may match both.
    """
    names = [certificate_name(vehicle) for vehicle in vehicles]
    rules, subjects, policies = [], [f'{{ id: "vehicles", cert_common_names: {json.dumps(names)} }},'], []
    for name, vehicle in zip(names, vehicles, strict=True):
        keys = json.dumps([key.format(p=prefix, v=vehicle) for key in _KEYS])
        rules += [
            f'{{ id: "{name}-in", permission: "allow", flows: ["ingress"],',
            f"  messages: {_MESSAGES},",
            f"  key_exprs: {keys} }},",
        ]
        subjects.append(f'{{ id: "{name}", cert_common_names: ["{name}"] }},')
        policies.append(f'{{ rules: ["{name}-in"], subjects: ["{name}"] }},')
    return rules, subjects, policies
