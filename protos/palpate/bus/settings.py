"""Zenoh settings; each one we rely on is set by hand, for defaults change between versions."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from palpate.config import LinkConfig

MAX_MESSAGE_BYTES = 4 << 20
"""Larger messages are refused on arrival; Zenoh's own limit is 1 GiB."""

INDIRECT_WAIT_S = 60.0
"""Without direct links opening blocks until the router answers; it gives up after this time [s]."""

LOSSLESS_STALL_S = 60.0
"""How long a lossless (replay) publisher may be blocked before its link is closed."""


def zenoh_config(link: LinkConfig, mode: str) -> zenoh.Config:
    """Settings of a session of ``mode`` ``"peer"``, ``"client"`` or ``"router"``."""
    client = mode == "client"
    wait_s = INDIRECT_WAIT_S if link.wait_for_router_s < 0 else link.wait_for_router_s
    settings: dict[str, Any] = {
        "mode": mode,
        # A peer retries for ever in the background; Session.open does the waiting and names what is
        # missing. A client cannot open without its router.
        "connect": {
            "endpoints": list(link.connect),
            "timeout_ms": round(wait_s * 1000) if client else -1,
            "exit_on_failure": client,
            "retry": {
                "period_init_ms": 200,
                "period_max_ms": 1000,
                "period_increase_factor": 1.5,
            },
        },
        "listen": {
            "endpoints": [] if client else list(link.listen),
            "timeout_ms": 0,
            "exit_on_failure": True,
        },
        # The router introduces peers to one another; their data then flows on direct links.
        "scouting": {
            "multicast": {"enabled": False},
            "gossip": {
                "enabled": True,
                "autoconnect": {"router": [], "peer": ["router", "peer"]},
            },
        },
        # Do not wait for peers that may not exist; Session.open waits for the router itself.
        "open": {"return_conditions": {"connect_scouted": False, "declares": True}},
        "timestamping": {"enabled": False},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "tx": {
                    "lease": round(link.lease_s * 1000),
                    "keep_alive": 4,
                    "queue": {
                        # Express messages take a batch each: with the default of two, twenty
                        # sensors that publish in the same millisecond lose frames.
                        "size": {"real_time": 16, "data_high": 16},
                        "congestion_control": {
                            "drop": {"wait_before_drop": 2000},
                            "block": {"wait_before_close": round(LOSSLESS_STALL_S * 1e6)},
                        },
                    },
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
            },
        },
    }
    if link.tls is not None:
        settings["transport"]["link"]["tls"] = {
            "root_ca_certificate": str(link.tls.root_ca_certificate),
            "enable_mtls": True,
            "listen_certificate": str(link.tls.certificate),
            "listen_private_key": str(link.tls.private_key),
            "connect_certificate": str(link.tls.certificate),
            "connect_private_key": str(link.tls.private_key),
        }
    return zenoh.Config.from_json5(json.dumps(settings))
