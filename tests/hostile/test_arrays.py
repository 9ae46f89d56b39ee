"""HDF5 files that say they hold more than they have."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.errors import DatasetError
from palpate.files.hdf5 import opened, read_array

h5py = pytest.importorskip("h5py")


def test_an_array_that_nobody_wrote_is_not_allocated(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name, shape in (("huge", (10**12,)), ("small", (1000,))):
            dataset = file.create_dataset(name, shape, "f4", chunks=(1000,))
            dataset.attrs["unit"] = "m"
    with opened(path, extra="training") as file:
        assert read_array(path, file, "small", "m").shape == (1000,)
        with pytest.raises(DatasetError, match=r"huge says that it has 4,000,000,000,000 bytes"):
            read_array(path, file, "huge", "m")
