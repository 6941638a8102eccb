"""The service as its users run it: in a process of its own, with subscribers in others."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from pathlib import Path

import msgpack
import pytest
import zenoh

import nedbus
from nedbus.transport import Session
from nedbus_msgs import (
    ENCODING,
    FIELD_TYPES,
    LAYOUTS,
    Address,
    Provenance,
    VehicleLocalPosition,
    provenance_of,
    upgrade,
)
from tests.conftest import DEADLINE, LOGS, Start, free_endpoint, message, wait_for
from tests.replays import open_replay
from tests.ulogs import UlogWriter, write_log

VLP = "vehicle_local_position"

# A reader that knows nothing of nedbus, as it could be in any language: zenoh, msgpack, and the documented keys.
PLAIN_READER = """
import json, sys, time
import msgpack, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
while True:
    try:
        session = zenoh.open(config)
        break
    except zenoh.ZError:
        time.sleep(0.05)
with session:
    subscriber = session.declare_subscriber("nedbus/**", zenoh.handlers.FifoChannel(1000))
    print("ready", flush=True)
    for number in range(int(sys.argv[2])):
        sample = subscriber.recv()
        values = [repr(value) for value in msgpack.unpackb(sample.payload.to_bytes())]
        print(json.dumps([str(sample.key_expr), str(sample.encoding), values]), flush=number % 100 == 99)
    subscriber.undeclare()
"""

# A reader that is a script of a user.
NEDBUS_READER = """
import json, sys
import nedbus
with nedbus.connect(sys.argv[1], timeout=30) as bus, bus.subscribe("*", mode="every") as subscription:
    print("ready", flush=True)
    for number in range(int(sys.argv[2])):
        sample = subscription.receive(30)
        values = [repr(value) for value in sample.message.__dict__.values()]
        print(json.dumps([str(sample.address), sample.lost, values]), flush=number % 100 == 99)
    print(json.dumps([subscription.counts.lost, subscription.counts.invalid]))
