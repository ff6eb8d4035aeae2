"""Who may do what on a hub with certificates, over real TLS, and what those are told whom it refuses."""

import json
import logging
import shutil
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from cryptography.hazmat.primitives.asymmetric import ec
from hypothesis import given, settings
from hypothesis import strategies as st

from common.access import (
    BETWEEN_HUBS,
    ROLES,
    Credentials,
    Rights,
    access_control,
    actor_rights,
    explain_refusal,
    load_credentials,
)
from common.bus import (
    EVERYBODY,
    Keys,
    Member,
    QueryServer,
    Subscription,
    announce,
    ask_bytes,
    publish,
    watch_members,
)
from common.contract import fetch_contract
from common.delivery import DuplicateFilter, Parcel, Receiver, Sender, Spool, pack_bundle
from common.errors import NoAnswerError, RefusedError, UsageError
from common.link import make_link, open_client, open_hub, open_router
from common.messages import (
    MEGABYTE,
    PROTOCOL,
    ContractReply,
    Nothing,
    Origin,
    Receipt,
    Stat,
    Version,
    decode,
    encode,
)
from deploy import certs
from tests.helpers import free_endpoint, wait_until

HOSTS = ("127.0.0.1", "hub.lan")
PAIR = ("cert.pem", "key.pem")
RUNS = count()
A, B = Member("actor", "actor-a", "0"), Member("actor", "actor-b", "0")
CURRICULUM = Member("curriculum", "curriculum", "curriculum")
LEARNER = Member("learner", "learner", "learner")
STORED = Receipt(answers=[""])
ENDED = -0.001
"""Days: a certificate that was made a minute ago or so ended then."""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Two authorities; the hubs of `ca` admit actor-a and actor-b, but not actor-c."""
    folder = tmp_path_factory.mktemp("made")
    certs.create(folder / "ca", ["actor-a", "actor-b"], HOSTS)
    certs.create(folder / "foreign", ["actor-a"], HOSTS)
    for changed in certs.issue(folder / "ca", "actor-c"):
        changed.write_text("actor-a\nactor-b\n")
    return folder


@pytest.fixture
def root(made, tmp_path) -> Path:
    """A copy of `made` to damage."""
    return shutil.copytree(made, tmp_path / "copy")


def free_tls_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


def unchecked(folder: Path) -> Credentials:
    """As load_credentials gave them before they ended, say."""
    return Credentials(folder, folder.name, ())


def mixed(root: Path, authority: str, pair: str) -> Path:
    """A folder with the ca.pem of one authority, and actor-a's certificate and key of another."""
    folder = root / "mixed" / "actor-a"
    shutil.copytree(root / pair / "actor-a", folder)
    shutil.copy(root / authority / "ca.pem", folder)
    return folder


# Reading a folder


def test_credentials_know_their_name_their_files_and_whom_they_admit(made):
    learner, actor = load_credentials(made / "ca" / "learner"), load_credentials(made / "ca" / "actor-a")
    assert (learner.name, learner.groups) == ("learner", ("actor-a", "actor-b"))
    assert (actor.name, actor.groups) == ("actor-a", ())
    tls = actor.tls()
    assert tls["enable_mtls"] is True and tls["verify_name_on_connect"] is True
    files = {key: Path(value) for key, value in tls.items() if isinstance(value, str)}
    assert all(file.parent == actor.folder and file.exists() for file in files.values())
    assert {file.name for file in files.values()} == {"ca.pem", *PAIR}


@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
def test_a_missing_file_is_named(root, name):
    folder = root / "ca" / "actor-a"
    (folder / name).unlink()
    with pytest.raises(UsageError, match=rf"^--certs .*: cannot read .*/actor-a/{name} \(No such file"):
        load_credentials(folder)
    with pytest.raises(
        UsageError, match=r"cannot read .*`navaclq certs init` and `issue` make such folders$"
    ):
        load_credentials(root / "nowhere")


@pytest.mark.parametrize("content", [b"", b"\xff\x00junk", b"-----BEGIN CERTIFICATE-----\nAAAA\n"])
@pytest.mark.parametrize("name", ["ca.pem", "cert.pem", "key.pem"])
def test_what_is_not_pem_is_refused(root, name, content):
    folder = root / "ca" / "actor-a"
    (folder / name).write_bytes(content)
    with pytest.raises(UsageError, match=r"actor-a: not a PEM certificate and key \("):
        load_credentials(folder)


