"""The service in a subprocess, with subscribers in other processes."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zenoh

import nedbus
from nedbus.daemon import Daemon, PlannedSource
from nedbus.daemon.output import SourceOutput
from nedbus.settings import load_settings
from nedbus.sources import SourceMessage
from nedbus.transport import Session, Uplinks, open_client, open_router
from nedbus.vehicle_events import EventLog
from nedbus_msgs import Address, Provenance, VehicleLocalPosition
from tests.flights.local_position import ENCODING, FIELD_TYPES, LAYOUTS, provenance_of, upgrade
from tests.flights.messages import VLP, message
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS, UlogWriter, write_log
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Process, Start
from tests.waits import DEADLINE, wait_for

Serve = Callable[..., tuple[Process, nedbus.Bus]]
connect = partial(nedbus.connect, timeout=DEADLINE)


@pytest.fixture
def serve(run_nedbus: Start) -> Iterator[Serve]:
    """Start services with given arguments, each with its own router, and connect to them."""
    with ExitStack() as closing:

        def start_service(*arguments: str, **options: str) -> tuple[Process, nedbus.Bus]:
            endpoint = free_endpoint()
            service = run_nedbus("serve", "-l", endpoint, *arguments, **options)
            wait_for(lambda: "router on" in service.err, what="the router")
            return service, closing.enter_context(connect(endpoint))

        yield start_service


def source_of(bus: nedbus.Bus, number: int = 0) -> nedbus.health.SourceStatus:
    """Return the status of a source, in the order of their vehicles; an empty status if it is not known yet."""
    # A source without a vehicle is in the status of each vehicle of its service; it comes last.
    found = {source.source: source for status in bus.services() for source in status.sources}
    sources = sorted(found.values(), key=lambda each: (not each.addresses, each.addresses))
    return sources[number] if number < len(sources) else nedbus.health.SourceStatus()


def has_state(bus: nedbus.Bus, state: str, number: int = 0) -> Callable[[], bool]:
    """Return a condition that is true while a source has this state."""
    return lambda: source_of(bus, number).state == state


def expected_rows(path: Path) -> dict[str, list[list[str]]]:
    """Return the local positions of a log by address, as read by `ulog:` (compared with pyulog in test_ulog.py)."""
    found: dict[str, list[list[str]]] = {}
    for each in open_replay(f"ulog:{path}?topics=VehicleLocalPosition").messages:
        found.setdefault(str(each.address), []).append(row_of(upgrade(each.fields)))
    return found


def row_of(message: VehicleLocalPosition) -> list[str]:
    """Return the values of a message as text, so that NaN equals NaN."""
    return [repr(value) for value in message.__dict__.values()]


def real_logs() -> list[Path]:
    return sorted(LOGS.glob("*.ulg")) or pytest.skip(f"no real logs in {LOGS}")


@pytest.mark.slow
@pytest.mark.logs
def test_plain_zenoh_reader_receives_every_message(run_nedbus: Start, endpoint: str) -> None:
    """A reader in any language, with Zenoh, msgpack and the documented keys, receives each message as an array."""
    path = next(log for log in real_logs() if "1.13" in log.name)
    config = zenoh.Config.from_json5(
        json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}})
    )
    with zenoh.open(config) as session:
        subscriber = session.declare_subscriber("nedbus/**", zenoh.handlers.RingChannel(2000))
        source = f"ulog:{path}?speed=max&wait=1&topics=VehicleLocalPosition"
        service = run_nedbus("serve", "-c", endpoint, "--until-done", "-s", source)
        samples = receive_samples(subscriber.handler, 1871)
        assert service.wait() == 0, service.err
    encodings = {str(sample.encoding) for sample in samples}
    missing = FIELD_TYPES.keys() - {*LAYOUTS["1.13"].fields, "hagl_max_z", "hagl_max_xy"}
    assert {encoding.split(";source=")[0] for encoding in encodings} == {ENCODING}
    assert {provenance_of(encoding) for encoding in encodings} == {
        Provenance("ulog", frozenset(missing))
    }
    received: dict[str, list[list[str]]] = {}
    for sample in samples:
        layout, *values = msgpack.unpackb(sample.payload.to_bytes(), use_list=False)
        assert (layout, len(values)) == (1, 53)
        received.setdefault(str(sample.key_expr).removeprefix("nedbus/"), []).append(
            [repr(value) for value in values]
        )
    assert received == expected_rows(path)


def receive_samples(handler: zenoh.Handler[zenoh.Sample], count: int) -> list[zenoh.Sample]:
    """Wait for a number of samples, and return them."""
    samples: list[zenoh.Sample] = []

    def are_received() -> bool:
        while (sample := handler.try_recv()) is not None:
            samples.append(sample)
        return len(samples) >= count

    wait_for(are_received, what=f"{count} samples")
    return samples


def test_message_without_a_timestamp_is_rejected(bus: nedbus.Bus) -> None:
    """A source's message without a timestamp is rejected; only a script's message gets the time of this host."""
    output = SourceOutput("px4", "px4-zenoh:", bus._publishers, time.monotonic, EventLog())
    output.publish_live(SourceMessage(0.0, Address("1", VLP), {"x": 1.0}))
    assert (output.published, output.rejected) == (0, 1)


@pytest.mark.slow
def test_replay_at_full_speed_is_lossless_for_a_slow_reader(tmp_path: Path, serve: Serve) -> None:
    """A replay at speed=max waits for readers; the service exits only once a slow reader has received everything."""
    total = 12_000
    path = write_log(tmp_path / "a.ulg", range(0, 1000 * total, 1000))
    service, bus = serve("--until-done", "-s", f"ulog:{path}?speed=max&wait=1")
    with bus.subscribe(mode="every") as subscription:
        last_while_running = 0
        for number in range(total):
            if number % 100 == 0:
                time.sleep(0.01)  # makes the reader slow
                last_while_running = number if service.popen.poll() is None else last_while_running
            sample = subscription.receive(DEADLINE)
            assert (sample.message.x, sample.lost) == (number, 0)
    assert last_while_running > total - 10_000, (
        "only messages in the reader's process may be unread at exit"
    )
    assert service.wait() == 0


@pytest.mark.slow
def test_replay_keeps_order_and_speed(tmp_path: Path, serve: Serve) -> None:
    """At speed=10 a flight of 4 s takes 0.36 s or more, and with wait=1 it starts with the first subscriber."""
    path = write_log(tmp_path / "a.ulg", range(0, 4_000_001, 100_000))
    service, bus = serve("--until-done", "-s", f"ulog:{path}?speed=10&wait=1")
    wait_for(has_state(bus, "waiting"), what="the service")
    assert source_of(bus).published == 0
    with bus.subscribe(mode="every") as subscription:
        samples = [subscription.receive(DEADLINE) for _ in range(41)]
    assert [sample.message.x for sample in samples] == list(range(41))
    assert (samples[-1].sent or 0) - (samples[0].sent or 0) > 0.36e9
    assert service.wait() == 0


@pytest.mark.slow
def test_replayed_messages_to_a_vehicle_have_their_own_source(serve: Serve) -> None:
    """Readers of a replayed bag see `mcap-input` as the source of /fmu/in/..., and `mcap` for all other topics."""
    path = Path(__file__).parents[2] / "data" / "fmu_in_topics.mcap"
    _, bus = serve("-s", f"mcap:{path}?topics=*&wait=1")
    with bus.subscribe("trajectory_setpoint") as inputs, bus.subscribe() as positions:
        assert inputs.receive(DEADLINE).source == "mcap-input"
        assert positions.receive(DEADLINE).source == "mcap"


@pytest.mark.slow
@pytest.mark.parametrize("locale", ["C.UTF-8", "C"])
def test_file_with_any_name_is_replayed(tmp_path: Path, serve: Serve, locale: str) -> None:
    """File names with ?, % or invalid UTF-8 are replayed and appear in the status, even in the C locale."""
    written = {
        "what%3F.ulg?": b"what?.ulg",
        "what?.ulg?": b"what?.ulg",
        "100%2525.ulg?": b"100%25.ulg",
        "a%20b.ulg?": b"a%20b.ulg",
        "Flüge.ulg?": "Flüge.ulg".encode(),
        os.fsdecode(b"Fl\xfcge.ulg?"): b"Fl\xfcge.ulg",
    }
    log = write_log(tmp_path / "a.ulg", [0, 1000])
    for name in written.values():
        Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name)).write_bytes(log.read_bytes())
    texts = [
        f"--source=ulog:{tmp_path}/{text}vehicle={number}" for number, text in enumerate(written)
    ]
    _, bus = serve(
        *texts, fresh=locale == "C", LC_ALL=locale, PYTHONUTF8="0", PYTHONCOERCECLOCALE="0"
    )
    for number in range(len(texts)):
        wait_for(has_state(bus, "done", number), what=texts[number])
        status = source_of(bus, number)
        assert status.published == 2
        assert status.source.startswith(f"ulog:{tmp_path}/")


@pytest.mark.slow
def test_ended_replay_loops_or_retains_its_last_message(tmp_path: Path, serve: Serve) -> None:
    """With loop=1 a replay starts again; without it, the service keeps replying with the last message of the replay."""
    path = write_log(tmp_path / "a.ulg", range(0, 100_000, 10_000))
    _, bus = serve("-s", f"ulog:{path}?loop=1&wait=1", "-s", f"ulog:{path}?vehicle=2&speed=max")
    wait_for(has_state(bus, "done", 1), what="the end of the replay")
    assert [sample.message.x for sample in bus.latest(vehicle="2")] == [9.0]
    assert bus.subscribe(vehicle="2").receive(DEADLINE).message.x == 9.0
    with bus.subscribe(vehicle="1", mode="every") as subscription:
        assert [subscription.receive(DEADLINE).message.x for _ in range(25)] == [
            *range(10),
            *range(10),
            *range(5),
        ]


@pytest.mark.slow
def test_invalid_message_is_rejected_counted_and_reported(
    tmp_path: Path, run_nedbus: Start, endpoint: str, zenoh_session: Session, bus: nedbus.Bus
) -> None:
    """An invalid message is not published, but reported with its reason on the rejection key, counted and logged."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in range(10):
        broken = number in {3, 4}
        writer.add(VLP, message(number), z_valid=int(broken), z=math.nan if broken else 1.0)
    path = writer.write(tmp_path / "a.ulg")
    listener = zenoh_session.declare_subscriber(
        "nedbus/@rejected/**", zenoh.handlers.RingChannel(10)
    )
    service = run_nedbus("serve", "-c", endpoint, "-s", f"ulog:{path}?wait=1")
    with bus.subscribe(VLP, mode="every") as subscription:
        received = [subscription.receive(DEADLINE).message.timestamp for _ in range(8)]
    assert received == [0, 1, 2, 5, 6, 7, 8, 9]
    report, _ = [
        json.loads(sample.payload.to_bytes()) for sample in receive_samples(listener.handler, 2)
    ]
    assert "z: must be finite while z_valid is true" in report["reason"]
    assert (report["fields"]["timestamp"], report["fields"]["z"]) == (3, "NaN")
    assert source_of(bus).rejected == 2
    assert "1/vehicle_local_position rejected: z: must be finite" in service.err