"""


def until_connected(endpoint: str) -> nedbus.Bus:
    return nedbus.connect(endpoint, timeout=DEADLINE)


def rows(text: str) -> list[list[object]]:
    return [json.loads(line) for line in text.splitlines() if line.startswith("[")]


def expected_rows(path: Path) -> dict[str, list[list[str]]]:
    """Return what a log holds, by address, read here by the source itself (test_ulog.py proves that against pyulog)."""
    found: dict[str, list[list[str]]] = {}
    for each in open_replay(f"ulog:{path}").messages:
        values = [repr(value) for value in upgrade(each.fields).__dict__.values()]
        found.setdefault(str(each.address), []).append(values)
    return found


def by_address(received: list[list[object]]) -> dict[str, list[object]]:
    found: dict[str, list[object]] = {}
    for address, _, values in received:
        found.setdefault(str(address), []).append(values)
    return found


def real_logs() -> list[Path]:
    logs = sorted(LOGS.glob("*.ulg"))
    if not logs:
        pytest.skip(f"the real logs are not here: {LOGS}")
    return logs


@pytest.mark.logs
@pytest.mark.timeout(300)
def test_all_real_logs_reach_another_process_whole(start: Start, run_nedbus: Start) -> None:
    """Every message of every real log goes log -> daemon -> router -> reader: none lost, none rejected, to the bit."""
    logs = real_logs()
    endpoint = free_endpoint()
    router = run_nedbus("router", "--listen", endpoint)
    reader = start("-c", NEDBUS_READER, endpoint, "9457")
    wait_for(lambda: "ready" in reader.out, what=f"the reader: {reader.err}")
    sources = [f"--source=ulog:{path}?speed=max&wait=1&vehicle={path.stem.replace('.', '_')}" for path in logs]
    service = run_nedbus("serve", "--connect", endpoint, "--until-done", *sources)
    assert service.wait(240) == 0, service.err
    assert reader.wait(60) == 0, reader.err
    *samples, counts = rows(reader.out)
    assert counts == [0, 0]
    assert len(samples) == 9457
    assert not any(lost for _, lost, _ in samples)
    received = by_address(samples)
    for path in logs:
        vehicle = path.stem.replace(".", "_")
        for address, values in expected_rows(path).items():
            assert received.pop(address.replace("1/", f"{vehicle}/", 1)) == values, (path, address)
    assert not received
    assert "rejected" not in service.err.replace("0 rejected", "")
    router.signal(signal.SIGTERM)
    assert router.wait() == 0


@pytest.mark.logs
def test_plain_zenoh_and_msgpack_see_every_sample(start: Start, run_nedbus: Start) -> None:
    """A script that knows nothing of this project sees each sample of a log as a 54-element array of its values."""
    path = next(log for log in real_logs() if "1.13" in log.name)
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--listen", endpoint, "--until-done", "-s", f"ulog:{path}?speed=max&wait=1")
    reader = start("-c", PLAIN_READER, endpoint, "1871")
    assert reader.wait(60) == 0, reader.err
    assert service.wait() == 0, service.err
    received = rows(reader.out)
    missing = FIELD_TYPES.keys() - {*LAYOUTS["1.13"].fields, "hagl_max_z", "hagl_max_xy"}
    encodings = {str(encoding) for _, encoding, _ in received}
    assert {encoding.split(";source=")[0] for encoding in encodings} == {ENCODING}
    assert {provenance_of(encoding) for encoding in encodings} == {Provenance("ulog", frozenset(missing))}
    expected = {
        f"nedbus/{address}": [["1", *(value.replace("(", "[").replace(")", "]") for value in row)] for row in values]
        for address, values in expected_rows(path).items()
    }
    assert all(isinstance(values, list) and len(values) == 54 for _, _, values in received)
    assert by_address(received) == expected


def test_replay_at_full_speed_loses_nothing_to_a_slow_reader(tmp_path: Path, run_nedbus: Start) -> None:
    """speed=max waits for whoever reads, and the service stays until a slow reader has all of it."""
    total = 30_000
    path = write_log(tmp_path / "a.ulg", range(0, 1000 * total, 1000))
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "--until-done", "-s", f"ulog:{path}?speed=max&wait=1")
    with until_connected(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        stayed = 0
        for number in range(total):
            if number % 100 == 0:
                time.sleep(0.01)  # what makes it slow
                stayed = number if service.popen.poll() is None else stayed
            sample = subscription.receive(DEADLINE)
            assert (sample.message.x, sample.lost) == (number, 0)
    assert stayed > total - 10_000, "only what the reader's process holds may be unread when the service ends"
    assert service.wait() == 0


def test_replay_keeps_its_order_and_speed(tmp_path: Path, run_nedbus: Start) -> None:
    """At speed=10 a flight of 10 s takes about 1 s, never less; wait=1 starts it when a subscriber is there."""
    path = write_log(tmp_path / "a.ulg", range(0, 10_000_001, 100_000))
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "--until-done", "-s", f"ulog:{path}?speed=10&wait=1")
    with until_connected(endpoint) as bus:
        wait_for(lambda: [source_of(s)["state"] for s in bus.services()] == ["waiting"], what="the service")
        assert source_of(bus.services()[0])["published"] == 0
        with bus.subscribe(VLP, mode="every") as subscription:
            samples = [subscription.receive(DEADLINE) for _ in range(101)]
    assert [sample.message.x for sample in samples] == list(range(101))
    assert samples[0].sent is not None
    assert samples[-1].sent is not None
    assert samples[-1].sent - samples[0].sent > 0.9e9
    assert service.wait() == 0


def source_of(status: dict[str, object], number: int = 0) -> dict[str, object]:
    sources = status["sources"]
    assert isinstance(sources, list)
    source = sources[number]
    assert isinstance(source, dict)
    return source


def test_pipe_is_an_error(tmp_path: Path, run_nedbus: Start) -> None:
    """A FIFO is refused at once: opening it would wait for a writer, for ever and without a word."""
    fifo = tmp_path / "flight.ulg"
    os.mkfifo(fifo)
    service = run_nedbus("serve", "-s", f"ulog:{fifo}")
    assert service.wait() == 2
    assert f"{fifo} is not a regular file: save it as one, then give that" in service.err


@pytest.mark.parametrize("locale", ["C.UTF-8", "C"])
@pytest.mark.parametrize(
    ("name", "written"),
    [
        (b"what?.ulg", "what%3F.ulg"),
        (b"what?.ulg", "what?.ulg?"),
        (b"100%25.ulg", "100%2525.ulg"),
        (b"a%20b.ulg", "a%20b.ulg"),
        ("Flüge.ulg".encode(), "Flüge.ulg"),
        (b"Fl\xfcge.ulg", os.fsdecode(b"Fl\xfcge.ulg")),
    ],
)
def test_any_file_name_is_served(tmp_path: Path, run_nedbus: Start, name: bytes, written: str, locale: str) -> None:
    """With ?, % or bytes that are no UTF-8 in it, and in the C locale: served, and named in the status."""
    os.replace(write_log(tmp_path / "a.ulg", [0, 1000]), os.path.join(os.fsencode(tmp_path), name))  # noqa: PTH105, PTH118 - bytes
    endpoint = free_endpoint()
    text = f"ulog:{tmp_path}/{written}"
    service = run_nedbus("serve", "-l", endpoint, "-s", text, LC_ALL=locale, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    with until_connected(endpoint) as bus:
        wait_for(lambda: [source_of(s)["state"] for s in bus.services()] == ["done"], what=f"the log: {service.err}")
        status = source_of(bus.services()[0])
        assert status["published"] == 2
        assert str(status["source"]).startswith(f"ulog:{tmp_path}/")


def test_loop_starts_again(tmp_path: Path, run_nedbus: Start) -> None:
    """loop=1 flies the log for ever."""
    path = write_log(tmp_path / "a.ulg", range(0, 100_000, 10_000))
    endpoint = free_endpoint()
    run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{path}?loop=1&wait=1")
    with until_connected(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        assert [subscription.receive(DEADLINE).message.x for _ in range(25)] == [*range(10), *range(10), *range(5)]


def test_simulator_publishes_all_topics_and_several_vehicles(run_nedbus: Start) -> None:
    """Two vehicles at once, each with its four topics and two estimators."""
    endpoint = free_endpoint()
    run_nedbus("serve", "-l", endpoint, "-s", "sim:", "-s", "sim:?vehicle=two&seed=2")
    with until_connected(endpoint) as bus:
        wait_for(lambda: len(bus.latest("*")) == 10, what="ten streams")
        assert {vehicle: len(addresses) for vehicle, addresses in bus.vehicles().items()} == {"1": 5, "two": 5}


def test_ended_replay_keeps_its_last_value(tmp_path: Path, run_nedbus: Start) -> None:
    """A service that goes on after a replay still answers with its last message."""
    path = write_log(tmp_path / "a.ulg", [0, 1000, 2000])
    endpoint = free_endpoint()
    run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{path}")
    with until_connected(endpoint) as bus:
        wait_for(lambda: [source_of(s)["state"] for s in bus.services()] == ["done"], what="the end of the replay")
        assert [sample.message.x for sample in bus.latest("*")] == [2.0]
        assert bus.subscribe("*").receive(DEADLINE).message.x == 2.0


def test_invalid_message_is_rejected_counted_and_reported(tmp_path: Path, run_nedbus: Start) -> None:
    """What fails validation is never published: it is on the rejected key with its reason, and counted in status."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(10):
        broken = number in {3, 4}
        writer.add(VLP, message(number), z_valid=int(broken), z=math.nan if broken else 1.0)
    path = writer.write(tmp_path / "a.ulg")
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{path}?wait=1")
    with until_connected(endpoint) as bus:
        reports: list[dict[str, object]] = []

        def note(raw: zenoh.Sample) -> None:
            reports.append(json.loads(raw.payload.to_bytes()))

        listener = bus._session.declare_subscriber("nedbus/@rejected/**", zenoh.handlers.Callback(note, indirect=False))
        with bus.subscribe(VLP, mode="every") as subscription:
            taken = [subscription.receive(DEADLINE).message.timestamp for _ in range(8)]
        wait_for(lambda: len(reports) == 2, what="two reports")
        assert taken == [0, 1, 2, 5, 6, 7, 8, 9]
        assert "z: must be finite while z_valid is true" in str(reports[0]["reason"])
        fields = reports[0]["fields"]
        assert isinstance(fields, dict)
        assert (fields["timestamp"], fields["z"]) == (3, "NaN")
        assert source_of(bus.services()[0])["rejected"] == 2
        listener.undeclare()
    assert "1/vehicle_local_position rejected: z: must be finite" in service.err


