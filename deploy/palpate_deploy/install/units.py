"""The files of a station as a service: units of systemd and udev rules, as text.

One unit runs `palpate up`, which starts, watches and stops its processes. The finite-element
process has a unit of its own: Warp writes machine code while it runs, and nothing else has to be
allowed to (docs/adr/0029-install.md).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from palpate.config import TLS_FILES, Role
from palpate_deploy.install.needs import HostNeeds
from palpate_deploy.station.processes import role_of
from palpate_deploy.station.profile import Profile
from palpate_deploy.station.supervision import STOP_WAIT_S

FEM = "fem"

_RULES = Path(__file__).with_name("sensors.rules")

PROFILES_FOLDER = PurePosixPath("/etc/palpate")
UNITS_FOLDER = PurePosixPath("/etc/systemd/system")
RULES_FOLDER = PurePosixPath("/etc/udev/rules.d")
STATES_FOLDER = PurePosixPath("/var/lib/palpate")
CACHES_FOLDER = PurePosixPath("/var/cache/palpate")

_MEMORY_MB = 512
"""Memory of a supervised process at most, summed over all of a unit [MiB]."""

_LEAST_MEMORY_MB = 2048

_SOLVER_MEMORY_MB = 3072
"""The same for each process that solves finite elements [MiB]: the default mesh takes 900."""


@dataclass(frozen=True, slots=True)
class ServicePlan:
    """A station that is to be a service.

    Attributes:
        name: Its name on this host, the instance of the units.
        profile: Its profile.
        needs: What it reaches of the host.
        program: The `palpate` command that the units run.
    """

    name: str
    profile: Profile
    needs: HostNeeds
    program: str

    @property
    def supervised(self) -> tuple[str, ...]:
        """Processes under `palpate up`: all but the finite elements; may be none."""
        return tuple(one for one in self.profile.processes if one != FEM)

    @property
    def solves(self) -> bool:
        """Whether there is a process of finite elements."""
        return FEM in self.profile.processes

    @property
    def main_unit(self) -> str:
        """The unit to start, stop and restart: others follow."""
        return unit_name(self.name, solver=not self.supervised)

    @property
    def stop_s(self) -> int:
        """Longest orderly stop of the processes under `palpate up` [s]."""
        return STOP_WAIT_S * len(self.supervised) + 20

    @property
    def memory_mb(self) -> int:
        """Memory of the processes under `palpate up` at most [MiB]."""
        return max(_LEAST_MEMORY_MB, _MEMORY_MB * len(self.supervised))

    @property
    def solver_memory_mb(self) -> int:
        """Memory of the finite elements at most [MiB]: the workers and who hands out the work."""
        one_more = 1 + (self.profile.fem.device is not None)
        return _SOLVER_MEMORY_MB * (self.profile.fem.workers + one_more)

    def files(self) -> dict[str, str]:
        """Texts of the units and rules, by absolute path."""
        texts = {}
        if self.supervised:
            texts[str(UNITS_FOLDER / unit_name(self.name))] = _station_unit(self)
        if self.solves:
            texts[str(UNITS_FOLDER / unit_name(self.name, solver=True))] = _solver_unit(self)
        if self.needs.serial:
            texts[str(rules_path(self.name))] = _RULES.read_text(encoding="utf-8")
        return texts


def unit_name(name: str, *, solver: bool = False) -> str:
    """Name of a station's unit, or of the one of its finite elements."""
    return f"palpate-fem@{name}.service" if solver else f"palpate@{name}.service"


def profile_path(name: str) -> PurePosixPath:
    """Where a station's profile lies."""
    return PROFILES_FOLDER / f"{name}.toml"


def rules_path(name: str) -> PurePosixPath:
    """Where a station's udev rules lie."""
    return RULES_FOLDER / f"70-palpate-{name}.rules"


def processes_value(names: Sequence[str]) -> str:
    """Value of ``PALPATE_PROCESSES`` that makes `palpate up` start these of a profile's only."""
    return json.dumps(list(names))


def _station_unit(plan: ServicePlan) -> str:
    name, needs = plan.name, plan.needs
    state = STATES_FOLDER / name
    relations, modules, devices = [], [], ["PrivateDevices=yes"]
    environment = [f"Environment=HOME={state} XDG_STATE_HOME={state}/state MPLCONFIGDIR=/tmp"]
    if plan.solves:
        relations.append(f"Wants={unit_name(name, solver=True)}")
        environment.append(f"Environment='PALPATE_PROCESSES={processes_value(plan.supervised)}'")
    if needs.serial:
        modules = ["modprobe@usbserial.service", "modprobe@cdc_acm.service"]
        relations += [
            "# The kinds of devices below are looked up at the start; a sensor may come later.",
            f"Wants={' '.join(modules)}",
        ]
        devices = ["SupplementaryGroups=dialout", *_device_lines(needs.serial)]
    return _unit(
        f"palpate station {name}",
        unit_name(name),
        [f"After={' '.join(['network.target', 'time-sync.target', *modules])}", *relations],
        [
            "# READY when every process has made its first turn, WATCHDOG while their supervisor",
            "# answers: it replaces what hangs. If it hangs itself, systemd starts all again.",
            f"ExecStart={plan.program} up --profile {profile_path(name)}",
            "# SIGTERM to `palpate up` alone: it stops the gateway first, the router last.",
            "KillMode=mixed",
            f"TimeoutStopSec={plan.stop_s}",
            "WatchdogSec=20",
            f"MemoryMax={plan.memory_mb}M",
            "",
            f"StateDirectory=palpate/{name}",
            "StateDirectoryMode=0700",
            f"WorkingDirectory={state}",
            *environment,
            *_credentials(plan.profile, roles_of(plan.profile)),
        ],
        [
            "MemoryDenyWriteExecute=yes",
            "# The gateway stays on one core; ProcSubset=pid would hide which one is idle.",
            "SystemCallFilter=sched_setaffinity",
            *devices,
            *_network((*needs.networks, *needs.device_networks), can=needs.can),
        ],
        "multi-user.target",
    )