@pytest.mark.slow
def test_failing_source_does_not_affect_others(tmp_path: Path, serve: Serve) -> None:
    """A failed source is retried until it is readable, with its error in the status; other sources stay published."""
    missing = tmp_path / "later.ulg"
    service, bus = serve("-s", f"ulog:{missing}?vehicle=late", "-s", "sim:")
    wait_for(lambda: bus.latest(VLP, vehicle="1"), what="the other source")
    wait_for(has_state(bus, "retrying", 1), what="a retry")
    assert "no such file" in str(source_of(bus, 1).error)
    write_log(missing, [0, 1000])
    wait_for(lambda: bus.latest(VLP, vehicle="late"), what="the recovered source")
    assert service.popen.poll() is None


@pytest.mark.slow
def test_until_done_exits_with_1_after_a_failure(tmp_path: Path, run_nedbus: Start) -> None:
    """With --until-done an unreadable source causes exit code 1, after all other finite sources have ended."""
    good = f"ulog:{write_log(tmp_path / 'a.ulg', [0, 1000])}?speed=max"
    sources = ("-s", "sim:?vehicle=2", "-s", "ulog:/nowhere.ulg", "-s", good)
    service = run_nedbus("serve", "-l", free_endpoint(), "--until-done", *sources)
    assert service.wait() == 1
    assert "/nowhere.ulg: no such file or directory" in service.err
    assert "2 published" in service.err


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_signal_stops_the_service(
    tmp_path: Path, serve: Serve, number: signal.Signals, code: int
) -> None:
    """SIGTERM and SIGINT stop the service in any state of its sources, without a traceback or lost messages."""
    path = write_log(tmp_path / "a.ulg", range(0, 10_000_000, 10_000))
    sources = (
        "sim:",
        f"ulog:{path}?vehicle=2",
        f"ulog:{path}?vehicle=3&speed=max&loop=1",
        "ulog:/nowhere.ulg",
    )
    service, bus = serve(*(f"--source={source}" for source in sources), coverage=False)
    for index, state in enumerate(("running", "running", "running", "retrying")):
        wait_for(has_state(bus, state, index), what=sources[index])
    service.signal(number)
    assert service.wait() == code
    assert "Traceback" not in service.err
    assert "lost" not in service.err