def test_the_key_of_another_certificate_is_refused(root):
    shutil.copy(root / "ca" / "actor-b" / "key.pem", root / "ca" / "actor-a")
    with pytest.raises(UsageError, match=r"actor-a: key\.pem does not belong to cert\.pem$"):
        load_credentials(root / "ca" / "actor-a")


def test_a_certificate_of_another_authority_is_refused(root):
    """Of the same name, and of another one."""
    folder = mixed(root, "ca", "foreign")
    for authority in (root / "ca" / "ca.pem", folder / "cert.pem"):
        (folder / "ca.pem").write_bytes(authority.read_bytes())
        with pytest.raises(UsageError, match=r"actor-a: cert\.pem is not of the authority in ca\.pem$"):
            load_credentials(folder)


def test_a_certificate_that_ended_is_refused(root):
    certs.issue(root / "ca", "actor-a", days=ENDED)
    with pytest.raises(UsageError, match=r"cert\.pem ended on \d{4}-\d\d-\d\d; `navaclq certs issue` renews"):
        load_credentials(root / "ca" / "actor-a")


@pytest.mark.parametrize("name", ["**", "actor-a/*", "actor a", "äctor", "actor-a$*", "a\n"])
def test_an_odd_common_name_or_group_is_refused(root, name):
    """What would be a pattern, or another key, in a rule."""
    folder, key = root / "ca" / "actor-a", ec.generate_private_key(ec.SECP256R1())
    certificate = certs._new_certificate(certs.read_authority(root / "ca"), name, key, [], days=1)
    for file in PAIR:
        (folder / file).unlink()
    certs._write(folder / "cert.pem", certs._pem(certificate))
    certs._write_key(folder / "key.pem", key)
    with pytest.raises(UsageError, match="is no role and no group of actors") as found:
        load_credentials(folder)
    assert repr(name) in str(found.value)


def test_an_odd_group_in_the_list_is_refused(root):
    (root / "ca" / "learner" / "groups.txt").write_text("actor-a\nactor-*\n")
    with pytest.raises(UsageError, match=r"learner: 'actor-\*' is no role and no group of actors"):
        load_credentials(root / "ca" / "learner")


@pytest.mark.parametrize("content", [b"actor-a\noperator\n", b"\xff\xfe"])
def test_a_list_with_a_role_or_without_text_is_refused(root, content):
    (root / "ca" / "learner" / "groups.txt").write_bytes(content)
    with pytest.raises(UsageError, match=r"groups.txt names operator|not a PEM certificate and key"):
        load_credentials(root / "ca" / "learner")


# The rules


groups = st.from_regex(r"actor-[A-Za-z0-9_.-]{1,20}", fullmatch=True)


def allowed(groups: tuple[str, ...], subject: str, message: str, flow: str) -> list[zenoh.KeyExpr]:
    """The keys for which a hub lets this message of a subject pass."""
    found = access_control(groups)
    own = [policy["rules"] for policy in found["policies"] if subject in policy["subjects"]]
    rules = [rule for rule in found["rules"] if rule["id"] in own[0]]
    fitting = [rule for rule in rules if message in rule["messages"] and flow in rule["flows"]]
    return [zenoh.KeyExpr(key) for rule in fitting for key in rule["key_exprs"]]


def may(groups: tuple[str, ...], subject: str, message: str, flow: str, key: str) -> bool:
    return any(rule.includes(zenoh.KeyExpr(key)) for rule in allowed(groups, subject, message, flow))


@settings(max_examples=20)
@given(st.lists(groups, max_size=5, unique=True).map(tuple))
def test_the_rules_deny_what_they_do_not_name_and_give_every_subject_one_policy(groups):
    found = access_control(groups)
    assert (found["enabled"], found["default_permission"]) == (True, "deny")
    names = {*ROLES, *groups}
    assert {subject["id"] for subject in found["subjects"]} == names
    assert all(subject["cert_common_names"] == [subject["id"]] for subject in found["subjects"])
    assert sorted(policy["subjects"][0] for policy in found["policies"]) == sorted(names)
    assert all(len(policy["subjects"]) == 1 for policy in found["policies"])
    ids = [rule["id"] for rule in found["rules"]]
    assert len(ids) == len(set(ids))
    assert sorted(ids) == sorted(rule for policy in found["policies"] for rule in policy["rules"])
    for rule in found["rules"]:
        assert rule["permission"] == "allow" and rule["messages"] and len(rule["flows"]) == 1
        assert rule["key_exprs"] and all(key.startswith("navaclq/*/") for key in rule["key_exprs"])


