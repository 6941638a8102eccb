"""Summary of a CI run from pytest's result files: skipped tests with their reasons, then the counts.

Exits with 1 if a test failed, a file is missing, or a test was skipped that is not listed here.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

_ROOT_ONLY: Final = (
    "tests.nedbus.test_atomic_write::test_folder_without_read_permission_is_not_synced"
)
_LANGUAGES: Final = "tests.other_languages"
_LANGUAGE: Final = f"{_LANGUAGES}.test_vectors::test_program_in_another_language_conforms"
_PACKAGES: Final = "needs the tools of a language, and packages from its registry"
KNOWN: Final = {
    _ROOT_ONLY: "CI runs as root",
    f"{_LANGUAGE}[node]": "needs Node.js, and a package from its registry",
    f"{_LANGUAGE}[cargo]": "needs Rust, and packages from its registry",
    f"{_LANGUAGES}.test_cpp_example::test_example_compiles_with_the_headers_of_zenoh": "needs zenoh-cpp",
    f"{_LANGUAGES}.test_ros2_generator::test_hash_equals_that_of_ros_2": _PACKAGES,
    f"{_LANGUAGES}.test_ros2_generator::test_literal_hash_equals_that_of_libraries": _PACKAGES,
    f"{_LANGUAGES}.test_payloads::test_decoder_of_documentation_returns_every_value": _PACKAGES,
    f"{_LANGUAGES}.test_readers::test_every_value_of_a_recording_is_read": _PACKAGES,
    f"{_LANGUAGES}.test_readers::test_every_value_of_a_saved_stream_is_read": _PACKAGES,
}
"""Tests that CI may skip, and why."""
NEWEST: Final = {
    "tests.nedbus.cli.test_systemd::test_unit_is_valid_and_hardened": "the image has no systemd",
    "tests.nedbus.monitoring.test_metrics::test_metrics_pass_promtool_check": "the image has no Prometheus",
    "tests.nedbus.monitoring.test_prometheus::test_rules_and_scrape_configuration_are_valid": "as above",
    "tests.nedbus.monitoring.test_prometheus::test_rules_fire_only_after_their_duration": "as above",
}
"""Further tests that `.ci/newest` may skip; their names may lack the parameters."""


def summarize(files: Sequence[Path], known: dict[str, str]) -> tuple[list[str], bool]:
    """Return the lines of the summary, counts last, and whether the run is good.

    Each test counts once, although property tests run twice.
    """
    lines, outcomes, reasons = list[str](), defaultdict[str, set[str]](set), dict[str, str]()
    for file in files:
        try:
            cases = [*ET.parse(file).iter("testcase")]  # noqa: S314 - written by pytest
        except (OSError, ET.ParseError) as exc:
            lines.append(f"no results in {file}: {exc}")
            continue
        for case in cases:
            found = {child.tag: child for child in case}
            kind = (
                "failed"
                if found.keys() & {"failure", "error"}
                else "skipped"
                if "skipped" in found
                else "passed"
            )
            name = f"{case.get('classname')}::{case.get('name')}"
            outcomes[kind].add(name)
            if kind == "skipped":
                reasons[name] = " ".join(found["skipped"].get("message", "").split())
    failed = outcomes["failed"]
    passed = outcomes["passed"] - failed
    skipped = outcomes["skipped"] - passed - failed
    unknown = {
        name for name in skipped if name not in known and name.partition("[")[0] not in known
    }
    good = bool(passed) and not (failed or unknown or lines)
    listed = Counter((name in unknown, name.partition("[")[0], reasons[name]) for name in skipped)
    for (is_unknown, name, reason), count in sorted(listed.items()):
        label = "skipped, which fails this run" if is_unknown else "skipped"
        lines.append(f"{label}: {name}: {reason}{f' ({count} times)' * (count > 1)}")
    return [*lines, f"{len(passed)} passed, {len(failed)} failed, {len(skipped)} skipped"], good


def main() -> None:
    """Print the summary of these files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument(
        "--newest",
        action="store_true",
        help="run of .ci/newest: no counts, and more may be skipped",
    )
    arguments = parser.parse_args()
    lines, good = summarize(arguments.files, KNOWN | NEWEST if arguments.newest else KNOWN)
    sys.stdout.writelines(f"{line}\n" for line in (lines[:-1] if arguments.newest else lines))
    sys.exit(not good)


if __name__ == "__main__":
    main()
