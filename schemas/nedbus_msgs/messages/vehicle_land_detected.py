"""VehicleLandDetected: on the ground or in the air."""

from nedbus_msgs.model import Layout, Message, Topic
from nedbus_msgs.model.px4_types import Bool, field


class VehicleLandDetected(Message):
    """Output of the land detector: in the air or on the ground, and the evidence for it.

    A multicopter lands in three steps: ground_contact, maybe_landed, landed, each once its evidence has lasted a while.
    So landed is set some time after touchdown; other kinds of vehicles mostly use landed alone.
    The flags from in_descend to close_to_ground_or_skipped_check are the evidence, for diagnosis.
    """

    TOPICS = (Topic("vehicle_land_detected", 1.0, "the land detector", on_change=True),)
    LAYOUTS = (Layout("1.13", "1.14, without rotational_movement"), Layout("1.14", "*"))

    freefall: Bool = field("The vehicle falls freely")

    ground_contact: Bool = field("First step: there is contact with the ground")
    maybe_landed: Bool = field("Second step: the vehicle may have landed")
    landed: Bool = field("Third step: the vehicle has landed")

    in_ground_effect: Bool = field("The vehicle descends straight, perhaps into ground effect")
    in_descend: Bool = field("The vehicle is told to descend")
    has_low_throttle: Bool = field("Throttle is too low to fly")
    vertical_movement: Bool = field("The vehicle moves vertically")
    horizontal_movement: Bool = field("The vehicle moves horizontally")
    rotational_movement: Bool = field("The vehicle rolls or pitches")
    close_to_ground_or_skipped_check: Bool = field("The ground is close, or no sensor can say so")
    at_rest: Bool = field("The vehicle does not move at all")