def _solver_unit(plan: ServicePlan) -> str:
    name = plan.name
    relations = ["After=network.target time-sync.target"]
    if plan.supervised:
        station = unit_name(name)
        relations += ["# Started, stopped and restarted with the station.", f"PartOf={station}"]
    devices = ["ProcSubset=pid", "PrivateDevices=yes"]
    if plan.needs.gpu:
        kinds = ("nvidia-frontend", "nvidia", "nvidia-uvm", "nvidia-caps")
        devices = [
            "# Not tried with a GPU.",
            *(f"DeviceAllow=char-{kind} rw" for kind in kinds),
        ]
    return _unit(
        f"palpate station {name}, finite elements",
        unit_name(name, solver=True),
        relations,
        [
            f"ExecStart={plan.program} run {FEM} --profile {profile_path(name)}",
            "TimeoutStopSec=15",
            "WatchdogSec=10",
            f"MemoryMax={plan.solver_memory_mb}M",
            "",
            "# Kernels that Warp has compiled.",
            f"CacheDirectory=palpate/{name}",
            "CacheDirectoryMode=0700",
            "WorkingDirectory=/tmp",
            f"Environment=HOME=/tmp XDG_CACHE_HOME={CACHES_FOLDER / name} MPLCONFIGDIR=/tmp",
            *_credentials(plan.profile, [Role.SERVICE]),
        ],
        [
            "# No MemoryDenyWriteExecute: Warp compiles its kernels into memory.",
            *devices,
            *_network(plan.needs.networks),
        ],
        "" if plan.supervised else "multi-user.target",
    )


def _unit(
    description: str,
    name: str,
    relations: Sequence[str],
    service: Sequence[str],
    own: Sequence[str],
    wanted_by: str,
) -> str:
    lines = [
        f"# Written by `palpate install`. Changes belong into: systemctl edit {name}",
        "[Unit]",
        f"Description={description}",
        *relations,
        "# What ends a station passes, e.g. a full disk: systemd tries until it has.",
        "StartLimitIntervalSec=0",
        "",
        "[Service]",
        "Type=notify",
        "NotifyAccess=main",
        *service,
        "",
        _RESTART,
        _CLOSED,
        *own,
        *(["", "[Install]", f"WantedBy={wanted_by}"] if wanted_by else []),
    ]
    return "\n".join(lines) + "\n"


def roles_of(profile: Profile) -> tuple[Role, ...]:
    """Roles that the processes of a station have."""
    return tuple(dict.fromkeys([*map(role_of, profile.processes), Role.SERVICE]))


def _credentials(profile: Profile, roles: Sequence[Role]) -> list[str]:
    """Certificates for a user that may not read them: systemd reads them and hands them over."""
    link = profile.link
    if link.certificates is not None:
        return [
            *(
                f"LoadCredential={role}_{name}:{link.certificates / role / name}"
                for role in roles
                for name in TLS_FILES.values()
            ),
            "Environment=PALPATE_LINK__CERTIFICATES=%d",
        ]
    if link.tls is None:
        return []
    paths = {key: getattr(link.tls, key) for key in TLS_FILES}
    return [
        *(f"LoadCredential={TLS_FILES[key]}:{path}" for key, path in paths.items()),
        *(f"Environment=PALPATE_LINK__TLS__{key.upper()}=%d/{TLS_FILES[key]}" for key in paths),
    ]


def _device_lines(serial: Sequence[str]) -> list[str]:
    kinds = [kind for line in serial for kind in _kinds(line)]
    return [f"DeviceAllow={kind} rw" for kind in dict.fromkeys(kinds)]


def _kinds(line: str) -> tuple[str, ...]:
    """What to allow for a serial line: its whole kind, because a number changes with the plug."""
    for kind in ("ttyUSB", "ttyACM"):
        if line.startswith(f"/dev/{kind}"):
            return (f"char-{kind}",)
    return ("char-ttyUSB", "char-ttyACM") if line.startswith("/dev/serial/") else (line,)


def _network(networks: Sequence[str], *, can: bool = False) -> list[str]:
    return [
        "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6" + (" AF_CAN" if can else ""),
        "IPAddressDeny=any",
        " ".join(["IPAddressAllow=localhost", *dict.fromkeys(networks)]),
    ]


_RESTART = """\
TimeoutStartSec=120
# One that hangs writes the stacks of its threads into the journal, then it is killed.
WatchdogSignal=SIGUSR1
TimeoutAbortSec=2
LimitCORE=0
Restart=on-failure
RestartSec=1
# The profile, or a package, is wrong: starting again cannot help.
RestartPreventExitStatus=2
LimitNOFILE=4096
TasksMax=1024
"""

_CLOSED = """\
DynamicUser=yes
UMask=0077
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
PrivateUsers=yes
PrivateMounts=yes
PrivateTmp=yes
ProtectSystem=strict
ProtectHome=yes
ProtectProc=invisible
ProtectClock=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectControlGroups=yes
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RemoveIPC=yes
LockPersonality=yes
KeyringMode=private
DevicePolicy=closed
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM"""
