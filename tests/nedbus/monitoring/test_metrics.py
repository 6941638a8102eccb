"""Metrics, health, readiness and status over HTTP from running services and exporters."""

from __future__ import annotations

import itertools
import json
import re
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

import nedbus
from nedbus import clock
from nedbus.cli.commands.bridges import serve_pages
from nedbus.client import Health, Histogram
from nedbus.daemon import Daemon, SourceMeasures
from nedbus.daemon.worker import State
from nedbus.health import SourceStatus, StreamHealth, StreamStatus
from nedbus.limits import EXPORTED_STREAMS as MAX_STREAMS
from nedbus.monitoring import Exporter, HttpServer, Page, service_pages
from nedbus.monitoring.metrics import MeasuredStream, metrics_page, stream_metrics
from nedbus.monitoring.pages import vehicles_page
from nedbus.settings import load_settings
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus.vehicle_events import AccountReport, EventLog, VehicleReport
from nedbus_msgs import Address, VehicleLocalPosition
from nedbus_msgs.messages import VehicleStatus
from tests.flights.local_position import encode
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import UlogWriter, write_log
from tests.peers.command_line import run_command
from tests.peers.http_client import HttpClient, read_families
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Process, Start
from tests.peers.prometheus import start_promtool
from tests.waits import DEADLINE, repeating, wait_for, wait_for_matching

# nedbus without the extra `metrics`.
WITHOUT_CLIENT = (
    "import sys; sys.modules['prometheus_client'] = None; from nedbus.cli import main; main()"
)
SERVE, EXPORT = ("serve", "-s", "sim:"), ("export",)
Serve = Callable[..., Process]


@pytest.fixture
def pages() -> HttpClient:
    return HttpClient(free_port())


@pytest.fixture
def serve(run_nedbus: Start, pages: HttpClient, endpoint: str) -> Serve:
    """Start services with HTTP pages at this test's router, and wait until they serve them."""

    def serve(*sources: str, connect: str = endpoint) -> Process:
        service = run_nedbus(
            "serve", "-c", connect, "--http", pages.where, *[f"--source={text}" for text in sources]
        )
        wait_for(lambda: pages.request("/healthz")[0] == 200, what=f"the pages: {service.err}")
        return service

    return serve


@contextmanager
def exporting(bus: nedbus.Bus) -> Iterator[HttpClient]:
    """Run an exporter as `nedbus export` does, and serve its pages."""
    exporter, stop = Exporter(bus, nedbus.Selection(), version="0"), threading.Event()
    with (
        ThreadPoolExecutor(1) as pool,
        closing(HttpServer("127.0.0.1:0", exporter.pages)) as server,
    ):
        reading = pool.submit(exporter.run, stop)
        try:
            yield HttpClient(server.port)
        finally:
            stop.set()
        reading.result(DEADLINE)


@pytest.mark.slow
def test_service_serves_metrics_health_and_status(serve: Serve, pages: HttpClient) -> None:
    """/metrics has series by vehicle, topic and source; /status returns JSON; /readyz and /healthz return one line."""
    serve("sim:?vehicle=7")
    of_stream = {"vehicle": "7", "topic": VLP, "source": "sim:?vehicle=7"}
    wait_for(lambda: pages.values("nedbus_stream_rate_hertz", **of_stream), what="a rate")
    assert pages.request("/readyz") == (200, "ready\n")
    assert pages.request("/healthz") == (200, "ok\n")
    status = json.loads(pages.request("/status?any=query")[1])
    assert [source["source"] for source in status["sources"]] == ["sim:?vehicle=7"]
    (published,) = pages.values("nedbus_messages_published_total", **of_stream)
    assert published >= status["sources"][0]["streams"][0]["health"]["messages"] > 0
    assert pages.values("nedbus_streams") == [12]
    assert pages.values("nedbus_source_addresses") == [12]
    assert pages.values("nedbus_source_state", state="running") == [1]
    assert sum(pages.values("nedbus_source_state")) == 1
    assert pages.values("nedbus_source_rejected_total") == [0]
    assert pages.values("nedbus_sessions", role="client") == [1]
    assert pages.values("nedbus_publish_duration_seconds_count")[0] > 0
    assert pages.values("nedbus_stream_flag_ratio", **of_stream, flag="dead_reckoning") == [0]
    assert pages.families()["nedbus_build_info"].samples[0].labels["version"] == nedbus.__version__


