"""Metrics, health, readiness and status over HTTP, of services and exporters as they run."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families
from prometheus_client.registry import Collector

import nedbus
from nedbus import StreamHealth
from nedbus.client import Health, Histogram
from nedbus.daemon import Daemon, SourceMeasures
from nedbus.daemon.status import SourceStatus, StreamStatus
from nedbus.errors import ConfigError, ListenError
from nedbus.monitoring import Exporter, HttpServer, Page, families, http_server, service_pages
from nedbus.monitoring.exposition import build_info, metrics_page
from nedbus.monitoring.families import MAX_STREAMS, Stream, stream_families
from nedbus.monitoring.service_metrics import _streams
from nedbus.settings import load_settings
from nedbus_msgs import VehicleLocalPosition, encode
from tests.conftest import DEADLINE, Process, Start, free_endpoint, free_port, message, wait_for
from tests.prometheus import start_promtool
from tests.ulogs import UlogWriter

VLP = "vehicle_local_position"
VALID = {
    **dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0),
    **dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), True),
}
# A service where the extra `metrics` is not installed.
WITHOUT_CLIENT = "import sys; sys.modules['prometheus_client'] = None; from nedbus.cli import main; main()"


class Pages:
    """What answers on a port of loopback."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.where = f"127.0.0.1:{port}"

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
        """Return the status and the content of an answer; (0, "") if there is none."""
        connection = http.client.HTTPConnection(self.where, timeout=DEADLINE)
        try:
            connection.request(method, path, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        except (ConnectionError, http.client.HTTPException):
            return 0, ""
        finally:
            connection.close()

    def families(self) -> dict[str, Metric]:
        """Return the metrics by name, as Prometheus's own client reads them."""
        status, text = self.ask("/metrics")
        return {each.name: each for each in text_string_to_metric_families(text)} if status == 200 else {}

    def values(self, name: str, **labels: str) -> list[float]:
        """Return the values of the series of a metric that have these labels."""
        return [
            sample.value
            for family in self.families().values()
            for sample in family.samples
            if sample.name == name and labels.items() <= sample.labels.items()
        ]


@pytest.fixture
def pages() -> Pages:
    return Pages(free_port())


@pytest.fixture
def serve(run_nedbus: Start, pages: Pages, endpoint: str) -> Callable[..., Process]:
    """Start a service of the router of this test that serves pages, and wait until it does."""

    def serve(*sources: str, connect: str = endpoint) -> Process:
        service = run_nedbus("serve", "-c", connect, "--http", pages.where, *[f"--source={text}" for text in sources])
        wait_for(lambda: pages.ask("/healthz")[0] == 200, what=f"the pages: {service.err}")
        return service

    return serve


@pytest.fixture
def export(run_nedbus: Start, pages: Pages, endpoint: str) -> Process:
    """Start an exporter, and wait until it serves pages."""
    exporter = run_nedbus("export", "-c", endpoint, "--http", pages.where)
    wait_for(lambda: pages.ask("/readyz")[0] == 200, what="the exporter")
    return exporter


Serve = Callable[..., Process]


def test_pages_of_a_service(serve: Serve, pages: Pages) -> None:
    """/metrics counts by vehicle, topic and source; /status is what `nedbus info` shows; the rest says one line."""
    serve("sim:?vehicle=7")
    of_stream = {"vehicle": "7", "topic": VLP, "source": "sim:?vehicle=7"}
    wait_for(lambda: pages.values("nedbus_stream_rate_hertz", **of_stream), what="a rate")
    assert pages.ask("/readyz") == (200, "ready\n")
    assert pages.ask("/healthz") == (200, "ok\n")
    status = json.loads(pages.ask("/status?any=query")[1])
    assert [source["source"] for source in status["sources"]] == ["sim:?vehicle=7"]
    (published,) = pages.values("nedbus_messages_published_total", **of_stream)
    assert published >= status["sources"][0]["streams"][0]["health"]["messages"] > 0
    assert pages.values("nedbus_streams") == [5]
    assert pages.values("nedbus_source_addresses") == [5]
    assert pages.values("nedbus_source_state", state="running") == [1]
    assert sum(pages.values("nedbus_source_state")) == 1
    assert pages.values("nedbus_source_rejected_total") == [0]
    assert pages.values("nedbus_sessions", role="client") == [1]
    assert pages.values("nedbus_publish_duration_seconds_count")[0] > 0
    assert pages.values("nedbus_stream_flag_ratio", **of_stream, flag="dead_reckoning") == [0]
    assert pages.families()["nedbus_build_info"].samples[0].labels["version"] == nedbus.__version__


def test_pages_of_an_exporter(export: Process, pages: Pages, bus: nedbus.Bus) -> None:
    """An exporter sees what is published, lost and invalid, and how long messages take."""
    session = bus._session
    publisher = session.declare_publisher(f"nedbus/7/{VLP}")
    numbers = [1, 2, 3, 6, 7]  # 4 and 5 were lost before they came to the router
    for number in numbers:
        info = zenoh.SourceInfo(publisher.id, number)
        stamp = session.new_timestamp()
        publisher.put(encode(message(10_000 * number, **VALID)), source_info=info, timestamp=stamp)
    session.put(f"nedbus/8/{VLP}", b"junk")
    of_stream = {"vehicle": "7", "topic": VLP}
    # The first message may be the last value that a subscription starts with: it does not count.
    received = "nedbus_messages_received_total"
    wait_for(lambda: pages.values(received, **of_stream) == [len(numbers) - 1], what="all that was sent")
    assert pages.values("nedbus_messages_lost_total", **of_stream) == [2]
    assert pages.values("nedbus_latency_seconds_count", **of_stream) == [len(numbers) - 1]
    assert 0 <= pages.values("nedbus_latency_seconds_sum", **of_stream)[0] < 60
    wait_for(lambda: pages.values("nedbus_messages_invalid_total") == [1], what="what is invalid")
    assert pages.values("nedbus_messages_dropped_total") == [0]
    assert pages.values("nedbus_connected") == [1]
    assert pages.ask("/healthz") == (200, "ok\n")
    status = json.loads(pages.ask("/status")[1])
    assert (status["connected"], status["invalid"]) == (True, 1)
    assert status["streams"][f"7/{VLP}"]["lost"] == 2
    assert not export.err.count("Traceback")


def test_metrics_pass_the_linter(serve: Serve, pages: Pages, start: Start, tmp_path: Path) -> None:
    """`promtool check metrics` finds nothing to say: names, units, types and help are as Prometheus wants them."""
    serve("sim:", f"mavlink:udpin:127.0.0.1:{free_port()}")
    text = tmp_path / "metrics"
    text.write_text(pages.ask("/metrics")[1])
    promtool = start_promtool(start, "check", "metrics", stdin=text)
    assert promtool.wait() == 0, promtool.err
    assert (promtool.out, promtool.err) == ("", "")


def test_rejections_are_counted_by_rule(serve: Serve, pages: Pages, tmp_path: Path) -> None:
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


def test_sources_that_are_configured_alike_are_told_apart(serve: Serve, pages: Pages) -> None:
    """The same source twice is a mistake, and yet no series occurs twice: Prometheus would take neither."""
    serve("sim:", "sim:")
    wait_for(lambda: len(pages.values("nedbus_source_rejected_total")) == 2, what="both sources")
    samples = [sample for family in pages.families().values() for sample in family.samples]
    series = [(sample.name, *sorted(sample.labels.items())) for sample in samples]
    assert len(set(series)) == len(series)
    assert len(pages.values("nedbus_source_state", source="sim: (2)")) == 6


def test_failing_source_is_not_ready(serve: Serve, pages: Pages, tmp_path: Path) -> None:
    """/readyz is 503 with the reason while a source cannot be read; the process is healthy all the same."""
    source = f"ulog:{tmp_path / 'missing.ulg'}"
    serve(source, "sim:")
    reason = f"{source}: retrying: {tmp_path / 'missing.ulg'}: no such file or directory\n"
    wait_for(lambda: pages.ask("/readyz") == (503, reason), what="the failure, and the other source")
    assert pages.ask("/healthz")[0] == 200


def test_silent_source_is_not_ready(serve: Serve, pages: Pages) -> None:
    """A live source from which nothing arrives is not ready; a replay that waits for a reader is."""
    source = f"mavlink:udpin:127.0.0.1:{free_port()}"
    serve(source, "sim:?wait=1")
    wait_for(lambda: pages.ask("/readyz") == (503, f"{source}: nothing arrives\n"), what="both to wait")
    assert sorted(pages.values("nedbus_source_addresses")) == [0, 5]
    assert pages.values("nedbus_source_state", state="waiting") == [1, 1]


def test_client_without_a_router_is_not_ready(serve: Serve, run_nedbus: Start, pages: Pages) -> None:
    """Before its router is there, after it has gone, and while it is there: 503, 503 and 200."""
    where = free_endpoint()
    serve("sim:", connect=where)
    assert pages.ask("/readyz") == (503, f"the service starts: {where}\n")
    assert pages.values("nedbus_sessions", role="client") == [0]
    router = run_nedbus("router", "-l", where)
    wait_for(lambda: pages.ask("/readyz") == (200, "ready\n"), what="the router")
    router.kill()
    wait_for(lambda: pages.ask("/readyz") == (503, f"no router answers at {where}\n"), what="its end")
    assert pages.values("nedbus_sessions", role="client") == [0]


def test_exporter_without_a_router_is_not_ready(run_nedbus: Start, pages: Pages) -> None:
    """An exporter that has lost its router says so."""
    where = free_endpoint()
    router = run_nedbus("router", "-l", where)
    run_nedbus("export", "--wait", "-c", where, "--http", pages.where)
    wait_for(lambda: pages.ask("/readyz") == (200, "ready\n"), what="the exporter")
    router.kill()
    wait_for(lambda: pages.ask("/readyz") == (503, f"no router answers at {where}\n"), what="the end of the router")
    assert pages.values("nedbus_connected") == [0]


def test_without_the_client_it_says_what_to_install(start: Start, pages: Pages, endpoint: str) -> None:
    """Without prometheus-client /metrics is 501 with what to install, and the other pages are as always."""
    start("-c", WITHOUT_CLIENT, "serve", "-c", endpoint, "-s", "sim:", "--http", pages.where)
    wait_for(lambda: pages.ask("/readyz")[0] == 200, what="the service")
    status, text = pages.ask("/metrics")
    assert status == 501
    assert re.fullmatch(r"prometheus_client: not installed: .*pip install .*\[metrics\]'\n", text)
    exporter = start("-c", WITHOUT_CLIENT, "export", "-c", endpoint, "--http", f"127.0.0.1:{free_port()}")
    assert exporter.wait() == 2
    assert exporter.err == f"nedbus: {text}"


@pytest.mark.parametrize("command", [("serve", "-s", "sim:"), ("export",)])
def test_taken_port_is_said(run_nedbus: Start, endpoint: str, command: tuple[str, ...]) -> None:
    """A port that another process has is one line, and exit code 1."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = f"127.0.0.1:{taken.getsockname()[1]}"
        process = run_nedbus(*command, "-c", endpoint, "--http", where)
        assert process.wait() == 1
    assert process.err.count("\n") == 1
    assert f"http://{where}" in process.err
    assert "choose another address with --http" in process.err


@pytest.mark.parametrize("command", [("serve", "-s", "sim:"), ("export",)])
@pytest.mark.parametrize("where", ["9464", "127.0.0.1:metrics", "127.0.0.1:65536", "::1:9464"])
def test_malformed_address_is_said(run_nedbus: Start, endpoint: str, command: tuple[str, ...], where: str) -> None:
    """An address that is none is one line that says how to write it, and exit code 2."""
    process = run_nedbus(*command, "-c", endpoint, "--http", where)
    assert process.wait() == 2
    assert process.err.count("\n") == 1
    assert f"'{where}' is not an address: write HOST:PORT, such as 127.0.0.1:9464" in process.err


def test_address_that_others_reach_is_warned_of(run_nedbus: Start, endpoint: str) -> None:
    """On loopback nobody else can read the pages; elsewhere the log says that others can."""
    port = free_port()
    service = run_nedbus("serve", "-c", endpoint, "-s", "sim:", "--http", f"0.0.0.0:{port}")
    wait_for(lambda: f"whoever reaches 0.0.0.0:{port} can read them" in service.err, what="the warning")
    other = run_nedbus("serve", "-c", endpoint, "-s", "sim:?vehicle=2", "--http", f"[::1]:{free_port()}")
    wait_for(lambda: "/healthz" in other.err or "::1" in other.err, what="the other")
    assert "whoever reaches" not in other.err


@pytest.fixture
def server() -> Iterator[Pages]:
    """Serve a page, one that fails, and one that waits until it is asked for 16 times at once."""

    def fail() -> Page:
        raise RuntimeError("a page that fails")

    together = threading.Barrier(16)

    def wait() -> Page:
        together.wait(DEADLINE)
        return Page.text("together")

    server = HttpServer("127.0.0.1:0", {"/page": lambda: Page.text("a page"), "/fails": fail, "/waits": wait})
    yield Pages(server.port)
    server.close()


def test_unknown_path_is_not_found(server: Pages, caplog: pytest.LogCaptureFixture) -> None:
    """404 says which pages there are, as / does; a page that fails is 500, goes to the log, and ends nothing."""
    assert server.ask("/other") == (404, "there is /page, /fails, /waits\n")
    assert server.ask("/")[0] == 200
    assert server.ask("/fails") == (500, "an unexpected error: the log has it\n")
    assert "a page that fails" in caplog.text
    assert server.ask("/page") == (200, "a page\n")


def test_nothing_can_be_changed(server: Pages) -> None:
    """Whatever is not GET or HEAD is refused; HEAD has the headers of GET, and no content."""
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "BREW"):
        assert server.ask("/page", method)[0] == 501, method
    assert server.ask("/page", "HEAD") == (200, "")
    connection = http.client.HTTPConnection(server.where, timeout=DEADLINE)
    connection.request("HEAD", "/page")
    answer = connection.getresponse()
    assert (answer.headers["Content-Length"], answer.headers["X-Content-Type-Options"]) == ("7", "nosniff")
    connection.close()


@pytest.mark.parametrize(
    ("host", "status", "elsewhere", "metrics"),
    [
        ("127.0.0.1:9464", 200, 200, 200),
        ("192.0.2.1", 200, 200, 200),  # of a forwarded port
        ("[::1]:9464", 200, 200, 200),
        ("[fe80::1]", 200, 200, 200),
        ("localhost:1234", 200, 200, 200),
        ("LocalHost.", 200, 200, 200),
        (f"{socket.gethostname()}:9464", 200, 200, 200),
        (f"{socket.getfqdn()}:9464", 200, 200, 200),
        ("vehicle-1:9464", 403, 200, 200),  # of a container
        ("evil.example:9464", 403, 403, 200),
        ("localhost.evil.example", 403, 403, 200),
        ("127.0.0.1.evil.example", 403, 403, 200),
        ("evil.example:9464@127.0.0.1", 403, 403, 200),
        ("[evil.example]", 403, 403, 200),
    ],
)
def test_foreign_names_get_nothing(host: str, status: int, elsewhere: int, metrics: int) -> None:
    """A page of somebody else whose name leads here cannot read the status, and on loopback nothing at all.

    Where other hosts may ask, a Prometheus and probes get metrics, health and readiness under any name.
    """
    content = {path: lambda: Page.text("content") for path in ("/metrics", "/healthz", "/readyz", "/status")}
    with closing(HttpServer("127.0.0.1:0", content)) as local, closing(HttpServer("0.0.0.0:0", content)) as public:
        for path in content:
            assert Pages(local.port).ask(path, Host=host)[0] == status, path
            assert Pages(public.port).ask(path, Host=host)[0] == (elsewhere if path == "/status" else metrics), path
        refused = "/status is answered under an address or a name of this host only\n"
        assert Pages(local.port).ask("/status", Host=host)[1] == ("content\n" if status == 200 else refused)


@pytest.mark.parametrize("sent", [b"", b"GET /page HTTP/1.0\r\nHost:"], ids=["silent", "half a request"])
def test_silent_clients_block_nobody(server: Pages, sent: bytes) -> None:
    """With 16 clients that send nothing, or half a request, the next one is answered, and the oldest has to go."""
    address = "127.0.0.1", server.port
    with ExitStack() as closing:
        silent = [closing.enter_context(socket.create_connection(address, DEADLINE)) for _ in range(16)]
        for client in silent:
            client.sendall(sent)
        for _ in range(20):
            assert server.ask("/page") == (200, "a page\n")
        assert silent[0].recv(1) == b""
        silent[-1].sendall(b"\r\n\r\n" if sent else b"GET /page HTTP/1.0\r\n\r\n")
        assert b"200 OK" in silent[-1].recv(1000)


@pytest.mark.parametrize(
    ("sent", "answer"),
    [
        (b"\x16\x03\x01 a TLS handshake\r\n\r\n", b"Error code: 400"),
        (b"GET\r\n\r\n", b"Error code: 400"),
        (b"GET /page HTTP/9.9\r\n\r\n", b"Error code: 505"),
        (b"GET /" + 70_000 * b"x" + b" HTTP/1.0\r\n\r\n", b"HTTP/1.0 414 "),
        (b"GET /page HTTP/1.0\r\n" + 200 * b"a: b\r\n" + b"\r\n", b"HTTP/1.0 431 "),
        (b"GET /page HTTP/1.0\r\na:" + 70_000 * b"x" + b"\r\n\r\n", b"HTTP/1.0 431 "),
        (b"GET /\xff\x00<script> HTTP/1.0\r\n\r\n", b"HTTP/1.0 404 "),
    ],
)
def test_bad_requests_are_refused(server: Pages, caplog: pytest.LogCaptureFixture, sent: bytes, answer: bytes) -> None:
    """Whatever is sent gets an answer, and no line in the log; the next client gets its page."""
    with socket.create_connection(("127.0.0.1", server.port), DEADLINE) as client:
        client.sendall(sent)
        assert answer in client.recv(10_000)
    assert server.ask("/page") == (200, "a page\n")
    assert not caplog.records


def test_clients_that_do_not_read_their_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 16 clients that read nothing of a large page, the next one is answered when their time is over."""
    monkeypatch.setattr(http_server, "_PATIENCE", 0.1)
    made = threading.Semaphore(0)

    def make() -> Page:
        made.release()
        return Page.text("x" * 20_000_000)  # more than the buffers of a connection hold

    server = HttpServer("127.0.0.1:0", {"/large": make, "/page": lambda: Page.text("a page")})
    with closing(server), ExitStack() as clients:
        for _ in range(16):
            client = clients.enter_context(socket.create_connection(("127.0.0.1", server.port), DEADLINE))
            client.sendall(b"GET /large HTTP/1.0\r\n\r\n")
            assert made.acquire(timeout=DEADLINE)
        wait_for(lambda: Pages(server.port).ask("/page") == (200, "a page\n"), what="the time of one to be over")


def test_more_clients_than_it_has_room_for(server: Pages) -> None:
    """While 16 are being answered no further one is; they get their answers, and then there is room again."""

    def wait() -> tuple[int, str]:
        """Ask until there is room: a client that has its answer may still count for a moment."""
        while (answer := server.ask("/waits")) == (0, ""):
            pass
        return answer

    with ThreadPoolExecutor(16) as pool:
        waiting = [pool.submit(wait) for _ in range(15)]
        while server.ask("/page")[0] == 0:  # the last of those 15 connects at the same time
            pass
        sixteenth = pool.submit(wait)
        assert {answer.result(DEADLINE) for answer in [*waiting, sixteenth]} == {(200, "together\n")}
    assert server.ask("/page") == (200, "a page\n")


def test_address_of_a_server_is_checked() -> None:
    """Whoever starts a server gets errors of ours."""
    with pytest.raises(ConfigError, match="write HOST:PORT"):
        HttpServer("localhost", {})
    with pytest.raises(ListenError, match="choose another address with --http"):
        HttpServer("192.0.2.1:0", {})


def streams(count: int) -> list[Stream]:
    """Return streams of two sources in turn, of three messages each."""
    found = []
    for number in range(count):
        health = StreamHealth(VLP)
        for each in range(3):
            health.add(message(each), received=each, lost=each)
        found.append(Stream(f"v{number}", VLP, f"source {number % 2}", health.snapshot(3)))
    return found


def test_number_of_streams_is_bounded() -> None:
    """Beyond 1,000 streams the counts of the rest are added up for each source, and nothing else of them is shown."""
    count = MAX_STREAMS + 201
    families = {each.name: each for each in stream_families(streams(count), messages=("nedbus_messages", "Messages"))}
    assert families["nedbus_streams"].samples[0].value == count
    messages = {tuple(sample.labels.values()): sample.value for sample in families["nedbus_messages"].samples}
    assert len(messages) == MAX_STREAMS + 2
    assert messages["other", "other", "source 0"] == 3 * 101
    assert messages["other", "other", "source 1"] == 3 * 100
    assert sum(messages.values()) == 3 * count
    assert sum(sample.value for sample in families["nedbus_messages_lost"].samples) == 3 * count
    assert len(families["nedbus_stream_age_seconds"].samples) == MAX_STREAMS


def test_text_is_that_of_the_official_client() -> None:
    """The page is to the byte what prometheus-client writes, also for sources with quotes and line breaks in them."""

    class Streams(Collector):
        def collect(self) -> Iterator[Metric]:
            strange = replace(streams(1)[0], source='ulog:a"b\\c\nd{}é', latencies=Histogram((0.001, 1.0)))
            yield build_info("1.0")
            yield from stream_families([*streams(3), strange], messages=("nedbus_messages", "Messages"))

    registry = CollectorRegistry()
    registry.register(Streams())
    expected = generate_latest(registry).decode()
    page = metrics_page(Streams())
    assert page.content.decode().partition("# HELP process_")[0] == expected
    assert page.content.decode().count("\n# TYPE process_") == 6


def test_stuck_source_is_not_healthy(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """/healthz is 503 when the loop of a source has not gone round for long: only a new start mends that."""
    pages = service_pages(Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0"))
    assert pages["/healthz"]() == Page.text("ok")
    monkeypatch.setattr(Daemon, "busy", 20.0)
    assert pages["/healthz"]() == Page.text("a source has been at one message for 20 s", status=503)


def ages(page: Page) -> set[str]:
    """Return the vehicles that have an age, on a page of metrics."""
    families = {each.name: each for each in text_string_to_metric_families(page.content.decode())}
    return {sample.labels["vehicle"] for sample in families["nedbus_stream_age_seconds"].samples}


def test_reader_that_fails_ends_the_exporter(bus: nedbus.Bus) -> None:
    """Pages that stand still would look like vehicles that are silent: the error is raised instead."""

    def fail(_: object) -> None:
        raise ArithmeticError

    exporter = Exporter(bus, nedbus.Selection(), version="0", watch=fail)
    bus.publisher(VLP, vehicle="1").publish(message(1))
    with pytest.raises(ArithmeticError):
        exporter.run(threading.Event())


def test_vehicle_that_was_switched_off_has_no_age(
    bus: nedbus.Bus, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who is silent for long, and has no liveliness token, keeps its counts and is not stale; it may come back."""
    exporter = Exporter(bus, nedbus.Selection(), version="0")
    stop = threading.Event()
    reading = threading.Thread(target=exporter.run, args=[stop])
    reading.start()
    try:
        with (
            nedbus.connect(endpoint) as other,
            other.publisher(VLP, vehicle="here") as here,
            other.publisher(VLP, vehicle="gone") as gone,
        ):
            for publisher in (here, gone):
                for number in (1, 2, 3):
                    publisher.publish(message(10_000 * number, **VALID))
            wait_for(lambda: ages(exporter.pages["/metrics"]()) == {"here", "gone"}, what="both")
            gone.close()
            wait_for(lambda: "gone" not in bus.vehicles(), what="the end of its token")
            assert ages(exporter.pages["/metrics"]()) == {"here", "gone"}
            monkeypatch.setattr(families, "SWITCHED_OFF", 0.0)
            assert ages(exporter.pages["/metrics"]()) == {"here"}
            counted = f'nedbus_messages_received_total{{source="",topic="{VLP}",vehicle="gone"}}'
            assert counted in exporter.pages["/metrics"]().content.decode()
            with other.publisher(VLP, vehicle="gone"):
                wait_for(lambda: ages(exporter.pages["/metrics"]()) == {"here", "gone"}, what="it to come back")
    finally:
        stop.set()
        reading.join()


def test_vehicle_of_a_service_that_was_switched_off_has_no_age(monkeypatch: pytest.MonkeyPatch) -> None:
    """A live source that has withdrawn a stream long ago has only its counts; one that is just stale has its age."""
    status = SourceStatus(
        "px4-zenoh:", "running", (f"on/{VLP}",), (f"off/{VLP}",), *(0, 0, {}, 0, 0, 0, None, 0, "", (), None, ())
    )
    health = streams(1)[0].health
    both = tuple(StreamStatus(f"{vehicle}/{VLP}", health) for vehicle in ("on", "off"))
    measures = SourceMeasures(status, both, Histogram((1.0,)))
    assert [stream.active for stream in _streams("px4-zenoh:", measures)] == [True, True]
    monkeypatch.setattr(families, "SWITCHED_OFF", 0.0)
    assert [stream.active for stream in _streams("px4-zenoh:", measures)] == [True, False]


def test_a_scrape_looks_at_each_stream_once(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page of a thousand streams is asked for every few seconds: nothing is computed twice for it."""
    daemon = Daemon(load_settings(source=("sim:",), connect=(endpoint,)), version="0")
    running = threading.Thread(target=daemon.run)
    running.start()
    try:
        wait_for(lambda: [len(source.streams) for source in daemon.measures] == [5], what="a message of each stream")
        looks: list[StreamHealth] = []
        original = StreamHealth.snapshot

        def look(stream: StreamHealth, now: int) -> Health:
            looks.append(stream)
            return original(stream, now)

        monkeypatch.setattr(StreamHealth, "snapshot", look)
        assert service_pages(daemon)["/metrics"]().status == 200
        assert len(looks) == len(set(looks)) == 5
    finally:
        daemon.stop()
        running.join()


def test_stream_that_has_ended_has_no_age() -> None:
    """A replay that has ended keeps its counts, and nothing that could look stale or invalid."""
    (stream,) = streams(1)
    families = {each.name: each for each in stream_families([replace(stream, active=False)], messages=("m", "M"))}
    assert families["m"].samples[0].value == 3
    assert families["nedbus_resets"].samples
    for name in ("nedbus_stream_age_seconds", "nedbus_stream_rate_hertz", "nedbus_stream_flag_ratio"):
        assert not families[name].samples, name


@pytest.mark.parametrize(
    ("counters", "resets"),
    [
        ((7, 7, 8, 8, 10), 3),
        ((254, 255, 0, 1), 3),
        ((5,), 0),
    ],
    ids=["rises", "wraps at 255", "began before"],
)
def test_resets_are_counted(counters: tuple[int, ...], resets: int) -> None:
    """A counter that rises has counted resets, across 255 too; what it counted before the first message is unknown."""
    health = StreamHealth(VLP)
    for number, counter in enumerate(counters):
        health.add(message(10_000_000 + number, z_reset_counter=counter, heading_reset_counter=9), received=number)
    counted = health.snapshot(0).resets
    assert (counted["z"], counted["heading"], counted["xy"]) == (resets, 0, 0)


def test_reboot_is_no_reset() -> None:
    """A reboot sets the counters to 0: that is a reboot, and no 252 resets; what comes after it counts."""
    health = StreamHealth(VLP)
    for time, counter in ((10_000_000, 3), (10_010_000, 4), (100, 0), (10_100, 1)):
        health.add(message(time, xy_reset_counter=counter), received=time)
    now = health.snapshot(0)
    assert (now.resets["xy"], now.reboots) == (2, 1)
