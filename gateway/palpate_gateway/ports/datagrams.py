"""All datagrams that wait at a socket, by one system call that keeps the interpreter lock.

``socket.recv`` releases the lock for each datagram, and gets it back from a dozen other threads
half a millisecond later: a CAN bus of 4400 frames a second then falls behind at any load.
``recvmmsg`` fetches all datagrams with their stamps without releasing it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import sys
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

BATCH = 256
"""Most datagrams at once."""

NO_STAMP = -1
"""Stands for a missing time of reception."""

LARGEST = 512
"""Longest datagram that is accepted [bytes]."""

_CONTROL = 64
_MSG_DONTWAIT = 0x40
_MSG_TRUNC = 0x20
_SO_TIMESTAMPNS = 35
_STAMP_KIND = _SO_TIMESTAMPNS << 32 | 1  # type and level (SOL_SOCKET) of the control message
_STAMP_SIZE = 32  # its header and a timespec

# struct mmsghdr of 64-bit Linux, field by field, so that a batch is read as arrays.
_HEADERS = np.dtype(
    {
        "names": ["iov", "iov_count", "control", "control_size", "flags", "size"],
        "formats": ["u8", "u8", "u8", "u8", "i4", "u4"],
        "offsets": [16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)


def available() -> bool:
    """Whether this system has ``recvmmsg`` as used here: Linux, 64 bits, little-endian."""
    return (
        sys.platform.startswith("linux")
        and ctypes.sizeof(ctypes.c_void_p) == 8
        and sys.byteorder == "little"
    )


class DatagramBatch(NamedTuple):
    """Datagrams in order of arrival.

    Attributes:
        data: Their bytes, uint8, shape ``(N, LARGEST)``; overwritten by the next ``take``.
        size: Length of each, shape ``(N,)``; 0 for one that is longer than ``LARGEST``.
        stamp_ns: When the kernel received each [ns since the Unix epoch], or ``NO_STAMP``.
    """

    data: npt.NDArray[np.uint8]
    size: npt.NDArray[np.uint32]
    stamp_ns: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.size)


class Datagrams:
    """Reads batches from a socket that another object owns.

    Args:
        descriptor: The socket's file descriptor; it stays open here until ``close``.

    Raises:
        OSError: It is no open socket.
    """

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=os.dup(descriptor))
        with contextlib.suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._receive = ctypes.PyDLL(None, use_errno=True).recvmmsg
        self._data = np.zeros((BATCH, LARGEST), np.uint8)
        self._control = np.zeros((BATCH, _CONTROL // 8), np.int64)
        parts = np.zeros((BATCH, 2), np.uint64)  # struct iovec: address and size
        parts[:, 0] = self._data.ctypes.data + LARGEST * np.arange(BATCH)
        parts[:, 1] = LARGEST
        self._parts = parts  # the headers point to it, so it must stay alive
        self._headers = np.zeros(BATCH, _HEADERS)
        self._headers["iov"] = parts.ctypes.data + 16 * np.arange(BATCH)
        self._headers["iov_count"] = 1
        self._headers["control"] = self._control.ctypes.data + _CONTROL * np.arange(BATCH)
        self._address = ctypes.c_void_p(self._headers.ctypes.data)

    def fileno(self) -> int:
        """For ``select``."""
        return self._socket.fileno()

    def take(self) -> DatagramBatch:
        """The datagrams that wait, at most ``BATCH``.

        Raises:
            OSError: The socket is gone.
        """
        headers = self._headers
        headers["control_size"] = _CONTROL
        count = self._receive(self.fileno(), self._address, BATCH, _MSG_DONTWAIT, None)
        if count < 0:
            number = ctypes.get_errno()
            if number not in (errno.EAGAIN, errno.EINTR):
                raise OSError(number, os.strerror(number))
            count = 0
        taken, control = headers[:count], self._control[:count]
        stamped = (taken["control_size"] >= _STAMP_SIZE) & (control[:, 1] == _STAMP_KIND)
        stamps_ns = np.where(stamped, control[:, 2] * 1_000_000_000 + control[:, 3], NO_STAMP)
        whole = (taken["flags"] & _MSG_TRUNC) == 0
        return DatagramBatch(self._data[:count], taken["size"] * whole, stamps_ns)

    def close(self) -> None:
        """Close this handle of the socket; never raises."""
        with contextlib.suppress(OSError):
            self._socket.close()
