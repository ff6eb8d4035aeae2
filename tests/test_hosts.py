"""A run on three hosts: learner and curriculum on one, an actor on each of two others, and bad links."""

import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from common.access import LOCAL
from common.bus import Keys, Member
from common.members import Members
from learner.log import Record
from tests.crew import SETTINGS, Crew, Id, assert_nothing_is_lost_and_nothing_there_twice, ids
from tests.helpers import wait_until
from tests.netns import Network, Tunnel

GROUPS = {"a": "actor-one", "b": "actor-two"}
"""Common names of the certificates of the actors' hosts."""
PORT = 7447
BACK = 10.0
"""Seconds within which an actor is back after its link is."""
STOP = 5.0
"""Seconds within which everything ends."""


class ByName(Members):
    """Actors go by their names, whatever their group is."""

    def of(self, role: str) -> dict:
        return {member.name: stat.values for member, stat in list(self.stats.items()) if member.role == role}


class Hosts(Crew):
    """A crew on three hosts, over mutual TLS with a folder of certificates, else over plain TCP.

    Its checks know of no groups: log and spools show those of the actors as `local`, once they are right.
    """

    def __init__(self, folder: Path, network: Network, certs: Path | None = None) -> None:
        super().__init__(folder)
        self.centre, *others = network.hosts
        self.host = dict(zip(GROUPS, others, strict=True))
        """Of each actor."""
        self.certs = certs
        self.groups = GROUPS if certs else dict.fromkeys(GROUPS, LOCAL)
        self.hub = f"{'tls' if certs else 'tcp'}/{self.centre.address}:{PORT}"
        operator = None
        if certs:
            own = certs / "operator"
            operator = ssl.create_default_context(cafile=own / "ca.pem")
            operator.load_cert_chain(own / "cert.pem", own / "key.pem")
        self.tunnel = Tunnel(self.centre, self.centre.address, PORT, operator)
        self.endpoint = self.tunnel.endpoint

    def start_all(self) -> None:
        self.start_learner()
        wait_until(lambda: "listens on" in self.words("learner"), 60, "the hub")
        for name in ("curriculum", *GROUPS):
            self.start_other(name)

    def start_learner(self) -> int:
        command = ("learner", "--run", self.run, "--listen", self.hub, *SETTINGS, *self._pass("learner"))
        return self.start("learner", *command, inside=self.centre.inside).pid

    def start_other(self, name: str) -> None:
        if name == "curriculum":
            inside, certificate = self.centre.inside, name
            command = ("curriculum", "serve", "--run", self.run)
        else:
            inside, certificate = self.host[name].inside, self.groups[name]
            command = ("actor", "--name", name, "--spool", self.spool)
        self.start(name, *command, "--connect", self.hub, *self._pass(certificate), inside=inside)

    def _pass(self, certificate: str) -> tuple[str | Path, ...]:
        return ("--certs", self.certs / certificate) if self.certs else ("--insecure",)

    @contextmanager
    def listening(self) -> Iterator[zenoh.Session]:
        with super().listening() as session:
            self.monitor = ByName(session, Keys("run"))
            yield session

    def log(self) -> list[Record]:
        records = super().log()
        return [
            r._replace(origin=r.origin.model_copy(update={"actor": self._local(r.origin.actor)}))
            for r in records
        ]

    def waiting(self) -> set[Id]:
        return {(self._local(address), boot, seq) for address, boot, seq in super().waiting()}

    def _local(self, address: str) -> str:
        group, name = address.split("/")
        assert self.groups[name] == group, f"{address} is not the name of an actor here"
        return f"{LOCAL}/{name}"

    def waiting_of(self, name: str) -> set[Id]:
        return {episode for episode in self.waiting() if episode[0] == f"{LOCAL}/{name}"}

    def sent(self, name: str) -> float:
        """Episodes of an actor that were acknowledged, as last told."""
        return self.monitor.of("actor").get(name, {}).get("acknowledged", 0)

    def weights(self, name: str) -> int:
        """Updates behind the newest weights of an actor, as last told."""
        version = str(self.monitor.of("actor").get(name, {}).get("weights", 0))
        return int(version.rpartition(".")[2])

    def here(self, name: str) -> bool:
        return Member("actor", self.groups[name], name) in self.monitor.alive

    def close(self) -> None:
        super().close()
        self.tunnel.close()


@pytest.fixture
def network() -> Iterator[Network]:
    found = Network("centre", "one", "two")
    yield found
    found.close()


@pytest.fixture
def plain(network: Network, tmp_path: Path) -> Iterator[Hosts]:
    found = Hosts(tmp_path, network)
    yield found
    found.close()


@pytest.fixture
def secure(network: Network, tmp_path: Path) -> Iterator[Hosts]:
    certs = tmp_path / "certs"
    groups = [word for group in GROUPS.values() for word in ("--group", group)]
    command = ("certs", "init", certs, "--host", network.hosts[0].address, *groups)
    subprocess.run([sys.executable, "-m", "deploy.cli", *map(str, command)], check=True)
    found = Hosts(tmp_path, network, certs)
    yield found
    found.close()


