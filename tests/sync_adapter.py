"""The asyncio client behind the interface of the blocking client, so that one test covers both."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Iterator
from functools import partial
from typing import Any, Self, cast

import nedbus

_WRAPPED = (nedbus.AsyncBus, nedbus.AsyncPublisher, nedbus.AsyncSubscription, nedbus.AsyncNewest)


class SyncAdapter:
    """Wrap an asyncio object: the same methods, run to completion by the runner."""

    def __init__(self, runner: asyncio.Runner, wrapped: Any) -> None:
        self._runner = runner
        self._wrapped = wrapped

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._wrapped, name)
        return partial(self._call, value) if callable(value) else value

    def __getitem__(self, key: Any) -> Any:
        return self._wrapped[key]

    def __enter__(self) -> Self:
        self._call(self._wrapped.__aenter__)
        return self

    def __exit__(self, *exc: object) -> None:
        self._call(self._wrapped.__aexit__, *exc)

    def __iter__(self) -> Iterator[Any]:
        try:
            while True:
                yield self._call(self._wrapped.__anext__)
        except StopAsyncIteration:
            return

    def _call(self, method: Any, *arguments: Any, **options: Any) -> Any:
        async def call() -> Any:
            result = method(*arguments, **options)
            return await result if inspect.isawaitable(result) else result

        result = self._runner.run(call())
        if result is self._wrapped or not isinstance(result, _WRAPPED):
            return result
        adapter = SyncAdapter(self._runner, result)
        return adapter.__enter__() if isinstance(result, nedbus.AsyncSubscription) else adapter


def sync_adapter(runner: asyncio.Runner, bus: nedbus.AsyncBus) -> nedbus.Bus:
    """Return an AsyncBus with the interface of a Bus."""
    return cast("nedbus.Bus", SyncAdapter(runner, bus))
