"""What is under deploy/, against Kubernetes' schemas, systemd, the command line, and each other."""

import os
import re
import shlex
import shutil
import subprocess
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import kubernetes_validate
import pytest
import typer.main
import yaml
from typer.exceptions import TyperException
from typer.testing import CliRunner

from deploy.cli.main import app

ROOT = Path(__file__).parents[1]
DOCKER, KUBERNETES, SYSTEMD = (ROOT / "deploy" / name for name in ("docker", "kubernetes", "systemd"))
KUSTOMIZATION = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
DOCKERFILE = (DOCKER / "Dockerfile").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
UNITS = sorted(SYSTEMD.glob("*.service"))
IMAGE = f"navaclq:{PROJECT['project']['version']}"
CLIENTS = ["actor", "curriculum", "operator"]
NAME = "app.kubernetes.io/name"
PORT = 7447
USER = 10001

# Reading the manifests


def documents(file: Path) -> list[dict[str, Any]]:
    return list(yaml.safe_load_all(file.read_text()))


def merge(base: Any, patch: Any) -> Any:
    """A strategic merge as kustomize's, as far as the patches here go: items of lists are known by name."""
    if isinstance(base, dict) and isinstance(patch, dict):
        return base | {key: merge(base[key], value) if key in base else value for key, value in patch.items()}
    if isinstance(base, list) and isinstance(patch, list):
        key = "mountPath" if "mountPath" in base[0] else "name"
        new = {item[key]: item for item in patch}
        merged = [merge(item, new.pop(item[key])) if item[key] in new else item for item in base]
        return [*new.values(), *merged]
    return patch


@cache
def objects() -> tuple[dict[str, Any], ...]:
    """All objects for the cluster, patched."""
    found = [item for name in KUSTOMIZATION["resources"] for item in documents(KUBERNETES / name)]
    for entry in KUSTOMIZATION["patches"]:
        (patch,) = documents(KUBERNETES / entry["path"])
        for i, item in enumerate(found):
            if re.fullmatch(entry["target"]["kind"], item["kind"]):
                found[i] = merge(item, {"spec": patch["spec"]})
    return tuple(found)


def specs(*kinds: str) -> dict[str, dict[str, Any]]:
    return {item["metadata"]["name"]: item["spec"] for item in objects() if item["kind"] in kinds}


WORKLOADS = specs("StatefulSet", "Deployment")
PODS = {name: spec["template"]["spec"] for name, spec in WORKLOADS.items()}
CONTAINERS = {name: pod["containers"][0] for name, pod in PODS.items()}


