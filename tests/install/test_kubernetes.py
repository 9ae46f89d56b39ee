"""Manifests of a site: valid for Kubernetes, and their probes tell the living from the hung."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from palpate.config import Role
from palpate.errors import ConfigError, PalpateError
from palpate_deploy.install.kubernetes import write_manifests
from palpate_deploy.station.certificates import issue, make_authority

validate: Any = pytest.importorskip("kubernetes_validate")

PROFILE = """
station = "pool"
processes = ["router", "fem", "features"]

[link]
certificates = "/etc/palpate/certs"

[router]
listen = ["tls/0.0.0.0:7447"]

[fem]
workers = 2
threads = 1
"""
VERSIONS = ("1.30", "1.33")
PATIENCE_S = 120.0


@pytest.fixture
def written(tmp_path: Path) -> dict[str, list[dict[str, Any]]]:
    """Documents of each file."""
    profile = tmp_path / "pool.toml"
    profile.write_text(PROFILE, encoding="utf-8")
    write_manifests(str(profile), tmp_path / "out", replicas=3)
    return {
        file.name: list(yaml.safe_load_all(file.read_text(encoding="utf-8")))
        for file in sorted((tmp_path / "out").iterdir())
    }


def pods(written: dict[str, list[dict[str, Any]]]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, documents in written.items():
        for one in documents:
            if one["kind"] in ("Deployment", "StatefulSet"):
                yield name.removesuffix(".yaml"), one["spec"]["template"]["spec"]


@pytest.mark.parametrize("version", VERSIONS)
def test_every_document_is_valid(written: dict[str, list[dict[str, Any]]], version: str) -> None:
    kinds = [one["kind"] for documents in written.values() for one in documents]
    assert sorted(set(kinds)) == [
        "ConfigMap", "Deployment", "NetworkPolicy", "PodDisruptionBudget", "Service", "StatefulSet",
    ]  # fmt: skip
    for documents in written.values():
        for document in documents:
            validate.validate(document, version, strict=True)


def test_a_wrong_document_would_be_found(written: dict[str, list[dict[str, Any]]]) -> None:
    document = written["fem.yaml"][0]
    document["spec"]["template"]["spec"]["containers"][0]["readOnlyRoot"] = True
    with pytest.raises(validate.ValidationError):
        validate.validate(document, VERSIONS[0], strict=True)


def test_no_pod_may_do_more_than_its_work(written: dict[str, list[dict[str, Any]]]) -> None:
    found = dict(pods(written))
    assert sorted(found) == ["features", "fem", "router"]
    for name, pod in found.items():
        assert pod["securityContext"]["runAsNonRoot"] is True
        assert pod["securityContext"]["runAsUser"] > 0
        assert pod["automountServiceAccountToken"] is False
        (container,) = pod["containers"]
        rights = container["securityContext"]
        assert rights["readOnlyRootFilesystem"] is True
        assert rights["allowPrivilegeEscalation"] is False
        assert rights["capabilities"] == {"drop": ["ALL"]}
        assert container["resources"]["limits"]["memory"]
        # Only the certificates of its own role, and never the authority's key.
        (secret,) = (one["secret"]["secretName"] for one in pod["volumes"] if "secret" in one)
        assert secret == ("palpate-router" if name == "router" else "palpate-service")


def test_selectors_and_names_meet(written: dict[str, list[dict[str, Any]]]) -> None:
    labels = {}
    for documents in written.values():
        for one in documents:
            if one["kind"] in ("Deployment", "StatefulSet"):
                own = one["spec"]["template"]["metadata"]["labels"]
                assert one["spec"]["selector"]["matchLabels"] == own
                labels[one["metadata"]["name"]] = own
    (service,) = (one for one in written["router.yaml"] if one["kind"] == "Service")
    assert service["spec"]["selector"] == labels["pool-router"]
    for name, pod in pods(written):
        environment = {one["name"]: one.get("value") for one in pod["containers"][0]["env"]}
        if name != "router":
            where = f"tls/{service['metadata']['name']}:{service['spec']['ports'][0]['port']}"
            assert environment["PALPATE_LINK__CONNECT"] == f'["{where}"]'
    for documents in written.values():
        for one in documents:
            if one["kind"] == "NetworkPolicy":
                assert one["spec"]["podSelector"]["matchLabels"] in labels.values()
                closed = one["metadata"]["name"] != "pool-router"
                assert (one["spec"]["ingress"] == []) == closed
    (config,) = written["profile.yaml"]
    assert tomllib.loads(config["data"]["profile.toml"]) == tomllib.loads(PROFILE)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"fem", "features"', '"gateway"', "gateway cannot run in a cluster"),
        ('"fem", "features"', '"metrics"', "metrics cannot run in a cluster"),
        ('["router", "fem", "features"]', '["fem"]', "router of its own"),
        ('certificates = "/etc/palpate/certs"', "", "without mutual TLS"),
        ('listen = ["tls/0.0.0.0:7447"]', 'listen = ["tls/127.0.0.1:7447"]', "loopback only"),
    ],
)  # fmt: skip
def test_what_does_not_belong_there_is_refused(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    assert old in PROFILE
    profile = tmp_path / "pool.toml"
    profile.write_text(PROFILE.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=says):
        write_manifests(str(profile), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_files_stay(written: dict[str, list[dict[str, Any]]], tmp_path: Path) -> None:
    (tmp_path / "out" / "fem.yaml").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match="another one"):
        write_manifests(str(tmp_path / "pool.toml"), tmp_path / "out", replicas=3)
    assert (tmp_path / "out" / "fem.yaml").read_text(encoding="utf-8") == "mine"


def test_the_probes_tell_the_living_from_the_hung(
    written: dict[str, list[dict[str, Any]]], tmp_path: Path, new_port: Any
) -> None:
    """The commands of the manifests, run here: a router, living, hung and gone."""
    certificates, port = tmp_path / "certs", new_port()
    make_authority(certificates)
    for role in Role:
        issue(certificates, role)
    text = PROFILE.replace("/etc/palpate/certs", str(certificates))
    text = text.replace("tls/0.0.0.0:7447", f"tls/0.0.0.0:{port}")
    profile = tmp_path / "here.toml"
    profile.write_text(text, encoding="utf-8")
    container = dict(pods(written))["router"]["containers"][0]
    environment = {**os.environ, "_PALPATE_HEARTBEAT": str(tmp_path / "beat")}

    def command(words: list[str]) -> list[str]:
        here = [str(profile) if word.endswith("profile.toml") else word for word in words]
        return [sys.executable, "-m", "palpate_deploy", *here]

    def probe(kind: str) -> int:
        words = container[kind]["exec"]["command"]
        assert words[0] == "palpate"
        done = subprocess.run(
            command(words[1:]), env=environment, check=False, capture_output=True, timeout=120
        )
        assert b"Traceback" not in done.stderr
        return done.returncode

    def until(kind: str, status: int) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while probe(kind) != status:
            assert time.monotonic() < deadline, f"{kind} never says {status}"
            time.sleep(0.2)

    assert (probe("livenessProbe"), probe("readinessProbe")) == (1, 1)
    process = subprocess.Popen(command(container["args"]), env=environment)
    try:
        until("startupProbe", 0)
        until("readinessProbe", 0)
        assert probe("livenessProbe") == 0
        process.send_signal(signal.SIGSTOP)
        until("livenessProbe", 1)
        until("readinessProbe", 1)
        process.send_signal(signal.SIGCONT)
        until("livenessProbe", 0)
        until("readinessProbe", 0)
        # A service that is not there is not ready, however well the router is.
        other = dict(pods(written))["fem"]["containers"][0]["readinessProbe"]["exec"]["command"]
        done = subprocess.run(command(other[1:]), env=environment, check=False, timeout=120)
        assert done.returncode == 1
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0


def test_a_probe_without_a_heartbeat_says_what_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from palpate_deploy.station.probe import why_not_live

    monkeypatch.delenv("_PALPATE_HEARTBEAT", raising=False)
    with pytest.raises(PalpateError, match="_PALPATE_HEARTBEAT"):
        why_not_live()