def test_exporter_measures_loss_latency_and_invalid_payloads(
    bus: nedbus.Bus, zenoh_session: Session, timings: Timings, caplog: pytest.LogCaptureFixture
) -> None:
    """An exporter counts received, lost and invalid messages, and measures latency."""
    timings.retransmit_timeout = 0.1  # no publisher can retransmit
    publisher = zenoh_session.declare_publisher(f"nedbus/7/{VLP}")
    numbers = [1, 2, 3, 6, 7]  # 4 and 5 are lost before the router
    of_stream = {"vehicle": "7", "topic": VLP}
    with exporting(bus) as pages:
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        for number in numbers:
            info, content = (
                zenoh.SourceInfo(publisher.id, number),
                encode(message(10_000 * number, **VALID)),
            )
            publisher.put(content, source_info=info, timestamp=zenoh_session.new_timestamp())
        zenoh_session.put(f"nedbus/8/{VLP}", b"junk")
        received = "nedbus_messages_received_total"
        wait_for(lambda: pages.values(received, **of_stream) == [len(numbers)], what="all messages")
        assert pages.values("nedbus_messages_lost_total", **of_stream) == [2]
        assert pages.values("nedbus_latency_seconds_count", **of_stream) == [len(numbers)]
        assert 0 <= pages.values("nedbus_latency_seconds_sum", **of_stream)[0] < 60
        wait_for(
            lambda: pages.values("nedbus_messages_invalid_total") == [1], what="the invalid payload"
        )
        assert (
            pages.values("nedbus_messages_dropped_total")
            == pages.values("nedbus_limit_reached_total", limit="keys")
            == [0]
        )
        assert pages.values("nedbus_connected") == [1]
        assert pages.request("/healthz") == (200, "ok\n")
        status = json.loads(pages.request("/status")[1])
    assert (status["connected"], status["invalid"]) == (True, 1)
    assert status["streams"][f"7/{VLP}"]["lost"] == 2
    assert "Traceback" not in caplog.text


@pytest.mark.slow
def test_healthy_vehicle_is_ok_on_vehicles_page(
    serve: Serve, pages: HttpClient, tmp_path: Path
) -> None:
    """/vehicles returns 200 with a line for each healthy vehicle, and no condition is exported."""
    times = range(100_000, 300_000_000, 100_000)
    well = write_log(tmp_path / "well.ulg", times, **VALID)
    serve(f"ulog:{well}?vehicle=7")
    wait_for(
        lambda: pages.values("nedbus_vehicle_state", vehicle="7", state="ok") == [1],
        what="the vehicle",
    )
    assert pages.request("/vehicles") == (200, "7 ok\n")
    assert pages.values("nedbus_vehicle_condition") == []
    assert sum(pages.values("nedbus_vehicle_state", vehicle="7")) == 1