def test_failing_source_stops_nobody(tmp_path: Path, run_nedbus: Start) -> None:
    """One source that fails is retried with back-off and shown in status; once it can be read, it is."""
    missing = tmp_path / "later.ulg"
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{missing}?vehicle=late", "-s", "sim:")
    with until_connected(endpoint) as bus:
        wait_for(lambda: bus.latest(VLP, vehicle="1"), what="the good source")
        wait_for(lambda: source_of(bus.services()[0])["retries"], what="a retry")
        status = source_of(bus.services()[0])
        assert status["state"] == "retrying"
        assert "no such file" in str(status["error"])
        write_log(missing, [0, 1000])
        wait_for(lambda: bus.latest(VLP, vehicle="late"), what="the source that came later")
        assert service.popen.poll() is None


def test_two_sources_of_one_vehicle_are_not_mixed(run_nedbus: Start) -> None:
    """The second source of an address fails with a hint; the first goes on."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "-s", "sim:", "-s", "sim:?seed=2")
    with until_connected(endpoint) as bus:
        wait_for(lambda: "published by this process already" in service.err, what="the rejection")
        states = {str(source_of(bus.services()[0], number)["state"]) for number in (0, 1)}
        assert states == {"running", "retrying"}


def test_until_done_tells_failure(tmp_path: Path, run_nedbus: Start) -> None:
    """With --until-done a source that cannot be read makes exit code 1, after the others have ended."""
    good = write_log(tmp_path / "a.ulg", [0, 1000])
    service = run_nedbus(
        "serve", "-l", free_endpoint(), "--until-done", "-s", "ulog:/nowhere.ulg", "-s", f"ulog:{good}"
    )
    assert service.wait() == 1
    assert "/nowhere.ulg: no such file or directory" in service.err
    assert "2 published" in service.err


def test_until_done_ignores_endless_sources(run_nedbus: Start) -> None:
    """The finite ones decide."""
    service = run_nedbus(
        "serve", "-l", free_endpoint(), "--until-done", "-s", "sim:", "-s", "sim:?vehicle=2&duration=0.5"
    )
    assert service.wait() == 0, service.err


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
@pytest.mark.parametrize("source", ["sim:", "ulog", "ulog max", "missing"])
def test_signal_ends_the_service(
    tmp_path: Path, run_nedbus: Start, number: signal.Signals, code: int, source: str
) -> None:
    """SIGTERM and SIGINT end the service, whatever its sources do; after 1.6 s it would end with another code."""
    path = write_log(tmp_path / "a.ulg", range(0, 100_000_000, 10_000))
    texts = {
        "sim:": "sim:",
        "ulog": f"ulog:{path}",
        "ulog max": f"ulog:{path}?speed=max&loop=1",
        "missing": "ulog:/nowhere.ulg",
    }
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "-s", texts[source], measured=False)
    with until_connected(endpoint) as bus:
        wait_for(bus.services, what=f"the service: {service.err}")
        service.signal(number)
        assert service.wait() == code
        assert "Traceback" not in service.err


def test_signal_ends_a_replay_that_a_stuck_reader_holds(tmp_path: Path, run_nedbus: Start) -> None:
    """A reader that never reads holds a replay at full speed, for up to ten minutes, but not the end of the service."""
    path = write_log(tmp_path / "a.ulg", range(0, 1000 * 60_000, 1000))
    endpoint = free_endpoint()
    service = run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{path}?speed=max&loop=1&wait=1")
    with until_connected(endpoint) as bus, bus.subscribe(VLP, mode="every"):
        stood: list[object] = [None]

        def stands() -> bool:
            before = stood[0]
            services = bus.services()
            stood[0] = source_of(services[0])["published"] if services else None
            return bool(stood[0]) and stood[0] == before

        wait_for(stands, what="the replay to be held")
        service.signal(signal.SIGTERM)
        service.wait()


def test_service_as_a_client_waits_for_its_router_and_comes_back(run_nedbus: Start) -> None:
    """With --connect the service starts before its router, and survives the router's death."""
    endpoint = free_endpoint()
    service = run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: "still trying" in service.err, what="the service to say that it waits")
    router = run_nedbus("router", "--listen", endpoint)
    with until_connected(endpoint) as bus:
        subscription = bus.subscribe(VLP, mode="every")
        first = subscription.receive(DEADLINE).message.timestamp
        router.kill()
        wait_for(lambda: not bus.connected, what="the link to break")
        router = run_nedbus("router", "--listen", endpoint)
        wait_for(lambda: bus.connected, what="the link to come back")
        timestamps = [subscription.receive(DEADLINE).message.timestamp for _ in range(300)]
        assert timestamps == [first + 10_000 * (step + 1) for step in range(300)]
        assert subscription.counts.lost == 0
    service.signal(signal.SIGTERM)
    assert service.wait() == 0