@pytest.mark.slow
@pytest.mark.parametrize("has_own_router", [True, False])
def test_stopped_service_delivers_what_it_has_published(
    tmp_path: Path, run_nedbus: Start, serve: Serve, endpoint: str, has_own_router: bool
) -> None:
    """A reader receives each message that a service published before SIGTERM, in order, and learns of the end.

    The replay runs at full speed. In the end the reader has no link, if the router was the service's own one, or else
    no vehicle.
    """
    path = write_log(tmp_path / "a.ulg", range(0, 10_000_000, 1000))
    source = "-s", f"ulog:{path}?speed=max&wait=1"
    with ExitStack() as closing:
        if has_own_router:
            service, bus = serve(*source)
        else:
            service = run_nedbus("serve", "-c", endpoint, *source)
            bus = closing.enter_context(connect(endpoint))
        subscription = closing.enter_context(bus.subscribe(VLP, mode="every"))
        received = [subscription.receive(DEADLINE).message.timestamp for _ in range(1000)]
        published = source_of(bus).published
        service.signal(signal.SIGTERM)
        assert service.wait() == 0, service.err
        while len(received) < published:
            received.append(subscription.receive(DEADLINE).message.timestamp)
        if has_own_router:
            wait_for(lambda: not bus.connected, what="the end of the link")
        else:
            wait_for(lambda: not bus.vehicles(), what="the end of the vehicle")
        while subscription.waiting:
            received.append(subscription.receive(DEADLINE).message.timestamp)
        assert received == [1000 * number for number in range(len(received))]
        assert 1000 <= published <= len(received) < 10_000
        assert subscription.counts.lost == 0


