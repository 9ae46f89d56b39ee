"""docs/asyncapi.json is an AsyncAPI 3 document of all that is in the tables.

The official JSON schema is not at hand here; what it demands of the parts that we use is written
out below.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from palpate.bus.endpoints import ENDPOINTS
from palpate.bus.topics import ENCODING_PREFIX, TOPICS, sensor_key, service_key

ROOT = Path(__file__).resolve().parents[2]
IDENTIFIER = re.compile(r"[A-Za-z0-9_\-.]+")


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        (ROOT / "docs" / "asyncapi.json").read_text(encoding="utf-8")
    )
    return found


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if key == "$ref":
                yield inner
            else:
                yield from references(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from references(inner)


def test_its_top_has_what_the_standard_demands_and_nothing_else(document: dict[str, Any]) -> None:
    allowed = {"asyncapi", "id", "info", "servers", "defaultContentType", "channels"}
    allowed |= {"operations", "components"}
    assert {key for key in document if not key.startswith("x-")} <= allowed
    assert document["asyncapi"] == "3.0.0"
    assert {"title", "version"} <= set(document["info"])
    for server in document["servers"].values():
        assert {"host", "protocol"} <= set(server)


def test_channels_and_operations_have_the_standards_form(document: dict[str, Any]) -> None:
    for name, channel in document["channels"].items():
        assert IDENTIFIER.fullmatch(name)
        assert set(re.findall(r"\{(\w+)\}", channel["address"])) == set(channel["parameters"])
        assert channel["messages"]
        for parameter in channel["parameters"].values():
            assert set(parameter) <= {"enum", "default", "description", "examples", "location"}
    for name, operation in document["operations"].items():
        assert IDENTIFIER.fullmatch(name)
        assert operation["action"] in ("send", "receive")
        channel = operation["channel"]["$ref"]
        listed = [operation["messages"], operation.get("reply", {}).get("messages", [])]
        for reference in references(listed):
            assert reference.startswith(channel.split("/messages/")[0])
    for message in document["components"]["messages"].values():
        assert set(message["payload"]) == {"schemaFormat", "schema"}
        assert message["payload"]["schema"].rstrip().endswith("}")


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    for reference in references(document):
        place: Any = document
        assert reference.startswith("#/")
        for part in reference[2:].split("/"):
            assert part in place, reference
            place = place[part]


def test_every_stream_and_question_is_in_it_with_its_key_and_quality(
    document: dict[str, Any],
) -> None:
    channels = document["channels"]
    assert set(channels) == {f"stream_{name}" for name in TOPICS} | {
        f"ask_{name}" for name in ENDPOINTS
    }
    assert set(document["operations"]) == set(channels)
    for name, topic in TOPICS.items():
        zenoh = channels[f"stream_{name}"]["x-zenoh"]
        assert zenoh["key"] == (
            service_key("*", "*", "*", name) if topic.per_service else sensor_key("*", "*", name)
        )
        assert zenoh["encoding"] == topic.encoding
        assert zenoh["priority"] == topic.priority.name
        assert zenoh["congestionControl"] == "DROP"
    for name, endpoint in ENDPOINTS.items():
        channel = channels[f"ask_{name}"]
        one = endpoint.services[0] if len(endpoint.services) == 1 else "*"
        assert channel["x-zenoh"]["key"] == (
            service_key("*", one, "*", endpoint.name)
            if endpoint.per_service
            else sensor_key("*", "*", endpoint.name)
        )
        told = channel["parameters"].get("service", {}).get("enum", [])
        assert told == list(endpoint.services)
        assert channel["x-zenoh"]["encoding"] == ENCODING_PREFIX + endpoint.request.schema
        reply = document["operations"][f"ask_{name}"]["reply"]
        answers = {one["$ref"].rpartition("/")[2] for one in reply["messages"]}
        assert answers == {endpoint.reply.schema.rpartition(".")[2], "Error"}
