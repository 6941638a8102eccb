"""Metrics, health, readiness and status over HTTP, of services and exporters as they run."""

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
from nedbus.events import Account, AccountReport, VehicleReport
from nedbus.health import SourceStatus, StreamHealth, StreamStatus
from nedbus.monitoring import Exporter, HttpServer, Page, service_pages
from nedbus.monitoring.metrics import MAX_STREAMS, MeasuredStream, metrics_page, stream_metrics
from nedbus.monitoring.pages import vehicles_page
from nedbus.settings import load_settings
from nedbus.timings import Timings
from nedbus.transport import Session
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

# A service where the extra `metrics` is not installed.
WITHOUT_CLIENT = "import sys; sys.modules['prometheus_client'] = None; from nedbus.cli import main; main()"
SERVE, EXPORT = ("serve", "-s", "sim:"), ("export",)
Serve = Callable[..., Process]


@pytest.fixture
def pages() -> HttpClient:
    return HttpClient(free_port())


@pytest.fixture
def serve(run_nedbus: Start, pages: HttpClient, endpoint: str) -> Serve:
    """Start a service of the router of this test that serves pages, and wait until it does."""

    def serve(*sources: str, connect: str = endpoint) -> Process:
        service = run_nedbus("serve", "-c", connect, "--http", pages.where, *[f"--source={text}" for text in sources])
        wait_for(lambda: pages.request("/healthz")[0] == 200, what=f"the pages: {service.err}")
        return service

    return serve


@contextmanager
def exporting(bus: nedbus.Bus) -> Iterator[HttpClient]:
    """Read as `nedbus export` does, and serve what was seen."""
    exporter, stop = Exporter(bus, nedbus.Selection(), version="0"), threading.Event()
    with ThreadPoolExecutor(1) as pool, closing(HttpServer("127.0.0.1:0", exporter.pages)) as server:
        reading = pool.submit(exporter.run, stop)
        try:
            yield HttpClient(server.port)
        finally:
            stop.set()
        reading.result(DEADLINE)


def test_pages_of_a_service(serve: Serve, pages: HttpClient) -> None:
    """/metrics counts by vehicle, topic and source; /status is what `nedbus info` shows; the rest says one line."""
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


def test_pages_of_an_exporter(
    bus: nedbus.Bus, zenoh_session: Session, timings: Timings, caplog: pytest.LogCaptureFixture
) -> None:
    """An exporter sees what is published, lost and invalid, and how long messages take."""
    timings.retransmit_timeout = 0.1  # no publisher caches what is missing
    publisher = zenoh_session.declare_publisher(f"nedbus/7/{VLP}")
    numbers = [1, 2, 3, 6, 7]  # 4 and 5 were lost before they came to the router
    of_stream = {"vehicle": "7", "topic": VLP}
    with exporting(bus) as pages:
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        for number in numbers:
            info, content = zenoh.SourceInfo(publisher.id, number), encode(message(10_000 * number, **VALID))
            publisher.put(content, source_info=info, timestamp=zenoh_session.new_timestamp())
        zenoh_session.put(f"nedbus/8/{VLP}", b"junk")
        received = "nedbus_messages_received_total"
        wait_for(lambda: pages.values(received, **of_stream) == [len(numbers)], what="all that was sent")
        assert pages.values("nedbus_messages_lost_total", **of_stream) == [2]
        assert pages.values("nedbus_latency_seconds_count", **of_stream) == [len(numbers)]
        assert 0 <= pages.values("nedbus_latency_seconds_sum", **of_stream)[0] < 60
        wait_for(lambda: pages.values("nedbus_messages_invalid_total") == [1], what="what is invalid")
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


