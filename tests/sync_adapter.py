"""The blocking face of the asyncio client, so that one test proves both."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Iterator
from functools import partial
from typing import Any, Self, cast

import nedbus

_TWINS = (nedbus.AsyncBus, nedbus.AsyncPublisher, nedbus.AsyncSubscription)


class SyncAdapter:
    """A twin of asyncio's: whatever is awaited there is waited for here, under the same names."""

    def __init__(self, runner: asyncio.Runner, twin: Any) -> None:
        self._runner = runner
        self._twin = twin

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._twin, name)
        return partial(self._call, value) if callable(value) else value

    def __enter__(self) -> Self:
        self._call(self._twin.__aenter__)
        return self

    def __exit__(self, *exc: object) -> None:
        self._call(self._twin.__aexit__, *exc)

    def __iter__(self) -> Iterator[Any]:
        try:
            while True:
                yield self._call(self._twin.__anext__)
        except StopAsyncIteration:
            return

    def _call(self, method: Any, *arguments: Any, **options: Any) -> Any:
        async def call() -> Any:
            result = method(*arguments, **options)
            return await result if inspect.isawaitable(result) else result

        result = self._runner.run(call())
        if result is self._twin or not isinstance(result, _TWINS):
            return result
        twin = SyncAdapter(self._runner, result)
        return twin.__enter__() if isinstance(result, nedbus.AsyncSubscription) else twin


def sync_adapter(runner: asyncio.Runner, bus: nedbus.AsyncBus) -> nedbus.Bus:
    """Return an AsyncBus with the face of a Bus."""
    return cast("nedbus.Bus", SyncAdapter(runner, bus))
