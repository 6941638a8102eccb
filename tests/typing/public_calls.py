"""Public calls for type checkers: mypy must accept them, and reject each line with a `type: ignore`.

An unneeded ignore is an error in mypy, so a wrong call that it accepts fails `make check`.
"""

from __future__ import annotations

from typing import assert_type

import numpy as np
import pandas as pd

import nedbus
from nedbus_msgs.model.px4_types import Float32, field


def subscribe(bus: nedbus.Bus) -> None:
    """Iteration yields models, rows or batches, each with its own type."""
    with bus.subscribe(vehicle="7", mode="every") as subscription:
        for sample in subscription:
            assert_type(sample, nedbus.Sample[nedbus.VehicleLocalPosition])
            assert_type(sample.message.x, float)
            sample.message.model_dump()
        for row in subscription.rows():
            assert_type(row, nedbus.Sample[nedbus.VehicleLocalPosition])
            assert_type(row.message.delta_xy, tuple[float, float])
            assert_type(row.message.height, float | None)
            row.message.y_valid  # type: ignore[attr-defined] # no such field
        for batch in subscription.batches():
            assert_type(batch, nedbus.Batch)
            assert_type(
                batch.of(nedbus.Address("7", "vehicle_local_position")), nedbus.MessageArray
            )
        assert_type(subscription.receive(1.0), nedbus.Sample)
    assert_type(bus.subscribe(max_rate=5), nedbus.Subscription)
    bus.subscribe(max_rate="5")  # type: ignore[call-overload] # not a number
    bus.subscribe(mode="newest")  # type: ignore[call-overload] # neither "latest" nor "every"
    bus.subscribe("vehicle_local_position", 7)  # type: ignore[call-overload] # vehicle is keyword-only
    bus.subscribe(limit="1")  # type: ignore[call-overload] # not a number


class WheelEncoders(nedbus.Message):
    """A message defined by a script."""

    TOPICS = (nedbus.Topic("wheel_encoders", 50.0, "a rover"),)
    wheel_speed: Float32 = field("Speed of the wheels [rad/s]")


def subscribe_by_class_and_topic(bus: nedbus.Bus, any_topic: str) -> None:
    """By class, the message type is known; by topic name, it is any message."""
    for sample in bus.subscribe(nedbus.VehicleAttitude):
        assert_type(sample, nedbus.Sample[nedbus.VehicleAttitude])
        assert_type(sample.message.q, tuple[float, float, float, float])
        sample.message.x  # type: ignore[attr-defined] # VehicleAttitude has no x
    assert_type(bus.subscribe(nedbus.SensorGps, mode="every").receive().message.fix_type, int)
    gps = bus.subscribe(nedbus.SensorGps, topic="vehicle_gps_position", vehicle=7, max_rate=5)
    assert_type(gps, nedbus.Subscription[nedbus.SensorGps])
    assert_type(bus.subscribe(topic="estimator_local_position").receive().message.x, float)
    assert_type(bus.subscribe(WheelEncoders).receive().message.wheel_speed, float)
    assert_type(bus.subscribe("*"), nedbus.Subscription[nedbus.Message])
    both = bus.subscribe(nedbus.VehicleAttitude, nedbus.SensorGps, limit=100)
    assert_type(both, nedbus.Subscription[nedbus.VehicleAttitude | nedbus.SensorGps])
    three = bus.subscribe(nedbus.VehicleAttitude, nedbus.SensorGps, nedbus.HomePosition)
    assert_type(
        three.receive().message, nedbus.VehicleAttitude | nedbus.SensorGps | nedbus.HomePosition
    )
    assert_type(
        bus.subscribe(nedbus.VehicleAttitude, "sensor_gps"), nedbus.Subscription[nedbus.Message]
    )
    both.batches(max_messages="1")  # type: ignore[arg-type] # not a number
    bus.subscribe(nedbus.VehicleAttitude, vehicle=["1", 2])
    bus.latest("*", vehicle=("1", "2"))
    bus.publisher(nedbus.VehicleAttitude, vehicle=7)
    bus.on_link(lambda is_up: assert_type(is_up, bool))
    bus.on_link(3)  # type: ignore[arg-type] # not a function
    view = bus.newest(nedbus.VehicleAttitude, any_topic, vehicle=7)
    assert_type(view[nedbus.VehicleAttitude].message.q, tuple[float, float, float, float])
    assert_type(view.get(nedbus.SensorGps), nedbus.health.NewestMessage[nedbus.SensorGps] | None)
    assert_type(view[any_topic], nedbus.health.NewestMessage[nedbus.Message])
    assert_type([each.alive for each in view.update(0.1)], list[bool])
    assert_type(bus.subscribe(any_topic).receive().message.timestamp, int)
    bus.subscribe(any_topic).receive().message.x  # type: ignore[attr-defined] # unknown message type
    assert_type(bus.latest(nedbus.HomePosition)[0].message.alt, float)
    assert_type(bus.latest("*", vehicle=7), list[nedbus.Sample[nedbus.Message]])
    assert_type(bus.latest(), list[nedbus.Sample[nedbus.VehicleLocalPosition]])