def test_vehicles_page_of_a_service(serve: Serve, pages: HttpClient, tmp_path: Path) -> None:
    """/vehicles is 503 with a line for each vehicle that is bad; who is well has a line with 200.

    The peers are a real service in another process, and a replay of a log that this test writes.
    """
    times = range(100_000, 300_000_000, 100_000)
    well = write_log(tmp_path / "well.ulg", times, **VALID)
    serve(f"ulog:{well}?vehicle=7")
    wait_for(lambda: pages.values("nedbus_vehicle_state", vehicle="7", state="ok") == [1], what="the vehicle")
    assert pages.request("/vehicles") == (200, "7 ok\n")
    assert pages.values("nedbus_vehicle_condition") == []
    assert sum(pages.values("nedbus_vehicle_state", vehicle="7")) == 1


def test_vehicle_that_is_not_well(serve: Serve, pages: HttpClient, tmp_path: Path) -> None:
    """Conditions are told by /vehicles and by metrics; /healthz and /readyz are of the service, and stay 200.

    The peers are a real service in another process, and replays of logs that this test writes.
    """
    times = range(100_000, 300_000_000, 100_000)
    logs = {
        "lost": write_log(tmp_path / "lost.ulg", times, **{**VALID, "xy_valid": False, "dead_reckoning": True}),
        "doubtful": write_log(tmp_path / "doubtful.ulg", times, **{**VALID, "dead_reckoning": True}),
    }
    serve(*[f"ulog:{log}?vehicle={name}" for name, log in logs.items()])
    wait_for(lambda: len(pages.values("nedbus_vehicle_condition")) == 3, what="what holds")
    found = {
        (each.labels["vehicle"], each.labels["condition"])
        for each in pages.families()["nedbus_vehicle_condition"].samples
    }
    assert found == {("lost", "xy_invalid"), ("lost", "dead_reckoning"), ("doubtful", "dead_reckoning")}
    assert pages.values("nedbus_vehicle_state", vehicle="lost", state="bad") == [1]
    assert pages.values("nedbus_vehicle_state", vehicle="doubtful", state="watch") == [1]
    status, text = pages.request("/vehicles")
    assert status == 503
    assert re.fullmatch(r"vehicle lost: xy not valid, since [\d:.]+ UTC \(.*\)\n", text)
    assert (pages.request("/healthz"), pages.request("/readyz")) == ((200, "ok\n"), (200, "ready\n"))


def test_vehicles_of_an_exporter(bus: nedbus.Bus, zenoh_session: Session, endpoint: str) -> None:
    """An exporter judges what it reads by the same states, and counts events; a real publisher is the peer."""
    with nedbus.connect(endpoint) as reader, exporting(reader) as pages, ExitStack() as closing:
        wait_for_matching(zenoh_session, f"nedbus/7/{VLP}")
        position, state = bus.publisher(VLP, vehicle="7"), bus.publisher("vehicle_status", vehicle="7")
        numbers, failsafe = itertools.count(1), threading.Event()

        def publish() -> None:
            number = 20_000 * next(numbers)
            position.publish(message(number, **VALID))
            state.publish(VehicleStatus.model_validate({"timestamp": number, "failsafe": failsafe.is_set()}))

        closing.enter_context(repeating(publish))
        wait_for(lambda: pages.request("/vehicles") == (200, "7 ok\n"), what="the vehicle")
        (before,) = pages.values("nedbus_vehicle_events_total", vehicle="7", severity="bad")
        failsafe.set()
        wait_for(lambda: pages.request("/vehicles")[1].startswith("vehicle 7: failsafe, since "), what="failsafe")
        assert pages.values("nedbus_vehicle_condition", vehicle="7", condition="failsafe") == [1]
        assert pages.values("nedbus_vehicle_events_total", vehicle="7", severity="bad")[0] > before
        failsafe.clear()
        wait_for(lambda: pages.request("/vehicles") == (200, "7 ok\n"), what="its end")


