"""A topic by name."""

from __future__ import annotations

import difflib
from typing import Any

from palpate.bus.topics import TOPICS, Topic
from palpate.errors import ConfigError


def topic_named(name: str) -> Topic[Any]:
    """A topic of the contract.

    Raises:
        ConfigError: There is none of this name; the error names the nearest.
    """
    topic = TOPICS.get(name)
    if topic is None:
        near = difflib.get_close_matches(name, TOPICS, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ConfigError(
            f"topic {name!r} does not exist", remedy=f"{hint}known: {', '.join(TOPICS)}"
        )
    return topic
