"""The bus: typed publishers, subscribers, queries, presence. Only here is Zenoh known.

Rules that were learned by running it (docs/adr/0004-keys-and-qos.md): callbacks only enqueue;
sensor streams drop rather than block; a query is always answered; plain TCP, never ``lowlatency``.
"""

from palpate.bus.claims import SensorClaims
from palpate.bus.delivery import Delivery
from palpate.bus.foreign import ForeignPublisher, ForeignSample, ForeignSubscriber, ForeignToken
from palpate.bus.link import Session
from palpate.bus.presence import AliveService, CallerToken, Presence
from palpate.bus.pubsub import Publisher, ReceivedMessage, Subscriber
from palpate.bus.query import Cancellation
from palpate.bus.queryable import QueryAnswer
from palpate.bus.router import SiteLink, run_router
from palpate.bus.tap import Tap, TapSample
from palpate.bus.topics import MAX_PAYLOAD_BYTES

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "AliveService",
    "CallerToken",
    "Cancellation",
    "Delivery",
    "ForeignPublisher",
    "ForeignSample",
    "ForeignSubscriber",
    "ForeignToken",
    "Presence",
    "Publisher",
    "QueryAnswer",
    "ReceivedMessage",
    "SensorClaims",
    "Session",
    "SiteLink",
    "Subscriber",
    "Tap",
    "TapSample",
    "run_router",
]
