"""Write docs/asyncapi.json and docs/asyncapi.md from the tables of ``palpate.bus`` (``make docs``).

``python docs/make_asyncapi.py``          writes both
``python docs/make_asyncapi.py --check``  exits 1 if a committed file is not what it would write

The JSON is an AsyncAPI 3.0 document of a station: it *sends* the streams that it publishes and
*receives* questions. What AsyncAPI has no word for stands under ``x-zenoh``.
"""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from palpate.bus.access import PUBLISHERS, QUESTIONS
from palpate.bus.attachments import attachment_of
from palpate.bus.endpoints import ENDPOINTS, Endpoint
from palpate.bus.topics import (
    ASKING_ROOT,
    CLAIM_ROOT,
    CONTRACT_VERSION,
    DUTY_ROOT,
    ENCODING_PREFIX,
    LIVE_ROOT,
    MAX_PAYLOAD_BYTES,
    ROBOT_POSE,
    ROOT,
    STATION_ROOT,
    TOPICS,
    Topic,
)
from palpate.codec import ERROR, STAGE_TIMINGS, Codec
from palpate.config import DEFAULT_ROUTER, Role

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
FOLDER = Path(__file__).resolve().parent
PROTOS = FOLDER.parent / "protos" / "palpate" / f"v{CONTRACT_VERSION}"
DOCUMENT, PAGE = FOLDER / "asyncapi.json", FOLDER / "asyncapi.md"

HEAD = """\
<!-- Written by docs/make_asyncapi.py from the tables of palpate/bus; do not edit. -->
# Streams and questions of a station

Everything that a station speaks over Zenoh, for programs in any language;
[asyncapi.json](asyncapi.json) says the same as an AsyncAPI 3.0 document. Messages and their fields:
[messages.md](messages.md). Why it is so: [ADR 0004](adr/0004-keys-and-qos.md).

A payload is protobuf, and its Zenoh encoding names the message:
`application/protobuf;palpate.v1.<Message>`. Payloads are at most {limit:,} bytes. `<station>`,
`<sensor>`, `<service>` and `<instance>` are 1-63 of `a-z`, `0-9`, `-`, `_`.

Who publishes, asks and answers is enforced where a station has certificates
([security.md](security.md)); everybody with a role may subscribe.
"""

NAME = {"pattern": "^[a-z0-9][a-z0-9_-]{0,62}$"}
PARTS = {
    "station": "Name of the station, e.g. lab.",
    "sensor": "Name of a sensor, e.g. finger.",
    "service": "Kind of process, e.g. features.",
    "instance": "Name of a process among several of its kind, e.g. features.",
}

TOKENS = {
    f"{LIVE_ROOT}/{{station}}/{{service}}/{{instance}}/alive": "a process lives",
    f"{LIVE_ROOT}/{{station}}/{{service}}/{{instance}}/ready": "it also serves",
    f"{ASKING_ROOT}/{{station}}/{{digest}}": "a caller waits for a simulation; the digest is the "
    "first 32 hexadecimal digits of the SHA-256 of its request_id",
    f"{CLAIM_ROOT}/{{station}}/{{sensor}}/{{held|wanted}}/{{since_wall_ns}}/{{session_id}}/{{instance}}"
    "/{host}/{serial}": "a gateway publishes this sensor, or waits for it",
    f"{DUTY_ROOT}/{{duty}}/{{station}}/{{sensor}}/{{held|wanted}}/{{since_wall_ns}}/{{session_id}}"
    "/{instance}/{host}/{serial}": "a service does this for a sensor, or stands by; serial is the "
    "digest of what its answers depend on",
    f"{STATION_ROOT}/{{station}}/router/{{held|wanted}}/{{since_wall_ns}}/{{session_id}}/{{instance}}"
    "/{host}/{serial}": "a router has the name of this station at a site, or waits for it",
}
"""Liveliness tokens, and what holds while they exist."""


def address_of(what: Topic[Any] | Endpoint[Any, Any]) -> str:
    """Key of a stream or question, with its parts in braces."""
    if what.per_service:
        return f"{ROOT}/{{station}}/@service/{{service}}/{{instance}}/{what.name}"
    return f"{ROOT}/{{station}}/{{sensor}}/{what.name}"


def services_of(what: Topic[Any] | Endpoint[Any, Any]) -> tuple[str, ...]:
    """The services that a key names; empty = those of every process, or it names none."""
    return what.services if isinstance(what, Endpoint) else ()


