"""Who may do what on the bus: credentials for mutual TLS, and the rules that a hub holds its clients to.

A certificate's common name is its role, `learner`, `curriculum`, `router` or `operator`, or a group of actors
such as `actor-host-b`. Zenoh reads the rules once, when the hub starts, and knows no patterns of names: so a
hub lists the groups it admits (`groups.txt`). What no rule allows is denied.
"""

from __future__ import annotations

import re
import socket
import ssl
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from common.errors import UsageError

LOCAL = "local"
"""The group of processes without certificates."""
RUNS = "navaclq/*"
"""Before every key: a hub's rules hold for any run."""
HANDSHAKE_SECONDS, VERDICT_SECONDS = 2.0, 1.0
"""How long `explain_refusal` waits for a handshake, and after it for what the other side makes of ours."""


class Credentials(NamedTuple):
    """A folder with ca.pem, cert.pem and key.pem, as `navaclq certs` makes them."""

    folder: Path
    name: str
    """Common name of the certificate."""
    groups: tuple[str, ...]
    """Groups of actors that this process admits when it listens."""

    def tls(self) -> dict[str, Any]:
        """Zenoh's `transport/link/tls` for listening and connecting."""
        certificate, key = str(self.folder / "cert.pem"), str(self.folder / "key.pem")
        return {
            "root_ca_certificate": str(self.folder / "ca.pem"),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }


def load_credentials(folder: Path) -> Credentials:
    """Reads a folder of certificates; raises UsageError when they cannot serve, now."""
    from cryptography import x509  # 0.1 s that a system without certificates need not spend
    from cryptography.hazmat.primitives.serialization import load_pem_private_key
    from cryptography.x509.oid import NameOID

    made = "`navaclq certs init` and `issue` make such folders"
    try:
        content = {name: (folder / name).read_bytes() for name in ("ca.pem", "cert.pem", "key.pem")}
        listed = folder / "groups.txt"
        content["groups.txt"] = listed.read_bytes() if listed.exists() else b""
    except OSError as error:
        raise UsageError(
            f"--certs {folder}: cannot read {error.filename} ({error.strerror}); {made}"
        ) from None
    try:
        authority = x509.load_pem_x509_certificate(content["ca.pem"])
        certificate = x509.load_pem_x509_certificate(content["cert.pem"])
        key = load_pem_private_key(content["key.pem"], None)
        groups = content["groups.txt"].decode().split()
        name = str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    except (ValueError, TypeError, IndexError) as error:
        raise UsageError(f"--certs {folder}: not a PEM certificate and key ({error}); {made}") from None
    if key.public_key() != certificate.public_key():
        raise UsageError(f"--certs {folder}: key.pem does not belong to cert.pem")
    try:
        certificate.verify_directly_issued_by(authority)
    except Exception:  # ValueError for another issuer, InvalidSignature for another key of the same name
        raise UsageError(f"--certs {folder}: cert.pem is not of the authority in ca.pem") from None
    if certificate.not_valid_after_utc < datetime.now(UTC):
        ended = certificate.not_valid_after_utc.date()
        raise UsageError(f"--certs {folder}: cert.pem ended on {ended}; `navaclq certs issue` renews it")
    for subject in (name, *groups):
        if not re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", subject):
            raise UsageError(f"--certs {folder}: {subject!r} is no role and no group of actors; {made}")
    if roles := ROLES.keys() & set(groups):
        raise UsageError(f"{listed} names {min(roles)}, a role, among the groups of actors")
    return Credentials(folder, name, tuple(groups))


def explain_refusal(endpoint: str, credentials: Credentials) -> str | None:
    """Why certificates keep us from the hub at `endpoint`, tls/HOST:PORT, for which Zenoh has no word.

    None when they do not, or when nobody answers there.
    """
    host, _, port = endpoint.removeprefix("tls/").rpartition(":")
    address, own = (host.strip("[]"), int(port)), credentials.folder
    try:
        _shake_hands(address, credentials)
    except ssl.SSLCertVerificationError as error:
        reason = f"is not of the authority in {own / 'ca.pem'}"
        if "mismatch" in error.verify_message:
            names = ", ".join(_hosts(address)) or "no host"
            reason = f"does not name {address[0]} but {names}; `navaclq certs issue --host` renews it"
        elif "purpose" in error.verify_message:
            reason = "is not that of a role which listens"
        elif "expired" in error.verify_message or "not yet valid" in error.verify_message:
            reason = "is not valid now, by the clock here"
        return f"the certificate of the hub at {endpoint} {reason}"
    except ssl.SSLError as error:
        alert = (error.reason or "").partition("_ALERT_")[2].lower()
        other, ended = "it is of another authority", "it is not valid now, by the clock there"
        known = {"unknown_ca": other, "decrypt_error": other, "certificate_expired": ended}
        if reason := known.get(alert, alert.replace("_", " ") if "certificate" in alert else ""):
            return f"the hub at {endpoint} does not accept {own / 'cert.pem'}: {reason}"
    except OSError:
        pass
    return None  # an SSLError of another kind is the end of a hub, for example


