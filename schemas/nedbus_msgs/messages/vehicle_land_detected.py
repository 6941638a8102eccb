"""VehicleLandDetected: on the ground or in the air."""

from nedbus_msgs.model import Layout, Message, Topic
from nedbus_msgs.model.px4_types import Bool, field


class VehicleLandDetected(Message):
    """Output of the land detector: in the air or on the ground, and the conditions behind it.

    A multicopter's landing is detected in three stages, each after its conditions have held for a while:
    ground_contact, maybe_landed, landed. So landed is set some time after touchdown; other types mostly use it alone.
    The flags from in_descend to close_to_ground_or_skipped_check are these conditions, for diagnosis.
    """

    TOPICS = (Topic("vehicle_land_detected", 1.0, "the land detector", on_change=True),)
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.14",
            without="rotational_movement",
        ),
        Layout("1.14", "*"),
    )

    freefall: Bool = field("Vehicle is in free fall")
    ground_contact: Bool = field("Stage 1: ground contact detected")
    maybe_landed: Bool = field("Stage 2: vehicle may have landed")
    landed: Bool = field("Stage 3: vehicle has landed")

    in_ground_effect: Bool = field("Vehicle descends vertically and may be in ground effect")
    in_descend: Bool = field("Descent commanded")
    has_low_throttle: Bool = field("Throttle is too low to fly")
    vertical_movement: Bool = field("Vertical movement detected")
    horizontal_movement: Bool = field("Horizontal movement detected")
    rotational_movement: Bool = field("Rotation about roll or pitch detected")
    close_to_ground_or_skipped_check: Bool = field(
        "Close to the ground, or not checked for lack of a sensor"
    )
    at_rest: Bool = field("Vehicle is at rest")
