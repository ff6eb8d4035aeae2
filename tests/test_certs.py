"""`navaclq certs`: who is let in by the certificates it makes, and what is left when it cannot make them."""

import json
import shutil
import socket
import ssl
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from cryptography.x509.oid import NameOID
from cryptography.x509.verification import (
    Criticality,
    ExtensionPolicy,
    PolicyBuilder,
    Store,
    VerificationError,
)

from common.errors import UsageError
from common.files import lock
from deploy import certs
from tests.helpers import largest_file
from tests.test_cli import call

LISTENERS = {"learner", "curriculum", "router"}
NAMES = {*LISTENERS, "operator", "actor-a", "actor-b"}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two authorities, for the tests to copy: `ca` with two groups of actors, and `foreign`."""
    folder = tmp_path_factory.mktemp("made")
    certs.create(folder / "ca", ["actor-b", "actor-a"])
    certs.create(folder / "foreign", ["actor-a"])
    return folder


@pytest.fixture
def root(made, tmp_path):
    """An authority with two groups of actors."""
    return shutil.copytree(made / "ca", tmp_path / "ca")


@pytest.fixture
def foreign(made, tmp_path):
    """Another authority, whose names are the same."""
    return shutil.copytree(made / "foreign", tmp_path / "foreign")


def load(folder):
    return x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())


def extension(certificate, kind):
    return certificate.extensions.get_extension_for_class(kind)


def fits(folder):
    """Whether key and certificate of a folder are a pair."""
    key = load_pem_private_key((folder / "key.pem").read_bytes(), None)
    return key.public_key() == load(folder).public_key()


def hosts(folder):
    return [str(name.value) for name in extension(load(folder), x509.SubjectAlternativeName).value]


def groups(root):
    """What the three lists hold."""
    return [(root / role / "groups.txt").read_text() for role in sorted(LISTENERS)]


def content(root):
    """Everything in a folder but the lock, to see whether it changed."""
    files = [file for file in root.rglob("*") if file.name != ".lock"]
    return {str(file.relative_to(root)): file.read_bytes() if file.is_file() else None for file in files}


def verifiers(root):
    """For servers the rules of browsers; for clients too, but that they need no alternative name."""
    authority = x509.load_pem_x509_certificate((root / "ca.pem").read_bytes())
    leaf = ExtensionPolicy.webpki_defaults_ee().may_be_present(
        x509.SubjectAlternativeName, Criticality.AGNOSTIC, None
    )
    strict = PolicyBuilder().store(Store([authority]))
    nameless = strict.extension_policies(ca_policy=ExtensionPolicy.webpki_defaults_ca(), ee_policy=leaf)
    return strict.build_server_verifier, nameless.build_client_verifier()


def test_every_certificate_carries_its_name_and_may_connect(root):
    assert {path.name for path in root.iterdir()} == NAMES | {"ca.pem", "ca.key"}
    _, verifier = verifiers(root)
    for name in NAMES:
        certificate = load(root / name)
        assert len(verifier.verify(certificate, []).chain) == 2
        assert [a.value for a in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == [name]
        assert (root / name / "ca.pem").read_bytes() == (root / "ca.pem").read_bytes()
        assert fits(root / name)


def test_only_roles_that_listen_may_serve_and_only_on_their_hosts(root):
    server, _ = verifiers(root)
    ours = [x509.DNSName("localhost"), *(x509.IPAddress(ip_address(a)) for a in ("127.0.0.1", "::1"))]
    for host in ours:
        for name in LISTENERS:
            server(host).verify(load(root / name), [])
        for name in NAMES - LISTENERS:
            with pytest.raises(VerificationError):
                server(host).verify(load(root / name), [])
    assert socket.gethostname() in hosts(root / "learner")
    with pytest.raises(VerificationError):
        server(x509.DNSName("elsewhere")).verify(load(root / "learner"), [])


def test_a_certificate_of_another_authority_of_the_same_name_is_not_ours(root, foreign):
    _, verifier = verifiers(root)
    with pytest.raises(VerificationError):
        verifier.verify(load(foreign / "actor-a"), [])


def test_certificates_are_what_strict_verifiers_want(root):
    now = datetime.now(UTC)
    authority = x509.load_pem_x509_certificate((root / "ca.pem").read_bytes())
    for certificate, days in [(authority, 3650), *((load(root / name), 825) for name in NAMES)]:
        assert certificate.version == x509.Version.v3
        assert 0 < certificate.serial_number < 2**159  # at most 20 bytes, and positive
        assert timedelta(minutes=5) <= now - certificate.not_valid_before_utc < timedelta(minutes=35)
        assert timedelta(days=days) - timedelta(minutes=30) < certificate.not_valid_after_utc - now
        assert certificate.not_valid_after_utc - now <= timedelta(days=days)
        basic, usage = extension(certificate, x509.BasicConstraints), extension(certificate, x509.KeyUsage)
        signs = certificate is authority
        assert basic.critical and usage.critical
        assert (basic.value.ca, basic.value.path_length) == (signs, 0 if signs else None)
        uses = (usage.value.digital_signature, usage.value.key_cert_sign, usage.value.crl_sign)
        assert uses == (not signs, signs, signs)
    key = extension(authority, x509.SubjectKeyIdentifier).value.digest
    assert extension(load(root / "learner"), x509.AuthorityKeyIdentifier).value.key_identifier == key
    assert len({load(root / name).serial_number for name in NAMES}) == len(NAMES)


def test_a_certificate_ends_with_its_authority_at_the_latest(root):
    certs.issue(root, "operator", days=4000)
    authority = x509.load_pem_x509_certificate((root / "ca.pem").read_bytes())
    assert load(root / "operator").not_valid_after_utc == authority.not_valid_after_utc


def test_keys_are_for_their_owner_alone(root):
    certs.issue(root, "learner")
    certs.issue(root, "actor-c")
    assert {path.stat().st_mode & 0o777 for path in [root, *root.glob("*/")]} == {0o700}
    keys = [root / "ca.key", *root.glob("*/key.pem")]
    assert len(keys) == 1 + len(NAMES) + 1
    assert {path.stat().st_mode & 0o777 for path in keys} == {0o600}


def handshake(server, client, authority):
    """Mutual TLS over loopback: the name that the server sees; ssl.SSLError when either side refuses.

    `client` is a folder, or None for no certificate; `authority` is whom the client trusts.
    """
    accepting = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=server / "ca.pem")
    accepting.load_cert_chain(server / "cert.pem", server / "key.pem")
    accepting.verify_mode = ssl.CERT_REQUIRED
    asking = ssl.create_default_context(cafile=authority / "ca.pem")
    if client:
        asking.load_cert_chain(client / "cert.pem", client / "key.pem")

    def accept(listener):
        plain, _ = listener.accept()
        plain.settimeout(10)
        with plain, accepting.wrap_socket(plain, server_side=True) as stream:
            stream.sendall(b"welcome")
            return dict(pair for (pair,) in stream.getpeercert()["subject"])["commonName"]

    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as pool:
        listener.settimeout(10)
        seen = pool.submit(accept, listener)
        with (
            socket.create_connection(listener.getsockname(), timeout=10) as plain,
            asking.wrap_socket(plain, server_hostname="localhost") as stream,
        ):
            assert stream.recv(7) == b"welcome"  # a client of TLS 1.3 hears here that it is refused
        return seen.result()


def test_an_actor_and_the_learner_accept_each_other(root):
    assert handshake(root / "learner", root / "actor-a", root) == "actor-a"


def test_strangers_are_refused(root, foreign):
    with pytest.raises(ssl.SSLError, match=r"(?i)unknown.ca|verify.failed"):
        handshake(root / "learner", foreign / "actor-a", root)
    with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
        handshake(root / "learner", None, root)
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(foreign / "learner", root / "actor-a", root)
    with pytest.raises(ssl.SSLCertVerificationError):  # an actor does not pass for the learner
        handshake(root / "actor-b", root / "actor-a", root)


def open_zenoh(mode, side, endpoint, folder):
    files = {"certificate": folder / "cert.pem", "private_key": folder / "key.pem"}
    tls = {f"{side}_{what}": str(file) for what, file in files.items()}
    tls |= {
        "root_ca_certificate": str(folder / "ca.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        f"{side}/endpoints": [endpoint],
        "connect/timeout_ms": 500,
        "connect/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def test_zenoh_takes_the_certificates_and_refuses_foreign_ones(root, foreign, endpoint):
    endpoint = endpoint.replace("tcp/", "tls/")
    with open_zenoh("peer", "listen", endpoint, root / "learner") as hub:
        with open_zenoh("client", "connect", endpoint, root / "actor-a") as client:
            assert list(client.info.peers_zid()) == [hub.info.zid()]
        shutil.copy(root / "ca.pem", foreign / "actor-a")  # it trusts our learner, who does not trust it
        with pytest.raises(zenoh.ZError):
            open_zenoh("client", "connect", endpoint, foreign / "actor-a").close()


def test_lists_hold_all_groups_in_order_and_only_a_new_group_changes_them(root):
    assert groups(root) == ["actor-a\nactor-b\n"] * 3
    changed = certs.issue(root, "actor-B9")
    assert {file.parent.name for file in changed} == LISTENERS
    assert groups(root) == ["actor-B9\nactor-a\nactor-b\n"] * 3
    assert certs.issue(root, "actor-a") == certs.issue(root, "operator") == []
    assert groups(root) == ["actor-B9\nactor-a\nactor-b\n"] * 3
    assert not (root / "operator" / "groups.txt").exists()


def test_a_group_that_was_taken_off_a_list_stays_off_until_it_is_issued_again(root):
    (root / "learner" / "groups.txt").write_text("actor-a\n")
    certs.issue(root, "learner")
    certs.issue(root, "actor-c")
    assert (root / "learner" / "groups.txt").read_text() == "actor-a\nactor-c\n"
    assert certs.issue(root, "actor-b") == [root / "learner" / "groups.txt"]


def test_a_lost_folder_is_made_again_with_all_groups(root):
    shutil.rmtree(root / "learner")
    shutil.rmtree(root / "actor-a")  # the other lists still know it
    certs.issue(root, "actor-c")
    certs.issue(root, "learner")
    assert groups(root) == ["actor-a\nactor-b\nactor-c\n"] * 3


def test_renewing_brings_a_new_key_and_keeps_hosts_list_and_other_files(root):
    certs.issue(root, "learner", ["a.example", "10.0.0.5", "localhost"])
    old = load(root / "learner")
    (root / "learner" / "notes.txt").write_text("mine")
    certs.issue(root, "learner", days=40)
    new = load(root / "learner")
    assert fits(root / "learner")
    assert new.public_key() != old.public_key()
    assert (new.not_valid_after_utc - datetime.now(UTC)).days in (39, 40)
    assert hosts(root / "learner") == ["a.example", "10.0.0.5", "localhost"]
    assert (root / "learner" / "notes.txt").read_text() == "mine"
    assert groups(root) == ["actor-a\nactor-b\n"] * 3
    assert handshake(root / "learner", root / "actor-a", root) == "actor-a"
    certs.issue(root, "learner", ["b.example", "b.example"])
    assert hosts(root / "learner") == ["b.example"]


@pytest.mark.parametrize("size", [100, 300])  # a key has 241 bytes, a certificate more
def test_a_full_disk_leaves_the_old_pair(root, size):
    before = content(root)
    for name in ("learner", "actor-a", "actor-new"):
        with largest_file(size), pytest.raises(UsageError, match=f"cannot write {root}: File too large"):
            certs.issue(root, name)
    assert content(root) == before
    certs.issue(root, "learner")
    assert fits(root / "learner")


def test_a_full_disk_leaves_nothing_of_a_new_authority(tmp_path):
    (tmp_path / "there").mkdir()
    for name in ("there", "new"):
        with largest_file(300), pytest.raises(UsageError, match="File too large"):
            certs.create(tmp_path / name)
    assert [path.name for path in tmp_path.rglob("*")] == ["there"]
    certs.create(tmp_path / "there")  # as a mounted volume would be
    assert fits(tmp_path / "there" / "actor-local")


def test_whoever_is_killed_between_the_two_renames_loses_nothing(root):
    certs.issue(root, "learner", ["a.example"])
    (root / "learner" / "groups.txt").write_text("actor-a\n")
    (root / "learner").rename(root / ".learner.old")
    shutil.copytree(root / "router", root / ".learner.new")
    certs.issue(root, "learner")
    assert fits(root / "learner")
    assert hosts(root / "learner") == ["a.example"]
    assert (root / "learner" / "groups.txt").read_text() == "actor-a\n"
    assert not list(root.glob(".learner.*"))


def test_a_killed_renewal_leaves_a_pair_that_fits(root):
    code = "import sys, pathlib; from deploy import certs\nroot = pathlib.Path(sys.argv[1])\n"
    code += "while True: certs.issue(root, 'learner')"
    first = load(root / "learner").serial_number
    for moment in (0.0, 0.0123):
        serial = load(root / "learner").serial_number
        with subprocess.Popen([sys.executable, "-c", code, root]) as process:
            while process.poll() is None and not _renewed(root, serial):
                time.sleep(0.001)
            time.sleep(moment)
            process.kill()
        assert process.returncode == -9
        kept = [folder for folder in (root / "learner", root / ".learner.old") if folder.exists()]
        assert fits(kept[0])
        certs.issue(root, "learner")
        assert fits(root / "learner")
        assert not list(root.glob(".learner.*"))
    assert load(root / "learner").serial_number != first


def _renewed(root, serial):
    try:
        return load(root / "learner").serial_number != serial
    except FileNotFoundError:  # between the renames
        return False


def test_two_that_issue_at_once_do_not_lose_a_group(root):
    with lock(root / ".lock"), pytest.raises(UsageError, match="another `navaclq certs` changes"):
        certs.issue(root, "actor-c")
    assert "actor-c" not in groups(root)[0]
    assert certs.issue(root, "actor-c")


def garble(file):
    def spoil(root, foreign):
        (root / file).write_text("-----BEGIN CERTIFICATE-----\nnonsense\n")

    return spoil


def drop(file):
    return lambda root, foreign: (root / file).unlink()


def change_key(root, foreign):
    shutil.copy(foreign / "ca.key", root / "ca.key")


def expire(root, foreign):
    """Makes an authority of the same key and name that ended yesterday."""
    key, now = certs.read_authority(root).key, datetime.now(UTC)
    name = certs.read_authority(root).certificate.subject
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(now - timedelta(days=9))
    ended = builder.not_valid_after(now - timedelta(days=1)).sign(key, SHA256())
    (root / "ca.pem").write_bytes(ended.public_bytes(Encoding.PEM))


@pytest.mark.parametrize(
    ("spoil", "arguments", "sentence"),
    [
        (None, ["init", "{root}"], "has an authority already; `navaclq certs issue {root} NAME` adds to it"),
        (drop("ca.pem"), ["init", "{root}"], "has an authority already"),
        (None, ["init", "{root}/learner/cert.pem"], "cannot write {root}/learner/cert.pem: "),
        (None, ["init", "{root}/nowhere/x"], "cannot write {root}/nowhere/x: No such file or directory"),
        (None, ["init", "new", "--group", "actor-a", "--group", "learner"], "learner is no group of actors"),
        (None, ["init", "new", "--group", "host-b"], "'host-b' can have no certificate; allowed are learner"),
        (None, ["init", "new", "--host", "bad host"], "'bad host' is neither a hostname nor an IP address"),
        (None, ["init", "new", "--days", "0"], "--days"),
        (drop("ca.pem"), ["issue", "{root}", "learner"], "{root}/ca.pem does not exist; name a folder"),
        (drop("ca.key"), ["issue", "{root}", "learner"], "{root}/ca.key does not exist; name a folder"),
        (None, ["issue", "{root}/nowhere", "learner"], "{root}/nowhere/ca.pem does not exist"),
        (garble("ca.pem"), ["issue", "{root}", "learner"], "{root}/ca.pem is no certificate in PEM"),
        (garble("ca.key"), ["issue", "{root}", "learner"], "{root}/ca.key is no private key in PEM"),
        (change_key, ["issue", "{root}", "learner"], "{root}/ca.key does not belong to {root}/ca.pem"),
        (expire, ["issue", "{root}", "learner"], "which is not now; check the clock"),
        (garble("learner/cert.pem"), ["issue", "{root}", "learner"], "name its hosts with --host"),
        (None, ["issue", "{root}", "driver"], "'driver' can have no certificate; allowed are learner"),
        (None, ["issue", "{root}", "actor-"], "actor- with letters, digits, _ . - after it"),
        (None, ["issue", "{root}", "actor-a/../../x"], "can have no certificate"),
        (None, ["issue", "{root}", "actor-a\n"], "can have no certificate"),
        (None, ["issue", "{root}", "actor-" + 59 * "x"], "at most 64 characters"),
        (None, ["issue", "{root}", "learner", "--host", "10.0.0.256"], "neither a hostname nor an IP"),
        (None, ["issue", "{root}", "learner", "--host", "tls/a:7447"], "neither a hostname nor an IP"),
        (None, ["issue", "{root}", "learner", "--host", "-a.example"], "neither a hostname nor an IP"),
        (None, ["issue", "{root}", "actor-a", "--host", "a"], "actor-a does not listen; --host goes with"),
        (garble("router/cert.pem"), ["show", "{root}"], "{root}/router/cert.pem is no certificate in PEM"),
        (None, ["show", "{root}/learner/nowhere"], "/ca.pem does not exist; name a folder"),
    ],
)
def test_wrong_use_gets_one_sentence_and_changes_nothing(
    monkeypatch, capsys, tmp_path, root, foreign, spoil, arguments, sentence
):
    monkeypatch.chdir(tmp_path)
    if spoil:
        spoil(root, foreign)
    before = content(tmp_path)
    code, out, err = call(monkeypatch, capsys, "certs", *(word.format(root=root) for word in arguments))
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.strip().splitlines()) == 1
    assert sentence.format(root=root) in err
    assert content(tmp_path) == before


def test_the_longest_name_is_allowed(root):
    name = "actor-" + 58 * "x"
    certs.issue(root, name)
    assert f"{name}\n" in groups(root)[0]


def test_init_makes_what_show_lists(monkeypatch, capsys, tmp_path):
    folder = tmp_path / "ca"
    arguments = ("--host", "a.example", "--host", "fd00::7", "--days", "29")
    code, out, _ = call(monkeypatch, capsys, "certs", "init", folder, *arguments)
    assert code == 0
    assert f"{folder / 'ca.key'} stays here" in out
    code, out, _ = call(monkeypatch, capsys, "certs", "show", folder, "--json")
    rows = {row["name"]: row for row in json.loads(out)["certificates"]}
    assert set(rows) == {"ca", *LISTENERS, "operator", "actor-local"}
    assert rows["learner"]["hosts"] == ["a.example", "fd00::7"]
    assert rows["actor-local"]["hosts"] == []
    assert rows["learner"]["days_left"] == 28
    assert datetime.fromisoformat(rows["ca"]["valid_until"]) > datetime.now(UTC) + timedelta(days=3600)
    call(monkeypatch, capsys, "certs", "issue", folder, "operator", "--days", "31")
    _, out, _ = call(monkeypatch, capsys, "certs", "show", folder)
    marked = {line.split()[0] for line in out.splitlines() if "days left !" in line}
    assert marked == {*LISTENERS, "actor-local"}
    assert "renews it" in out


def test_issuing_a_group_says_what_to_copy_and_to_restart(monkeypatch, capsys, root):
    code, out, _ = call(monkeypatch, capsys, "certs", "issue", root, "actor-c")
    assert code == 0
    assert f"{root / 'actor-c'}: copy this folder" in out
    for role in LISTENERS:
        assert f"{root / role / 'groups.txt'} now admits actor-c: copy it to the host of {role}" in out
    assert "restart it to admit actor-c" in out
    _, out, _ = call(monkeypatch, capsys, "certs", "issue", root, "actor-c")
    assert "groups.txt" not in out


def test_the_command_line_starts_without_cryptography():
    code = "import sys, deploy.cli.main; assert 'cryptography' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
