"""Access rules of a fleet: generate the vehicle entries of a router's configuration file.

Zenoh's access control supports neither wildcards in common names nor key expressions derived from them, so each vehicle
requires its own rule, subject and policy. They are written between marker lines; the rest of the file is unchanged.
"""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from nedbus.atomic_write import atomic_write
from nedbus.errors import ConfigError, system_reason
from nedbus_msgs import DEFAULT_PREFIX, check_prefix

from .certificate import CERTIFICATE_PREFIX, certificate_name

_BEGIN: Final = "// BEGIN vehicles"
_END: Final = "// END vehicles"
_BLOCK: Final = re.compile(
    rf"(?P<begin>^(?P<indent>[ \t]*){_BEGIN}[^\n]*\n)(?P<content>.*?)(?P<end>^[ \t]*{_END})",
    re.DOTALL | re.MULTILINE,
)
_SUBJECT: Final = re.compile(
    rf'^[ \t]*\{{ id: "{CERTIFICATE_PREFIX}([A-Za-z0-9_-]+)", cert_common_names: ', re.MULTILINE
)
# A vehicle sends data, last messages, retransmissions (@adv), downsampled streams (@rate), liveliness tokens, probes of
# `nedbus doctor`, schemas, rejection reports and the service status.
_MESSAGES: Final = '["put", "delete", "reply", "declare_queryable", "liveliness_token"]'
_KEYS: Final = (
    "{p}/{v}/**",
    "{p}/{v}/@alive/**",
    "{p}/{v}/**/@adv/**",
    "{p}/{v}/**/@rate/*",
    "{p}/{v}/**/@rate/*/@adv/**",
    "{p}/{v}/@doctor/*",
    "{p}/@schema/{v}/*",
    "{p}/@rejected/{v}/**",
    "{p}/@service/{v}/*/status",
    "{p}/@service/*/status",  # of older services: readers use only its id, host and version
)


def read_access_rules(file: Path) -> list[str]:
    """Return the vehicles named in a router's file; raise ConfigError like `write_access_rules`."""
    return _SUBJECT.findall(_find_blocks(file)[1]["content"])


def write_access_rules(
    file: Path, vehicles: Iterable[str], *, prefix: str = DEFAULT_PREFIX
) -> None:
    """Atomically replace the vehicle entries of a router's file; the rest of the file is unchanged.

    Raises AddressError for an invalid vehicle; ConfigError if no vehicle is given, or for a file that cannot be read or
    written, or lacks the marker lines of `config/router-secure.json5`.
    """
    check_prefix(prefix)
    names = sorted(set(vehicles))
    if not names:  # Zenoh rejects a subject without names
        raise ConfigError.in_file(file, "name at least one vehicle")
    text = _find_blocks(file)[0].string
    # A vehicle's certificate matches two subjects: "vehicles" for common permissions, and its own.
    subjects = [
        f'{{ id: "vehicles", cert_common_names: {json.dumps(list(map(certificate_name, names)))} }},'
    ]
    rules = list[str]()
    policies = list[str]()
    for vehicle, name in zip(names, map(certificate_name, names), strict=True):
        keys = json.dumps([key.format(p=prefix, v=vehicle) for key in _KEYS])
        rules += [
            f'{{ id: "{name}-in", permission: "allow", flows: ["ingress"],',
            f"  messages: {_MESSAGES},",
            f"  key_exprs: {keys} }},",
        ]
        subjects.append(f'{{ id: "{name}", cert_common_names: ["{name}"] }},')
        policies.append(f'{{ rules: ["{name}-in"], subjects: ["{name}"] }},')
    sections = iter((rules, subjects, policies))  # in the order of the marked blocks in the file

    def fill(block: re.Match[str]) -> str:
        return "".join(
            [
                block["begin"],
                *(f"{block['indent']}{line}\n" for line in next(sections)),
                block["end"],
            ]
        )

    try:
        with atomic_write(file, replace=True) as temporary:
            temporary.write_text(_BLOCK.sub(fill, text), encoding="utf-8")
            temporary.chmod(file.stat().st_mode)
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be written: {system_reason(exc)}") from exc


def _find_blocks(file: Path) -> list[re.Match[str]]:
    try:
        blocks = list(_BLOCK.finditer(file.read_text(encoding="utf-8")))
    except OSError as exc:
        raise ConfigError.in_file(file, f"cannot be read: {system_reason(exc)}") from exc
    except UnicodeDecodeError as exc:
        raise ConfigError.in_file(file, "not UTF-8 text") from exc
    if len(blocks) != 3:
        reason = (
            f"found {len(blocks)} of 3 pairs of marker lines '{_BEGIN}' and '{_END}', in rules, subjects and policies"
            " of access_control: start from config/router-secure.json5"
        )
        raise ConfigError.in_file(file, reason)
    return blocks
