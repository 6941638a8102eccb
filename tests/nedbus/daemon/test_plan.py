"""The plan of a service: its sources, and the mistakes in its settings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from nedbus.daemon import Daemon, plan_sources
from nedbus.settings import load_settings
from nedbus_msgs import Address

ENDLESS = "no source ever ends: use a log or a recording without loop=1, or sim: with duration="


@pytest.mark.parametrize(
    ("settings", "mistakes"),
    [
        ({"source": ["sim:"], "until_done": True}, [f"until_done: {ENDLESS}"]),
        ({"source": ["sim:", "sim:?duration=1&vehicle=2"], "until_done": True}, []),
        ({"source": ["sim:"]}, []),
        ({}, ["source: no source is given: use --source with sim:, ulog:FILE, px4-zenoh: or mavlink:LINK"]),
        (
            {"source": ["sim:"], "tls_certificate": "a.crt"},
            ["tls_certificate: a certificate is set, but not the CA to trust; set both"],
        ),
    ],
)  # fmt: skip
def test_mistakes_name_the_setting(settings: dict[str, Any], mistakes: list[str]) -> None:
    """A service without sources, or that never ends although it shall, and half of a TLS identity are mistakes."""
    _, errors = plan_sources(load_settings(**settings), ["tcp/127.0.0.1:1"])
    assert [str(error) for error in errors] == mistakes


def test_order_and_texts_of_sources_are_kept() -> None:
    """Each valid source is planned with its number in the settings, besides an invalid one."""
    settings = load_settings(source=["sim:", "foo:", "sim:?vehicle=2"], vehicle="7")
    plan, errors = plan_sources(settings, ["tcp/127.0.0.1:1"])
    assert [(planned.index, planned.text, planned.vehicle) for planned in plan] == [
        (0, "sim:", "7"),
        (2, "sim:?vehicle=2", "7"),
    ]
    assert len(errors) == 1


def test_vehicle_with_two_publishers_is_a_duplicate() -> None:
    """A position that another service publishes, too, is a duplicate in the event log, whatever its state is."""
    main, other = Address("1", "vehicle_local_position"), Address("2", "vehicle_local_position")
    updates = list[dict[Address, str]]()
    fake: Any = Daemon(load_settings(source=["sim:"]), version="1")
    fake._registry = SimpleNamespace(publishers={main: None}, shared_vehicles=lambda: {"1"})
    fake.event_log = SimpleNamespace(
        vehicles={"1": SimpleNamespace(main=main), "2": SimpleNamespace(main=other)},
        update=lambda _, states, **__: updates.append(states),
    )
    measures = SimpleNamespace(
        states={str(main): "ok", str(other): "slow"},
        status=SimpleNamespace(dropped=0, overload=""),
    )
    fake.update_events([measures])
    assert updates == [{main: "duplicate", other: "slow"}]