@pytest.mark.slow
def test_bad_vehicle_returns_503_only_on_vehicles_page(
    serve: Serve, pages: HttpClient, tmp_path: Path
) -> None:
    """For a bad vehicle /vehicles returns 503 and a metric is exported; /healthz and /readyz still return 200."""
    times = range(100_000, 300_000_000, 100_000)
    logs = {
        "lost": write_log(
            tmp_path / "lost.ulg", times, **{**VALID, "xy_valid": False, "dead_reckoning": True}
        ),
        "doubtful": write_log(
            tmp_path / "doubtful.ulg", times, **{**VALID, "dead_reckoning": True}
        ),
    }
    serve(*[f"ulog:{log}?vehicle={name}" for name, log in logs.items()])
    wait_for(lambda: len(pages.values("nedbus_vehicle_condition")) == 3, what="the conditions")
    found = {
        (each.labels["vehicle"], each.labels["condition"])
        for each in pages.families()["nedbus_vehicle_condition"].samples
    }
    assert found == {
        ("lost", "xy_invalid"),
        ("lost", "dead_reckoning"),
        ("doubtful", "dead_reckoning"),
    }
    assert pages.values("nedbus_vehicle_state", vehicle="lost", state="bad") == [1]
    assert pages.values("nedbus_vehicle_state", vehicle="doubtful", state="watch") == [1]
    status, text = pages.request("/vehicles")
    assert status == 503
    assert re.fullmatch(r"vehicle lost: xy not valid, since [\d:.]+ UTC \(.*\)\n", text)
    assert (pages.request("/healthz"), pages.request("/readyz")) == (
        (200, "ok\n"),
        (200, "ready\n"),
    )


def test_exporter_reports_vehicle_states(
    bus: nedbus.Bus, zenoh_session: Session, endpoint: str
) -> None:
    """An exporter derives vehicle states and event counts from the messages that it receives."""
    with nedbus.connect(endpoint) as reader, exporting(reader) as pages, ExitStack() as closing:
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        position, state = (
            bus.publisher(VLP, vehicle="7"),
            bus.publisher("vehicle_status", vehicle="7"),
        )
        numbers, failsafe = itertools.count(1), threading.Event()

        def publish() -> None:
            number = 20_000 * next(numbers)
            position.publish(message(number, **VALID))
            state.publish(
                VehicleStatus.model_validate({"timestamp": number, "failsafe": failsafe.is_set()})
            )

        closing.enter_context(repeating(publish))
        wait_for(lambda: pages.request("/vehicles") == (200, "7 ok\n"), what="the vehicle")
        (before,) = pages.values("nedbus_vehicle_events_total", vehicle="7", severity="bad")
        failsafe.set()
        wait_for(
            lambda: pages.request("/vehicles")[1].startswith("vehicle 7: failsafe, since "),
            what="failsafe",
        )
        assert pages.values("nedbus_vehicle_condition", vehicle="7", condition="failsafe") == [1]
        assert pages.values("nedbus_vehicle_events_total", vehicle="7", severity="bad")[0] > before
        failsafe.clear()
        wait_for(
            lambda: pages.request("/vehicles") == (200, "7 ok\n"), what="the end of the failsafe"
        )


def test_text_from_peers_is_one_line_on_vehicles_page() -> None:
    """Line breaks and control characters in a rejection reason become spaces on /vehicles."""
    report = VehicleReport("watch", "rejected: \n8 ok\x1b[2J", 1.0, ("rejected",))
    page = vehicles_page(AccountReport("service", "host", 2.0, vehicles={"7": report}))
    assert page == Page.text("7 rejected:  8 ok [2J, since 00:00:01.0 UTC (1.0 s)")
    forgotten = VehicleReport("bad", "no position", 1.0, ("silent",))
    assert (
        vehicles_page(AccountReport("service", "host", 5000.0, vehicles={"7": forgotten})).status
        == 200
    )
    assert (
        vehicles_page(AccountReport("service", "host", 50.0, vehicles={"7": forgotten})).status
        == 503
    )
    assert vehicles_page(AccountReport("service", "host", 50.0, {})) == Page.text("no vehicles")


@pytest.mark.parametrize("every", [1, 3])
def test_flapping_flag_stays_a_condition(every: int) -> None:
    """While a flag flaps, its condition stays active, so that a scrape between two changes does not miss it."""
    event_log, address = EventLog(), Address("7", VLP)
    for number in range(100):
        is_valid = number // every % 2 == 0
        event_log.add(
            address,
            message(20_000 * (number + 1), **{**VALID, "xy_valid": is_valid}),
            0.02 * number,
        )
        if number > 5 * every:
            assert event_log.state("7", 0.02 * number).text.startswith("xy not valid")
    event_log.update(10.0, {address: "ok"})
    assert event_log.state("7", 10.0).severity == ("info" if is_valid else "bad")


