"""Selection of topics, and of the streams of a flight by topic, vehicle and instance."""

from collections.abc import Collection, Iterable, Sequence, Set
from pathlib import Path
from typing import Final

from nedbus.errors import AddressError
from nedbus_msgs import ANY, MESSAGES, TOPICS, Address, Selection, get_topic

_MAX_NAMED: Final = 10  # addresses listed in an error


def parse_topics(text: str) -> tuple[str, ...]:
    """Parse `TOPIC,TOPIC`; a message name selects all of its topics; raise AddressError for an invalid name."""
    names = tuple(part.strip() for part in text.split(",")) if text else ()
    for name in names:
        if name not in (ANY, *MESSAGES):
            get_topic(name)
    return names


def topics_of(names: Collection[str]) -> Set[str] | None:
    """Return the topics of names from `parse_topics`, by default the built-in ones; None means all."""
    return (
        None
        if ANY in names
        else {topic for name in names for topic in _topics_of(name)} or TOPICS.keys()
    )


def absent_topics(names: Collection[str], topics: Collection[str], where: str) -> list[str]:
    """Return a list of at most one warning: the requested topics and messages missing from `topics`."""
    absent = [name for name in names if name != ANY and _topics_of(name).isdisjoint(topics)]
    return [f"{where} has no messages of {', '.join(absent)}"] if absent else []


def _topics_of(name: str) -> Set[str]:
    return MESSAGES[name].topics.keys() if name in MESSAGES else {name}


def matching(
    where: Path | str, addresses: Sequence[Address], selection: Selection
) -> list[Address]:
    """Return the selected addresses of a flight; raise AddressError if there are none."""
    topics, vehicles = selection.topics, selection.vehicles
    steps: list[tuple[str, object, Selection]] = [
        ("vehicle", " or ".join(vehicles), Selection(vehicle=vehicles)),
        ("topic", " or ".join(topics), Selection(topics, vehicles)),
        ("instance", selection.instance, selection),
    ]
    for part, value, step in steps:
        if not any(map(step.matches, addresses)):
            raise AddressError(
                part, value, f"one of {_list(addresses)}", problem=f"is not in {where}"
            )
    return list(filter(selection.matches, addresses))


def single_match(path: Path, addresses: Sequence[Address], selection: Selection) -> list[Address]:
    """Return a list with the selected address of a file; raise AddressError unless exactly one matches.

    The first instance of a topic that only the file defines has no instance number: the topic alone selects it.
    """
    found = matching(path, addresses, selection)
    plain = [address for address in found if address.instance is None]
    found = (
        plain
        if len(plain) == 1 and len({(each.vehicle, each.topic) for each in found}) == 1
        else found
    )
    lacking = [
        part
        for part in ("topic", "vehicle", "instance")
        if len({getattr(each, part) for each in found}) > 1
    ]
    if lacking:
        problem = f"one stream of {path}, but several match; set {' and '.join(lacking)} to one of {_list(found)}"
        given = {
            "topic": " or ".join(selection.topics),
            "vehicle": " or ".join(selection.vehicles),
            "instance": selection.instance,
        }
        raise AddressError(lacking[0], given[lacking[0]], problem)
    return found


def require_one_vehicle(where: Path | str, addresses: Iterable[Address], vehicle: str) -> None:
    """Raise AddressError if these addresses, selected by `vehicle`, belong to several vehicles."""
    vehicles = sorted({address.vehicle for address in addresses})
    if len(vehicles) > 1:
        raise AddressError(
            "vehicle", vehicle, f"one vehicle of {where}: {', '.join(vehicles[:_MAX_NAMED])}"
        )


def _list(addresses: Sequence[Address]) -> str:
    more = len(addresses) - _MAX_NAMED
    return ", ".join(map(str, addresses[:_MAX_NAMED])) + (f" and {more} more" if more > 0 else "")