@settings(max_examples=20)
@given(groups, groups)
def test_a_group_says_nothing_under_the_name_of_another(one, other):
    if one == other:
        return
    keys, member = Keys("run-1"), Member("actor", other, "0")
    sent = {
        "query": [f"{c}/{other}/0" for c in (keys.trajectory, keys.frames, keys.result, keys.candidates)],
        "put": [keys.stat(member), keys.version],
        "liveliness_token": [keys.live(member, "1")],
        "declare_liveliness_subscriber": [keys.live(member, "1")],
        "declare_queryable": [keys.contract, keys.weights("policy"), keys.task, keys.score, keys.snapshot],
        "reply": [keys.contract, keys.weights("policy"), keys.task, keys.score, keys.snapshot],
        "delete": [keys.version, keys.stat(Member("actor", one, "0"))],
    }
    for message, forbidden in sent.items():
        rules = allowed((one, other), one, message, "ingress")
        assert not any(rule.intersects(zenoh.KeyExpr(key)) for rule in rules for key in forbidden)
    assert may((one, other), other, "query", "ingress", f"{keys.trajectory}/{other}/0")


def test_only_hubs_offer_weights_and_contracts_and_only_actors_deliver():
    keys, groups = Keys("run-1"), ("actor-a",)
    for subject in ("curriculum", "operator", "actor-a"):
        for key in (keys.weights("policy"), keys.weights("critic"), keys.contract):
            assert not may(groups, subject, "declare_queryable", "ingress", key)
            assert not may(groups, subject, "reply", "ingress", key)
        assert not may(groups, subject, "put", "ingress", keys.version)
        assert may(groups, subject, "put", "egress", keys.version)
        assert may(groups, subject, "query", "ingress", keys.contract)
        delivers = may(groups, subject, "query", "ingress", f"{keys.trajectory}/actor-a/0")
        assert delivers == (subject == "actor-a")
    for question in (keys.task, keys.score, keys.snapshot):
        assert may(groups, "curriculum", "declare_queryable", "ingress", question)
        assert may(groups, "actor-a", "query", "ingress", question)
        assert may(groups, "operator", "query", "ingress", question)
        assert not may(groups, "curriculum", "query", "ingress", question)
    assert not may(groups, "actor-a", "query", "ingress", keys.weights("critic"))


def test_an_operator_has_the_right_to_ask_hear_and_watch_only():
    assert ROLES["operator"]._replace(asks=(), hears=(), watches=()) == Rights()
    assert {role for role, rights in ROLES.items() if rights == BETWEEN_HUBS} == {"learner", "router"}
    assert actor_rights("actor-a").serves == ()


# A system with certificates


class Place(NamedTuple):
    """Where clients connect: at the learner's hub, or at a router that is connected to it."""

    hub: zenoh.Session
    hub_endpoint: str
    endpoint: str
    ca: Path

    def join(self, name: str):
        """A client with the certificate of that name."""
        return open_client(make_link(self.endpoint, load_credentials(self.ca / name)), patience=60.0)


@pytest.fixture(scope="module", params=["hub", "router"])
def place(made, request) -> Iterator[Place]:
    ca, first, second = made / "ca", free_tls_endpoint(), free_tls_endpoint()
    at_hub = make_link(first, load_credentials(ca / "learner"))
    with ExitStack() as stack:
        hub = stack.enter_context(open_hub(at_hub))
        if request.param == "router":
            credentials = load_credentials(ca / "router")
            stack.enter_context(open_router(make_link(second, credentials), make_link(first, credentials)))
        yield Place(hub, first, second if request.param == "router" else first, ca)


@pytest.fixture
def keys() -> Keys:
    """Of a run of its own for each test."""
    return Keys(f"run-{next(RUNS)}")


@pytest.fixture
def serve() -> Iterator[Callable[[zenoh.Session, str, bytes], None]]:
    """Answers questions on a key with a text until the test ends: the next asks for contracts of any run."""
    with ExitStack() as stack:

        def answer(session: zenoh.Session, key: str, text: bytes) -> None:
            stack.callback(QueryServer(session, key, lambda *_: text).close)

        yield answer


class Store:
    """What a Receiver on a channel took in."""

    def __init__(self, session: zenoh.Session, channel: str) -> None:
        self.stored: list[str] = []
        self._seen = DuplicateFilter()
        self.receiver = Receiver(session, channel, self._take, self._seen.seen, MEGABYTE)

    def _take(self, parcel: Parcel) -> None:
        self.stored.append(f"{parcel.origin.actor}: {parcel.payload.decode()}")
        self._seen.add(parcel.origin)