@pytest.mark.slow
def test_metrics_pass_promtool_check(
    serve: Serve, pages: HttpClient, start: Start, tmp_path: Path
) -> None:
    """`promtool check metrics` accepts all names, units, types and help texts."""
    serve("sim:", f"mavlink:udpin:127.0.0.1:{free_port()}")
    text = tmp_path / "metrics"
    text.write_text(pages.request("/metrics")[1])
    promtool = start_promtool(start, "check", "metrics", stdin=text)
    assert (promtool.wait(), promtool.out, promtool.err) == (0, "", "")


@pytest.mark.slow
def test_rejections_are_counted_by_rule(serve: Serve, pages: HttpClient, tmp_path: Path) -> None:
    """Rejections are counted by violated rule, and the counts add up to the total of the source."""
    log = tmp_path / "flight.ulg"
    writer = UlogWriter()
    writer.define([VLP])
    wrong: tuple[dict[str, object], ...] = (
        {},
        {"eph": -1.0},
        {"timestamp_sample": 9},
        {"eph": -2.0},
    )
    for number, fields in enumerate(wrong, 1):
        writer.add(
            VLP, VehicleLocalPosition.model_construct(**{**message(number).__dict__, **fields})
        )
    writer.write(log)
    source = f"ulog:{log}"
    serve(source)
    wait_for(
        lambda: pages.values("nedbus_source_rejected_total", source=source) == [3],
        what="the rejections",
    )
    rejected = pages.families()["nedbus_messages_rejected"].samples
    rules = {
        "eph: must not be negative": 2,
        "timestamp_sample: must not be later than timestamp": 1,
    }
    assert {sample.labels["rule"]: sample.value for sample in rejected} == rules
    assert pages.values("nedbus_messages_published_total") == [1]


@pytest.mark.slow
def test_sources_with_equal_text_have_unique_series(serve: Serve, pages: HttpClient) -> None:
    """A source configured twice does not duplicate series, which Prometheus would reject."""
    serve("sim:", "sim:")
    wait_for(lambda: len(pages.values("nedbus_source_rejected_total")) == 2, what="both sources")
    samples = [sample for family in pages.families().values() for sample in family.samples]
    series = [(sample.name, *sorted(sample.labels.items())) for sample in samples]
    assert len(set(series)) == len(series)
    assert len(pages.values("nedbus_source_state", source="sim: (2)")) == 6


@pytest.mark.slow
def test_failed_or_silent_source_is_not_ready(
    serve: Serve, pages: HttpClient, tmp_path: Path
) -> None:
    """/readyz returns 503 with a line for each failed and each silent live source; /healthz still returns 200.

    A replay that waits for a reader is ready.
    """
    missing, silent = f"ulog:{tmp_path / 'missing.ulg'}", f"mavlink:udpin:127.0.0.1:{free_port()}"
    serve(missing, silent, "sim:?wait=1")
    failed = f"{missing}: retrying: {tmp_path / 'missing.ulg'}: no such file or directory\n"
    wait_for(
        lambda: pages.request("/readyz") == (503, f"{failed}{silent}: nothing arrives\n"),
        what="both sources",
    )
    assert pages.request("/healthz")[0] == 200
    assert sorted(pages.values("nedbus_source_addresses")) == [0, 0, 12]
    assert pages.values("nedbus_source_state", state="waiting") == [0, 1, 1]


