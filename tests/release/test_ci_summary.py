"""Summary of a CI run: counts in the last line, reasons of skipped tests, and failure for unknown ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.release.ci_summary import KNOWN, NEWEST, summarize

ROOT = Path(__file__).parents[2]
PASSED = '<testcase classname="tests.test_a" name="test_one"/>'
FAILED = (
    '<testcase classname="tests.test_a" name="test_one"><failure message="assert 1"/></testcase>'
)
SKIPPED = '<testcase classname="tests.test_a" name="test_two[1]"><skipped message="no such&#10;log"/></testcase>'
ENTRY = "tests.test_a::test_two"


@pytest.mark.parametrize(
    ("cases", "known", "lines", "good"),
    [
        ([PASSED], (), ["1 passed, 0 failed, 0 skipped"], True),
        ([PASSED, PASSED], (), ["1 passed, 0 failed, 0 skipped"], True),
        ([PASSED, FAILED], (), ["0 passed, 1 failed, 0 skipped"], False),
        ([], (), ["0 passed, 0 failed, 0 skipped"], False),
        (
            [PASSED + SKIPPED],
            (ENTRY,),
            [f"skipped: {ENTRY}: no such log", "1 passed, 0 failed, 1 skipped"],
            True,
        ),
        (
            [PASSED + SKIPPED],
            (f"{ENTRY}[1]",),
            [f"skipped: {ENTRY}: no such log", "1 passed, 0 failed, 1 skipped"],
            True,
        ),
        (
            [PASSED + SKIPPED],
            (f"{ENTRY}[2]",),
            [
                f"skipped, which fails this run: {ENTRY}: no such log",
                "1 passed, 0 failed, 1 skipped",
            ],
            False,
        ),
    ],
)
def test_summary_counts_each_test_once_and_lists_skipped_ones(
    tmp_path: Path, cases: list[str], known: tuple[str, ...], lines: list[str], good: bool
) -> None:
    """The counts are the last line; each skipped test has a line with its reason; an unknown one fails the run."""
    files = [tmp_path / f"{number}.xml" for number in range(len(cases))]
    for file, case in zip(files, cases, strict=True):
        file.write_text(f"<testsuites><testsuite>{case}</testsuite></testsuites>")
    assert summarize(files, dict.fromkeys(known, "why")) == (lines, good)


@pytest.mark.parametrize("content", [None, "<testsuites>"])
def test_missing_result_file_fails_the_run(tmp_path: Path, content: str | None) -> None:
    """A run without complete results, as after a crash, fails, and the counts are still the last line."""
    file, absent = tmp_path / "tests.xml", tmp_path / "slow.xml"
    file.write_text(f"<testsuites>{PASSED}</testsuites>")
    if content is not None:
        absent.write_text(content)
    lines, good = summarize([file, absent], {})
    assert lines[0].startswith(f"no results in {absent}: ")
    assert (lines[1:], good) == (["1 passed, 0 failed, 0 skipped"], False)


@pytest.mark.parametrize("entry", [*KNOWN, *NEWEST])
def test_known_skip_names_an_existing_test(entry: str) -> None:
    """Each test that may be skipped exists."""
    module, _, name = entry.partition("::")
    assert (
        f"def {name.partition('[')[0]}("
        in ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text()
    )