@pytest.mark.slow
def test_signal_stops_a_replay_blocked_by_a_stuck_reader(tmp_path: Path, serve: Serve) -> None:
    """A stuck reader blocks a replay at full speed for up to ten minutes, but not the exit of the service."""
    path = write_log(tmp_path / "a.ulg", range(0, 1_000_000, 1000))
    service, bus = serve("-s", f"ulog:{path}?speed=max&loop=1&wait=1")
    with bus.subscribe(VLP, mode="every"):
        published: list[object] = [0]

        def is_blocked() -> bool:
            published.append(source_of(bus).published)
            return published[-1] == published[-2] != 0

        wait_for(is_blocked, what="the replay to block")
        service.signal(signal.SIGTERM)
        service.wait()


class SlowToOpen:
    """A source in a call that returns a moment after its session was closed, as some calls into Zenoh do."""

    def __init__(self) -> None:
        self.has_started = threading.Event()

    def listen(self, router: Session | None) -> Iterator[None]:
        assert router is not None
        self.has_started.set()
        with suppress(zenoh.ZError):
            while True:
                router.put("slow", b"")
        threading.Event().wait(0.2)
        yield None


def test_service_ends_after_the_threads_of_its_sources() -> None:
    """A source that is busy in Zenoh has ended when the service ends; otherwise it would abort the process."""
    daemon = Daemon(load_settings(source=("sim:",), listen=(free_endpoint(),)), version="0")
    source = SlowToOpen()
    daemon._plan = [PlannedSource(0, "slow:", "1", source)]
    thread = threading.Thread(target=daemon.run)
    thread.start()
    assert source.has_started.wait(10.0)
    daemon.stop()
    thread.join(20.0)
    assert not thread.is_alive()
    assert "slow:" not in {running.name for running in threading.enumerate()}