@pytest.mark.slow
def test_service_and_exporter_without_router_are_not_ready(
    serve: Serve, run_nedbus: Start, pages: HttpClient
) -> None:
    """/readyz returns 503 before the router starts, 200 while it runs, and 503 after it has stopped."""
    where, exported = free_endpoint(), HttpClient(free_port())
    serve("sim:", connect=where)
    assert pages.request("/readyz") == (503, f"the service is waiting for a router at {where}\n")
    assert pages.values("nedbus_sessions", role="client") == [0]
    router = run_nedbus("router", "-l", where)
    run_nedbus("export", "--wait", "-c", where, "--http", exported.where)
    both = (pages, exported)
    wait_for(
        lambda: {each.request("/readyz") for each in both} == {(200, "ready\n")}, what="the router"
    )
    router.kill()
    no_router = (503, f"no router answers at {where}\n")
    wait_for(
        lambda: {each.request("/readyz") for each in both} == {no_router},
        what="the end of the router",
    )
    assert exported.request("/vehicles") == no_router
    assert (
        pages.values("nedbus_sessions", role="client") == exported.values("nedbus_connected") == [0]
    )


@pytest.mark.slow
def test_missing_prometheus_client_returns_501_with_install_hint(
    start: Start, pages: HttpClient, endpoint: str
) -> None:
    """Without prometheus-client, /metrics returns 501 and names the extra to install; the other pages work."""
    start("-c", WITHOUT_CLIENT, "serve", "-c", endpoint, "-s", "sim:", "--http", pages.where)
    wait_for(lambda: pages.request("/readyz")[0] == 200, what="the service")
    status, text = pages.request("/metrics")
    assert status == 501
    assert re.fullmatch(r"prometheus_client: not installed; .*pip install .*\[metrics\]'\n", text)
    exporter = start(
        "-c", WITHOUT_CLIENT, "export", "-c", endpoint, "--http", f"127.0.0.1:{free_port()}"
    )
    assert exporter.wait() == 2
    assert exporter.err == f"nedbus: {text}"


@pytest.mark.parametrize("command", [SERVE, EXPORT])
def test_port_in_use_is_a_one_line_error(endpoint: str, command: tuple[str, ...]) -> None:
    """A port in use by another process is a one-line error with exit code 1."""
    with socket.socket() as taken:  # not listening: a probe of the port must not wait for a reply
        taken.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        ended = run_command(*command, "-c", endpoint, "--http", where)
    assert (ended.exit_code, ended.err.count("\n")) == (1, 1)
    assert f"http://{where}" in ended.err
    assert "choose another address with --http" in ended.err


@pytest.mark.parametrize("command", [SERVE, EXPORT])
@pytest.mark.parametrize("where", ["9464", "127.0.0.1:metrics", "127.0.0.1:65536", "::1:9464"])
def test_malformed_http_address_is_a_one_line_error(
    endpoint: str, command: tuple[str, ...], where: str
) -> None:
    """A malformed address is a one-line error with the expected form and exit code 2."""
    ended = run_command(*command, "-c", endpoint, "--http", where)
    assert (ended.exit_code, ended.err.count("\n")) == (2, 1)
    assert f"'{where}' is not an address: write HOST:PORT, such as 127.0.0.1:9464" in ended.err


def test_public_http_address_logs_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    """An address other than loopback logs a warning that anyone on the network can read the pages."""
    for where, count in ((f"[::1]:{free_port()}", 0), (f"0.0.0.0:{free_port()}", 1)):
        with serve_pages(where, {}):
            assert caplog.text.count(f"{where} has no password") == count


def streams(count: int, topic: str = VLP) -> list[MeasuredStream]:
    """Return streams of three messages each, alternating between two sources."""
    health = StreamHealth(topic)
    for each in range(3):
        health.add(message(each), received=each, lost=each)
    return [
        MeasuredStream((f"v{number}", topic, f"source {number % 2}"), health.snapshot(3))
        for number in range(count)
    ]


