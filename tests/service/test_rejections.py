"""Reports of rejected messages, as a reader follows them."""

from __future__ import annotations

import pytest

import nedbus
from nedbus import ClosedError
from nedbus.client import PublisherRegistry, QueryServer, RejectionReport
from nedbus_msgs import Address
from tests.conftest import wait_for, wait_for_reader

ADDRESS = Address("7", "estimator_local_position", 1)


def test_reports_arrive_with_their_reason(endpoint: str) -> None:
    """What a service reports is read with its address; what is no report is left out, whoever sends it."""
    with nedbus.connect(endpoint) as bus, nedbus.connect(endpoint) as service:
        rejections = bus.rejections()
        wait_for_reader(service._session, ADDRESS.rejected_key())
        for key, payload in {
            "nedbus/@rejected/7/nothing": b'{"reason": "no such topic"}',
            ADDRESS.rejected_key(): b"no JSON",
            Address("8", "vehicle_local_position").rejected_key(): b'["a list"]',
        }.items():
            service._session.put(key, payload)
        service._session.put(ADDRESS.rejected_key(), b'{"reason": "%s"}' % (b"x" * 100_000))
        queries = QueryServer(service._session)
        PublisherRegistry(service._session, queries, prefix="nedbus", is_client=True).reject(
            ADDRESS, {"reason": "x is NaN"}
        )
        reports: list[RejectionReport] = []

        def has_come() -> bool:
            reports.extend(rejections.take())
            return bool(reports)

        wait_for(has_come, what="the report")
        assert [(report.address, report.reason) for report in reports] == [(ADDRESS, "x is NaN")]
        assert rejections.take() == []
        rejections.close()
        queries.close()


def test_nothing_is_taken_after_the_end(endpoint: str) -> None:
    """A closed bus says so, and closing twice is nothing."""
    bus = nedbus.connect(endpoint)
    rejections = bus.rejections()
    bus.close()
    with pytest.raises(ClosedError):
        rejections.take()
    rejections.close()
    with pytest.raises(ClosedError):
        bus.rejections()