@pytest.mark.slow
def test_client_service_waits_for_its_router_and_reconnects(run_nedbus: Start) -> None:
    """With --connect a service waits for its router, reconnects after a router crash, and stops on a signal."""
    endpoint = free_endpoint()
    interrupted, service = (
        run_nedbus("serve", "--connect", endpoint, "-s", "sim:") for _ in range(2)
    )
    wait_for(lambda: "connecting to" in interrupted.err, what="the service to wait")
    interrupted.signal(signal.SIGTERM)
    assert interrupted.wait() == 0
    wait_for(lambda: "still trying" in service.err, what="the warning")
    router = run_nedbus("router", "--listen", endpoint)
    with connect(endpoint) as bus, bus.subscribe(VLP, mode="every") as subscription:
        samples = [subscription.receive(DEADLINE)]
        router.kill()
        wait_for(lambda: not bus.connected, what="the link to break")
        run_nedbus("router", "--listen", endpoint)
        wait_for(lambda: bus.connected, what="the link to recover")
        recovered = time.time_ns()
        while (samples[-1].sent or 0) < recovered:
            samples.append(subscription.receive(DEADLINE))
        first = samples[0].message.timestamp
        assert [each.message.timestamp for each in samples] == [
            first + 10_000 * step for step in range(len(samples))
        ]
        assert subscription.counts.lost == 0
    service.signal(signal.SIGTERM)
    assert service.wait() == 0


@pytest.mark.slow
def test_client_service_logs_the_origin_of_connect(
    run_nedbus: Start, endpoint: str, tmp_path: Path
) -> None:
    """A service that is a client because of NEDBUS_CONNECT or a file logs this, and how to run a router instead."""
    hint = "use --listen to run a router instead"
    file, here = tmp_path / "some.toml", free_endpoint()
    file.write_text(f'connect = "{endpoint}"')
    variable = {"NEDBUS_CONNECT": endpoint}
    services = {
        text: run_nedbus("serve", "-s", "ulog:/gone.ulg", *flags, **environment)
        for flags, environment, text in (
            ((), variable, f"connecting to a router at {endpoint}, set by NEDBUS_CONNECT; {hint}"),
            (
                ("--config", str(file)),
                {},
                f"connecting to a router at {endpoint}, set by {file}; {hint}",
            ),
            (("--connect", endpoint), {}, f"connecting to a router at {endpoint}\n"),
            (("--listen", here), variable, f"router on {here}, joining {endpoint}"),
        )
    }
    wait_for(
        lambda: all(text in service.err for text, service in services.items()),
        what=f"all of {[*services]}",
    )


