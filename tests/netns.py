"""Hosts on one machine: network namespaces that are cabled to a switch, with links that a test can spoil.

Nothing of this shows in the main namespace: the switch, a bridge, has a namespace of its own. A test reaches
a port of a host through a Tunnel.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from tests.wire import Wire

PREFIX = "navaclq"
"""Namespaces are PREFIX-PID-NAME, by the process that made them."""
NAMESPACES = Path("/run/netns")
CLONE_NEWNET = 0x40000000
PACKAGES = {"ip": "iproute2", "tc": "iproute2", "nft": "nftables"}

_ours: set[str] = set()
"""Namespaces of this process that are in use."""


def _do(*command: object) -> str:
    """What a command says; skips the test where the machine cannot do that."""
    words = [str(word) for word in command]
    if shutil.which(words[0]) is None:
        pytest.skip(f"hosts on one machine need the command {words[0]} (package {PACKAGES[words[0]]})")
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no hosts can be had on this machine: `{' '.join(words)}` says {done.stderr.strip()!r}")
    return done.stdout


class Host:
    """A namespace with an address, and the cable from it to the switch."""

    def __init__(self, switch: str, namespace: str, name: str, address: str) -> None:
        self.namespace, self.address = namespace, address
        self.inside = ["ip", "netns", "exec", namespace]
        """Before a command that is to run on this host."""
        self._switch, self._port, self._table = switch, f"to-{name}"[:15], f"loss_{name}"
        peer = ("peer", "name", "eth0", "netns", namespace)
        _do("ip", "-n", switch, "link", "add", self._port, "type", "veth", *peer)
        for at, port in ((switch, self._port), (namespace, "eth0")):  # packets as a real card sends them
            _do("ip", "-n", at, "link", "set", port, "gso_max_segs", 1)
        _do("ip", "-n", switch, "link", "set", self._port, "master", "switch", "up")
        _do("ip", "-n", namespace, "address", "add", f"{address}/24", "dev", "eth0")
        for port in ("lo", "eth0"):
            _do("ip", "-n", namespace, "link", "set", port, "up")
        _do(*self.inside, "true")

    def cut(self) -> None:
        """Pulls the cable."""
        self._set("down")

    def mend(self) -> None:
        """Puts it back."""
        self._set("up")

    def _set(self, state: str) -> None:
        subprocess.run(["ip", "-n", self._switch, "link", "set", self._port, state], check=True)

    def narrow(self, megabits: float) -> None:
        """Makes the cable one of so many Mbit/s, each way."""
        shape = ("tbf", "rate", f"{megabits}mbit", "burst", "32kb", "latency", "100ms")
        _do("tc", "-n", self._switch, "qdisc", "replace", "dev", self._port, "root", *shape)
        _do("tc", "-n", self.namespace, "qdisc", "replace", "dev", "eth0", "root", *shape)

    def lose(self, percent: int) -> None:
        """Lets so many packets of a hundred vanish on the cable, each way."""
        lose = f"numgen random mod 100 < {percent} counter drop"
        hook = "{ type filter hook forward priority 0 ; }"
        for words in (
            f"add table bridge {self._table}",
            f"add chain bridge {self._table} lose {hook}",
            f"add rule bridge {self._table} lose iifname {self._port} {lose}",
            f"add rule bridge {self._table} lose oifname {self._port} {lose}",
        ):
            _do("ip", "netns", "exec", self._switch, "nft", *words.split())

    def lost(self) -> list[int]:
        """How many packets have vanished, from the host and to it."""
        listing = ("-j", "list", "table", "bridge", self._table)
        rules = json.loads(_do("ip", "netns", "exec", self._switch, "nft", *listing))["nftables"]
        parts = [part for rule in rules if "rule" in rule for part in rule["rule"]["expr"]]
        return [part["counter"]["packets"] for part in parts if "counter" in part]


class Network:
    """Hosts on a switch, in the order of their names; gone when closed, with whatever still runs on them."""

    def __init__(self, *names: str) -> None:
        if os.geteuid() != 0:
            pytest.skip("hosts on one machine are network namespaces, which only root can make")
        remove_leftovers()
        self._namespaces = [f"{PREFIX}-{os.getpid()}-{name}" for name in ("switch", *names)]
        try:
            for namespace in self._namespaces:
                _ours.add(namespace)
                _do("ip", "netns", "add", namespace)
            switch = self._namespaces[0]
            _do("ip", "-n", switch, "link", "add", "switch", "type", "bridge", "stp_state", 0)
            _do("ip", "-n", switch, "link", "set", "switch", "up")
            self.hosts = [
                Host(switch, namespace, name, f"10.77.0.{i}")
                for i, (namespace, name) in enumerate(zip(self._namespaces[1:], names, strict=True), 1)
            ]
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Removes everything; once is enough."""
        for namespace in self._namespaces:
            _remove(namespace)
            _ours.discard(namespace)


def remove_leftovers() -> None:
    """Removes the namespaces of processes that ended without doing so."""
    for path in NAMESPACES.glob(f"{PREFIX}-*-*"):
        pid = path.name.split("-")[1]
        dead = pid == str(os.getpid()) or not Path(f"/proc/{pid}").exists()  # a container's pids come again
        if pid.isdecimal() and dead and path.name not in _ours:
            _remove(path.name)


def _remove(namespace: str) -> None:
    """Ends what runs in a namespace, and removes it; also half of one."""
    if not (NAMESPACES / namespace).exists():
        return
    found = subprocess.run(["ip", "netns", "pids", namespace], capture_output=True, text=True)
    for pid in found.stdout.split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    subprocess.run(["ip", "netns", "delete", namespace], capture_output=True)


class Tunnel(Wire):
    """A wire whose connections come out on a host and go on to an address there.

    With `tls` they are plain on this side and encrypted on that.
    """

    def __init__(self, host: Host, address: str, port: int, tls: ssl.SSLContext | None = None) -> None:
        self._target, self._tls = (address, port), tls
        self._inside = ThreadPoolExecutor(1, "tunnel", _enter, (host.namespace,))
        """A thread on the host: a socket stays where it was made, whoever uses it."""
        super().__init__(port)

    async def _reach(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        loop = asyncio.get_running_loop()
        there = await loop.run_in_executor(self._inside, socket.create_connection, self._target, 5.0)
        there.setblocking(False)
        name = self._target[0] if self._tls else None
        return await asyncio.open_connection(sock=there, ssl=self._tls, server_hostname=name)

    def close(self) -> None:
        """Ends everything."""
        super().close()
        self._inside.shutdown()


def _enter(namespace: str) -> None:
    """Moves the calling thread to a namespace, for good."""
    libc = ctypes.CDLL(None, use_errno=True)
    with (NAMESPACES / namespace).open() as file:
        if libc.setns(file.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"cannot enter {namespace}")
