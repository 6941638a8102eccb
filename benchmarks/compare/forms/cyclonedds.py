"""Cyclone DDS without a router: a typed dataclass as CDR over UDP on the loopback, reliable, every sample kept."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS

PACKAGES = ["cyclonedds==11.0.1"]

DOMAIN = 77
LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><Peers><Peer address="127.0.0.1"/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>
</Domain></CycloneDDS>"""
QOS = Qos(Policy.Reliability.Reliable(duration(infinite=True)), Policy.History.KeepAll)


def field_type(name: str, value: object) -> Any:
    """Choose the type that PX4 has."""
    if type(value) is bool:
        return bool
    if type(value) is int:
        return types.uint64 if "timestamp" in name else types.uint8
    if type(value) is tuple:
        return types.array[types.float32, 2]
    return types.float64 if name in {"ref_lat", "ref_lon"} else types.float32


Position = make_idl_struct(
    "Position", "bench.Position", {name: field_type(name, value) for name, value in FIELDS.items()}
)


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    _domain = Domain(DOMAIN, LOOPBACK)
    participant = DomainParticipant(DOMAIN)
    writer = DataWriter(participant, Topic(participant, "vehicle_local_position", Position), QOS)
    yield [lambda stamp: writer.write(Position(**{**FIELDS, "timestamp": stamp}))]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    _domain = Domain(DOMAIN, LOOPBACK)
    participant = DomainParticipant(DOMAIN)
    reader = DataReader(participant, Topic(participant, "vehicle_local_position", Position), QOS)
    ready()
    for message in reader.take_iter():
        if not seen(message.timestamp if message.x else 0):
            break