def test_uplink_state_of_a_router_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """A router logs when its link to another router does not come up, is up, is lost, and recovers."""
    far, now = free_endpoint(), 0.0
    caplog.set_level("INFO", "nedbus")
    expected = [
        f"no link to {far}: still trying", f"the link to {far} is up after 3 s",
        f"the link to {far} is lost: reconnecting", f"the link to {far} is up after 12 s",
    ]  # fmt: skip
    session = open_router(listen=(free_endpoint(),), connect=(far,))
    uplinks = Uplinks(session, (far,), now=lambda: now)

    def has_logged(count: int) -> bool:
        uplinks.check()
        return caplog.messages == expected[:count]

    assert has_logged(0)
    now = 3.0
    assert has_logged(1)
    other = open_router(listen=(far,))
    wait_for(lambda: has_logged(2), what="the link")
    other.close()
    wait_for(lambda: has_logged(3), what="the loss")
    now += 12.0
    other = open_router(listen=(far,))
    wait_for(lambda: has_logged(4), what="the link to recover")
    other.close()
    session.close()


def test_uplink_state_of_a_client_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """A client logs once that its link is lost and once that it is up again, with endpoints and outage duration."""
    here, other, now = free_endpoint(), free_endpoint(), 0.0
    caplog.set_level("INFO", "nedbus")
    router = open_router(listen=(here,))
    with open_client([here, other], timeout=DEADLINE) as session:
        uplinks = Uplinks(session, (here, other), is_client=True, now=lambda: now)

        def has_logged(*lines: str) -> bool:
            uplinks.check()
            return caplog.messages == [f"the link to {here} or {other} is {line}" for line in lines]

        assert has_logged()
        router.close()
        wait_for(lambda: has_logged("lost: reconnecting"), what="the loss")
        now = 12.0
        router = open_router(listen=(here,))
        wait_for(
            lambda: has_logged("lost: reconnecting", "up after 12 s"), what="the link to recover"
        )
    router.close()


def test_unreachable_router_on_a_shared_port_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    """If routers share a port number, only the unreachable router is reported, even if endpoints have host names."""
    port, now = free_endpoint().rpartition(":")[2], 0.0
    live, dead, named = (f"tcp/{host}:{port}" for host in ("127.0.0.1", "127.0.0.2", "localhost"))
    router = open_router(listen=(live,))
    session = open_router(listen=(free_endpoint(),), connect=(live, dead))
    uplinks = Uplinks(session, (live, dead, named), now=lambda: now)

    def has_joined() -> bool:
        uplinks.check()
        return caplog.messages == [f"joined {live}", f"joined {named}"]

    caplog.set_level("INFO", "nedbus")
    wait_for(has_joined, what="the link")
    now = 3.0
    uplinks.check()
    assert caplog.messages[2:] == [f"no link to {dead}: still trying"]
    session.close()
    router.close()


@pytest.mark.slow
def test_port_in_use_is_an_error_with_remedy(run_nedbus: Start, endpoint: str) -> None:
    """If the port is in use, the error states the endpoint, the reason and two remedies."""
    service = run_nedbus("serve", "--listen", endpoint, "-s", "sim:")
    assert service.wait() == 1
    remedy = (
        "choose another endpoint with --listen, or join the router that runs there with --connect"
    )
    reason = f"nedbus: cannot listen on {endpoint} (address already in use)"
    assert service.err.strip().splitlines()[-1] == f"{reason}: {remedy}"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (
            "",
            "source: no source is given: use --source with sim:, ulog:FILE, px4-zenoh: or mavlink:LINK",
        ),
        ("-s foo:x", "source 'foo:x': unknown kind 'foo'; choose from sim, ulog"),
        ("-s a/b.ulg", "write ulog:a/b.ulg"),
        ("-s ulg:a/b.ulg", "unknown kind 'ulg'; write ulog:a/b.ulg"),
        ("-s ulog:", "source 'ulog:': the target is missing or not allowed; write ulog:FILE"),
        (
            "-s sim:x",
            "source 'sim:x': the target is missing or not allowed; write sim:?OPTION=VALUE",
        ),
        ("-s sim:?sed=1", "source 'sim:?sed=1': unknown option 'sed'"),
        ("-s sim:?seed=1&seed=2", "an option occurs twice; remove one"),
        ("-s sim:?speed=0", "speed=0 is invalid; expected a factor from 0.001"),
        ("-s sim:?speed=1e-300", "speed=1e-300 is invalid; expected a factor from 0.001"),
        ("-s sim:?speed=nan", "speed=nan is invalid; expected a factor from 0.001"),
        ("-s sim:?duration=inf", "duration=inf is invalid; expected seconds"),
        ("-s sim:?duration=1e308", "duration=1e308 is invalid; expected seconds"),
        ("-s sim:?vehicle=a/b", "vehicle=a/b is invalid; expected 1 to 64 characters of A-Z"),
        ("-s sim:?speed", "'speed' is not OPTION=VALUE"),
        ("-s ulog:a?b.ulg", "'b.ulg' is not OPTION=VALUE&OPTION=VALUE; in a path, write ? as %3F"),
        ("-s ulog:pipe", "pipe is not a regular file; save the data to a file first"),
        ("-s sim: --until-done", "until_done: no source ever ends"),
        ("-s sim: --listen 7447", "listen: '7447' is not an endpoint: write PROTOCOL/HOST:PORT"),
        ("-s sim: --config no.toml", "no.toml: there is no such file"),
        ("-s sim: --prefix a/*", "prefix: prefix 'a/*' is not valid"),
    ],
)
def test_invalid_option_is_a_usage_error(arguments: str, text: str) -> None:
    """With an invalid option, the service prints one line with the remedy and exits with 2, without a traceback."""
    os.mkfifo("pipe")  # opening it would block forever
    service = run_command("serve", *arguments.split())
    assert service.exit_code == 2
    assert text in service.err
    assert len(service.err.splitlines()) == 1


