"""Table of all kinds of events: source, severity and possible causes."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from .rules import (
    AID_SOURCES,
    EVIDENCE,
    FAILSAFE_FLAGS,
    FAULTS,
    FUSED,
    HEIGHTS,
    MINOR_AIDS,
    REJECTED,
)

Severity = Literal["bad", "watch", "info"]
"""How bad an event or a state is."""

SEVERITIES: Final[tuple[Severity, ...]] = get_args(Severity)
"""Severities, worst first: bad (the vehicle cannot do its task), watch (may become bad), info (routine)."""


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """A kind of event.

    `severity`: severity of a start or a single event; `on_ground` replaces it while the vehicle is disarmed. Ends are
    always info. `message`: the PX4 message in which it is detected, "" for other sources.
    `causes`: kinds that may explain it. `row`: its row in plots, by default its name.

    `validity`: a quantity of the estimate is invalid. `usual`: normal in a flight that has it from its first message
    on, as without GNSS: no fault and no part of the state then, but evidence.
    `correction`: the estimate is corrected; both starts and ends of conditions may explain it.
    `phase`: a phase of a flight, shown even if its severity is info.
    `of_data`: it concerns the data, not the vehicle, and is no present fault in a verdict.
    `stateless`: it does not affect the vehicle's state. `kept_on_reboot`: a reboot does not end it.

    A kind with `flags` is a condition, active while any of these fields of the message equals `bad`; the values of
    `flags` are labels. Flags that change in the same message become one event.
    `begin`, `end`: event texts, with `{}` for the labels. `first`: text of the end of an initial condition.
    `minor`: flags whose start is info. `initial`: a flag that is bad in the first message begins a condition.
    """

    name: str
    severity: Severity = "watch"
    message: str = ""
    causes: tuple[str, ...] = ()
    on_ground: Severity | None = None
    row: str = ""
    validity: bool = False
    correction: bool = False
    phase: bool = False
    stateless: bool = False
    of_data: bool = False
    kept_on_reboot: bool = False
    flags: Mapping[str, str] = field(default_factory=dict)
    begin: str = ""
    end: str = ""
    first: str = ""
    bad: bool = True
    minor: frozenset[str] = frozenset()
    initial: bool = False
    usual: bool = False

    def conditions(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the flags of an event, one condition each; `("",)` for a kind without flags."""
        if self.flags:
            return names
        return ("",)


_ESTIMATE: Final = "VehicleLocalPosition"
_FLAGS: Final = "EstimatorStatusFlags"
_GPS: Final = "SensorGps"
_STATUS: Final = "VehicleStatus"
_JAMMED: Final = ("jamming", "spoofing")
_SENSING: Final = (
    "no_messages",
    "no_vision",
    "gps_fix_lost",
    "gps_fix",
    "few_satellites",
    *_JAMMED,
    "not_fused",
    "not_aided",
    "aid_rejected",
    "aid_unused",
    "vision_unused",
    "innovation_rejected",
    "estimator_fault",
    "ekf_changed",
    "transition",
)
_CONTRADICTED: Final = ("height_contradicted", "position_contradicted")
_INVALID: Final = (
    "xy_invalid",
    "z_invalid",
    "v_xy_invalid",
    "v_z_invalid",
    "dead_reckoning",
    *_CONTRADICTED,
)


def _validity(name: str, flag: str, quantity: str, *causes: str) -> Kind:
    return Kind(
        name,
        "bad",
        message=_ESTIMATE,
        causes=("text", *_SENSING, *causes, "reboot"),
        validity=True,
        flags={flag: quantity},
        bad=False,
        initial=True,
        begin=f"{quantity} not valid",
        end=f"{quantity} valid again",
        first=f"{quantity} valid for the first time",
    )


def _not_global(quantity: str) -> Kind:
    return Kind(
        f"{quantity}_not_global",
        "watch",
        message=_ESTIMATE,
        causes=_SENSING,
        on_ground="info",
        flags={f"{quantity}_global": quantity},
        initial=True,
        usual=True,
        bad=False,
        begin=f"{quantity} has no global reference",
        end=f"{quantity} has a global reference",
    )