def test_what_peers_say_is_one_line() -> None:
    """A reason quotes what somebody sent: it adds no line to /vehicles; no peer, as no source passes such a text on."""
    told = VehicleReport("watch", "rejected: \n8 ok\x1b[2J", 1.0, ("rejected",))
    page = vehicles_page(AccountReport("service", "host", 2.0, vehicles={"7": told}))
    assert page == Page.text("7 rejected:  8 ok [2J, since 00:00:01.0 UTC (1.0 s)")
    forgotten = VehicleReport("bad", "no position", 1.0, ("silent",))
    assert vehicles_page(AccountReport("service", "host", 5000.0, vehicles={"7": forgotten})).status == 200
    assert vehicles_page(AccountReport("service", "host", 50.0, vehicles={"7": forgotten})).status == 503
    assert vehicles_page(AccountReport("service", "host", 50.0, {})) == Page.text("no vehicle is known")


@pytest.mark.parametrize("every", [1, 3])
def test_flag_that_goes_to_and_fro_is_a_condition(every: int) -> None:
    """A scrape that meets a moment at which it is not set misses nothing, until it has settled; messages are made."""
    account, address = Account(), Address("7", VLP)
    for number in range(100):
        is_valid = number // every % 2 == 0
        account.add(address, message(20_000 * (number + 1), **{**VALID, "xy_valid": is_valid}), 0.02 * number)
        if number > 5 * every:
            assert account.state("7", 0.02 * number).text.startswith("xy not valid")
    account.update(10.0, {address: "ok"})
    assert account.state("7", 10.0).severity == ("info" if is_valid else "bad")


def test_metrics_pass_the_linter(serve: Serve, pages: HttpClient, start: Start, tmp_path: Path) -> None:
    """`promtool check metrics` finds nothing to say: names, units, types and help are as Prometheus wants them."""
    serve("sim:", f"mavlink:udpin:127.0.0.1:{free_port()}")
    text = tmp_path / "metrics"
    text.write_text(pages.request("/metrics")[1])
    promtool = start_promtool(start, "check", "metrics", stdin=text)
    assert (promtool.wait(), promtool.out, promtool.err) == (0, "", "")


def test_rejections_are_counted_by_rule(serve: Serve, pages: HttpClient, tmp_path: Path) -> None:
    """Each rule that messages of a source violate has a count; their sum is the count of the source."""
    log = tmp_path / "flight.ulg"
    writer = UlogWriter()
    writer.define([VLP])
    wrong: tuple[dict[str, object], ...] = ({}, {"eph": -1.0}, {"timestamp_sample": 9}, {"eph": -2.0})
    for number, fields in enumerate(wrong, 1):
        writer.add(VLP, VehicleLocalPosition.model_construct(**{**message(number).__dict__, **fields}))
    writer.write(log)
    source = f"ulog:{log}"
    serve(source)
    wait_for(lambda: pages.values("nedbus_source_rejected_total", source=source) == [3], what="the rejections")
    rejected = pages.families()["nedbus_messages_rejected"].samples
    rules = {"eph: must not be negative": 2, "timestamp_sample: must not be later than timestamp": 1}
    assert {sample.labels["rule"]: sample.value for sample in rejected} == rules
    assert pages.values("nedbus_messages_published_total") == [1]


def test_sources_that_are_configured_alike_are_told_apart(serve: Serve, pages: HttpClient) -> None:
    """The same source twice is a mistake, and yet no series occurs twice: Prometheus would take neither."""
    serve("sim:", "sim:")
    wait_for(lambda: len(pages.values("nedbus_source_rejected_total")) == 2, what="both sources")
    samples = [sample for family in pages.families().values() for sample in family.samples]
    series = [(sample.name, *sorted(sample.labels.items())) for sample in samples]
    assert len(set(series)) == len(series)
    assert len(pages.values("nedbus_source_state", source="sim: (2)")) == 6


