"""A link that can be cut: python -m benchmarks.fleet_link PORT TARGET_PORT, TCP on loopback.

It prints "ready", and does what it is told, a word a line: `cut` lets nothing pass any more, and tells neither side,
as a cable that is pulled; `join` lets pass again; `count` prints as JSON the bytes that passed so far, and how many
connections there were.
"""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import suppress
from typing import Final

_CHUNK: Final = 65_536


def main() -> None:
    """Forward until stdin is closed."""
    asyncio.run(Link(int(sys.argv[2])).run(int(sys.argv[1])))


class Link:
    """All connections to one port, forwarded to another."""

    def __init__(self, target: int) -> None:
        self._target = target
        self._open = asyncio.Event()
        self._open.set()
        self._passed = {"up": 0, "down": 0}
        self._connections = 0

    async def run(self, port: int) -> None:
        """Listen, and do what the lines of stdin say."""
        loop = asyncio.get_running_loop()
        async with await asyncio.start_server(self._accept, "127.0.0.1", port, backlog=4096):
            print("ready", flush=True)
            while line := await loop.run_in_executor(None, sys.stdin.readline):
                match line.strip():
                    case "cut":
                        self._open.clear()
                    case "join":
                        self._open.set()
                    case "count":
                        print(json.dumps({**self._passed, "connections": self._connections}), flush=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await self._open.wait()
        self._connections += 1
        try:
            other_reader, other_writer = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.close()
            return
        with suppress(OSError):
            await asyncio.gather(self._forward(reader, other_writer, "up"), self._forward(other_reader, writer, "down"))

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, way: str) -> None:
        try:
            while data := await reader.read(_CHUNK):
                await self._open.wait()
                self._passed[way] += len(data)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            await self._open.wait()  # nor does the end of one side pass a link that is cut
            writer.close()


if __name__ == "__main__":
    main()