def test_service_says_what_made_it_a_client(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """NEDBUS_CONNECT is set for scripts: a service that follows it says so, and how to be a router all the same."""
    hint = "it starts no router of its own without --listen"
    by_variable = run_nedbus("serve", "-s", "sim:", NEDBUS_CONNECT=endpoint)
    wait_for(lambda: f"client of {endpoint}, as set by NEDBUS_CONNECT: {hint}" in by_variable.err, what="the variable")
    file = tmp_path / "some.toml"
    file.write_text(f'connect = "{endpoint}"')
    by_file = run_nedbus("serve", "-s", "sim:?vehicle=2", "--config", str(file))
    wait_for(lambda: f"client of {endpoint}, as set by {file}: {hint}" in by_file.err, what="the file")
    by_flag = run_nedbus("serve", "-s", "sim:?vehicle=3", "--connect", endpoint)
    wait_for(lambda: f"client of {endpoint}\n" in by_flag.err, what="the flag")
    here = free_endpoint()
    router = run_nedbus("serve", "-s", "sim:?vehicle=4", "--listen", here, NEDBUS_CONNECT=endpoint)
    wait_for(lambda: f"router on {here}, joining {endpoint}" in router.err, what="the router")


def test_links_to_other_routers_are_said(run_nedbus: Start) -> None:
    """A router that joins another says when the link is up, that it does not come up, and that it is lost."""
    near, far = free_endpoint(), free_endpoint()
    service = run_nedbus("serve", "-s", "sim:", "--listen", near, "--connect", far)
    wait_for(lambda: f"no link to {far}: still trying" in service.err, what="the warning")
    assert "joined" not in service.err
    router = run_nedbus("router", "--listen", far)
    wait_for(lambda: f"joined {far}" in service.err, what="the link")
    router.kill()
    wait_for(lambda: f"the link to {far} is lost" in service.err, what="the loss")


def test_signal_ends_a_service_that_waits_for_its_router(run_nedbus: Start) -> None:
    """A service that never found its router ends cleanly too."""
    service = run_nedbus("serve", "--connect", free_endpoint(), "-s", "sim:")
    wait_for(lambda: "still trying" in service.err, what="the service to say that it waits")
    service.signal(signal.SIGTERM)
    assert service.wait() == 0


def test_taken_port_is_a_clear_error(run_nedbus: Start, endpoint: str) -> None:
    """The error names the endpoint, the reason, and both ways out."""
    service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:")
    assert service.wait() == 1
    assert service.err.strip().splitlines()[-1] == (
        f"nedbus: cannot listen on {endpoint} (address already in use): choose another endpoint with --listen,"
        " or join the router that runs there with --connect"
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "source: nothing to publish: give --source sim:, ulog:FILE, px4-zenoh: or mavlink:LINK, or several"),
        (["-s", "foo:x"], "source 'foo:x': there is no kind 'foo': choose from sim, ulog"),
        (["-s", "a/b.ulg"], "write ulog:a/b.ulg"),
        (["-s", "ulg:a/b.ulg"], "there is no kind 'ulg': write ulog:a/b.ulg"),
        (["-s", "ulog:"], "source 'ulog:': write it as ulog:FILE"),
        (["-s", "sim:x"], "source 'sim:x': write it as sim:?OPTION=VALUE"),
        (["-s", "sim:?sed=1"], "source 'sim:?sed=1': there is no option 'sed'"),
        (["-s", "sim:?speed=0"], "speed=0 is invalid: expected a factor from 0.001"),
        (["-s", "sim:?vehicle=a/b"], "vehicle=a/b is invalid: expected 1 to 64 of A-Z"),
        (["-s", "sim:?speed"], "'speed' is not OPTION=VALUE"),
        (["-s", "ulog:a?b.ulg"], "'b.ulg' is not OPTION=VALUE&OPTION=VALUE, and a path with ? in it has %3F instead"),
        (["-s", "ulog:/dev/null"], "/dev/null is not a regular file: save it as one, then give that"),
        (["-s", "sim:", "--until-done"], "until_done: no source ever ends"),
        (["-s", "sim:", "--listen", "7447"], "listen: '7447' is not an endpoint: write PROTOCOL/HOST:PORT"),
        (["-s", "sim:", "--config", "no.toml"], "no.toml: there is no such file"),
        (["-s", "sim:", "--prefix", "a/*"], "prefix: prefix 'a/*' is not valid"),
    ],
)
def test_wrong_flag_is_a_usage_error(run_nedbus: Start, arguments: list[str], text: str) -> None:
    """Exit code 2, and one line that says what to write instead."""
    service = run_nedbus("serve", *arguments)
    assert service.wait() == 2
    assert text in service.err
    assert len(service.err.splitlines()) == 1


