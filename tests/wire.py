"""A TCP connection that a test can cut: everything between an actor and its hub goes through it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from typing import Any

from deploy.launcher import free_port


class Wire:
    """Listens on `endpoint` and passes on to a port of this machine, except while it is cut."""

    def __init__(self, port: int) -> None:
        self._port, self.own = port, free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.own}"
        self._open: set[asyncio.StreamWriter] = set()
        self._cut = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="wire", daemon=True)
        self._thread.start()
        self._server = self._do(asyncio.start_server(self._join, "127.0.0.1", self.own))

    def cut(self, stall: bool = False) -> None:
        """Ends all connections, takes no new one; with `stall` they stay open, and nothing gets through."""
        self._cut = True
        if not stall:
            self._do(self._end_all())

    def mend(self) -> None:
        """Lets everything through again."""
        self._cut = False

    def close(self) -> None:
        """Ends everything."""
        self._server.close()
        self._do(self._end_all())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(10)

    async def _end_all(self) -> None:
        for writer in self._open:
            writer.transport.abort()

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._cut:
            writer.transport.abort()
            return
        try:
            there_reader, there = await asyncio.open_connection("127.0.0.1", self._port)
        except OSError:  # the hub is away
            writer.transport.abort()
            return
        ends = {writer, there}
        self._open |= ends
        await asyncio.gather(self._pass(reader, there), self._pass(there_reader, writer))
        self._open -= ends

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(2**16):
                while self._cut:
                    await asyncio.sleep(0.05)
                writer.write(data)
                await writer.drain()
        except OSError:
            pass
        finally:
            writer.close()