def test_source_from_which_nothing_comes_is_not_ready(serve: Serve, pages: HttpClient, tmp_path: Path) -> None:
    """/readyz is 503 with a line for each source that cannot be read, and each live one that is silent.

    A replay that waits for a reader is ready; the process is healthy all the same.
    """
    missing, silent = f"ulog:{tmp_path / 'missing.ulg'}", f"mavlink:udpin:127.0.0.1:{free_port()}"
    serve(missing, silent, "sim:?wait=1")
    failed = f"{missing}: retrying: {tmp_path / 'missing.ulg'}: no such file or directory\n"
    wait_for(lambda: pages.request("/readyz") == (503, f"{failed}{silent}: nothing arrives\n"), what="all three")
    assert pages.request("/healthz")[0] == 200
    assert sorted(pages.values("nedbus_source_addresses")) == [0, 0, 12]
    assert pages.values("nedbus_source_state", state="waiting") == [0, 1, 1]


def test_without_a_router_is_not_ready(serve: Serve, run_nedbus: Start, pages: HttpClient) -> None:
    """Before its router is there, after it has gone, and while it is there: 503, 503 and 200; an exporter too."""
    where, exported = free_endpoint(), HttpClient(free_port())
    serve("sim:", connect=where)
    assert pages.request("/readyz") == (503, f"the service is starting: {where}\n")
    assert pages.values("nedbus_sessions", role="client") == [0]
    router = run_nedbus("router", "-l", where)
    run_nedbus("export", "--wait", "-c", where, "--http", exported.where)
    both = (pages, exported)
    wait_for(lambda: {each.request("/readyz") for each in both} == {(200, "ready\n")}, what="the router")
    router.kill()
    no_router = (503, f"no router answers at {where}\n")
    wait_for(lambda: {each.request("/readyz") for each in both} == {no_router}, what="its end")
    assert exported.request("/vehicles") == no_router  # it knows nothing of any
    assert pages.values("nedbus_sessions", role="client") == exported.values("nedbus_connected") == [0]


def test_without_the_client_it_says_what_to_install(start: Start, pages: HttpClient, endpoint: str) -> None:
    """Without prometheus-client /metrics is 501 with what to install, and the other pages are as always."""
    start("-c", WITHOUT_CLIENT, "serve", "-c", endpoint, "-s", "sim:", "--http", pages.where)
    wait_for(lambda: pages.request("/readyz")[0] == 200, what="the service")
    status, text = pages.request("/metrics")
    assert status == 501
    assert re.fullmatch(r"prometheus_client: not installed: .*pip install .*\[metrics\]'\n", text)
    exporter = start("-c", WITHOUT_CLIENT, "export", "-c", endpoint, "--http", f"127.0.0.1:{free_port()}")
    assert exporter.wait() == 2
    assert exporter.err == f"nedbus: {text}"


@pytest.mark.parametrize("command", [SERVE, EXPORT])
def test_taken_port_is_said(endpoint: str, command: tuple[str, ...]) -> None:
    """A port that another process has is one line, and exit code 1."""
    with socket.socket() as taken:  # not listening: so that whoever asks what it is need not wait for an answer
        taken.bind(("127.0.0.1", 0))
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        ended = run_command(*command, "-c", endpoint, "--http", where)
    assert (ended.exit_code, ended.err.count("\n")) == (1, 1)
    assert f"http://{where}" in ended.err
    assert "choose another address with --http" in ended.err


@pytest.mark.parametrize("command", [SERVE, EXPORT])
@pytest.mark.parametrize("where", ["9464", "127.0.0.1:metrics", "127.0.0.1:65536", "::1:9464"])
def test_malformed_address_is_said(endpoint: str, command: tuple[str, ...], where: str) -> None:
    """An address that is none is one line that says how to write it, and exit code 2."""
    ended = run_command(*command, "-c", endpoint, "--http", where)
    assert (ended.exit_code, ended.err.count("\n")) == (2, 1)
    assert f"'{where}' is not an address: write HOST:PORT, such as 127.0.0.1:9464" in ended.err


def test_address_that_others_reach_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """On loopback nobody else can read the pages; elsewhere the log says that others can."""
    for where, count in ((f"[::1]:{free_port()}", 0), (f"0.0.0.0:{free_port()}", 1)):
        with serve_pages(where, {}):
            assert caplog.text.count(f"no password protects {where}") == count


