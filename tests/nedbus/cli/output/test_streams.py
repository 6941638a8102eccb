"""Formats of lines on stdout."""

from __future__ import annotations

import pytest

from nedbus.cli.output.streams import csv_line

WIDE = ("\uff1d1", "\uff0b1", "\uff0d1", "\uff20A1")


@pytest.mark.parametrize("text", ["=1+1", "+SUM(A1)", "-A1", "@A1", "\t=1", "\r=1", "\n=1", *WIDE])
def test_text_cell_is_not_a_formula(text: str) -> None:
    """A text that a spreadsheet would evaluate is preceded by an apostrophe."""
    assert csv_line([text]).strip('"').startswith(f"'{text[0]}")


def test_numbers_and_other_texts_are_unchanged() -> None:
    """Numbers, also formatted ones, keep their sign, and other texts are written as they are."""
    assert csv_line([-1.5, "-0.52", "-inf", "+2", None, "a=b"]) == "-1.5,-0.52,-inf,+2,,a=b"