def use_rows_as_messages(
    sample: nedbus.Sample, row: nedbus.Sample[nedbus.VehicleLocalPosition]
) -> None:
    """Functions that accept a message also accept a row."""
    assert_type(nedbus.frames.to_global(sample.message), nedbus.frames.GlobalPosition | None)
    assert_type(nedbus.frames.to_global(row.message), nedbus.frames.GlobalPosition | None)
    nedbus.frames.to_global(row.message).latitude  # type: ignore[union-attr] # None without a global origin
    assert_type(sample.message.position, nedbus.frames.Ned | None)
    assert_type(row.message.global_position, nedbus.frames.GlobalPosition | None)
    nedbus.frames.ned_to_enu(sample.message.position)  # type: ignore[arg-type] # may be None
    assert_type(nedbus.ResetTracker().add(row.message), nedbus.Continuous)
    nedbus.health.Monitor().add(row)
    nedbus.health.Monitor().add(sample)
    sample.message.x = 1.0  # type: ignore[misc] # messages are frozen
    assert_type(sample.sent, int | None)


def publish(bus: nedbus.Bus) -> None:
    """Publish a message, its fields by name, or an array."""
    publisher = bus.publisher("external_ins_local_position", vehicle="mine", source="ins")
    publisher.publish(nedbus.VehicleLocalPosition(timestamp=1, x=2.0))
    publisher.publish({"timestamp": 1, "x": 2.0})
    publisher.publish(nedbus.VehicleLocalPosition(timestamp=1, x="2"))  # type: ignore[arg-type] # not a number
    # checked when it is published: a publisher is of any message
    publisher.publish({"timestamp": 1, "x": "2"})
    publisher.publish_many(np.zeros(3, nedbus.DTYPE))
    publisher.publish(1.0)  # type: ignore[arg-type] # not a message
    nedbus.VehicleLocalPosition(timestamp=1, X=2.0)  # type: ignore[call-arg] # no such field
    bus.publisher("external_ins_local_position")  # type: ignore[call-arg] # vehicle is missing


async def read_and_publish() -> None:
    """The asyncio client has the same calls, with await."""
    tls = nedbus.Tls("ca.crt", "reader.crt", "reader.key")
    async with nedbus.connect_async("tls/10.0.0.1:7447", tls=tls) as bus:
        async for sample in bus.subscribe():
            assert_type(sample, nedbus.Sample[nedbus.VehicleLocalPosition])
        async for row in bus.subscribe().rows():
            assert_type(row, nedbus.Sample[nedbus.VehicleLocalPosition])
        assert_type(bus.subscribe(max_rate=0.5), nedbus.AsyncSubscription)
        assert_type(bus.newest("*"), nedbus.AsyncNewest)
        assert_type(await bus.newest().update(), list[nedbus.health.NewestMessage[nedbus.Message]])
        async for attitude in bus.subscribe(nedbus.VehicleAttitude):
            assert_type(attitude.message.q, tuple[float, float, float, float])
            attitude.message.x  # type: ignore[attr-defined] # VehicleAttitude has no x
        assert_type(bus.subscribe("*"), nedbus.AsyncSubscription[nedbus.Message])
        for _ in bus.subscribe():  # type: ignore[attr-defined] # needs async for
            pass
        publisher = await bus.publisher("external_ins_local_position", vehicle="mine")
        assert_type(publisher, nedbus.AsyncPublisher)
        await publisher.publish(nedbus.VehicleLocalPosition(timestamp=1))
        await publisher.publish(nedbus.VehicleAttitude(timestamp=1))
        await publisher.publish_row(nedbus.VehicleLocalPosition(timestamp=1))
        assert_type(await publisher.flush(), bool)
        await publisher.flush("1")  # type: ignore[arg-type] # not a number of seconds
        vehicles = await bus.vehicles(timeout=1.0)
        assert_type(vehicles["7"], list[nedbus.Address])
        assert_type(vehicles.complete, bool)
        assert_type(await bus.latest(), list[nedbus.Sample])
        assert_type(await bus.latest(nedbus.HomePosition), list[nedbus.Sample[nedbus.HomePosition]])
        assert_type(await bus.latest("home_position"), list[nedbus.Sample[nedbus.Message]])


