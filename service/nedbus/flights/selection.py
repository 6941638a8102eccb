"""Selection of topics, and of the streams of a flight by topic, vehicle and instance."""

from collections.abc import Collection, Iterable, Sequence, Set
from pathlib import Path

from nedbus import limits
from nedbus.errors import AddressError
from nedbus_msgs import ANY, MESSAGES, TOPICS, Address, Selection, get_topic


def parse_topics(text: str) -> tuple[str, ...]:
    """Parse `TOPIC,TOPIC`; a message name selects all of its topics; raise AddressError for an invalid name."""
    if not text:
        return ()
    names = [part.strip() for part in text.split(",")]
    for name in names:
        is_known = name == ANY or name in MESSAGES
        if not is_known:
            get_topic(name)
    return tuple(names)


def topics_of(names: Collection[str]) -> Set[str] | None:
    """Return the topics of names from `parse_topics`, by default the built-in ones; None means all."""
    if ANY in names:
        return None
    topics = set[str]()
    for name in names:
        topics |= _topics_of(name)
    return topics or TOPICS.keys()


def absent_topics(names: Collection[str], topics: Collection[str], where: str) -> list[str]:
    """Return a list of at most one warning: the requested topics and messages missing from `topics`."""
    asked = [name for name in names if name != ANY]
    absent = [name for name in asked if _topics_of(name).isdisjoint(topics)]
    if not absent:
        return []
    return [f"{where} has no messages of {', '.join(absent)}"]


def _topics_of(name: str) -> Set[str]:
    if name in MESSAGES:
        return MESSAGES[name].topics.keys()
    return {name}


def matching(
    where: Path | str, addresses: Sequence[Address], selection: Selection
) -> list[Address]:
    """Return the selected addresses of a flight; raise AddressError if there are none."""
    steps = {
        "vehicle": Selection(vehicle=selection.vehicles),
        "topic": Selection(selection.topics, selection.vehicles),
        "instance": selection,
    }
    for part, step in steps.items():
        if not any(map(step.matches, addresses)):
            expected = f"one of {_list(addresses)}"
            value = _value_of(part, selection)
            raise AddressError(part, value, expected, problem=f"is not in {where}")
    return list(filter(selection.matches, addresses))


def _value_of(part: str, selection: Selection) -> object:
    """Return what a selection has for "vehicle", "topic" or "instance", as an error shows it."""
    values = {
        "vehicle": " or ".join(selection.vehicles),
        "topic": " or ".join(selection.topics),
        "instance": selection.instance,
    }
    return values[part]


def single_match(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return a list with the selected address of a file; raise AddressError unless exactly one matches.

    The first instance of a topic that only the file defines has no instance number: the topic alone selects it.
    """
    matches = matching(path, addresses, selection)
    topics = {(address.vehicle, address.topic) for address in matches}
    plain = [address for address in matches if address.instance is None]
    if len(topics) == 1 and len(plain) == 1:
        matches = plain
    lacking = []
    for part in ("topic", "vehicle", "instance"):
        values = {getattr(address, part) for address in matches}
        if len(values) > 1:
            lacking.append(part)
    if lacking:
        choices = f"set {' and '.join(lacking)} to one of {_list(matches)}"
        expected = f"one stream of {path}, but several match; {choices}"
        raise AddressError(lacking[0], _value_of(lacking[0], selection), expected)
    return matches


def require_one_vehicle(where: Path | str, addresses: Iterable[Address], vehicle: str) -> None:
    """Raise AddressError if these addresses, selected by `vehicle`, belong to several vehicles."""
    vehicles = sorted({address.vehicle for address in addresses})
    if len(vehicles) > 1:
        names = ", ".join(vehicles[: limits.SHOWN_NAMES])
        raise AddressError("vehicle", vehicle, f"one vehicle of {where}: {names}")


def _list(addresses: Sequence[Address]) -> str:
    text = ", ".join(map(str, addresses[: limits.SHOWN_NAMES]))
    more = len(addresses) - limits.SHOWN_NAMES
    if more > 0:
        return f"{text} and {more} more"
    return text
