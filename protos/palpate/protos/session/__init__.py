"""The bus: typed publishers, subscribers, queries, presence. Only here is Zenoh known.

Rules that were learned by running it (docs/adr/0004-keys-and-qos.md): callbacks only enqueue;
sensor streams drop rather than block; a query is always answered; plain TCP, never ``lowlatency``.
"""

from palpate.protos.session.link import Session
from palpate.protos.session.opening import run_router
from palpate.protos.session.presence import Alive, Asking, Presence
from palpate.protos.session.publish import Publisher
from palpate.protos.session.queues import Delivery
from palpate.protos.session.streams import MAX_REPLY_BYTES, Answer
from palpate.protos.session.subscribe import Received, Sample, Subscriber, Tap

__all__ = [
    "MAX_REPLY_BYTES",
    "Alive",
    "Answer",
    "Asking",
    "Delivery",
    "Presence",
    "Publisher",
    "Received",
    "Sample",
    "Session",
    "Subscriber",
    "Tap",
    "run_router",
]