def test_service_reads_its_file(tmp_path: Path, run_nedbus: Start) -> None:
    """Sources, endpoint and prefix from nedbus.toml; a flag wins over the environment, which wins over the file."""
    endpoint = free_endpoint()
    file = tmp_path / "nedbus.toml"
    file.write_text('source = ["sim:"]\nlisten = ["tcp/127.0.0.1:1"]\nprefix = "fleet"\nvehicle = 7\n')
    run_nedbus("serve", "--config", str(file), "--vehicle", "9", NEDBUS_LISTEN=endpoint, NEDBUS_VEHICLE="8")
    with nedbus.connect(endpoint, timeout=DEADLINE, prefix="fleet") as bus:
        wait_for(lambda: list(bus.vehicles()) == ["9"], what="vehicle 9")


def test_embedded_router_from_a_zenoh_file(tmp_path: Path, run_nedbus: Start) -> None:
    """The embedded router takes a file that zenohd reads too; a mistake in it is told with line and column."""
    endpoint = free_endpoint()
    file = tmp_path / "router.json5"
    file.write_text(f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }}, // a comment\n}}')
    run_nedbus("serve", "--router-config", str(file), "-s", "sim:")
    with until_connected(endpoint) as bus:
        wait_for(bus.latest, what="data")
    file.write_text('{\n  mode: "router",\n  lisen: {},\n}')
    service = run_nedbus("serve", "--router-config", str(file), "-s", "sim:")
    assert service.wait() == 2
    assert f"{file}, line 3, column 3: unknown field 'lisen', expected one of" in service.err