@pytest.mark.slow
def test_service_reads_its_settings_file(tmp_path: Path, run_nedbus: Start) -> None:
    """Sources, endpoint and prefix come from the file; flags override the environment, which overrides the file."""
    endpoint = free_endpoint()
    file = tmp_path / "nedbus.toml"
    file.write_text(
        'source = ["sim:"]\nlisten = ["tcp/127.0.0.1:1"]\nprefix = "fleet"\nvehicle = 7\n'
    )
    run_nedbus(
        "serve", "--config", str(file), "--vehicle", "9", NEDBUS_LISTEN=endpoint, NEDBUS_VEHICLE="8"
    )
    with connect(endpoint, prefix="fleet") as bus:
        wait_for(lambda: list(bus.vehicles()) == ["9"], what="vehicle 9")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["serve -s sim: --router-config", "router"])
def test_router_accepts_a_zenohd_file(tmp_path: Path, run_nedbus: Start, command: str) -> None:
    """A router reads a configuration file of zenohd, and its flags override the endpoints of the file, as in zenohd."""
    near, far = free_endpoint(), free_endpoint()
    file = tmp_path / "router.json5"
    file.write_text(f"{{ mode: 'router', listen: {{ endpoints: ['{near}'] }}, // a comment\n}}")
    run_nedbus(*command.split(), str(file))
    with connect(near) as writer:
        router = run_nedbus(
            *command.replace("sim:", "sim:?vehicle=2").split(), str(file), "-l", far, "-c", near
        )
        with connect(far) as reader:
            writer.publisher(VLP, vehicle="7").publish(message(1))
            vehicles = {"7", *(["1", "2"] if "sim:" in command else [])}
            wait_for(
                lambda: {sample.vehicle for sample in reader.latest()} == vehicles,
                what="second router",
            )
            wait_for(
                lambda: {sample.vehicle for sample in writer.latest()} == vehicles,
                what="first router",
            )
    wait_for(lambda: f"joined {near}" in router.err, what="the link")


def query_json(zenoh_session: Session, key: str) -> list[dict[str, Any]]:
    """Return the JSON replies to a plain Zenoh query."""
    return [json.loads(reply.ok.payload.to_bytes()) for reply in zenoh_session.get(key) if reply.ok]