def open_files(any_topic: str) -> None:
    """A flight is called as a bus is subscribed to, and yields the same types."""
    with nedbus.open(["a.ulg", "b.mcap"], vehicle=7) as flight:
        for sample in flight(nedbus.VehicleAttitude, start=1.0):
            assert_type(sample, nedbus.Sample[nedbus.VehicleAttitude])
            sample.message.x  # type: ignore[attr-defined] # VehicleAttitude has no x
        for row in flight(rows=True).rows():
            assert_type(row, nedbus.Sample[nedbus.VehicleLocalPosition])
        assert_type(flight("*"), nedbus.FlightSamples[nedbus.Message])
        assert_type(flight(any_topic), nedbus.FlightSamples[nedbus.Message])
        assert_type(
            flight(nedbus.VehicleAttitude, "home_position"), nedbus.FlightSamples[nedbus.Message]
        )
        for batch in flight(nedbus.SensorGps, topic="vehicle_gps_position").batches():
            assert_type(batch, nedbus.Batch)
        assert_type(flight.utc, nedbus.UtcOffset | None)
        flight(mode="every")  # type: ignore[call-overload] # a file has no slow readers


def read() -> None:
    """Files are read as arrays, or as data frames of the given library."""
    assert_type(nedbus.read("flight.ulg", vehicle=7), nedbus.MessageArray)
    assert_type(nedbus.read("flight.ulg", dataframe="pandas"), pd.DataFrame)
    assert_type(nedbus.read("flight.ulg", ["home_position"]), dict[str, nedbus.MessageArray])
    assert_type(nedbus.read(["a.ulg", "b.ulg"], ["home_position"]), dict[str, nedbus.MessageArray])
    assert_type(nedbus.align(["a.ulg", "b.ulg"], on=10.0), nedbus.MessageArray)
    assert_type(nedbus.read("flight.ulg", ["*"], dataframe="pandas"), dict[str, pd.DataFrame])
    assert_type(nedbus.align("flight.ulg", on=50.0, method="linear"), nedbus.MessageArray)
    assert_type(nedbus.align({}, on=[1, 2], utc=True, dataframe="pandas"), pd.DataFrame)
    assert_type(nedbus.utc_of("flight.ulg"), nedbus.UtcOffset | None)
    nedbus.read("flight.ulg", dataframe="arrow")  # type: ignore[call-overload] # neither pandas nor polars
    nedbus.connect(tls_ca="ca.crt")  # type: ignore[call-arg] # use tls=Tls(...)
    nedbus.raed  # type: ignore[attr-defined] # no such name


def explain(bus: nedbus.Bus, flight: nedbus.Flight) -> None:
    """Events and verdicts: a history from files, an open flight and samples, an iterator from a bus."""
    assert_type(nedbus.events("flight.ulg"), nedbus.health.EventHistory)
    assert_type(nedbus.events(flight, vehicle=7), nedbus.health.EventHistory)
    assert_type(nedbus.events(list(flight("*"))), nedbus.health.EventHistory)
    assert_type(nedbus.events(bus, within=60.0), nedbus.health.LiveEvents)
    assert_type(nedbus.why(bus), dict[str, nedbus.health.Verdict])
    assert_type(bus.why("7"), nedbus.health.Verdict)
    for event in nedbus.events(bus):
        assert_type(event, nedbus.health.Event)
    nedbus.events("flight.ulg", within=60.0)  # type: ignore[call-overload] # only of a bus
