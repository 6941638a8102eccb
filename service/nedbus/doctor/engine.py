"""Run checks in parallel, each with a timeout: the engine of `nedbus doctor`, `nedbus check` and `serve --check`."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from nedbus.errors import NedbusError
from nedbus.log_event import about

from .finding import Finding, State

_log = logging.getLogger(__name__)


class Check(NamedTuple):
    """A check that may wait for the network or a file.

    `name`, `subject`: those of its findings. `run`: returns or yields the findings.
    `place`: where a mistake stands in the configuration: a setting, or a text in a file; "" if it stands nowhere.
    """

    name: str
    subject: str
    run: Callable[[], Iterable[Finding]]
    place: str = ""


def run_checks(checks: Sequence[Check], seconds: float) -> Iterator[tuple[Check, Finding]]:
    """Run checks in parallel threads; yield their findings in the order of the checks.

    A check that fails or takes longer than `seconds` results in a finding; its own timeouts then end its thread.
    """
    results: dict[int, list[Finding]] = {}  # by the number of the check

    def run(number: int) -> None:
        results[number] = _run(checks[number])

    threads = [
        threading.Thread(target=run, args=(number,), name=f"nedbus-{check.name}", daemon=True)
        for number, check in enumerate(checks)
    ]
    end = time.monotonic() + seconds
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    for number, check in enumerate(checks):
        findings = results.get(number)
        if findings is None:
            findings = [_late(check, seconds)]
        for finding in findings:
            yield check, finding


def _run(check: Check) -> list[Finding]:
    """Return the findings of a check, also if it fails."""
    try:
        return list(check.run())
    except (NedbusError, OSError) as exc:
        return [Finding(check.name, check.subject, "wrong", f"check failed: {exc}")]
    except BaseException as exc:  # noqa: BLE001 - includes Zenoh's panics
        name = f"{check.name} {check.subject}".rstrip()
        _log.exception("unexpected error in check %s", name, extra=about("internal_error"))
        seen = f"check failed: unexpected {type(exc).__name__}: {exc}"
        advice = "a bug in nedbus: report it with the traceback above"
        return [Finding(check.name, check.subject, "unknown", seen, advice)]


def _late(check: Check, seconds: float) -> Finding:
    seen = f"no result within {seconds:g} s"
    advice = "try again; if this persists, a DNS server may not be answering"
    state: State = "unknown"
    if check.name == "endpoint":
        state = "wrong"
    return Finding(check.name, check.subject, state, seen, advice)