def settings(file: Path) -> dict[str, list[str]]:
    """All values of each setting of a unit, with what all units have in common."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in (*SYSTEMD.glob("navaclq-.service.d/*.conf"), file):
        for name, value in re.findall(r"^(\w+)=(.*)$", path.read_text(), re.MULTILINE):
            found[name].append(value)
    return found


def filled(text: str, values: dict[str, str] | None = None) -> str:
    """The text with ${NAME} and ${NAME:-default} in their values."""
    return re.sub(r"\$\{(\w+)(?::-(.*?))?\}", lambda match: (values or {}).get(match[1], match[2]), text)


class Process(NamedTuple):
    """A process as a manifest starts it."""

    place: str
    commands: list[list[str]]
    """The words after `navaclq`: its own and those of its probes."""
    environment: dict[str, str]


def processes() -> Iterator[Process]:
    for name, found in CONTAINERS.items():
        probes = [probe["exec"]["command"] for kind, probe in found.items() if kind.endswith("Probe")]
        scripts = [command[2] if command[:2] == ["sh", "-c"] else shlex.join(command) for command in probes]
        environment = {item["name"]: item.get("value", "") for item in found["env"]}
        yield Process(f"kubernetes {name}", [found["args"], *invoked(*scripts)], environment)
    for name, service in COMPOSE["services"].items():
        commands = [map(filled, service["command"]), service["healthcheck"]["test"][2:]]
        environment = {key: filled(value) for key, value in service.get("environment", {}).items()}
        yield Process(f"compose {name}", [list(words) for words in commands], environment)
    for file in UNITS:
        values = {"NAVACLQ_CONNECT": f"tls/x:{PORT}", "STATE_DIRECTORY": "/s", "CREDENTIALS_DIRECTORY": "/c"}
        values |= dict(line.split("=", 1) for line in settings(file)["Environment"])
        yield Process(f"systemd {file.stem}", invoked(filled(settings(file)["ExecStart"][0], values)), {})


def invoked(*lines: str) -> list[list[str]]:
    """The words after each `navaclq` that lines of shell run, also by sudo, timeout, ssh or docker run."""
    found, words = [], list[str]()
    for line in lines:
        lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|")
        lexer.whitespace_split = True
        for word in [*lexer, ";"]:
            if set(word) <= set(";&|"):
                found += _invoked(words)
                words = []
            else:
                words.append(word)
    return found


def _invoked(words: list[str]) -> list[list[str]]:
    while words and re.fullmatch(r"!|sudo|timeout|\d+|\w+=.*", words[0]):
        words = words[1:]
    if words[:1] == ["ssh"]:
        return invoked(words[-1])
    if words[:2] == ["docker", "run"]:
        return [words[words.index(IMAGE) + 1 :]]
    return [words[1:]] if words and Path(words[0]).name == "navaclq" else []


def parse(words: list[str]) -> set[str]:
    """The variables that the command reads; AssertionError when it would not take these words."""
    command, rest = typer.main.get_command(app), list(words)
    while hasattr(command, "commands"):
        name = rest.pop(0)
        assert name in command.commands, f"navaclq {shlex.join(words)}: no command {name!r}"
        command = command.commands[name]
    try:
        command.make_context("navaclq", rest)
    except TyperException as error:
        raise AssertionError(f"navaclq {shlex.join(words)}: {error.format_message()}") from None
    return {str(parameter.envvar) for parameter in command.params}


def endpoints(process: Process) -> set[tuple[str, str, str]]:
    """(protocol, host, port) of all that a process listens on and connects to."""
    texts = [*process.environment.values(), *(word for words in process.commands for word in words)]
    return {found for text in texts for found in re.findall(r"\b(tls|tcp)/([^,:]+):(\d+)", text)}


PROCESSES = list(processes())
each_process = pytest.mark.parametrize("process", PROCESSES, ids=lambda process: process.place)
each_unit = pytest.mark.parametrize("file", UNITS, ids=lambda file: file.stem)
each_workload = pytest.mark.parametrize("name", WORKLOADS)

# The command line


def test_reader_of_shell_finds_every_form_of_a_command():
    line = (
        "A=1 navaclq a && sudo /x/navaclq b c || ! timeout 8 navaclq d; ssh host 'navaclq e' | "
        f"docker run -v x:/y {IMAGE} f --g & kubectl -n navaclq get pods; docker build -t {IMAGE} ."
    )
    assert invoked(line) == [["a"], ["b", "c"], ["d"], ["e"], ["f", "--g"]]


@pytest.mark.parametrize("words", [["actor", "--nmae", "x"], ["actr"], ["actor", "--count", "many"]])
def test_command_with_a_mistake_does_not_parse(words):
    with pytest.raises(AssertionError, match="navaclq act"):
        parse(words)


@each_process
def test_every_command_parses_and_reads_the_variables_that_are_set_for_it(process):
    assert len(process.commands) > (not process.place.startswith("systemd"))
    given = {name for name in process.environment if name.startswith("NAVACLQ_")}
    for words in process.commands:
        told = {f"NAVACLQ_{word[2:].upper()}" for word in words if word.startswith("--")}
        assert given <= parse(words) | told, f"navaclq {shlex.join(words)} does not read all of {given}"


@each_process
def test_every_endpoint_is_tls_with_certificates_at_the_one_port(process):
    assert endpoints(process)
    assert {(protocol, port) for protocol, _, port in endpoints(process)} == {("tls", str(PORT))}
    for words in process.commands:
        assert "--certs" in words or process.environment["NAVACLQ_CERTS"] == "/certs"


def test_guide_shows_commands_that_parse():
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / "hosts.md").read_text(), re.DOTALL)
    shown = invoked(*(line for block in blocks for line in block.replace("\\\n", " ").splitlines()))
    assert {words[0] for words in shown} == {
        *("actor", "certs", "curriculum", "doctor", "learner", "router", "top")
    }
    for words in shown:
        parse(words)


# Kubernetes


@pytest.mark.parametrize("version", ["1.29", kubernetes_validate.latest_version()])
def test_every_object_is_valid(version):
    for item in objects():
        try:
            kubernetes_validate.validate(item, version, strict=True)
        except kubernetes_validate.ValidationError as error:
            pytest.fail(f"{item['kind']} {item['metadata']['name']}: {error.message}")


def test_kustomization_lists_every_file_and_no_other():
    listed = [*KUSTOMIZATION["resources"], *(entry["path"] for entry in KUSTOMIZATION["patches"])]
    there = {path.name for path in KUBERNETES.glob("*.y*ml")} - {"kustomization.yaml"}
    assert sorted(listed) == sorted(there)
    (namespace,) = (item["metadata"] for item in objects() if item["kind"] == "Namespace")
    assert namespace["name"] == KUSTOMIZATION["namespace"]
    assert namespace["labels"] == {"pod-security.kubernetes.io/enforce": "restricted"}
    assert set(KUSTOMIZATION) == {
        *("apiVersion", "kind", "namespace", "resources", "patches", "images", "secretGenerator")
    }


def test_selectors_match_the_pods_that_they_mean():
    assert sorted(WORKLOADS) == ["actor", "curriculum", "learner"]
    for name, spec in WORKLOADS.items():
        assert spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"] == {NAME: name}
    (port,) = CONTAINERS["learner"]["ports"]
    assert port["containerPort"] == PORT
    services = specs("Service")
    for spec in services.values():
        assert spec["selector"] == {NAME: "learner"}
        assert [(p["port"], p["targetPort"]) for p in spec["ports"]] == [(PORT, port["name"])]
    headless = {name for name, spec in services.items() if spec.get("clusterIP") == "None"}
    assert headless == {WORKLOADS["learner"]["serviceName"]}
    assert set(services) - headless == {"learner"}
    assert WORKLOADS["learner"]["replicas"] == WORKLOADS["curriculum"]["replicas"] == 1
    assert WORKLOADS["curriculum"]["strategy"] == {"type": "Recreate"}


@each_workload
def test_volumes_claims_and_secrets_are_there_and_used(name):
    volumes = {volume["name"]: volume for volume in PODS[name]["volumes"]}
    templates = {claim["metadata"]["name"] for claim in WORKLOADS[name].get("volumeClaimTemplates", [])}
    mounts = CONTAINERS[name]["volumeMounts"]
    assert {mount["name"] for mount in mounts} == {*volumes, *templates}
    claims = {volume.get("persistentVolumeClaim", {}).get("claimName") for volume in volumes.values()}
    assert claims <= {None, *specs("PersistentVolumeClaim")}
    secret = volumes["certs"]["secret"]
    assert (secret["secretName"], secret["defaultMode"]) == (f"{name}-certs", 0o440)
    assert sorted(f"{name}-certs" for name in WORKLOADS) == sorted(
        generated["name"] for generated in KUSTOMIZATION["secretGenerator"]
    )
    assert {"name": "certs", "mountPath": "/certs", "readOnly": True} in mounts
    written = {f"/{word.split('/')[1]}" for word in CONTAINERS[name]["args"] if word.startswith("/")}
    assert written <= {mount["mountPath"] for mount in mounts if not mount.get("readOnly")}


@each_workload
def test_variables_stand_only_where_somebody_expands_them(name):
    known = set[str]()
    for item in CONTAINERS[name]["env"]:
        assert set(re.findall(r"\$\((\w+)\)", item.get("value", ""))) <= known
        known.add(item["name"])
    assert set(re.findall(r"\$\((\w+)\)", " ".join(CONTAINERS[name]["args"]))) <= known
    for kind, probe in CONTAINERS[name].items():
        if kind.endswith("Probe"):
            command = probe["exec"]["command"]
            assert "$(" not in " ".join(command)  # Kubernetes leaves those of probes alone
            assert set(re.findall(r"\$(\w+)", " ".join(command))) <= known
            assert command[:2] == ["sh", "-c"] or "$" not in " ".join(command)


@each_workload
def test_every_pod_is_restricted(name):
    pod, container = PODS[name], CONTAINERS[name]
    assert len(pod["containers"]) == 1
    assert pod["securityContext"].items() >= {
        "runAsNonRoot": True,
        "seccompProfile": {"type": "RuntimeDefault"},
        **dict.fromkeys(("runAsUser", "runAsGroup", "fsGroup"), USER),
    }.items()  # fmt: skip
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert pod["automountServiceAccountToken"] is False
    assert pod["terminationGracePeriodSeconds"] >= 10  # a process takes up to five
    assert [sorted(container["resources"][key]) for key in ("requests", "limits")] == [["cpu", "memory"]] * 2


def test_network_lets_clients_reach_the_learner_and_nobody_anybody_else():
    learner = {"podSelector": {"matchLabels": {NAME: "learner"}}}
    clients = {"podSelector": {"matchExpressions": [{"key": NAME, "operator": "In", "values": CLIENTS}]}}
    dns = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}}}
    hub = [{"port": PORT, "protocol": "TCP"}]
    names = [{"port": 53, "protocol": "UDP"}, {"port": 53, "protocol": "TCP"}]
    into = [{"from": [clients], "ports": hub}]
    out = [{"to": [learner], "ports": hub}, {"to": [dns], "ports": names}]
    assert specs("NetworkPolicy") == {
        "default-deny": {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]},
        "learner": {**learner, "policyTypes": ["Ingress"], "ingress": into},
        "clients": {**clients, "policyTypes": ["Egress"], "egress": out},
    }
    assert set(WORKLOADS) <= {"learner", *CLIENTS}


@each_workload
def test_probes_are_calm(name):
    startup, ready, live = (
        CONTAINERS[name].get(f"{kind}Probe") for kind in ("startup", "readiness", "liveness")
    )
    for probe in (ready, live):
        assert probe["periodSeconds"] >= 30
        assert 10 <= probe["timeoutSeconds"] < probe["periodSeconds"]
    assert live["periodSeconds"] * live["failureThreshold"] >= 300
    if name == "learner":
        assert startup["periodSeconds"] * startup["failureThreshold"] >= 600  # it reads its log back
    else:
        assert startup is None  # it would kill who waits for a learner


@pytest.mark.parametrize("name", ["actor", "curriculum"])
@pytest.mark.parametrize(
    ("hub", "member", "ready", "alive"),
    [(0, 0, True, True), (0, 1, False, False), (1, 1, False, True)],
    ids=["connected", "its hub does not know it", "without a hub"],
)
def test_client_is_killed_only_when_its_hub_does_not_know_it(tmp_path, name, hub, member, ready, alive):
    doctor = tmp_path / "navaclq"
    doctor.write_text(f'#!/bin/sh\ncase "$*" in *"--member me") exit {member};; *) exit {hub};; esac\n')
    doctor.chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "MEMBER": "me"}
    for kind, expected in (("readiness", ready), ("liveness", alive)):
        command = CONTAINERS[name][f"{kind}Probe"]["exec"]["command"]
        assert (subprocess.run(command, env=environment, check=False).returncode == 0) is expected, kind


def test_client_asks_for_itself():
    members = {p.place: p.environment.get("MEMBER") for p in PROCESSES if p.place.startswith("kubernetes")}
    assert members == {
        "kubernetes learner": None,
        "kubernetes curriculum": "curriculum/curriculum",
        "kubernetes actor": "actor/$(POD_NAME)",
    }
    args = CONTAINERS["actor"]["args"]
    assert args[args.index("--name") + 1] == "$(POD_NAME)"


# Certificates


def test_documented_command_makes_the_certificates_that_are_mounted(tmp_path):
    (line,) = re.findall(
        r"^#\s+(navaclq certs init .*)$", (KUBERNETES / "kustomization.yaml").read_text(), re.M
    )
    assert line in (ROOT / "docs" / "hosts.md").read_text()
    (words,) = invoked(line.replace("deploy/kubernetes/certs", str(tmp_path / "certs")))
    assert CliRunner().invoke(app, words).exit_code == 0
    for secret in KUSTOMIZATION["secretGenerator"]:
        assert {Path(file).name for file in secret["files"]} >= {"ca.pem", "cert.pem", "key.pem"}
        (folder,) = {Path(file).parent for file in secret["files"]}
        assert folder.name.startswith(secret["name"].removesuffix("-certs"))
        assert [file for file in secret["files"] if not (tmp_path / file).is_file()] == []
    mounts = [filled(mount) for service in COMPOSE["services"].values() for mount in service["volumes"]]
    folders = [mount.split(":")[0] for mount in mounts if mount.startswith(".")]
    assert [folder for folder in folders if not (tmp_path / folder / "key.pem").is_file()] == []
    in_containers = [process for process in PROCESSES if not process.place.startswith("systemd")]
    called = {host for process in in_containers for _, host, _ in endpoints(process)} - {"0.0.0.0"}
    assert called == {words[i + 1] for i, word in enumerate(words) if word == "--host"}


@pytest.mark.parametrize("folder", [DOCKER, KUBERNETES], ids=lambda folder: folder.name)
def test_certificates_stay_out_of_git_and_of_the_image(folder):
    assert (folder / ".gitignore").read_text().split() == ["certs/"]
    assert str(folder.relative_to(ROOT)) in (ROOT / ".dockerignore").read_text().split()


# The image and compose


def instruction(name: str) -> list[str]:
    """What follows the instruction in the Dockerfile, each time."""
    return re.findall(rf"^{name} (.*)$", DOCKERFILE.replace("\\\n", " "), re.MULTILINE)


def test_image_is_of_this_release_and_runs_as_a_user():
    (image,) = KUSTOMIZATION["images"]
    assert f"{image['name']}:{image['newTag']}" == IMAGE
    assert {container["image"] for container in CONTAINERS.values()} == {image["name"]}
    assert {service["image"] for service in COMPOSE["services"].values()} == {IMAGE}
    assert instruction("USER") == [f"{USER}:{USER}"]
    assert f"useradd --uid {USER} " in DOCKERFILE
    assert instruction("ENTRYPOINT") == ['["navaclq"]']
    assert len({base.split()[0] for base in instruction("FROM")}) == 1  # the venv is of that Python


def test_image_gets_the_packages_and_what_installs_them():
    first, *rest = (ROOT / ".dockerignore").read_text().split()
    context = {line.removeprefix("!") for line in rest if line.startswith("!")}
    assert first == "*"
    assert [name for name in context if not (ROOT / name).exists()] == []
    packages = {
        pattern.removesuffix("*") for pattern in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]
    }
    assert packages | {PROJECT["project"]["readme"], *PROJECT["project"]["license-files"]} <= context
    copied = {
        word for line in instruction("COPY") if not line.startswith("--from") for word in line.split()[:-1]
    }
    assert {"pyproject.toml", "constraints.txt"} <= copied <= {*context, "."}


SERVICE_KEYS = {
    *("image", "build", "command", "environment", "healthcheck", "hostname", "init", "ports", "profiles"),
    *("restart", "stop_grace_period", "volumes", "read_only", "tmpfs", "cap_drop", "security_opt"),
}


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_compose_service_is_whole_and_confined(name):
    service = COMPOSE["services"][name]
    assert set(service) <= SERVICE_KEYS
    assert set(service["healthcheck"]) == {"test", "interval", "timeout", "start_period"}
    assert service["healthcheck"]["test"][:2] == ["CMD", "navaclq"]
    confined = {"read_only": True, "cap_drop": ["ALL"], "security_opt": ["no-new-privileges:true"]}
    assert service.items() >= {**confined, "tmpfs": ["/tmp"], "restart": "unless-stopped"}.items()
    assert int(service["stop_grace_period"].removesuffix("s")) >= 10
    assert (DOCKER / service["build"]["context"]).resolve() == ROOT
    assert (ROOT / service["build"]["dockerfile"]).read_text() == DOCKERFILE
    mounts = [filled(mount).split(":") for mount in service["volumes"]]
    assert [mount for mount in mounts if mount[1] == "/certs"] == [[mounts[-1][0], "/certs", "ro"]]
    written = {f"/{word.split('/')[1]}" for word in service["command"] if word.startswith("/")}
    assert written <= {mount[1] for mount in mounts}


def test_compose_declares_what_it_uses():
    assert {key for key in COMPOSE if not key.startswith("x-")} == {"name", "services", "volumes"}
    mounts = [
        filled(mount).split(":") for service in COMPOSE["services"].values() for mount in service["volumes"]
    ]
    kept = {source: target for source, target, *_ in mounts if not source.startswith("./certs/")}
    assert set(kept) == set(COMPOSE["volumes"])
    (made,) = re.findall(r"install -d -o navaclq -g navaclq (.*)", DOCKERFILE)
    assert sorted(set(kept.values())) == sorted(made.split())  # else the user could not write there
    assert COMPOSE["services"]["learner"]["ports"] == [f"{PORT}:{PORT}"]


# systemd


@each_unit
def test_unit_has_what_its_command_uses(file):
    found, role = settings(file), file.stem.removeprefix("navaclq-").removesuffix("@")
    (line,), (environment,) = found["ExecStart"], found["EnvironmentFile"]
    assert line.startswith(f"/opt/navaclq/bin/navaclq {role} ")
    assert environment.removeprefix("-") == f"/etc/navaclq/{role}.env"
    given = {"CREDENTIALS_DIRECTORY", *(setting.split("=")[0] for setting in found["Environment"])}
    given |= {"STATE_DIRECTORY"} if found["StateDirectory"] else set()
    given |= set() if environment.startswith("-") else {"NAVACLQ_CONNECT"}
    assert set(re.findall(r"\$\{(\w+)\}", line)) <= given
    files = ["ca.pem", "cert.pem", "key.pem", *(["groups.txt"] if "--listen" in line else [])]
    loaded = [value.replace("%j", role) for value in found["LoadCredential"]]
    assert loaded == [f"{name}:/etc/navaclq/{role}/{name}" for name in files]


@each_unit
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("Restart", "always"),
        ("StartLimitIntervalSec", "0"),
        ("WantedBy", "multi-user.target"),
        ("DynamicUser", "yes"),
        ("ProtectSystem", "strict"),
        ("TimeoutStopSec", "30"),
    ],
)
def test_unit_always_comes_back_and_never_as_root(file, name, value):
    assert settings(file)[name] == [value]


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not here")
@each_unit
def test_systemd_accepts_the_unit_and_finds_it_confined(tmp_path, file):
    shutil.copytree(SYSTEMD, tmp_path, dirs_exist_ok=True)
    for path in tmp_path.glob("*.service"):
        path.write_text(path.read_text().replace("/opt/navaclq/bin/navaclq", "/bin/true"))
    environment = os.environ | {"SYSTEMD_UNIT_PATH": f"{tmp_path}:"}
    name = file.name.replace("@.", "@1.")
    verify = ["verify", "--man=no", "--recursive-errors=one"]
    exposed = ["security", "--offline=yes", "--threshold=25", "--no-pager"]  # 2.5 of 10
    for arguments in (verify, exposed):
        command = ["systemd-analyze", *arguments, name]
        result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert (result.returncode, result.stderr) == (0, ""), result.stdout[-300:]
