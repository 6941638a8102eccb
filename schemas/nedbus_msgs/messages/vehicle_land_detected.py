"""VehicleLandDetected: whether the vehicle is on the ground."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import Bool, Uint64


class VehicleLandDetected(Message):
    """Output of the land detector: in the air, on the ground, and why.

    A multicopter lands in three steps, each after some time of its signs: ground_contact, maybe_landed, landed.
    So landed comes some time after touchdown; other kinds of vehicles mostly use landed alone.
    The flags from in_descend to close_to_ground_or_skipped_check are the signs behind these steps, for diagnosis.
    """

    TOPICS: ClassVar = (Topic("vehicle_land_detected", 1.0, "the land detector", on_change=True),)
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp freefall ground_contact maybe_landed landed in_ground_effect in_descend has_low_throttle
            vertical_movement horizontal_movement close_to_ground_or_skipped_check at_rest""",
        "1.14": "*",
    }  # fmt: skip

    timestamp: Uint64 = Field(description="Time since boot [us]")

    freefall: Bool = Field(False, description="The vehicle falls freely")

    ground_contact: Bool = Field(False, description="First step: there is contact with the ground")
    maybe_landed: Bool = Field(False, description="Second step: the vehicle may have landed")
    landed: Bool = Field(False, description="Third step: the vehicle has landed")

    in_ground_effect: Bool = Field(False, description="The vehicle descends straight, perhaps into ground effect")
    in_descend: Bool = Field(False, description="The vehicle is told to descend")
    has_low_throttle: Bool = Field(False, description="Throttle is too low to fly")
    vertical_movement: Bool = Field(False, description="The vehicle moves vertically")
    horizontal_movement: Bool = Field(False, description="The vehicle moves horizontally")
    rotational_movement: Bool = Field(False, description="The vehicle rolls or pitches")
    close_to_ground_or_skipped_check: Bool = Field(False, description="The ground is close, or no sensor can say so")
    at_rest: Bool = Field(False, description="The vehicle does not move at all")