_ROWS: Final = (
    Kind("duplicate", "bad", kept_on_reboot=True),
    Kind("gone", "bad", causes=("link_down", "battery", "silent"), kept_on_reboot=True),
    Kind("silent", "bad", causes=("link_down", "battery", "overload"), kept_on_reboot=True),
    Kind("link_down", "bad"),
    Kind("reboot", "bad", causes=("duplicate", "battery", "gone", "silent"), phase=True),
    _validity("xy_invalid", "xy_valid", "xy", "dead_reckoning"),
    _validity("z_invalid", "z_valid", "z"),
    _validity("v_xy_invalid", "v_xy_valid", "vxy", "dead_reckoning"),
    _validity("v_z_invalid", "v_z_valid", "vz"),
    *(
        Kind(
            name,
            "bad",
            message=_ESTIMATE,
            causes=("text", *_SENSING, "dead_reckoning", "reset", "jump"),
            on_ground="info",
        )
        for name in _CONTRADICTED
    ),
    Kind(
        "failsafe",
        "bad",
        message=_STATUS,
        causes=("text", *_INVALID, *_SENSING, "failsafe_flag", "gcs_lost", "battery"),
        flags={"failsafe": "failsafe"},
        initial=True,
        begin="failsafe",
        end="failsafe cleared",
    ),
    Kind("battery", "bad", message="BatteryStatus", causes=("text",)),
    Kind(
        "dead_reckoning",
        "watch",
        message=_ESTIMATE,
        causes=("text", *_SENSING),
        flags={"dead_reckoning": "dead reckoning"},
        initial=True,
        begin="dead reckoning",
        end="dead reckoning ended",
    ),
    Kind(
        "no_messages",
        "watch",
        causes=("text", "link_down"),
        on_ground="info",
        flags={name: name for name in EVIDENCE},
        begin="no {} message",
        end="{} messages resumed",
    ),
    Kind("no_vision", "watch", causes=("text", "link_down", "aid_rejected"), on_ground="info"),
    Kind(
        "text",
        "watch",
        message="LogMessage",
        causes=("no_messages", "ekf_changed"),
        row="PX4",
        phase=True,
        stateless=True,
    ),
    Kind(
        "reset",
        "watch",
        message=_ESTIMATE,
        causes=("text", *_SENSING, *_INVALID, "origin_set", "origin_moved"),
        on_ground="info",
        correction=True,
    ),
    Kind(
        "jump",
        "watch",
        message=_ESTIMATE,
        causes=("text", "duplicate", *_SENSING, *_INVALID),
        correction=True,
    ),
    Kind(
        "ekf_changed",
        "watch",
        causes=("text", "estimator_fault", "innovation_rejected"),
        on_ground="info",
    ),
    Kind(
        "estimator_fault",
        "watch",
        message=_FLAGS,
        causes=("text",),
        flags=FAULTS,
        initial=True,
        begin="EKF fault: {}",
        end="EKF fault cleared: {}",
    ),
    Kind(
        "gps_fix_lost",
        "watch",
        message=_GPS,
        causes=("text", *_JAMMED, "few_satellites"),
        usual=True,
    ),
    Kind("few_satellites", "watch", message=_GPS, causes=_JAMMED),
    Kind("jamming", "watch", message=_GPS, causes=("text",)),
    Kind("spoofing", "watch", message=_GPS, causes=("text",)),
    Kind(
        "origin_contradicted",
        "watch",
        message=_ESTIMATE,
        causes=("text", "origin_set", "origin_moved"),
        on_ground="info",
    ),
    Kind("not_aided", "watch", message=_FLAGS, on_ground="info"),
    Kind(
        "aid_rejected",
        "watch",
        causes=("text", "gps_fix_lost", "gps_fix", *_JAMMED, "estimator_fault"),
        on_ground="info",
        flags=AID_SOURCES,
        minor=MINOR_AIDS,
        begin="EKF rejects {}",
        end="EKF accepts {} again",
    ),
    Kind(
        "vision_unused",
        "watch",
        causes=("text", "aid_rejected", "aid_unused", "estimator_fault"),
        on_ground="info",
    ),
    Kind(
        "innovation_rejected",
        "watch",
        message=_FLAGS,
        causes=("gps_fix_lost", "gps_fix", *_JAMMED, "estimator_fault"),
        flags=REJECTED,
        begin="EKF rejects {}",
        end="EKF accepts {} again",
    ),
    Kind(
        "not_fused",
        "watch",
        message=_FLAGS,
        causes=(
            "no_messages",
            "no_vision",
            "gps_fix_lost",
            "few_satellites",
            *_JAMMED,
            "aid_rejected",
            "innovation_rejected",
            "estimator_fault",
        ),
        on_ground="info",
        flags=FUSED,
        bad=False,
        minor=frozenset(HEIGHTS),
        begin="EKF stopped fusing {}",
        end="EKF started fusing {}",
    ),
    _not_global("xy"),
    _not_global("z"),
    Kind(
        "origin_moved",
        "watch",
        message=_ESTIMATE,
        causes=(*_SENSING, "reset"),
        on_ground="info",
        correction=True,
    ),
    Kind("origin_set", "info", message=_ESTIMATE, causes=_SENSING, correction=True),
    Kind(
        "gcs_lost",
        "watch",
        message=_STATUS,
        causes=("text",),
        on_ground="info",
        flags={"gcs_connection_lost": "GCS connection"},
        begin="GCS connection lost",
        end="GCS connection regained",
    ),
    Kind(
        "failsafe_flag",
        "watch",
        message="FailsafeFlags",
        causes=("text", *_INVALID, *_SENSING),
        on_ground="info",
        flags=FAILSAFE_FLAGS,
        begin="failsafe flags: {}",
        end="failsafe flags cleared: {}",
    ),
    Kind("lost", "watch", causes=("link_down", "overload"), of_data=True),
    Kind("rejected", "watch", of_data=True, kept_on_reboot=True),
    Kind("overload", "watch"),
    Kind(
        "aid_unused",
        "info",
        causes=("text",),
        flags=AID_SOURCES,
        begin="EKF receives {}, but does not fuse it",
        end="EKF fuses {}",
    ),
    Kind("transition", "info", message=_STATUS, causes=("text", "mode"), phase=True),
    Kind(
        "heading_not_good",
        "info",
        message=_ESTIMATE,
        causes=(*_SENSING, "reset", "landed"),
        flags={"heading_good_for_control": "heading"},
        bad=False,
        begin="heading not good for control",
        end="heading good for control",
    ),
    Kind(
        "dist_bottom_invalid",
        "info",
        message=_ESTIMATE,
        causes=("not_fused", "estimator_fault"),
        flags={"dist_bottom_valid": "distance to ground"},
        bad=False,
        begin="distance to ground not valid",
        end="distance to ground valid",
    ),
    Kind("gps_fix", "info", message=_GPS, causes=("few_satellites", *_JAMMED), phase=True),
    Kind(
        "mode",
        "info",
        message=_STATUS,
        causes=("text", "failsafe", "failsafe_flag", "xy_invalid", "z_invalid"),
        phase=True,
    ),
    Kind("vehicle_type", "info", message=_STATUS, causes=("transition",), phase=True),
    Kind("armed", "info", message=_STATUS, row="armed, landed", phase=True),
    Kind(
        "disarmed",
        "info",
        message=_STATUS,
        causes=("text", "landed", "failsafe", "failsafe_flag", "estimator_fault"),
        row="armed, landed",
        phase=True,
    ),
    Kind("takeoff", "info", message="VehicleLandDetected", row="armed, landed", phase=True),
    Kind("landed", "info", message="VehicleLandDetected", row="armed, landed", phase=True),
    Kind("other_ekf", "info", flags={**FAULTS, **REJECTED}),
    Kind("dropout", "info"),
)


class _Kinds(dict[str, Kind]):
    def __missing__(self, name: str) -> Kind:
        return Kind(name)


OF_SERVICE: Final = frozenset({"link_down", "overload"})
"""Kinds of events of a service itself, which it reports for each of its vehicles."""

KINDS: Final = _Kinds({kind.name: kind for kind in _ROWS})
"""All kinds of events by name, most important first; a name unknown to this version gets a default kind."""


def importance(kind: str) -> int:
    """Return the rank of a kind in KINDS; 0 is the most important."""
    return [*KINDS, kind].index(kind)


def rank_vehicle(name: str, severity: Severity) -> tuple[int, str]:
    """Return a sort key for vehicles: worst severity first, then natural order of names (2 before 10)."""
    natural = re.sub(r"\d+", lambda number: number[0].zfill(20), name)
    return SEVERITIES.index(severity), natural


def flagged(message: str) -> list[Kind]:
    """Return the kinds detected from flags of a message."""
    return [kind for kind in KINDS.values() if kind.message == message and kind.flags]
