"""Cyclone DDS without a router: a typed dataclass as CDR over UDP on the loopback, reliable, every sample kept."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS, TYPES

PACKAGES = ["cyclonedds==11.0.1"]

DOMAIN = 77
LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface name="lo"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><Peers><Peer address="127.0.0.1"/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>
</Domain></CycloneDDS>"""
QOS = Qos(Policy.Reliability.Reliable(duration(infinite=True)), Policy.History.KeepAll)


IDL_TYPES = {
    "bool": bool, "uint64": types.uint64, "uint8": types.uint8, "float32[2]": types.array[types.float32, 2],
    "float64": types.float64, "float32": types.float32,
}  # fmt: skip
Position = make_idl_struct(
    "Position", "bench.Position", {name: IDL_TYPES[type_name] for name, type_name in TYPES.items()}
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
