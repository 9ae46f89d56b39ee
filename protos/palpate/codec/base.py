"""A codec: one message type, its name on the wire, to bytes and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import DecodeError, Message

from palpate.errors import WireError

M = TypeVar("M")
P = TypeVar("P", bound=Message)


@dataclass(frozen=True, slots=True)
class Codec(Generic[M]):
    """Bytes to value and back, checked both ways.

    Attributes:
        schema: Full name of the protobuf message, e.g. ``"palpate.v1.ElectrodeFrame"``.
        encode: Value to payload; raises ``WireError`` for a value that breaks the contract.
        decode: Payload to value; raises ``WireError`` likewise.
        message_type: The generated class (for schemas embedded in records).
    """

    schema: str
    encode: Callable[[M], bytes]
    decode: Callable[[bytes], M]
    message_type: type[Message]


def codec_of(
    message_type: type[P], encode: Callable[[M], bytes], from_wire: Callable[[P], M]
) -> Codec[M]:
    """Build a codec from an encoder and a checked conversion of the parsed message."""
    schema = message_type.DESCRIPTOR.full_name
    parse = message_type.FromString

    def decode(payload: bytes) -> M:
        try:
            message = parse(payload)
        except DecodeError as error:
            raise WireError(
                f"{len(payload)} bytes do not parse as {schema}",
                remedy="the sender is broken or speaks another contract",
                reason="parse",
            ) from error
        return from_wire(message)

    return Codec(schema, encode, decode, message_type)