def streams(count: int, topic: str = VLP) -> list[MeasuredStream]:
    """Return streams of two sources in turn, of three messages each."""
    health = StreamHealth(topic)
    for each in range(3):
        health.add(message(each), received=each, lost=each)
    return [
        MeasuredStream((f"v{number}", topic, f"source {number % 2}"), health.snapshot(3)) for number in range(count)
    ]


def test_number_of_streams_is_bounded() -> None:
    """Beyond 1,000 streams the counts of the rest are added up for each source, and nothing else of them is shown."""
    count = MAX_STREAMS + 201
    families = {each.name: each for each in stream_metrics(streams(count), messages="nedbus_messages_received")}
    assert families["nedbus_streams"].samples[0].value == count
    messages = {tuple(sample.labels.values()): sample.value for sample in families["nedbus_messages_received"].samples}
    assert len(messages) == MAX_STREAMS + 2
    assert messages["other", "other", "source 0"] == 3 * 101
    assert messages["other", "other", "source 1"] == 3 * 100
    assert sum(messages.values()) == 3 * count
    assert sum(sample.value for sample in families["nedbus_messages_lost"].samples) == 3 * count
    assert len(families["nedbus_stream_age_seconds"].samples) == MAX_STREAMS


def test_positions_have_labels_before_others() -> None:
    """Alerts are about positions; of what has no rate there is no age, which an alert would take for silence."""
    many = [*streams(2, "home_position"), *streams(MAX_STREAMS, "battery_status"), *streams(3)]
    families = {each.name: each for each in stream_metrics(many, messages="nedbus_messages_received")}
    topics = Counter(sample.labels["topic"] for sample in families["nedbus_messages_received"].samples)
    assert topics == {VLP: 3, "home_position": 2, "battery_status": MAX_STREAMS - 5, "other": 2}
    ages = {sample.labels["topic"] for sample in families["nedbus_stream_age_seconds"].samples}
    assert ages == {VLP, "battery_status"}
    assert {sample.labels["topic"] for sample in families["nedbus_resets"].samples} == {VLP}


def test_labels_are_escaped() -> None:
    """A source with quotes and line breaks in it is one label, and the page has the metrics of the process."""
    source = 'ulog:a"b\\c\nd{}é'
    strange = replace(streams(1)[0], labels=("v0", VLP, source), latencies=Histogram((0.001, 1.0)))
    families = stream_metrics([*streams(3), strange], messages="nedbus_messages_received")
    text = metrics_page(families).content.decode()
    found = read_families(text)
    assert [each.labels["source"] for each in found["nedbus_messages_received"].samples][-1] == source
    assert [each.value for each in found["nedbus_latency_seconds"].samples] == [0, 0, 0, 0, 0]
    assert text.count("\n# TYPE process_") == 6