def deliver(
    session: zenoh.Session, channel: str, address: str, text: str, author: str | None = None
) -> bytes:
    """One delivery on the key of `address`; its header says `author`."""
    origin = Origin(actor=author or address, boot="b", seq=next(RUNS))
    bundle = pack_bundle([Parcel(origin, zlib.crc32(text.encode()), text.encode())])
    return ask_bytes(session, f"{channel}/{address}", *bundle, timeout=10.0)


def insist(action: Callable[[], object], shows: Callable[[], object]) -> None:
    """Acts until it shows: what others have declared takes a moment to be known."""

    def act() -> object:
        action()
        time.sleep(0.02)
        return shows()

    wait_until(act)


def insist_on_answer(action: Callable[[], bytes]) -> bytes:
    """The first answer."""
    found: list[bytes] = []

    def act() -> None:
        with suppress(NoAnswerError):
            found.append(action())

    insist(act, lambda: found)
    return found[0]


def stat(member: Member) -> Stat:
    return Stat(**member._asdict(), host="h", pid=1, since=0.0, code="c", protocol=PROTOCOL, values={})


def hear_stats(session: zenoh.Session, keys: Keys) -> tuple[list[str], Subscription]:
    """Groups whose figures are heard, by the key that hubs judge by."""
    heard: list[str] = []
    key = keys.stat(EVERYBODY)
    return heard, session.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr)))


def hear_versions(session: zenoh.Session, keys: Keys) -> tuple[list[int], Subscription]:
    heard: list[int] = []
    return heard, Subscription(session, keys.version, Version, lambda version: heard.append(version.counter))


def watch(session: zenoh.Session, keys: Keys) -> tuple[list[tuple[Member, bool]], object]:
    seen: list[tuple[Member, bool]] = []
    return seen, watch_members(session, keys, lambda member, life, alive: seen.append((member, alive)))


@contextmanager
def sending(session: zenoh.Session, folder: Path, member: Member) -> Iterator[Sender]:
    sender = Sender(session, Spool(folder, MEGABYTE), member, "b1", timeout=5.0)
    try:
        yield sender
    finally:
        sender.close(patience=0.0)


def test_an_actor_delivers_under_its_own_name_and_under_no_other(place, keys, tmp_path):
    stored: list[str] = []
    receiver = Receiver(
        place.hub,
        keys.trajectory,
        lambda parcel: stored.append(parcel.origin.actor),
        lambda _: False,
        MEGABYTE,
    )
    with (
        place.join("actor-a") as session,
        sending(session, tmp_path / "b", B) as forged,
        sending(session, tmp_path / "a", A) as own,
    ):
        own.put(keys.trajectory, Nothing())
        wait_until(lambda: own.sent == 1)
        forged.put(keys.trajectory, Nothing())
        wait_until(lambda: forged.trouble)
        own.put(keys.trajectory, Nothing())  # after it on the same session
        wait_until(lambda: own.sent == 2)
        assert stored == ["actor-a/0", "actor-a/0"]
        assert (forged.sent, len(forged.spool)) == (0, 1)
        assert forged.trouble == f"nobody serves {keys.trajectory}/actor-b/0"
        assert not receiver.refused, "not even a refusal: the hub lets nothing of it pass"


def test_on_every_channel_a_hub_stops_what_comes_under_another_name(place, keys):
    with place.join("actor-a") as a, place.join("actor-b") as b, place.join("curriculum") as curriculum:
        at_hub = [Store(place.hub, channel) for channel in (keys.trajectory, keys.frames)]
        at_curriculum = [Store(curriculum, channel) for channel in (keys.result, keys.candidates)]
        channels = (keys.trajectory, keys.frames, keys.result, keys.candidates)
        for store, channel in zip([*at_hub, *at_curriculum], channels, strict=True):
            assert (
                decode(Receipt, insist_on_answer(lambda c=channel: deliver(a, c, "actor-a/0", "1"))) == STORED
            )
            for address in ("actor-b/0", "local/0", "*/*", "**"):
                with pytest.raises(NoAnswerError, match="nobody serves"):
                    deliver(a, channel, address, "forged", author="actor-b/0")
            assert decode(Receipt, deliver(a, channel, "actor-a/1", "2")) == STORED
            assert decode(Receipt, deliver(b, channel, "actor-b/0", "3")) == STORED
            assert store.stored == ["actor-a/0: 1", "actor-a/1: 2", "actor-b/0: 3"]
            assert not store.receiver.refused


