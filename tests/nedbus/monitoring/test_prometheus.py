"""A real Prometheus scrapes real services and evaluates the packaged rules: each alert fires and clears."""

from __future__ import annotations

import json
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import count
from pathlib import Path

import pytest
import zenoh

import nedbus
from nedbus.pki import make_authority, make_certificate, write_access_rules
from nedbus.transport import Session
from nedbus_msgs.arrays import to_array
from nedbus_msgs.messages import VehicleStatus
from tests.flights.local_position import encode
from tests.flights.messages import VALID, VLP, message
from tests.flights.ulogs import write_log
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Process, Start
from tests.peers.prometheus import ALERTS, PACKAGING, Prometheus, start_promtool
from tests.waits import repeating, wait_for

PEER = str(Path(__file__).parents[1] / "sources" / "mavlink" / "mavlink_peer.py")
ROW = {
    "x": 1.5, "y": -2.25, "z": -10.0, "vx": 0.5, "vy": -0.25, "vz": 0.125, "heading": -1.0, "eph": 0.5, "epv": 0.75,
    "ref_lat": 47.3977418, "ref_lon": 8.5455939, "ref_alt": 487.957, "dist_bottom": 10.5,
}  # fmt: skip
TIMEOUT = 90.0  # s until all alerts have fired, or cleared
# nedbus with timeouts of one second for retransmission and backoff, and queues of 100 instead of 65,536 messages, which
# a small burst overflows.
SHORT_TIMEOUTS = """
import nedbus.limits
from nedbus.cli import main
from nedbus.timings import TIMINGS
nedbus.limits.UNREAD_MESSAGES = 100
TIMINGS.retransmit_timeout, TIMINGS.backoff = 1.0, (1.0,)
main()
"""