def test_stuck_source_is_not_healthy(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """/healthz is 503 when the loop of a source has not gone round for long: only a new start mends that."""
    pages = service_pages(Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0"))
    assert pages["/healthz"]() == Page.text("ok")
    monkeypatch.setattr(Daemon, "busy", 20.0)
    assert pages["/healthz"]() == Page.text("a source has been blocked on one message for 20 s", status=503)


def test_reader_that_fails_ends_the_exporter(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """HttpClient that stand still would look like vehicles that are silent: the error is raised instead."""

    def fail(_: object) -> None:
        raise ArithmeticError

    exporter = Exporter(bus, nedbus.Selection(), version="0")
    monkeypatch.setattr(exporter, "add", fail)
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with pytest.raises(ArithmeticError):
        exporter.run(threading.Event())


def test_vehicle_that_was_switched_off_has_no_age(bus: nedbus.Bus, endpoint: str, timings: Timings) -> None:
    """A stream silent for long, without a token, has no series any more; it may come back."""
    with (
        exporting(bus) as pages,
        nedbus.connect(endpoint) as other,
        other.publisher(VLP, vehicle="here") as here,
        other.publisher(VLP, vehicle="gone") as gone,
    ):

        def ages() -> set[str]:
            return {each.labels["vehicle"] for each in pages.families()["nedbus_stream_age_seconds"].samples}

        for publisher in (here, gone):
            for number in (1, 2, 3):
                publisher.publish(message(10_000 * number, **VALID))
        wait_for(lambda: ages() == {"here", "gone"}, what="both")
        gone.close()
        wait_for(lambda: "gone" not in bus.vehicles(), what="the end of its token")
        assert ages() == {"here", "gone"}
        timings.forgotten = 0.0
        wait_for(lambda: ages() == {"here"}, what="the next look")
        assert not pages.values("nedbus_messages_received_total", vehicle="gone", topic=VLP)
        with other.publisher(VLP, vehicle="gone") as back:
            for number in (4, 5, 6):
                back.publish(message(10_000 * number, **VALID))
            wait_for(lambda: ages() == {"here", "gone"}, what="it to come back")


@pytest.mark.parametrize(("state", "active"), [("running", {"on", "off"}), ("done", set())])
def test_stream_that_has_ended_has_no_age(monkeypatch: pytest.MonkeyPatch, state: State, active: set[str]) -> None:
    """A replay that has ended has only counts; a stale stream has its age."""
    health = streams(1)[0].health
    both = tuple(StreamStatus(f"{vehicle}/{VLP}", health) for vehicle in ("on", "off"))
    status = SourceStatus("px4-zenoh:", state, (f"on/{VLP}",), (f"off/{VLP}",), streams=both)
    monkeypatch.setattr(Daemon, "measures", [SourceMeasures(status, Histogram((1.0,)))])
    page = service_pages(Daemon(load_settings(source=("sim:",)), version="0"))["/metrics"]()
    found = read_families(page.content.decode())
    counts, of_now = ("messages_published", "resets"), ("age_seconds", "rate_hertz", "flag_ratio")
    expected = {name: {"on", "off"} for name in counts} | {f"stream_{name}": active for name in of_now}
    for name, vehicles in expected.items():
        assert {each.labels["vehicle"] for each in found[f"nedbus_{name}"].samples} == vehicles, name


def test_account_of_a_thousand_vehicles_with_faults_arrives(endpoint: str) -> None:
    """A reader gets every vehicle, its faults and their events, and the sources of a status of many megabytes."""
    daemon = Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    names = {f"vehicle-{number}" for number in range(999)}
    try:
        with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
            wait_for(bus.services, what="the service")
            for seconds, flags in enumerate(({}, {"xy_valid": False}, {"xy_valid": False, "z_valid": False})):
                for name in names:
                    sent = message((seconds + 1) * 10**6, **VALID | flags)
                    daemon.account.add(Address(name, VLP), sent, clock.steady())
            [account] = bus.accounts(within=60.0)
    finally:
        daemon.stop()
        running.join()
    assert account.vehicles.keys() >= names
    assert all({"xy_invalid", "z_invalid"} <= set(account.vehicles[name].kinds) for name in names)
    assert len(account.events) >= 1998


def test_a_scrape_looks_at_each_stream_once(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page of a thousand streams is asked for every few seconds: nothing is computed twice for it."""
    daemon = Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    try:
        wait_for(
            lambda: [len(source.status.streams) for source in daemon.measures] == [12], what="a message of each stream"
        )
        looks: list[StreamHealth] = []
        original = StreamHealth.snapshot

        def look(stream: StreamHealth, now: int) -> Health:
            looks.append(stream)
            return original(stream, now)

        monkeypatch.setattr(StreamHealth, "snapshot", look)
        assert service_pages(daemon)["/metrics"]().status == 200
        assert len(looks) == len(set(looks)) == 12
    finally:
        daemon.stop()
        running.join()