def test_streams_beyond_limit_are_summed_by_source() -> None:
    """For streams beyond 1,000, only the sums of their counts per source are exported."""
    count = MAX_STREAMS + 201
    families = {
        each.name: each
        for each in stream_metrics(streams(count), messages="nedbus_messages_received")
    }
    assert families["nedbus_streams"].samples[0].value == count
    messages = {
        tuple(sample.labels.values()): sample.value
        for sample in families["nedbus_messages_received"].samples
    }
    assert len(messages) == MAX_STREAMS + 2
    assert messages["other", "other", "source 0"] == 3 * 101
    assert messages["other", "other", "source 1"] == 3 * 100
    assert sum(messages.values()) == 3 * count
    assert sum(sample.value for sample in families["nedbus_messages_lost"].samples) == 3 * count
    assert len(families["nedbus_stream_age_seconds"].samples) == MAX_STREAMS


def test_positions_are_exported_before_other_streams() -> None:
    """Positions keep their series when the limit is exceeded; streams without a nominal rate have no age."""
    many = [*streams(2, "home_position"), *streams(MAX_STREAMS, "battery_status"), *streams(3)]
    families = {
        each.name: each for each in stream_metrics(many, messages="nedbus_messages_received")
    }
    topics = Counter(
        sample.labels["topic"] for sample in families["nedbus_messages_received"].samples
    )
    assert topics == {VLP: 3, "home_position": 2, "battery_status": MAX_STREAMS - 5, "other": 2}
    ages = {sample.labels["topic"] for sample in families["nedbus_stream_age_seconds"].samples}
    assert ages == {VLP, "battery_status"}
    assert {sample.labels["topic"] for sample in families["nedbus_resets"].samples} == {VLP}


def test_labels_are_escaped() -> None:
    """Quotes and line breaks in a source are escaped in its label; the page also has process metrics."""
    source = 'ulog:a"b\\c\nd{}é'
    strange = replace(streams(1)[0], labels=("v0", VLP, source), latencies=Histogram((0.001, 1.0)))
    families = stream_metrics([*streams(3), strange], messages="nedbus_messages_received")
    text = metrics_page(families).content.decode()
    found = read_families(text)
    assert [each.labels["source"] for each in found["nedbus_messages_received"].samples][
        -1
    ] == source
    assert [each.value for each in found["nedbus_latency_seconds"].samples] == [0, 0, 0, 0, 0]
    assert text.count("\n# TYPE process_") == 6