def _shake_hands(address: tuple[str, int], credentials: Credentials) -> None:
    """Raises ssl.SSLError when one side does not accept the other, OSError when there is none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(credentials.folder / "ca.pem")
    context.load_cert_chain(credentials.folder / "cert.pem", credentials.folder / "key.pem")
    with (
        socket.create_connection(address, HANDSHAKE_SECONDS) as plain,
        context.wrap_socket(plain, server_hostname=address[0]) as secure,
    ):
        secure.settimeout(VERDICT_SECONDS)
        secure.recv(1)  # with TLS 1.3 a refusal comes only now; silence, and so a timeout, is consent


def _hosts(address: tuple[str, int]) -> list[str]:
    """Hosts that the certificate of a hub names, whatever else is wrong with it."""
    from cryptography import x509

    try:
        pem = ssl.get_server_certificate(address, timeout=HANDSHAKE_SECONDS)
        extensions = x509.load_pem_x509_certificate(pem.encode()).extensions
        named = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (OSError, ValueError, x509.ExtensionNotFound):
        return []
    return [str(name.value) for name in named]


class Rights(NamedTuple):
    """What a client may do, as keys below `navaclq/RUN/`."""

    asks: tuple[str, ...] = ()
    """Queries it may send, and get replies to."""
    serves: tuple[str, ...] = ()
    """Queries it may answer."""
    tells: tuple[str, ...] = ()
    """Publications it may send."""
    hears: tuple[str, ...] = ()
    """Publications it may receive."""
    lives: tuple[str, ...] = ()
    """Liveliness tokens it may declare."""
    watches: tuple[str, ...] = ()
    """Liveliness tokens it may see."""


def _member(role: str, group: str) -> dict[str, tuple[str, ...]]:
    return {"tells": (f"stat/{role}/{group}/*",), "lives": (f"live/{role}/{group}/**",)}


ALL = ("**",)
BETWEEN_HUBS = Rights(asks=ALL, serves=ALL, tells=ALL, hears=ALL, lives=ALL, watches=ALL)
"""Each hub holds its own clients to the rules; from hub to hub everything passes."""
QUESTIONS = ("curriculum/task", "curriculum/score", "curriculum/snapshot")
ROLES = {
    "curriculum": Rights(
        asks=("contract", "weights/latest/critic"),
        serves=("curriculum/**",),
        hears=("weights/version",),
        watches=("live/curriculum/**",),
        **_member("curriculum", "curriculum"),
    ),
    "operator": Rights(
        asks=("contract", *QUESTIONS), hears=("stat/**", "weights/version"), watches=("live/**",)
    ),
    "learner": BETWEEN_HUBS,
    "router": BETWEEN_HUBS,
}


def actor_rights(group: str) -> Rights:
    """A group of actors sends only under its own name."""
    delivered = ("trajectory", "frames", "curriculum/result", "curriculum/candidates")
    return Rights(
        asks=(
            "contract",
            "weights/latest/policy",
            *QUESTIONS,
            *(f"{channel}/{group}/*" for channel in delivered),
        ),
        hears=("weights/version",),
        watches=(f"live/actor/{group}/**",),
        **_member("actor", group),
    )


def access_control(groups: tuple[str, ...]) -> dict[str, Any]:
    """Zenoh's `access_control` of a hub that admits these groups of actors."""
    rights = ROLES | {group: actor_rights(group) for group in groups}
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for subject, granted in rights.items():
        own = _rules(subject, granted)
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [subject]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": subject, "cert_common_names": [subject]} for subject in rights],
        "policies": policies,
    }


def _rules(subject: str, rights: Rights) -> list[dict[str, Any]]:
    """`ingress` is what comes from the client, `egress` what goes to it."""
    into, out = "ingress", "egress"
    meanings: dict[str, list[tuple[tuple[str, ...], str]]] = {
        "asks": [(("query",), into), (("reply", "declare_queryable"), out)],
        "serves": [(("declare_queryable", "reply"), into), (("query",), out)],
        "tells": [(("put",), into), (("declare_subscriber",), out)],
        "hears": [(("declare_subscriber",), into), (("put",), out)],
        "lives": [
            (("liveliness_token",), into),
            (("declare_liveliness_subscriber", "liveliness_query"), out),
        ],
        "watches": [
            (("declare_liveliness_subscriber", "liveliness_query"), into),
            (("liveliness_token",), out),
        ],
    }
    return [
        {
            "id": f"{subject} {right} {flow}",
            "permission": "allow",
            "messages": list(messages),
            "flows": [flow],
            "key_exprs": [f"{RUNS}/{key}" for key in getattr(rights, right)],
        }
        for right, flows in meanings.items()
        if getattr(rights, right)
        for messages, flow in flows
    ]