def named_address_of(what: Topic[Any] | Endpoint[Any, Any]) -> str:
    """As ``address_of``, with the services that answer."""
    services = services_of(what)
    named = services[0] if len(services) == 1 else f"{{{'|'.join(services)}}}"
    return address_of(what).replace("{service}", named) if services else address_of(what)


def field_name(codec: Codec[Any], name: str) -> str:
    """Name of a field as text of the page; a ``KeyError`` where the message has no such field."""
    return f"`{codec.message_type.DESCRIPTOR.fields_by_name[name].name}`"


def message_name(codec: Codec[Any]) -> str:
    """Name of a message without its package."""
    return codec.schema.rpartition(".")[2]


def definitions() -> dict[str, str]:
    """Each message as the .proto files define it, comment included, by name."""
    found = {}
    pattern = re.compile(r"((?:^//.*\n)*)^message (\w+) \{(?:\}|\n(?:.*\n)*?\})", re.MULTILINE)
    for file in sorted(PROTOS.glob("*.proto")):
        for match in pattern.finditer(file.read_text(encoding="utf-8")):
            found[match[2]] = match[0]
    return found


def message_of(codec: Codec[Any], definition: str) -> dict[str, Any]:
    """A message of the document."""
    name = message_name(codec)
    return {
        "name": codec.schema,
        "title": name,
        "contentType": f"{ENCODING_PREFIX}{codec.schema}",
        "payload": {
            "schemaFormat": "application/vnd.google.protobuf;version=3",
            "schema": definition,
        },
        "externalDocs": {"url": f"messages.md#{name.lower()}"},
    }


def channel_of(
    what: Topic[Any] | Endpoint[Any, Any], codecs: Iterable[Codec[Any]], zenoh: dict[str, Any]
) -> dict[str, Any]:
    """A channel: where messages of some kinds travel, and how."""
    address = address_of(what)
    parameters: dict[str, dict[str, Any]] = {
        part: {"description": PARTS[part]} for part in re.findall(r"\{(\w+)\}", address)
    }
    if services := services_of(what):
        parameters["service"]["enum"] = list(services)
    return {
        "address": address,
        "description": what.doc,
        "parameters": parameters,
        "messages": {
            message_name(one): {"$ref": f"#/components/messages/{message_name(one)}"}
            for one in codecs
        },
        "x-zenoh": {"key": re.sub(r"\{[^}]+\}", "*", named_address_of(what)), **zenoh},
    }


def is_estimate(topic: Topic[Any]) -> bool:
    """Whether a model made its messages."""
    return "bundle_sha256" in topic.codec.message_type.DESCRIPTOR.fields_by_name


def stream_quality(topic: Topic[Any]) -> dict[str, Any]:
    """How a stream is sent."""
    timings = {"attachment": STAGE_TIMINGS.schema} if is_estimate(topic) else {}
    return {
        "kind": "publication",
        "encoding": topic.encoding,
        "priority": topic.priority.name,
        "congestionControl": "DROP",
        "reliability": "RELIABLE",
        "express": False,
        "usualRateHz": topic.rate_hz,
        "recorded": topic.recorded,
        "sequenceWithoutHoles": topic.contiguous,
        "publishers": in_order(PUBLISHERS[topic.name]),
        **timings,
    }


def in_order(roles: Collection[Role]) -> list[str]:
    """Roles by their names, always in one order."""
    return [role.value for role in Role if role in roles]


def question_quality(constant: str, endpoint: Endpoint[Any, Any]) -> dict[str, Any]:
    """How a question is asked, and by whom."""
    return {
        "kind": "query",
        "encoding": ENCODING_PREFIX + endpoint.request.schema,
        "replyEncoding": ENCODING_PREFIX + endpoint.reply.schema,
        "errorEncoding": ENCODING_PREFIX + ERROR.schema,
        "attachment": attachment_of(1.5).decode(),
        "consolidation": "NONE",
        "wildcards": endpoint.per_service,
        "askers": in_order(QUESTIONS[constant].askers),
        "answerers": in_order(QUESTIONS[constant].answerers),
    }


def references(channel: str, *codecs: Codec[Any]) -> list[dict[str, str]]:
    """Messages of a channel."""
    return [{"$ref": f"#/channels/{channel}/messages/{message_name(one)}"} for one in codecs]