def test_blocked_source_is_not_healthy(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """/healthz returns 503 when one message has blocked a source for 20 s, because only a restart helps."""
    pages = service_pages(Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0"))
    assert pages["/healthz"]() == Page.text("ok")
    monkeypatch.setattr(Daemon, "busy", 20.0)
    assert pages["/healthz"]() == Page.text(
        "a source has been blocked by one message for 20 s", status=503
    )


def test_failed_reader_ends_the_exporter(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """An error in the reading thread is raised, because stale pages would look like silent vehicles."""

    def fail(_: object) -> None:
        raise ArithmeticError

    exporter = Exporter(bus, nedbus.Selection(), version="0")
    monkeypatch.setattr(exporter, "add", fail)
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with pytest.raises(ArithmeticError):
        exporter.run(threading.Event())


def test_forgotten_stream_has_no_series(bus: nedbus.Bus, endpoint: str, timings: Timings) -> None:
    """A silent stream without a liveliness token loses its series, and regains them when it resumes."""
    with (
        exporting(bus) as pages,
        nedbus.connect(endpoint) as other,
        other.publisher(VLP, vehicle="here") as here,
        other.publisher(VLP, vehicle="gone") as gone,
    ):

        def ages() -> set[str]:
            return {
                each.labels["vehicle"]
                for each in pages.families()["nedbus_stream_age_seconds"].samples
            }

        for publisher in (here, gone):
            for number in (1, 2, 3):
                publisher.publish(message(10_000 * number, **VALID))
        wait_for(lambda: ages() == {"here", "gone"}, what="both")
        gone.close()
        wait_for(lambda: "gone" not in bus.vehicles(), what="the end of its token")
        assert ages() == {"here", "gone"}
        usual, timings.forgotten = timings.forgotten, 0.0
        wait_for(lambda: ages() == {"here"}, what="the next poll")
        timings.forgotten = usual  # else a poll may forget the stream before its new token arrives
        assert not pages.values("nedbus_messages_received_total", vehicle="gone", topic=VLP)
        with other.publisher(VLP, vehicle="gone") as back:
            for number in (4, 5, 6):
                back.publish(message(10_000 * number, **VALID))
            wait_for(lambda: ages() == {"here", "gone"}, what="the stream to resume")


@pytest.mark.parametrize(("state", "active"), [("running", {"on", "off"}), ("done", set())])
def test_ended_stream_has_no_age(
    monkeypatch: pytest.MonkeyPatch, state: State, active: set[str]
) -> None:
    """Streams of a replay that has ended have only counts; stale streams also have an age."""
    health = streams(1)[0].health
    both = tuple(StreamStatus(f"{vehicle}/{VLP}", health) for vehicle in ("on", "off"))
    status = SourceStatus("px4-zenoh:", state, (f"on/{VLP}",), (f"off/{VLP}",), streams=both)
    monkeypatch.setattr(Daemon, "measures", [SourceMeasures(status, Histogram((1.0,)))])
    page = service_pages(Daemon(load_settings(source=("sim:",)), version="0"))["/metrics"]()
    found = read_families(page.content.decode())
    counts, of_now = ("messages_published", "resets"), ("age_seconds", "rate_hertz", "flag_ratio")
    expected = {name: {"on", "off"} for name in counts} | {
        f"stream_{name}": active for name in of_now
    }
    for name, vehicles in expected.items():
        assert {each.labels["vehicle"] for each in found[f"nedbus_{name}"].samples} == vehicles, (
            name
        )


@pytest.mark.long
def test_report_of_950_vehicles_is_complete(endpoint: str) -> None:
    """A report of many megabytes arrives with every vehicle, its faults and their events.

    Two events of each vehicle leave room in the log of 2,000 for those of the simulated vehicle and of the host's load.
    """
    daemon = Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    names = {f"vehicle-{number}" for number in range(950)}
    try:
        with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
            wait_for(bus.services, what="the service")
            for seconds, flags in enumerate(
                ({}, {"xy_valid": False}, {"xy_valid": False, "z_valid": False})
            ):
                for name in names:
                    sent = message((seconds + 1) * 10**6, **VALID | flags)
                    daemon.event_log.add(Address(name, VLP), sent, clock.steady())
            reports: list[AccountReport] = []  # one of each vehicle

            def is_complete() -> bool:
                reports[:] = bus.accounts(within=60.0, timeout=DEADLINE)
                return {name for report in reports for name in report.vehicles} >= names

            wait_for(is_complete, what="the reports of all vehicles")
    finally:
        daemon.stop()
        running.join()
    vehicles = {name: vehicle for report in reports for name, vehicle in report.vehicles.items()}
    assert all({"xy_invalid", "z_invalid"} <= set(vehicles[name].kinds) for name in names)
    assert sum(len(report.events) for report in reports) >= 1900


def test_scrape_takes_one_snapshot_per_stream(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scrape computes the health of each stream once, because a page may list a thousand streams."""
    daemon = Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    try:
        wait_for(
            lambda: [len(source.status.streams) for source in daemon.measures] == [12],
            what="a message of each stream",
        )
        snapshots: list[StreamHealth] = []
        original = StreamHealth.snapshot

        def count_snapshot(stream: StreamHealth, now: int) -> Health:
            snapshots.append(stream)
            return original(stream, now)

        monkeypatch.setattr(StreamHealth, "snapshot", count_snapshot)
        assert service_pages(daemon)["/metrics"]().status == 200
        assert len(snapshots) == len(set(snapshots)) == 12
    finally:
        daemon.stop()
        running.join()
