"""A site in a cluster: manifests for Kubernetes, written from a profile.

What has no wire to a sensor may run there: the site's router, replicas of the finite-element
service, estimating services that stand by. Sensors and recordings stay on the PCs of the lab.
Every pod has mutual TLS to the router, by certificates from a secret of its role.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate.config import endpoint_host_port, is_loopback
from palpate.errors import ConfigError
from palpate_deploy.install.containers import USER, write_files
from palpate_deploy.install.plan import checked_name, present_version
from palpate_deploy.install.units import FEM
from palpate_deploy.station.processes import check_packages, role_of
from palpate_deploy.station.profile import Profile, Service, parse_profile, profile_path, read_toml

CLUSTERED = frozenset({"router", "fem", "features", "field", "synthesis"})
"""Processes that may run in a cluster; ``metrics`` is served on loopback, where nobody reads it."""

_CERTIFICATES = "/etc/palpate/certs"
_PROFILE = "/etc/palpate/profile"
_BEATS = "/run/palpate"
_MEMORY_MB = {"router": 512, "fem": 4096}
_SERVICE_MEMORY_MB = 1024
_PROBE_S = 10
_LONGEST_NAME = 20


def write_manifests(profile: str, folder: Path, *, name: str = "", replicas: int = 2) -> None:
    """Write the manifests into a folder; files that are there stay.

    Raises:
        ConfigError: The profile is wrong or cannot run in a cluster, or another file lies there.
        MissingExtraError: A process needs a package that is not installed.
    """
    path = profile_path(profile)
    name = checked_name(name or path.stem)
    if len(name) > _LONGEST_NAME:
        raise ConfigError(
            f"{name!r} is too long to stand in the names of pods",
            remedy=f"name it otherwise (--name): {_LONGEST_NAME} characters at most",
        )
    texts = manifests(
        parse_profile(read_toml(path), where=str(path)),
        path.read_text(encoding="utf-8"),
        name,
        replicas=replicas,
    )
    write_files(folder, texts)
    print("next, once for each role that runs there, router and service:")
    print("  kubectl create secret generic palpate-router --from-file=lab-certs/router")
    print("  kubectl create secret generic palpate-service --from-file=lab-certs/service")
    print(f"  kubectl apply --filename {folder}")


def manifests(profile: Profile, text: str, name: str, *, replicas: int) -> dict[str, str]:
    """Texts by the names of the files.

    Raises:
        ConfigError: The profile cannot run in a cluster.
    """
    _check(profile)
    check_packages(profile)
    port = endpoint_host_port(_exposed(profile))[1]
    documents: dict[str, list[dict[str, Any]]] = {
        "profile.yaml": [_object("v1", "ConfigMap", name, name, data={"profile.toml": text})]
    }
    for service in profile.processes:
        made = _router(name, port) if service == "router" else _replicas(name, service, replicas)
        made.append(_policy(name, service, port))
        documents[f"{service}.yaml"] = made
        pod = made[0]["spec"]["template"]
        pod["spec"] = _pod(profile, name, service, port)
    head = "# Written by palpate install --kubernetes.\n"
    return {
        file: head + "---\n".join(_yaml(document) for document in found)
        for file, found in documents.items()
    }


def _check(profile: Profile) -> None:
    if strange := [one for one in profile.processes if one not in CLUSTERED]:
        raise ConfigError(
            f"{', '.join(strange)} cannot run in a cluster: sensors, recordings, pages and "
            "metrics belong to a PC of the lab",
            remedy=f"write a profile with some of {', '.join(sorted(CLUSTERED))}; the stations "
            "connect up to its router: [router] connect",
        )
    if "router" not in profile.processes:
        raise ConfigError(
            "a site in a cluster has a router of its own",
            remedy='name "router" among the processes of this profile',
        )
    if str(profile.link.certificates) != _CERTIFICATES:
        raise ConfigError(
            "pods reach one another over a network, and are known by their certificates",
            remedy=f'[link] certificates = "{_CERTIFICATES}"',
        )
    _exposed(profile)


def _exposed(profile: Profile) -> str:
    for endpoint in profile.router.listen:
        if not is_loopback(endpoint_host_port(endpoint)[0]):
            return endpoint
    raise ConfigError(
        "the router listens on loopback only, which no other pod and no station reaches",
        remedy='[router] listen = ["tls/0.0.0.0:7447"]',
    )


def _labels(name: str, service: str) -> dict[str, str]:
    return {"app.kubernetes.io/name": f"palpate-{service}", "app.kubernetes.io/instance": name}


def _object(
    version: str, kind: str, name: str, instance: str, *, service: str = "", **more: Any
) -> dict[str, Any]:
    labels = {"app.kubernetes.io/part-of": "palpate", "app.kubernetes.io/instance": instance}
    labels |= _labels(instance, service) if service else {}
    return {
        "apiVersion": version,
        "kind": kind,
        "metadata": {"name": name, "labels": labels},
        **more,
    }


def _router(name: str, port: int) -> list[dict[str, Any]]:
    own, labels = f"{name}-router", _labels(name, "router")
    template = {"metadata": {"labels": labels}}
    ports = [{"name": "zenoh", "port": port, "targetPort": port, "protocol": "TCP"}]
    return [
        _object(
            "apps/v1",
            "StatefulSet",
            own,
            name,
            service="router",
            spec={
                "serviceName": own,
                "replicas": 1,
                "selector": {"matchLabels": labels},
                "template": template,
            },
        ),
        # Stations of the lab reach it at a port of every node; a load balancer does as well.
        _object(
            "v1",
            "Service",
            own,
            name,
            service="router",
            spec={"type": "NodePort", "selector": labels, "ports": ports},
        ),
    ]


def _replicas(name: str, service: str, replicas: int) -> list[dict[str, Any]]:
    labels = _labels(name, service)
    own = f"{name}-{service}"
    spec = {
        "replicas": replicas,
        "selector": {"matchLabels": labels},
        "strategy": {"type": "RollingUpdate", "rollingUpdate": {"maxUnavailable": 1}},
        "template": {"metadata": {"labels": labels}},
    }
    made = [_object("apps/v1", "Deployment", own, name, service=service, spec=spec)]
    if replicas > 1:
        budget = {"minAvailable": 1, "selector": {"matchLabels": labels}}
        made.append(
            _object("policy/v1", "PodDisruptionBudget", own, name, service=service, spec=budget)
        )
    return made


def _policy(name: str, service: str, port: int) -> dict[str, Any]:
    """Only the router is reached, and the others reach it and the names of services."""
    zenoh = {"protocol": "TCP", "port": port}
    names = [{"protocol": "UDP", "port": 53}, {"protocol": "TCP", "port": 53}]
    spec: dict[str, Any] = {
        "podSelector": {"matchLabels": _labels(name, service)},
        "policyTypes": ["Ingress", "Egress"],
        "ingress": [{"ports": [zenoh]}] if service == "router" else [],
        "egress": [
            {"ports": names},
            {
                "to": [{"podSelector": {"matchLabels": _labels(name, "router")}}],
                "ports": [zenoh],
            },
        ],
    }
    return _object(
        "networking.k8s.io/v1",
        "NetworkPolicy",
        f"{name}-{service}",
        name,
        service=service,
        spec=spec,
    )


def _pod(profile: Profile, name: str, service: Service, port: int) -> dict[str, Any]:
    role = role_of(service).value
    file = f"{_PROFILE}/profile.toml"
    connect = f"tls/127.0.0.1:{port}" if service == "router" else f"tls/{name}-router:{port}"
    environment: list[dict[str, Any]] = [
        {"name": "HOME", "value": "/tmp"},
        {"name": "XDG_STATE_HOME", "value": "/tmp/state"},
        {"name": "XDG_CACHE_HOME", "value": "/tmp/cache"},
        {"name": "PALPATE_LINK__CONNECT", "value": json.dumps([connect])},
        {"name": "_PALPATE_HEARTBEAT", "value": f"{_BEATS}/{service}"},
    ]
    if service != "router":
        name_of_pod = {"fieldRef": {"fieldPath": "metadata.name"}}
        environment.append({"name": "PALPATE_REPLICA", "valueFrom": name_of_pod})
    memory_mb = _MEMORY_MB.get(service, _SERVICE_MEMORY_MB)
    cores = 1
    if service == FEM:
        memory_mb *= profile.fem.workers
        cores = profile.fem.workers * max(1, profile.fem.threads)
    amounts = {"memory": f"{memory_mb}Mi", "ephemeral-storage": "2Gi"}
    requests = {"memory": f"{memory_mb // 2}Mi", "cpu": str(cores) if service == FEM else "100m"}
    container = {
        "name": service,
        "image": f"palpate:{present_version()}",
        "args": ["run", service, "--profile", file],
        "env": environment,
        "resources": {"requests": requests, "limits": amounts},
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        # Until the first heartbeat; then one that does not beat is started again.
        "startupProbe": _probe(["probe", "live"], times=18),
        "livenessProbe": _probe(["probe", "live"], times=2),
        "readinessProbe": _probe(["probe", "ready", service, "--profile", file], times=2),
        "volumeMounts": [
            {"name": "profile", "mountPath": _PROFILE, "readOnly": True},
            {"name": "certs", "mountPath": f"{_CERTIFICATES}/{role}", "readOnly": True},
            {"name": "beats", "mountPath": _BEATS},
            {"name": "tmp", "mountPath": "/tmp"},
        ],
    }
    if service == "router":
        container["ports"] = [{"name": "zenoh", "containerPort": port, "protocol": "TCP"}]
    return {
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 30,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [container],
        "volumes": [
            {"name": "profile", "configMap": {"name": name}},
            {
                "name": "certs",
                "secret": {"secretName": f"palpate-{role}", "defaultMode": 0o440},
            },
            {"name": "beats", "emptyDir": {"medium": "Memory", "sizeLimit": "1Mi"}},
            {"name": "tmp", "emptyDir": {"sizeLimit": "2Gi"}},
        ],
    }


def _probe(command: list[str], *, times: int) -> dict[str, Any]:
    return {
        "exec": {"command": ["palpate", *command]},
        "periodSeconds": _PROBE_S,
        "timeoutSeconds": _PROBE_S,
        "failureThreshold": times,
    }


def _yaml(value: Mapping[str, Any], indent: str = "") -> str:
    """Plain values as YAML in blocks; every scalar is written as JSON, which is YAML, too."""
    lines = []
    for key, item in value.items():
        if isinstance(item, Mapping) and item:
            lines.append(f"{indent}{key}:\n{_yaml(item, indent + '  ')}")
        elif isinstance(item, str) and "\n" in item:
            block = "".join(f"{indent}  {line}".rstrip() + "\n" for line in item.splitlines())
            lines.append(f"{indent}{key}: |\n{block}")
        elif _is_list_of_maps(item):
            lines.append(f"{indent}{key}:\n")
            for one in item:
                first = _yaml(one, indent + "    ")
                lines.append(f"{indent}  - {first[len(indent) + 4 :]}")
        else:
            lines.append(f"{indent}{key}: {json.dumps(item)}\n")
    return "".join(lines)


def _is_list_of_maps(item: object) -> bool:
    return (
        isinstance(item, Sequence)
        and not isinstance(item, str)
        and bool(item)
        and all(isinstance(one, Mapping) and one for one in item)
    )
