"""HDF5 files on a disk that refuses."""

from __future__ import annotations

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import h5py
import numpy as np
import pytest

from palpate.errors import DatasetError
from palpate.files.hdf5 import hdf5_written_whole

WRITE = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from palpate.errors import DatasetError
from palpate.files.hdf5 import hdf5_written_whole

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a file that becomes too large is an error then
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
values = np.random.default_rng(0).normal(size=4000)
try:
    with hdf5_written_whole(Path(sys.argv[1]), extra="training") as file:
        file.attrs["schema"] = "palpate.test"
        for k in range(20):
            file.create_dataset(f"values{k}", data=values, compression="gzip" if k % 2 else None)
        file["values0"][100:200] = file["values2"][:100]
except DatasetError as error:
    print(error)
"""


@pytest.mark.parametrize("size", [0, 3_000, 100_000, 635_000, 645_000, 660_000])
def test_a_disk_that_is_full_at_any_moment_is_told_and_no_more(tmp_path: Path, size: int) -> None:
    """Also where only closing is refused, at which HDF5 crashes the process."""
    path = tmp_path / "made" / "set.h5"
    words = [sys.executable, "-c", WRITE, str(path), str(size)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert f"cannot write {path}" in ended.stdout
    assert not list(path.parent.iterdir())


def test_what_fails_while_a_file_is_written_leaves_the_old_one(tmp_path: Path) -> None:
    path, values = tmp_path / "set.h5", np.arange(1e5)
    for failing in (False, True):
        with (
            pytest.raises(DatasetError, match="enough") if failing else nullcontext(),
            hdf5_written_whole(path, extra="training") as file,
        ):
            file.attrs["schema"] = "palpate.test"
            file["values"] = values
            if failing:
                raise DatasetError("enough", remedy="stop")
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["values"][:], values)
    assert list(tmp_path.iterdir()) == [path]
