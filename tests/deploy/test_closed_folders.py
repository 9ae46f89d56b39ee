"""What lies in a folder of another user is named with what to do, and ends no command."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("h5py")

from palpate.config import Role, TlsConfig
from palpate.errors import ConfigError
from palpate.files.outputs import check_folder, check_output
from palpate_deploy.cli.options import existing_file
from palpate_deploy.station.certificates import issue, list_certificates, make_authority
from palpate_deploy.station.profile import profile_path
from palpate_fem.calibration.measured import read_indentations
from palpate_fem.cli.check import verify_command
from palpate_fem.cli.model import model_of
from palpate_fem.store.read import SimulationStore
from palpate_fem.validation.sources import measured_from
from palpate_services.inference.repository import Repository

_NOBODY = 65534


@contextmanager
def closed(folder: Path) -> Iterator[None]:
    """In the block, the folder is one that this process may not enter."""
    root = os.geteuid() == 0
    folder.chmod(0)
    if root:
        os.seteuid(_NOBODY)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(0o700)


@pytest.mark.parametrize(
    "look",
    [
        lambda folder: existing_file(folder / "lab.mcap"),
        lambda folder: profile_path(folder / "lab.toml"),
        TlsConfig.of_folder,
        lambda folder: TlsConfig.of_role(folder, Role.ROBOT),
        list_certificates,
        lambda folder: issue(folder, Role.ROBOT),
        lambda folder: Repository(None).resolve(str(folder)),
        lambda folder: check_output(folder / "table.csv", "--out", ".csv"),
        lambda folder: check_folder(folder / "runs", "--out"),
        lambda folder: model_of(mesh=str(folder / "meshes"), edge_mm=None, layers=2),
        lambda folder: verify_command(only=None, slow=False, shared_data=folder, as_json=True),
        lambda folder: measured_from(folder / "measured.h5"),
        lambda folder: read_indentations(folder / "measured.h5"),
        SimulationStore.open,
        lambda folder: SimulationStore.open(folder / "presses.sim"),
    ],
)
def test_a_closed_folder_is_told(tmp_path: Path, look: Callable[[Path], object]) -> None:
    with closed(tmp_path), pytest.raises(ConfigError, match=r"cannot be read: Permission denied"):
        look(tmp_path)


def test_no_authority_is_made_in_a_closed_folder(tmp_path: Path) -> None:
    with closed(tmp_path), pytest.raises(ConfigError, match=r"cannot be made: .*Permission denied"):
        make_authority(tmp_path / "certs")
