"""Publisher methods with invalid messages and arguments."""

from __future__ import annotations

import numpy as np
import pytest

import nedbus
from nedbus_msgs import VehicleLocalPosition
from nedbus_msgs.arrays import DTYPE, to_array
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import numbered


@pytest.mark.parametrize("method", ["publish", "publish_row", "publish_many"])
def test_every_publish_method_raises_for_invalid_messages(client: nedbus.Bus, method: str) -> None:
    """Every publish method of either client raises InvalidMessageError for an invalid message, and sends nothing."""
    publisher = client.publisher(VLP, vehicle="1")
    fields = {**message(1).model_dump(), "eph": -1.0}
    given: dict[str, object] = {
        "publish": fields,
        "publish_row": tuple(fields.values()),
        "publish_many": to_array([message(1), VehicleLocalPosition.model_construct(**fields)]),
    }
    with pytest.raises(nedbus.InvalidMessageError, match=r"eph: must not be negative \(is -1.0\)") as info:
        getattr(publisher, method)(given[method])
    assert isinstance(info.value, nedbus.NedbusError)
    assert ("at index 1:" in str(info.value)) is (method == "publish_many")
    assert publisher.published == 0


def test_publish_many_with_invalid_arguments_sends_nothing(bus: nedbus.Bus) -> None:
    """`publish_many` raises TypeError for another dtype and ClosedError after closing; an empty array sends nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    with pytest.raises(TypeError, match="astype"):
        publisher.publish_many(np.zeros(3, [("x", "f4")]))
    publisher.publish_many(np.empty(0, DTYPE))
    publisher.close()
    with pytest.raises(nedbus.ClosedError):
        publisher.publish_many(numbered(1))
    assert publisher.published == 0