def document() -> dict[str, Any]:
    """The AsyncAPI document."""
    channels: dict[str, Any] = {}
    operations: dict[str, Any] = {}
    used: dict[str, Codec[Any]] = {one.schema: one for one in (ERROR, STAGE_TIMINGS)}
    for topic in TOPICS.values():
        name = f"stream_{topic.name}"
        used[topic.codec.schema] = topic.codec
        channels[name] = channel_of(topic, [topic.codec], stream_quality(topic))
        operations[name] = {
            "action": "receive" if topic is ROBOT_POSE else "send",
            "channel": {"$ref": f"#/channels/{name}"},
            "summary": topic.doc,
            "messages": references(name, topic.codec),
        }
    for constant, endpoint in ENDPOINTS.items():
        name = f"ask_{constant}"
        kinds = {one.schema: one for one in (endpoint.request, endpoint.reply, ERROR)}
        used |= kinds
        channels[name] = channel_of(endpoint, kinds.values(), question_quality(constant, endpoint))
        operations[name] = {
            "action": "receive",
            "channel": {"$ref": f"#/channels/{name}"},
            "summary": endpoint.doc,
            "messages": references(name, endpoint.request),
            "reply": {
                "channel": {"$ref": f"#/channels/{name}"},
                "messages": references(name, endpoint.reply, ERROR),
            },
        }
    known = definitions()
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "palpate",
            "version": f"{CONTRACT_VERSION}.0.0",
            "description": "Tactile sensing for the SynTouch BioTac over Zenoh. The major version "
            "stands in every key and in the name of every message; within it there are additions "
            "only.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/protobuf",
        "servers": {
            "router": {
                "host": DEFAULT_ROUTER.partition("/")[2],
                "protocol": "zenoh",
                "description": "The station's router. From another host: tls/HOST:PORT with "
                "certificates of both sides.",
            }
        },
        "channels": channels,
        "operations": operations,
        "components": {
            "messages": {
                message_name(codec): message_of(codec, known[message_name(codec)])
                for _, codec in sorted(used.items())
            }
        },
        "x-zenoh": {
            "maxPayloadBytes": MAX_PAYLOAD_BYTES,
            "names": NAME["pattern"],
            "livelinessTokens": TOKENS,
        },
    }


def page() -> str:
    """The readable page."""

    def link(codec: Codec[Any]) -> str:
        name = message_name(codec)
        return f"[{name}](messages.md#{name.lower()})"

    def code(address: str) -> str:
        text = address.replace("{", "<").replace("}", ">").replace("|", " or ")
        return f"`{text}`"

    def key(what: Topic[Any] | Endpoint[Any, Any]) -> str:
        return code(named_address_of(what))

    lines = [
        HEAD.format(limit=MAX_PAYLOAD_BYTES),
        "## Streams",
        "",
        "Published with congestion control DROP, reliable, not express: a subscriber that does not",
        "keep up loses messages and never slows a sensor down. `robot_pose` is the one stream that",
        "a station receives. Each estimate has its",
        f"{link(STAGE_TIMINGS)} in the attachment, not in the payload.",
        "",
        "| key | message | usual rate | priority | recorded | published by | meaning |",
        "|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS.values():
        rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "on events"
        recorded = "yes" if topic.recorded else "no"
        lines.append(
            f"| {key(topic)} | {link(topic.codec)} | {rate} | {topic.priority.name} | {recorded} "
            f"| {', '.join(in_order(PUBLISHERS[topic.name]))} | {topic.doc} |"
        )
    lines += [
        "",
        "## Questions",
        "",
        "Zenoh queries: the request is the payload, with its encoding. The attachment",
        f"`{attachment_of(1.5).decode()}` says how long the caller waits; without it a service",
        "works on for callers that have left. Each question ends in replies or in one",
        f"{link(ERROR)}, whose {field_name(ERROR, 'retry_after_ms')} says when to ask again. No",
        "reply at all means that nobody serves the key, or that the reply was larger than a",
        "message may be. A question about a sensor names one sensor; one to processes may have",
        "wildcards. One in place of a service that the key names also reaches other services,",
        "which refuse what is no request of theirs.",
        "",
        "| key | request | reply | asked by | answered by | meaning |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {key(one)} | {link(one.request)} | {link(one.reply)} "
        f"| {', '.join(in_order(QUESTIONS[constant].askers))} "
        f"| {', '.join(in_order(QUESTIONS[constant].answerers))} | {one.doc} |"
        for constant, one in ENDPOINTS.items()
    ]
    lines += [
        "",
        "## Liveliness tokens",
        "",
        "| key | while it exists |",
        "|---|---|",
        *(f"| {code(token)} | {meaning} |" for token, meaning in TOKENS.items()),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    wanted = {
        DOCUMENT: json.dumps(document(), indent=1, ensure_ascii=False) + "\n",
        PAGE: page(),
    }
    sys.exit(FRESH["write_or_check"](wanted))
