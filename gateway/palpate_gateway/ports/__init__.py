"""Serial lines, sockets and CAN buses: bytes in and out, with typed errors."""
