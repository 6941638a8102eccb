"""Which streams of a file are meant; where that is none, or several, what is to blame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from nedbus.errors import AddressError
from nedbus_msgs import ANY, Address, Selection

_MAX_NAMED: Final = 10  # addresses that an error names


def matching(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return the addresses of a file that are selected; raise AddressError when there is none."""
    found = [address for address in addresses if selection.matches(address)]
    if found:
        return found
    has = f"which has {_list(addresses)}"
    of_vehicle = [address for address in addresses if selection.vehicle in (ANY, address.vehicle)]
    if not of_vehicle:
        raise AddressError("vehicle", selection.vehicle, f"one that is in {path}, {has}")
    if not any(selection.topic in (ANY, address.topic) for address in of_vehicle):
        of = "" if selection.vehicle == ANY else f" of vehicle {selection.vehicle}"
        raise AddressError("topic", selection.topic, f"one{of} that is in {path}, {has}")
    raise AddressError("instance", selection.instance, f"one of {selection.topic} that is in {path}, {has}")


def the_one(path: Path, addresses: Sequence[Address], selection: Selection) -> Address:
    """Return the only address of a file that is selected; raise AddressError when there is none, or more than one."""
    found = matching(path, addresses, selection)
    if len(found) == 1:
        return found[0]
    parts: dict[str, tuple[object, list[object]]] = {
        "topic": (selection.topic, [address.topic for address in found]),
        "vehicle": (selection.vehicle, [address.vehicle for address in found]),
        "instance": (selection.instance, [address.instance for address in found]),
    }
    lacking = [name for name, (_, values) in parts.items() if len(set(values)) > 1]
    given = parts[lacking[0]][0]
    raise AddressError(
        lacking[0],
        given,
        f"one stream of {path}, where several match: name {' and '.join(lacking)} too, of {_list(found)}",
    )


def _list(addresses: Sequence[Address]) -> str:
    more = len(addresses) - _MAX_NAMED
    return ", ".join(map(str, addresses[:_MAX_NAMED])) + (f" and {more} more" if more > 0 else "")