def test_a_header_of_another_group_is_refused_logged_once_and_not_stored(place, keys, caplog):
    store = Store(place.hub, keys.trajectory)
    with place.join("actor-a") as session:
        insist_on_answer(lambda: deliver(session, keys.trajectory, "actor-a/0", "1"))
        with caplog.at_level(logging.WARNING):
            for _ in range(3):
                with pytest.raises(RefusedError, match=r"^under another's name: actor-b/0$"):
                    deliver(session, keys.trajectory, "actor-a/0", "forged", author="actor-b/0")
        with pytest.raises(RefusedError, match="under another's name: actor-b/0"):
            deliver(session, keys.trajectory, "actor-a/*", "forged", author="actor-b/0")
        deliver(session, keys.trajectory, "actor-a/0", "2")
    assert store.stored == ["actor-a/0: 1", "actor-a/0: 2"]
    assert store.receiver.refused == {"under another's name": 4}
    assert [record.getMessage() for record in caplog.records] == [
        f"refused a message on {keys.trajectory}/actor-a/{name}: under another's name: actor-b/0"
        for name in ("0", "*")
    ]


def without_certificate(endpoint: str, authority: Path) -> zenoh.Config:
    """Of a client that would trust the hub, and has nothing to show."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 1000,
        "scouting/multicast/enabled": False,
        "transport/link/tls": {"root_ca_certificate": str(authority)},
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def test_strangers_get_no_connection(place, keys, root):
    """Without a certificate, of another authority, and of another authority although they trust ours."""
    store = Store(place.hub, keys.trajectory)

    def come_without() -> None:
        with zenoh.open(without_certificate(place.endpoint, place.ca / "ca.pem")) as session:
            deliver(session, keys.trajectory, "actor-a/0", "forged")

    def come_with(folder: Path) -> None:
        with open_client(make_link(place.endpoint, unchecked(folder))) as session:
            deliver(session, keys.trajectory, "actor-a/0", "forged")

    with ThreadPoolExecutor() as pool:
        bare = pool.submit(come_without)
        foreign = pool.submit(come_with, root / "foreign" / "actor-a")
        trusting = pool.submit(come_with, mixed(root, "ca", "foreign"))
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            bare.result()
        with pytest.raises(UsageError, match="is not of the authority in"):
            foreign.result()
        with pytest.raises(UsageError, match="does not accept"):
            trusting.result()
    with place.join("actor-a") as session:
        insist_on_answer(lambda: deliver(session, keys.trajectory, "actor-a/0", "1"))
    assert store.stored == ["actor-a/0: 1"]


def test_a_group_that_is_not_listed_connects_and_gets_no_answers(place, keys, serve):
    store = Store(place.hub, keys.trajectory)
    for key in (keys.contract, keys.weights("policy")):
        serve(place.hub, key, b"true")
    with place.join("actor-c") as stranger, place.join("actor-a") as a:
        for key in (keys.contract, keys.weights("policy")):
            assert insist_on_answer(lambda k=key: ask_bytes(a, k, b"")) == b"true"
        versions, subscription = hear_versions(stranger, keys)
        for key in (keys.contract, "navaclq/*/contract", keys.weights("policy")):
            with pytest.raises(NoAnswerError, match="nobody serves"):
                ask_bytes(stranger, key, b"")
        with pytest.raises(NoAnswerError, match="nobody serves"):
            deliver(stranger, keys.trajectory, "actor-c/0", "forged")
        publish(place.hub, keys.version, Version(counter=1))
        with pytest.raises(NoAnswerError, match="nobody serves"):  # after the notice, if that came
            ask_bytes(stranger, keys.contract, b"")
        assert (versions, subscription.ignored, store.stored) == ([], 0, [])


def test_a_curriculum_cannot_send_trajectories(place, keys, serve):
    stores = [Store(place.hub, channel) for channel in (keys.trajectory, keys.frames)]
    serve(place.hub, keys.contract, b"true")
    with place.join("curriculum") as session:
        assert insist_on_answer(lambda: ask_bytes(session, keys.contract, b"")) == b"true"
        for channel in (keys.trajectory, keys.frames):
            for address in ("actor-a/0", "curriculum/curriculum", "learner/learner"):
                with pytest.raises(NoAnswerError, match="nobody serves"):
                    deliver(session, channel, address, "forged")
        assert ask_bytes(session, keys.contract, b"") == b"true"
    assert [store.stored for store in stores] == [[], []]


@pytest.mark.parametrize("forger", [A, CURRICULUM], ids=["actor", "curriculum"])
def test_forged_version_notices_reach_nobody_and_true_ones_do(place, keys, forger):
    with (
        place.join(forger.group) as session,
        place.join("actor-b") as other,
        place.join("operator") as operator,
    ):
        listening = [hear_versions(listener, keys) for listener in (other, operator, place.hub)]
        stats, subscription = hear_stats(place.hub, keys)
        everybody = lambda least: all(max(heard, default=0) >= least for heard, _ in listening)  # noqa: E731
        insist(lambda: publish(place.hub, keys.version, Version(counter=1)), lambda: everybody(1))
        insist(lambda: publish(session, keys.stat(forger), stat(forger)), lambda: stats)
        stats.clear()
        publish(session, keys.version, Version(counter=666))
        session.put(keys.version, encode(Version(counter=666)))
        session.put(f"{keys.root}/weights/*", encode(Version(counter=666)))
        session.delete(keys.version)
        insist(lambda: publish(session, keys.stat(forger), stat(forger)), lambda: stats)
        insist(lambda: publish(place.hub, keys.version, Version(counter=2)), lambda: everybody(2))
        assert [set(heard) for heard, _ in listening] == [{1, 2}] * 3
        assert [found.ignored for _, found in listening] == [0, 0, 0]
        subscription.undeclare()


@pytest.mark.parametrize("forger", [A, CURRICULUM], ids=["actor", "curriculum"])
def test_forged_weights_and_contracts_reach_nobody_and_true_ones_do(place, keys, serve, forger):
    asked: list[str] = []
    contract = ContractReply(run=keys.root.split("/")[1], config="", encoder=b"", digest={})
    serve(place.hub, keys.contract, encode(contract))
    serve(place.hub, keys.weights("policy"), b"true")
    store = Store(place.hub, keys.trajectory)

    def forge(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        with query:
            query.reply(query.key_expr, b"forged")

    with (
        place.join(forger.group) as session,
        place.join("actor-b") as other,
        place.join("operator") as operator,
    ):
        insist_on_answer(lambda: deliver(other, keys.trajectory, "actor-b/0", "1"))
        assert insist_on_answer(lambda: ask_bytes(other, keys.weights("policy"), b"")) == b"true"
        seen, watcher = watch(operator, keys)
        forged = [
            session.declare_queryable(key, forge, complete=True)  # such a one is asked first
            for key in (
                keys.weights("policy"),
                keys.contract,
                "navaclq/*/contract",
                f"{keys.trajectory}/*/*",
                f"{keys.root}/**",
            )
        ]
        token = announce(session, keys, forger)  # goes after them on the same session
        wait_until(lambda: (forger, True) in seen)
        for _ in range(10):
            assert fetch_contract(other, patience=0.0) == contract
            assert ask_bytes(other, keys.weights("policy"), b"") == b"true"
            assert ask_bytes(place.hub, keys.weights("policy"), b"") == b"true"
            assert decode(Receipt, deliver(other, keys.trajectory, "actor-b/0", "2")) == STORED
        assert not asked and len(store.stored) == 11
        for declared in (*forged, token, watcher):
            declared.undeclare()


def test_a_liveliness_token_under_another_name_is_not_seen(place, keys):
    with place.join("actor-a") as session, place.join("operator") as operator:
        early, early_watcher = watch(operator, keys)
        others = (B, CURRICULUM, LEARNER, Member("actor", "local", "0"), Member("operator", "operator", "0"))
        forged = [session.liveliness().declare_token(keys.live(other, "x")) for other in others]
        token = announce(session, keys, A)
        wait_until(lambda: early)
        late, late_watcher = watch(operator, keys)
        wait_until(lambda: late)
        for declared in (*forged, token):
            declared.undeclare()
        wait_until(lambda: (A, False) in early and (A, False) in late)
        assert {member for member, _ in early} == {member for member, _ in late} == {A}
        for declared in (early_watcher, late_watcher):
            declared.undeclare()


def test_figures_under_another_name_are_not_heard(place, keys):
    with place.join("actor-a") as session, place.join("operator") as operator:
        at_operator, first = hear_stats(operator, keys)
        at_hub, second = hear_stats(place.hub, keys)
        for other in (B, CURRICULUM, LEARNER, Member("actor", "local", "0")):
            publish(session, keys.stat(other), stat(other))
        insist(lambda: publish(session, keys.stat(A), stat(A)), lambda: at_operator and at_hub)
        for other in (B, CURRICULUM, LEARNER, Member("actor", "local", "0")):
            publish(session, keys.stat(other), stat(other))  # now that somebody is known to listen
        publish(session, f"{keys.root}/stat/*/*/*", stat(B))
        before = len(at_operator), len(at_hub)
        insist(
            lambda: publish(session, keys.stat(A), stat(A)),
            lambda: len(at_operator) > before[0] and len(at_hub) > before[1],
        )
        assert set(at_operator) == set(at_hub) == {keys.stat(A)}
        first.undeclare()
        second.undeclare()


def test_an_operator_hears_everything(place, keys):
    with (
        place.join("actor-a") as a,
        place.join("curriculum") as curriculum,
        place.join("operator") as operator,
    ):
        stats, first = hear_stats(operator, keys)
        versions, _second = hear_versions(operator, keys)
        seen, watcher = watch(operator, keys)
        speakers = {A: a, CURRICULUM: curriculum, LEARNER: place.hub}
        tokens = [announce(session, keys, member) for member, session in speakers.items()]

        def speak() -> None:
            for member, session in speakers.items():
                publish(session, keys.stat(member), stat(member))
            publish(place.hub, keys.version, Version(counter=1))

        insist(speak, lambda: set(stats) == {keys.stat(member) for member in speakers} and versions)
        wait_until(lambda: {member for member, alive in seen if alive} == set(speakers))
        for declared in (first, watcher, *tokens):
            declared.undeclare()


def test_an_operator_sends_nothing_but_questions(place, keys, serve):
    asked: list[str] = []
    store = Store(place.hub, keys.trajectory)
    questions = {keys.task: b"task", keys.score: b"score", keys.snapshot: b"snapshot"}
    answers = {keys.contract: b"contract", keys.weights("policy"): b"weights", **questions}
    serve(place.hub, keys.contract, b"contract")
    serve(place.hub, keys.weights("policy"), b"weights")
    with (
        place.join("operator") as operator,
        place.join("operator") as screen,
        place.join("actor-a") as a,
        place.join("curriculum") as curriculum,
    ):
        for key in questions:
            serve(curriculum, key, answers[key])
        for key, text in answers.items():
            assert insist_on_answer(lambda k=key: ask_bytes(a, k, b"")) == text
        listening = [hear_versions(session, keys) for session in (place.hub, a, screen)]
        stats, figures = hear_stats(place.hub, keys)
        insist(
            lambda: publish(place.hub, keys.version, Version(counter=1)),
            lambda: all(heard for heard, _ in listening),
        )
        seen, watcher = watch(screen, keys)

        for member in (Member("operator", "operator", "0"), A):
            operator.put(keys.stat(member), encode(stat(member)))
        operator.put(keys.version, encode(Version(counter=666)))
        for key in (f"{keys.trajectory}/actor-a/0", f"{keys.trajectory}/operator/0", keys.weights("policy")):
            with pytest.raises(NoAnswerError, match="nobody serves"):
                ask_bytes(operator, key, b"")
        for key in (keys.contract, *questions):  # after all of these
            assert ask_bytes(operator, key, b"") == answers[key]

        declared = [operator.declare_queryable(key, lambda query: asked.append("")) for key in answers]
        for member in (Member("operator", "operator", "0"), A):
            declared.append(operator.liveliness().declare_token(keys.live(member, "x")))
        late, _subscription = hear_versions(operator, keys)  # declared after all of these
        insist(lambda: publish(place.hub, keys.version, Version(counter=2)), lambda: late)
        for key, text in answers.items():
            assert ask_bytes(a, key, b"") == text
        declared.append(announce(a, keys, A))
        insist(
            lambda: publish(place.hub, keys.version, Version(counter=3)),
            lambda: seen and all(3 in heard for heard, _ in listening),
        )
        assert ({member for member, _ in seen}, stats, asked, store.stored) == ({A}, [], [], [])
        assert not any(666 in heard for heard in (late, *(heard for heard, _ in listening)))
        for found in (*declared, figures, watcher):
            found.undeclare()


def test_the_learner_sees_who_comes_and_goes_behind_a_router_and_names_are_unique(place, keys):
    seen, watcher = watch(place.hub, keys)
    at_hub = make_link(place.hub_endpoint, load_credentials(place.ca / "actor-a"))
    with place.join("actor-a") as session, open_client(at_hub) as second:
        token = announce(session, keys, A)
        with pytest.raises(UsageError, match=r"actor named '0' is already connected; choose another --name"):
            announce(second, keys, A)
        wait_until(lambda: (A, True) in seen)
        token.undeclare()
        wait_until(lambda: (A, False) in seen)
    watcher.undeclare()


# A clear word


@contextmanager
def hub_with(folder: Path) -> Iterator[str]:
    """The endpoint of a hub with these certificates, whatever they are."""
    endpoint = free_tls_endpoint()
    with open_hub(make_link(endpoint, unchecked(folder))):
        yield endpoint


def refusal(endpoint: str, folder: Path) -> str:
    """What a client with these certificates is told."""
    with pytest.raises(UsageError) as found, open_client(make_link(endpoint, unchecked(folder))):
        pass
    return str(found.value)


def test_a_hub_of_another_authority_is_explained(root):
    with hub_with(root / "ca" / "learner") as endpoint:
        ours = root / "foreign" / "actor-a"
        assert refusal(endpoint, ours) == (
            f"the certificate of the hub at {endpoint} is not of the authority in {ours}/ca.pem"
        )


def test_a_certificate_that_the_hub_does_not_accept_is_explained(root):
    ours = mixed(root, "ca", "foreign")
    with hub_with(root / "ca" / "learner") as endpoint:
        said = f"the hub at {endpoint} does not accept {ours}/cert.pem: it is of another authority"
        assert refusal(endpoint, ours) == said


def test_a_hub_that_does_not_name_its_host_is_explained_with_the_names_it_has(root):
    with hub_with(root / "ca" / "learner") as endpoint:
        wrong = endpoint.replace("127.0.0.1", "localhost")
        assert refusal(wrong, root / "ca" / "actor-a") == (
            f"the certificate of the hub at {wrong} does not name localhost but 127.0.0.1, hub.lan; "
            "`navaclq certs issue --host` renews it"
        )


def test_a_certificate_that_ended_since_it_was_read_is_explained(root):
    certs.issue(root / "ca", "actor-a", days=ENDED)
    ours = root / "ca" / "actor-a"
    with hub_with(root / "ca" / "learner") as endpoint:
        said = (
            f"the hub at {endpoint} does not accept {ours}/cert.pem: it is not valid now, by the clock there"
        )
        assert refusal(endpoint, ours) == said


def test_a_hub_whose_certificate_ended_is_explained_also_behind_one_that_is_away(root):
    certs.issue(root / "ca", "learner", days=ENDED)
    ours, away = root / "ca" / "actor-a", free_tls_endpoint()
    with hub_with(root / "ca" / "learner") as endpoint:
        said = f"the certificate of the hub at {endpoint} is not valid now, by the clock here"
        with (
            pytest.raises(UsageError) as found,
            open_client(make_link(f"{away},{endpoint}", unchecked(ours))),
        ):
            pass
        assert str(found.value) == said


def test_a_hub_with_a_certificate_that_may_not_listen_is_explained(root):
    with hub_with(root / "ca" / "actor-b") as endpoint:
        said = f"the certificate of the hub at {endpoint} is not that of a role which listens"
        assert refusal(endpoint, root / "ca" / "actor-a") == said


def test_nothing_is_explained_when_nobody_answers_or_all_is_well(made):
    ours = load_credentials(made / "ca" / "actor-a")
    with hub_with(made / "ca" / "learner") as endpoint:
        assert explain_refusal(endpoint, ours) is None
    assert explain_refusal(endpoint, ours) is None, "nobody listens any more"
    with (
        pytest.raises(NoAnswerError, match="no hub answers"),
        open_client(make_link(endpoint, ours), patience=0.0),
    ):
        pass
    assert explain_refusal("tls/no-such-host.invalid:7447", ours) is None


def test_nothing_is_explained_when_something_else_answers(made):
    """One that is silent, as a frozen hub, one that hangs up, as a hub that ends, and one without TLS."""
    ours = load_credentials(made / "ca" / "actor-a")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        began = time.monotonic()
        assert explain_refusal(f"tls/127.0.0.1:{silent.getsockname()[1]}", ours) is None
        assert 1.5 < time.monotonic() - began < 20
    for answer in (b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x15\x03\x03\x00\x02\x02\x50"):
        with socket.create_server(("127.0.0.1", 0)) as server:

            def serve(server=server, answer=answer) -> None:
                connection, _ = server.accept()
                with connection:
                    connection.recv(4096)
                    connection.sendall(answer)

            thread = threading.Thread(target=serve)
            thread.start()
            assert explain_refusal(f"tls/127.0.0.1:{server.getsockname()[1]}", ours) is None
            thread.join()


def test_the_command_line_says_in_one_sentence_why_a_hub_refuses(root):
    ours = root / "foreign" / "actor-a"
    with hub_with(root / "ca" / "learner") as endpoint:
        command = ["actor", "--connect", endpoint, "--certs", str(ours)]
        done = subprocess.run(
            [sys.executable, "-m", "deploy.cli", *command], capture_output=True, text=True, timeout=150
        )
    said = f"the certificate of the hub at {endpoint} is not of the authority in {ours}/ca.pem"
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == f"error: {said}"
    assert "Traceback" not in done.stderr