def wait_for_training_of_both(hosts: Hosts) -> None:
    """Until the learner learns from both actors, and both drive with what it has learned."""
    hosts.wait_for_training(90)
    for name in GROUPS:
        wait_until(lambda n=name: hosts.sent(n) > 3, 60, f"episodes of {name}")
        wait_until(lambda n=name: hosts.weights(n) > 0, 60, f"weights at {name}")
    assert {address for address, *_ in ids(hosts.log())} == {f"{LOCAL}/{name}" for name in GROUPS}
    wait_until(lambda: hosts.monitor.curriculum.get("outcomes", 0) > 0, 30, "outcomes at the curriculum")
    wait_until(lambda: hosts.figure("tasks/gate") > 0, 30, "episodes of tasks of the curriculum")
    assert hosts.figure("refused") == 0


def assert_all_goes_on(hosts: Hosts) -> None:
    """Updates, new weights at both actors, and episodes of both that were driven with them."""
    updates = hosts.figure("updates")
    wait_until(lambda: hosts.figure("updates") > updates + 50, 30, "updates")
    for name in GROUPS:
        wait_until(lambda n=name: hosts.weights(n) > updates, 30, f"new weights at {name}")
        sent = hosts.sent(name)
        wait_until(lambda n=name, s=sent: hosts.sent(n) > s + 3, 30, f"episodes of {name}")


def partition(hosts: Hosts, name: str, seconds: float) -> set[Id]:
    """Cuts an actor's host off for so long; which episodes waited there when its link came back."""
    (other,) = GROUPS.keys() - {name}
    sent, updates = hosts.sent(other), hosts.figure("updates")
    waited = len(hosts.waiting_of(name))
    hosts.host[name].cut()
    time.sleep(seconds)
    # the other goes on, and what the cut one makes meanwhile waits
    wait_until(lambda: hosts.sent(other) > sent, 20, f"episodes of {other}")
    wait_until(lambda: hosts.figure("updates") > updates, 20, "updates without the one that is cut off")
    wait_until(lambda: len(hosts.waiting_of(name)) > waited + 2, 20, f"episodes that wait at {name}")
    held, newest = hosts.waiting_of(name), max(hosts.figure("updates"), hosts.weights(name) + 1)
    hosts.host[name].mend()
    mended = time.monotonic()
    wait_until(lambda: hosts.here(name) and hosts.weights(name) >= newest, BACK, f"{name} with new weights")
    back = time.monotonic() - mended
    wait_until(lambda: not held & hosts.waiting(), 30, "delivery of what had waited")
    print(
        f"cut off for {seconds} s, {len(held)} episodes waiting: a member with new weights {back:.1f} s, "
        f"all delivered {time.monotonic() - mended:.1f} s after"
    )
    return held


def stop_all(hosts: Hosts) -> None:
    """All at once, as when hosts are shut down."""
    began, ended = time.monotonic(), dict[str, float]()

    def all_ended() -> bool:
        for name, process in hosts.running.items():
            if name not in ended and process.poll() is not None:
                ended[name] = round(time.monotonic() - began, 1)
        return len(ended) == len(hosts.running)

    for process in hosts.running.values():
        process.terminate()
    wait_until(all_ended, STOP, "the end of all")
    print(f"ended after the signal, s: {ended}")
    for name, process in hosts.running.items():
        assert process.returncode == 0, hosts.words(name)
        assert "Traceback" not in hosts.words(name), hosts.words(name)


def assert_whole(hosts: Hosts, held: set[Id]) -> None:
    """Nothing is lost and nothing there twice, in particular of what was held up."""
    found = set(ids(assert_nothing_is_lost_and_nothing_there_twice(hosts)))
    assert held <= found
    assert len(found) >= sum(hosts.of_actors("acknowledged"))


@pytest.mark.timeout(480)
def test_hosts_train_over_mutual_tls_and_one_that_is_cut_off_for_four_seconds_comes_back(secure):
    secure.start_all()
    with secure.listening():
        wait_for_training_of_both(secure)
        held = partition(secure, "b", 4.0)
        assert_all_goes_on(secure)
        stop_all(secure)
        assert_whole(secure, held)


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_hosts_train_over_plain_tcp(plain):
    plain.start_all()
    with plain.listening():
        wait_for_training_of_both(plain)
        assert_all_goes_on(plain)
        stop_all(plain)
        assert_whole(plain, set())


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_host_that_is_cut_off_for_sixteen_seconds_comes_back(secure):
    secure.start_all()
    with secure.listening():
        wait_for_training_of_both(secure)
        held = partition(secure, "b", 16.0)
        assert "actor actor-two/b left" in secure.words("learner"), "it was missed meanwhile"
        assert_all_goes_on(secure)
        stop_all(secure)
        assert_whole(secure, held)


@pytest.mark.slow
@pytest.mark.timeout(480)
def test_hosts_on_links_that_lose_packets_or_are_narrow_train_and_lose_nothing(secure):
    secure.host["a"].lose(2)
    secure.host["b"].narrow(20)
    secure.start_all()
    with secure.listening():
        wait_for_training_of_both(secure)
        for _ in range(3):
            assert_all_goes_on(secure)
        wait_until(lambda: min(secure.host["a"].lost()) > 20, 60, "packets that vanish each way")
        stop_all(secure)
        print(f"{secure.host['a'].lost()} packets of a vanished")
        assert_whole(secure, set())
