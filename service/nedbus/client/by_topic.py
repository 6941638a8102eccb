"""Decorators that give `subscribe` and `latest` a type for each topic, defined in the stub beside this file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def _typed(method: Callable[..., Any]) -> Callable[..., Any]:
    return method


by_topic = by_topic_async = last = last_async = _typed
