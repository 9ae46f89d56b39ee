"""Write docs/messages.md from the comments of the .proto files (``make docs``).

``python docs/make_messages.py``          writes the page
``python docs/make_messages.py --check``  exits 1 if the committed page is not what it would write
"""

from __future__ import annotations

import runpy
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from google.protobuf import descriptor_pb2

FRESH = runpy.run_path(str(Path(__file__).with_name("fresh.py")))
ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "messages.md"
HEAD = """\
<!-- Written by docs/make_messages.py from protos/palpate/v1/*.proto; do not edit. -->
# Messages of `palpate.v1`

What travels on the wire. The comments are those of the `.proto` files; units and frames are those
of [conventions.md](conventions.md); which message travels under which key is in
[ADR 0004](adr/0004-keys-and-qos.md). Beyond its type, each field is checked for meaning (length,
range, finite numbers) on sending and on arrival: [ADR 0003](adr/0003-wire-format.md).
"""

Field = descriptor_pb2.FieldDescriptorProto
SCALARS = {
    value: name.removeprefix("TYPE_").lower()
    for name, value in descriptor_pb2.FieldDescriptorProto.Type.items()
}
# Field numbers of descriptor.proto, of which source paths are made.
MESSAGE, ENUM, FIELD, VALUE = 4, 5, 2, 2
Comments = Mapping[tuple[int, ...], str]


def read_contract(folder: Path) -> list[descriptor_pb2.FileDescriptorProto]:
    """The .proto files below ``folder`` as descriptors with their comments, sorted by name."""
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "contract.binpb"
        command = [sys.executable, "-m", "grpc_tools.protoc", f"-I{folder}"]
        command += [f"--descriptor_set_out={out}", "--include_source_info"]
        files = sorted((folder / "palpate" / "v1").glob("*.proto"))
        subprocess.run([*command, *map(str, files)], check=True)
        return list(descriptor_pb2.FileDescriptorSet.FromString(out.read_bytes()).file)


def comments_of(file: descriptor_pb2.FileDescriptorProto) -> Comments:
    """Comment of each declaration, by its source path, as one line."""
    return {
        tuple(place.path): " ".join(f"{place.leading_comments} {place.trailing_comments}".split())
        for place in file.source_code_info.location
    }


def type_of(field: Field, maps: Mapping[str, str]) -> str:
    """The type as it is written in the .proto file, linked to its table where it is ours."""
    if field.type_name in maps:
        return maps[field.type_name]
    if field.type_name:
        name = field.type_name.rpartition(".")[2]
        text = f"[{name}](#{name.lower()})"
    else:
        text = f"`{SCALARS[field.type]}`"
    if field.label == Field.LABEL_REPEATED:
        return f"repeated {text}"
    return f"optional {text}" if field.proto3_optional else text


def maps_of(message: descriptor_pb2.DescriptorProto, scope: str) -> dict[str, str]:
    """Types of map entries, which protoc turns into nested messages, by full name."""
    return {
        f"{scope}.{message.name}.{entry.name}": (
            f"map of `{SCALARS[entry.field[0].type]}` to `{SCALARS[entry.field[1].type]}`"
        )
        for entry in message.nested_type
        if entry.options.map_entry
    }


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """A markdown table."""
    columns = list(head)
    lines = [f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    return [*lines, *(f"| {' | '.join(row)} |" for row in rows), ""]


def page_of(files: Iterable[descriptor_pb2.FileDescriptorProto]) -> str:
    """The whole page."""
    lines = HEAD.splitlines()
    for file in files:
        name = file.name.rpartition("/")[2]
        lines += ["", f"## {name}", ""]
        comments = comments_of(file)
        for index, enum in enumerate(file.enum_type):
            path = (ENUM, index)
            lines += [f"### {enum.name}", ""]
            lines += [text, ""] if (text := comments.get(path)) else []
            lines += table(
                ("value", "name", "meaning"),
                (
                    (str(value.number), f"`{value.name}`", comments.get((*path, VALUE, i), ""))
                    for i, value in enumerate(enum.value)
                ),
            )
        for index, message in enumerate(file.message_type):
            path = (MESSAGE, index)
            maps = maps_of(message, f".{file.package}")
            lines += [f"### {message.name}", ""]
            lines += [text, ""] if (text := comments.get(path)) else []
            if not message.field:
                lines += ["No fields.", ""]
                continue
            lines += table(
                ("no.", "field", "type", "meaning"),
                (
                    (
                        str(field.number),
                        f"`{field.name}`",
                        type_of(field, maps),
                        comments.get((*path, FIELD, i), ""),
                    )
                    for i, field in enumerate(message.field)
                ),
            )
        lines.pop()
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    page = page_of(read_contract(ROOT / "protos"))
    sys.exit(FRESH["write_or_check"]({PAGE: page}))