@pytest.mark.slow
def test_plain_zenoh_can_query_status_and_messages(
    run_nedbus: Start, zenoh_session: Session, endpoint: str
) -> None:
    """A plain Zenoh client can query service status, schemas, and the last message of each key, with timestamp."""
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:?topics=VehicleLocalPosition")
    status_key = "nedbus/@service/*/*/status"
    wait_for(
        lambda: [
            s
            for each in query_json(zenoh_session, status_key)
            for s in each["sources"]
            if s["published"]
        ],
        what="messages",
    )
    [status] = query_json(zenoh_session, status_key)
    names = {
        "service",
        "vehicle",
        "host",
        "version",
        "started",
        "now",
        "role",
        "endpoints",
        "refused",
        "sources",
    }
    assert set(status) == names
    assert (status["role"], status["endpoints"]) == ("client", [endpoint])
    [source] = status["sources"]
    assert (source["source"], source["state"], source["rejected"], source["total"]) == (
        "sim:?topics=VehicleLocalPosition",
        "running",
        0,
        None,
    )
    topics = (
        VLP,
        f"{VLP}_groundtruth",
        "external_ins_local_position",
        *(f"estimator_local_position/{n}" for n in (0, 1)),
    )
    assert source["addresses"] == [f"1/{topic}" for topic in topics]
    layouts = query_json(zenoh_session, "nedbus/@schema/*/VehicleLocalPosition")[0]["layouts"]
    [current] = [layout for layout in layouts if layout["wire"] == 1]
    assert [field["name"] for field in current["fields"]] == list(VehicleLocalPosition.model_fields)

    wait_for(lambda: len(list(zenoh_session.get("nedbus/**"))) == 5, what="five replies")
    [reply] = zenoh_session.get("nedbus/1/estimator_local_position/1")
    assert reply.ok is not None
    assert str(reply.ok.encoding) == "application/msgpack;px4_msgs/VehicleLocalPosition;source=sim"
    assert reply.ok.timestamp is not None
    assert msgpack.unpackb(reply.ok.payload.to_bytes())[0] == 1
    assert str(reply.ok.key_expr) == "nedbus/1/estimator_local_position/1"


@pytest.mark.slow
def test_duplicate_vehicle_is_logged_and_reported(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """If two services publish one vehicle, both log it once, and every command reports it until one of them stops."""
    none = run_command("health", "-c", endpoint)
    assert none.exit_code == 1
    assert "no service of" in none.err
    first = run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(bus.latest, what="the first service")
    healthy = run_command("health", NEDBUS_CONNECT=endpoint)
    assert healthy.exit_code == 0, healthy.err
    assert healthy.out.startswith("1 service, 1 source, ")
    second = run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    warning = (
        "vehicle 1 is also published by another process: stop one, or give it another --vehicle"
    )
    for service in (first, second):
        wait_for(partial(lambda each: warning in each.err, service), what="the warning")
    assert bus.publishers()[Address("1", VLP)] == 2
    unhealthy = run_command("health", NEDBUS_CONNECT=endpoint)
    assert unhealthy.exit_code == 1
    assert (
        "vehicle 1 has several publishers: stop one, or give it another vehicle id" in unhealthy.err
    )
    measured = run_command("hz", "--duration", "2", "--json", VLP, NEDBUS_CONNECT=endpoint)
    assert '"state": "duplicate", "reason": "2 publishers: ' in measured.out
    assert f"1/{VLP}" in (listed := run_command("list", NEDBUS_CONNECT=endpoint).out)
    assert "duplicate: 2 publishers" in listed
    wait_for(
        lambda: [each.vehicles["1"].kinds[0] for each in bus.accounts()] == ["duplicate"] * 2,
        what="accounts",
    )
    explained = run_command("why", NEDBUS_CONNECT=endpoint).out
    assert explained.startswith(f"1: several publishers of {VLP}"), (
        "once, though both services report it"
    )
    assert "\n1: " not in explained
    assert "2 publishers of this address" in run_command("doctor", NEDBUS_CONNECT=endpoint).out
    second.signal(signal.SIGTERM)
    wait_for(lambda: bus.publishers()[Address("1", VLP)] == 1, what="the second service to stop")
    wait_for(lambda: run_command("health", NEDBUS_CONNECT=endpoint).exit_code == 0, what="health")
    assert [service.err.count(warning) for service in (first, second)] == [1, 1]
