"""Limits: each number has its reason and its effect, and the reference lists it."""

from __future__ import annotations

import ast
from pathlib import Path
from types import ModuleType

import pytest

import nedbus.limits
import nedbus_msgs.limits
from docs.generator.api import constants_of
from docs.generator.tables import limits_page


@pytest.mark.parametrize("module", [nedbus.limits, nedbus_msgs.limits])
def test_each_limit_has_reason_and_effect(module: ModuleType) -> None:
    """The docstring of a limit says what it bounds and why, then what happens at it; the page of limits has its row."""
    texts = dict(constants_of(ast.parse(Path(str(module.__file__)).read_text())))
    page = limits_page()
    for name in vars(module):
        if name.isupper():
            assert texts[name].count(". ") >= 1, name
            assert texts[name].endswith("."), name
            assert f"| `{name}` |" in page