@contextmanager
def traffic(bus: nedbus.Bus, zenoh_session: Session, udp_port: int) -> Iterator[threading.Event]:
    """Publish at 50 Hz; yield an event that makes everything fail while it is set.

    While it is set, vehicle "gone" is silent, "lost" skips every other sequence number, "doubtful" reports an invalid
    position, dead reckoning and failsafe, "many" sends bursts, and junk is sent to a key and to a MAVLink port.
    """
    bad = threading.Event()
    gone, doubtful, many = (
        bus.publisher(VLP, vehicle=name) for name in ("gone", "doubtful", "many")
    )
    status = bus.publisher("vehicle_status", vehicle="doubtful")
    junk, numbered = (
        zenoh_session.declare_publisher(f"nedbus/{name}/{VLP}") for name in ("junk", "lost")
    )
    burst = to_array([message(number, **VALID) for number in range(1, 401)])
    numbers = count(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:

        def send() -> None:
            is_bad = bad.is_set()
            if is_bad:
                next(numbers)
            number = next(numbers)
            now = message(20_000 * number, **VALID)
            doubtful.publish(
                message(
                    20_000 * number,
                    **{
                        **VALID,
                        **dict.fromkeys(("xy_valid", "z_valid"), not is_bad),
                        "dead_reckoning": is_bad,
                    },
                )
            )
            status.publish(
                VehicleStatus.model_validate({"timestamp": 20_000 * number, "failsafe": is_bad})
            )
            numbered.put(encode(now), source_info=zenoh.SourceInfo(numbered.id, number))
            burst["timestamp"] += 20_000
            many.publish_many(burst if is_bad else burst[:1])
            if is_bad:
                junk.put(b"junk")
                with suppress(ConnectionError):
                    stranger.sendto(b"\xfd junk", ("127.0.0.1", udp_port))
            else:
                gone.publish(now)

        with repeating(send):
            yield bad


def shorten(rules: str) -> str:
    """Shorten all `for` times to 1 s, and all ranges to 10 s."""
    return re.sub(r"\[\dm\]", "[10s]", re.sub(r"for: \d+[sm]", "for: 1s", rules))


@pytest.mark.long
@pytest.mark.timeout(300)
def test_every_alert_fires_and_clears(
    start: Start, run_nedbus: Start, bus: nedbus.Bus, zenoh_session: Session, tmp_path: Path
) -> None:
    """Each alert fires for its cause, names the cause in its labels, and clears when the cause ends.

    All causes are present at the same time; the packaged rules have shortened times.
    """
    rules, (endpoint,) = shorten(ALERTS.read_text()), bus.routers
    silent, lossy = free_port(), free_port()
    second, missing = free_endpoint(), tmp_path / "flight.ulg"
    addresses = [f"127.0.0.1:{free_port()}" for _ in range(8)]
    service, exporter, lonely, lonely_exporter, ended, full, full_exporter, refused = addresses
    values = tmp_path / "values.json"
    values.write_text(json.dumps([ROW]))

    def fly(port: int, *options: str) -> Process:
        return start(PEER, "--to", f"127.0.0.1:{port}", "--values", str(values), *options)

    route = partial(run_nedbus, "router", "-l", second)
    export_ended = partial(
        run_nedbus, "export", "-c", endpoint, "--vehicle", "gone", "--http", ended
    )
    sources = {
        "silent": f"mavlink:udpin:127.0.0.1:{silent}?vehicles=1:silent",
        "lossy": f"mavlink:udpin:127.0.0.1:{lossy}?vehicles=1:lossy",
        "missing": f"ulog:{missing}?vehicle=missing&loop=1",
    }
    start("-c", SHORT_TIMEOUTS, "export", "-c", endpoint, "--http", exporter)
    router = route()
    run_nedbus("serve", "-c", second, "--http", lonely, "-s", "sim:?speed=0.3&vehicle=lonely")
    run_nedbus("export", "--wait", "-c", second, "--http", lonely_exporter)
    to_end = export_ended()
    small = start_small_router(run_nedbus, tmp_path, full, full_exporter)
    restore_rules = refuse_vehicle(run_nedbus, tmp_path, refused)
    vehicle = fly(lossy, "--drop", "0.3")
    start(
        "-c",
        SHORT_TIMEOUTS,
        "serve",
        "-c",
        endpoint,
        "--http",
        service,
        *[f"--source={text}" for text in sources.values()],
    )
    prometheus = Prometheus(start, tmp_path, rules, {"nedbus": addresses})
    wait_for(
        lambda: len(prometheus.query("up == 1")) == 8,
        what="all eight to be scraped",
        seconds=TIMEOUT,
    )

    expected: dict[str, list[dict[str, str]]] = {
        "NedbusDown": [{"instance": ended}],
        "NedbusNoRouter": [{"instance": lonely}, {"instance": lonely_exporter}],
        "NedbusVehicleRefused": [{"vehicle": "2", "instance": refused}],
        "NedbusRouterFull": [{"instance": full, "role": "router"}, {"instance": full_exporter}],
        "NedbusSourceDown": [{"source": sources["missing"], "state": "retrying"}],
        "NedbusSourceSilent": [{"source": sources["silent"]}],
        "NedbusStreamStale": [{"vehicle": "gone", "topic": VLP, "instance": exporter}],
        "NedbusPositionInvalid": [
            {"vehicle": "doubtful", "condition": kind} for kind in ("xy_invalid", "z_invalid")
        ],
        "NedbusDeadReckoning": [{"vehicle": "doubtful"}],
        "NedbusVehicleFailsafe": [{"vehicle": "doubtful"}],
        "NedbusMessagesLost": [
            {"source": sources["lossy"]},
            {"vehicle": "lost", "instance": exporter},
        ],
        "NedbusMessagesRejected": [{"source": sources["silent"]}],
        "NedbusPayloadsInvalid": [{"instance": exporter}],
        "NedbusReaderSlow": [{"instance": exporter}],
    }
    assert expected.keys() == set(re.findall(r"alert: (\w+)", rules))

    with traffic(bus, zenoh_session, silent) as bad, ExitStack() as crowd:
        of_gone = f'nedbus_messages_received_total{{instance="{exporter}", vehicle="gone"}} > 10'
        wait_for(
            lambda: prometheus.query(of_gone), what="the vehicle that will be gone", seconds=TIMEOUT
        )
        bad.set()
        for _ in range(6):  # with the exporter's two sessions, eight of ten
            crowd.enter_context(nedbus.connect(small))
        router.kill()
        to_end.kill()
        for name, causes in expected.items():
            for cause in causes:
                wait_for(
                    partial(prometheus.alerts, name, **cause),
                    what=f"{name} {cause}",
                    seconds=TIMEOUT,
                )
        # <no value>, <error expanding template>
        assert not [text for text in prometheus.annotations() if "<" in text]

        bad.clear()
        crowd.close()
        restore_rules()
        route()
        export_ended()
        vehicle.kill()
        fly(lossy)
        fly(silent)
        write_log(
            missing, range(0, 10_000_000, 100_000), topic="vehicle_local_position_groundtruth"
        )
        for name in expected:
            has_ended = partial(lambda alert: not prometheus.alerts(alert), name)
            wait_for(has_ended, what=f"the end of {name}", seconds=TIMEOUT)
    assert not any(prometheus.scrape_errors().values())
    assert not prometheus.process.err


def start_small_router(run_nedbus: Start, folder: Path, service: str, exporter: str) -> str:
    """Start a service with a router limited to ten sessions, and an exporter with two; return the endpoint."""
    where, file = free_endpoint(), folder / "small.json5"
    shipped = (PACKAGING.parent / "config" / "router.json5").read_text()
    file.write_text(shipped.replace("max_sessions: 1000", "max_sessions: 10"))
    source = "sim:?speed=0.3&vehicle=small"
    run_nedbus("serve", "--router-config", str(file), "-l", where, "--http", service, "-s", source)
    run_nedbus("export", "--wait", "-c", where, "--http", exporter)
    return where


def refuse_vehicle(run_nedbus: Start, folder: Path, pages: str) -> Callable[[], None]:
    """Start a service whose router refuses its vehicle; return a function that adds access rules for it."""
    pki, file, endpoint = (
        folder / "pki",
        folder / "secure.json5",
        free_endpoint().replace("tcp/", "tls/"),
    )
    make_authority(pki)
    make_certificate(pki, "router", hosts=["127.0.0.1"])
    make_certificate(pki, "vehicle-2")
    shipped = (PACKAGING.parent / "config" / "router-secure.json5").read_text()
    file.write_text(
        shipped.replace("/etc/nedbus/pki", str(pki)).replace("tls/0.0.0.0:7447", endpoint)
    )
    router = run_nedbus("router", str(file))
    files = {"ca": "ca.crt", "certificate": "vehicle-2.crt", "key": "vehicle-2.key"}
    shown = [f"--tls-{option}={pki / name}" for option, name in files.items()]
    run_nedbus("serve", "-c", endpoint, *shown, "-s", "sim:?vehicle=2&speed=0.3", "--http", pages)

    def restore() -> None:
        write_access_rules(file, ["1", "2"])
        router.kill()
        run_nedbus("router", str(file))

    return restore


@pytest.mark.parametrize(
    ("name", "series", "times"),
    [
        (  # 15 s of dead reckoning, as in each lap of the simulation, is too short; 31 s is not
            "NedbusDeadReckoning",
            'nedbus_vehicle_condition{condition="dead_reckoning"} _x10 1x14 stale _x5 1x60',
            {"25s": False, "1m0s": False, "1m10s": True},
        ),
        ("NedbusStreamStale", "nedbus_stream_age_seconds 0+1x20", {"3s": False, "9s": True}),
        (  # 0.2 Hz: three intervals are 15 s
            "NedbusStreamStale",
            "nedbus_stream_age_seconds 0+1x30; nedbus_stream_usual_rate_hertz 0.2x30",
            {"14s": False, "21s": True},
        ),
        # a count by rule first appears as 1, which increase() misses; the source's count was 0 before
        (
            "NedbusMessagesRejected",
            "nedbus_source_rejected_total 0x30 1x500; nedbus_messages_rejected_total _x30 1x500",
            {"25s": False, "45s": True, "5m45s": False},
        ),
        (  # a service that has ended: its losses on the network were counted by stream before, and fired no alert
            "NedbusMessagesLost",
            'nedbus_source_lost_total{job="a"} 0x60 stale; nedbus_messages_lost_total{job="a"} 0x30 5x29 stale',
            {"45s": False, "1m15s": False},
        ),
        (  # an exporter
            "NedbusMessagesLost",
            'nedbus_messages_lost_total{job="a"} 0x30 5x30',
            {"25s": False, "45s": True},
        ),
        (  # a replay waiting for a reader
            "NedbusSourceSilent",
            'nedbus_source_state{state="waiting"} 1x100; nedbus_source_addresses 5x100',
            {"1m30s": False},
        ),
        (  # from 80 % on, but not for brief connections
            "NedbusRouterFull",
            'nedbus_sessions{role="router"} 799x100 800x100; nedbus_sessions_max{role="router"} 1000x300',
            {"1m40s": False, "2m30s": False, "2m50s": True},
        ),
        (  # from an exporter, for each router
            "NedbusRouterFull",
            'nedbus_router_sessions{router="a"} 10x30 9x10 10x80; nedbus_router_sessions_max{router="a"} 12x300',
            {"59s": False, "1m20s": False, "1m45s": True},
        ),
    ],
)
def test_rules_fire_only_after_their_duration(
    start: Start, tmp_path: Path, name: str, series: str, times: dict[str, bool]
) -> None:
    """With their packaged times, the rules fire neither too early nor without a fault."""
    inputs = []
    for each in series.split("; "):
        metric, _, values = each.rpartition("} ") if "}" in each else each.partition(" ")
        inputs.append({"series": f"{metric}}}" if "{" in metric else metric, "values": values})
    head, *rules = ALERTS.read_text().split("      - alert: ")
    alone, file = tmp_path / "alone.yml", tmp_path / "test.yml"  # JSON is YAML
    alone.write_text(
        head + "".join(f"      - alert: {rule}" for rule in rules if rule.startswith(f"{name}\n"))
    )
    expected = [{"eval_time": time, "alertname": name, "exp_alerts": []} for time in times]
    file.write_text(
        json.dumps({"rule_files": [str(alone)], "evaluation_interval": "1s", "tests": [
            {"interval": "1s", "input_series": inputs, "alert_rule_test": expected}
        ]})
    )  # fmt: skip
    promtool = start_promtool(start, "test", "rules", str(file))
    assert promtool.wait() == int(any(times.values())), promtool.err
    fired = {time for time in times if f"time: {time}," in promtool.out + promtool.err}
    assert fired == {time for time, fires in times.items() if fires}, promtool.out + promtool.err


def test_rules_and_scrape_configuration_are_valid(start: Start) -> None:
    """Rules and scrape configuration pass promtool; each rule has a severity, a summary and a description."""
    for arguments in (("rules", str(ALERTS)), ("config", str(ALERTS.with_name("prometheus.yml")))):
        promtool = start_promtool(start, "check", *arguments)
        assert promtool.wait() == 0, promtool.err
    rules = ALERTS.read_text().split("- alert: ")[1:]
    assert rules
    for rule in rules:
        assert re.search("severity: (critical|warning)\n", rule), rule
        assert "summary: " in rule, rule
        assert "description: " in rule, rule


@pytest.mark.slow
def test_dashboard_and_rules_use_existing_metrics(
    run_nedbus: Start, start: Start, endpoint: str, tmp_path: Path
) -> None:
    """Each metric in rules and dashboard is exported by a service or an exporter; each query returns data."""
    dashboard = json.loads((PACKAGING / "grafana" / "nedbus.json").read_text())
    assert {each["name"] for each in dashboard["templating"]["list"]} == {
        "datasource",
        "vehicle",
        "topic",
    }
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    addresses = [f"127.0.0.1:{free_port()}" for _ in range(3)]
    run_nedbus("serve", "-c", endpoint, "-s", "sim:", "--http", addresses[0])
    run_nedbus("serve", "-l", free_endpoint(), "-s", "sim:", "--http", addresses[2])
    run_nedbus("export", "-c", endpoint, "--http", addresses[1])
    prometheus = Prometheus(start, tmp_path, ALERTS.read_text(), {"nedbus": addresses})
    for query in queries:
        filled = (
            re.sub(r"\$__(rate_interval|range)", "10s", query)
            .replace("$vehicle", ".*")
            .replace("$topic", "ve.*")
        )
        assert "$" not in filled
        # the panel shows only increases
        found = partial(prometheus.query, filled.removesuffix(" > 0"))
        if "rejected" in query:  # no series before the first rejection
            found()
        else:
            wait_for(found, what=query)
    exposed = {each["__name__"] for each, _ in prometheus.query('{__name__!=""}')}
    used = set(re.findall(r"\b(?:nedbus|process)_\w+", " ".join([*queries, ALERTS.read_text()])))
    # only with a fault or TLS
    without = {"nedbus_messages_rejected_total", "nedbus_vehicle_refused"}
    # exported by the simulation only at times
    assert used - exposed - {"nedbus_vehicle_condition"} == without
    assert len(used) > 20