def test_status_tells_everything(run_nedbus: Start, raw: Session, endpoint: str) -> None:
    """Any Zenoh client can ask for the status: who, since when, where, and each source."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    found: list[dict[str, object]] = []

    def ask() -> bool:
        replies = raw.get("nedbus/@service/*/status")
        found[:] = [json.loads(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]
        return bool(found and found[0]["sources"]) and source_of(found[0])["published"] != 0

    wait_for(ask, what="a status with messages")
    assert {"service", "host", "version", "started", "now", "role", "endpoints", "refused", "sources"} == set(found[0])
    assert (found[0]["role"], found[0]["endpoints"]) == ("client", [endpoint])
    source = source_of(found[0])
    assert (source["source"], source["state"], source["rejected"], source["total"]) == ("sim:", "running", 0, None)
    assert source["addresses"] == [
        "1/vehicle_local_position",
        "1/vehicle_local_position_groundtruth",
        "1/external_ins_local_position",
        "1/estimator_local_position/0",
        "1/estimator_local_position/1",
    ]


def test_any_client_gets_the_last_value(run_nedbus: Start, raw: Session, endpoint: str) -> None:
    """A plain Zenoh get on a key or a wildcard is answered with the last payload of each key, stamped."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: len(list(raw.get("nedbus/**"))) == 5, what="five answers")
    [reply] = raw.get("nedbus/1/estimator_local_position/1")
    assert reply.ok is not None
    assert str(reply.ok.encoding) == "application/msgpack;px4_msgs/VehicleLocalPosition;source=sim"
    assert reply.ok.timestamp is not None
    assert msgpack.unpackb(reply.ok.payload.to_bytes())[0] == 1
    assert Address.from_key(str(reply.ok.key_expr)).instance == 1


def test_schema_is_on_the_network(run_nedbus: Start, raw: Session, endpoint: str) -> None:
    """Whoever reads can ask what the fields are."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    found: list[dict[str, object]] = []

    def ask() -> bool:
        found[:] = [
            json.loads(reply.ok.payload.to_bytes())
            for reply in raw.get("nedbus/@schema/VehicleLocalPosition")
            if reply.ok is not None
        ]
        return bool(found)

    wait_for(ask, what="the schema")
    layouts = found[0]["layouts"]
    assert isinstance(layouts, list)
    current = next(layout for layout in layouts if layout["wire"] == 1)
    assert [field["name"] for field in current["fields"]] == list(VehicleLocalPosition.model_fields)


def test_loop_of_one_message_does_not_spin(tmp_path: Path, run_nedbus: Start) -> None:
    """A lap takes a moment, however short the log is."""
    path = write_log(tmp_path / "a.ulg", [0])
    endpoint = free_endpoint()
    run_nedbus("serve", "-l", endpoint, "-s", f"ulog:{path}?loop=1")
    with until_connected(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        sent = [subscription.receive(DEADLINE).sent or 0 for _ in range(6)]
    assert sent[5] - sent[1] > 0.35e9


def test_second_service_of_a_vehicle_is_warned_of(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """Two services of one vehicle mix two flights: the second says so."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(bus.latest, what="the first service")
    second = run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: "is published by another process too" in second.err, what="the warning")


def test_failing_source_lets_go_of_its_addresses(tmp_path: Path, run_nedbus: Start) -> None:
    """A source that conflicts in one topic does not keep the others from a third."""
    writer = UlogWriter()
    writer.define([VLP, "external_ins_local_position"])
    writer.add(VLP, message(1))
    writer.add("external_ins_local_position", message(2))
    both = writer.write(tmp_path / "both.ulg")
    one = write_log(tmp_path / "one.ulg", [1], topic="external_ins_local_position", vz=7.0)
    ins = write_log(tmp_path / "vlp.ulg", range(0, 10**9, 10**6))
    endpoint = free_endpoint()
    sources = [f"ulog:{ins}", f"ulog:{both}?wait=1", f"ulog:{one}?wait=1"]
    run_nedbus("serve", "-l", endpoint, *(f"--source={source}" for source in sources))
    with until_connected(endpoint) as bus:
        wait_for(lambda: bus.latest(VLP), what="the first source, before the others start")
        with bus.subscribe("external_ins_local_position"):
            wait_for(
                lambda: [s.message.vz for s in bus.latest("external_ins_local_position")] == [7.0],
                what="the third source",
            )


def test_endpoints_replace_those_of_a_router_file(tmp_path: Path, run_nedbus: Start) -> None:
    """With a file the service is a router, which listens and joins where the flags say, as zenohd does."""
    file = tmp_path / "router.json5"
    file.write_text("{ mode: 'router', listen: { endpoints: ['tcp/127.0.0.1:1'] } }")
    endpoint, other = free_endpoint(), free_endpoint()
    run_nedbus("router", "--listen", other)
    flags = ["--router-config", str(file), "--listen", endpoint, "--connect", other]
    run_nedbus("serve", "-s", "sim:", *flags)
    for where in (endpoint, other):
        with until_connected(where) as bus:
            wait_for(bus.latest, what=f"a message at {where}")


def test_router_takes_endpoints_beside_its_file(tmp_path: Path, run_nedbus: Start) -> None:
    """The file says all but where: one file serves several routers of a network."""
    file = tmp_path / "router.json5"
    file.write_text("{ mode: 'router', listen: { endpoints: ['tcp/127.0.0.1:1'] } }")
    near, far = free_endpoint(), free_endpoint()
    run_nedbus("router", "--listen", near)
    run_nedbus("router", str(file), "--listen", far, "--connect", near)
    with until_connected(near) as writer, until_connected(far) as reader:
        writer.publisher(VLP, vehicle="1").publish(message(1))
        wait_for(reader.latest, what="the message behind the second router")


def test_health_is_that_of_this_host(run_nedbus: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """A healthy service exits with 0; none at all, and one with a source that fails, with 1 and the reason."""
    none = run_nedbus("health", "-c", endpoint)
    assert none.wait() == 1
    assert "no service of" in none.err
    service = run_nedbus("serve", "-c", endpoint, "-s", "sim:")
    wait_for(bus.latest, what="data")
    healthy = run_nedbus("health", NEDBUS_CONNECT=endpoint)
    assert healthy.wait() == 0, healthy.err
    assert healthy.out.startswith("1 services, 1 sources, ")
    service.kill()
    run_nedbus("serve", "-c", endpoint, "-s", "ulog:/gone.ulg", "-s", "sim:?vehicle=2")
    wait_for(lambda: "2" in bus.vehicles(), what="the second service")
    wait_for(lambda: "retrying" in str(bus.services()), what="its failure")
    failing = run_nedbus("health", "-c", endpoint)
    assert failing.wait() == 1
    assert "ulog:/gone.ulg is retrying: " in failing.err


@pytest.mark.parametrize("option", ["duration=inf", "duration=1e308", "speed=1e-300", "speed=nan", "seed=1&seed=2"])
def test_extreme_options_are_usage_errors(run_nedbus: Start, option: str) -> None:
    """No option ends in a traceback."""
    service = run_nedbus("serve", "-s", f"sim:?{option}")
    assert service.wait() == 2
    assert len(service.err.splitlines()) == 1
