"""What `subscribe` and `latest` return for each topic: only type checkers know, from the stub beside this file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def _typed(method: Callable[..., Any]) -> Callable[..., Any]:
    return method


by_topic = by_topic_async = last = last_async = _typed
