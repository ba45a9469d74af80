"""Fast writing and reading of chunked MCAP files with JSON messages.

The reference library (``mcap``) builds every record through a stream of small writes, which costs more than the
encoding itself; here messages are encoded straight into the chunk and indexed on the fly, and the library serves
only for the records that are rare. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from io import BytesIO
from typing import Any, BinaryIO

import msgspec
import msgspec.inspect
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS = _MESSAGE.size - _RECORD.size
_INDEX = struct.Struct("<QQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_CHUNK_HEAD = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<BQQQ")


def _record(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


_DAMAGED = (
    McapError, zstandard.ZstdError, struct.error, LookupError, UnicodeDecodeError, OverflowError, MemoryError
)  # fmt: skip


@contextmanager
def _whole(what: str) -> Iterator[None]:
    """What cannot be read within is told as a ValueError: lengths and numbers of a damaged file point anywhere."""
    try:
        yield
    except _DAMAGED as error:
        raise ValueError(f"{what} is damaged ({str(error) or type(error).__name__})") from error


def flat_schema(kind: Any) -> dict[str, Any]:
    """JSON Schema of a msgspec type in the small dialect that plotting tools read.

    References are inlined, an optional value has the schema of the value, a tuple is an array of its first item, and
    an integer with names is one of constants. The dialect has no arrays of arrays, and one that names such a field is
    refused as a whole: the field is in the messages, but not in the schema.
    """
    schema = msgspec.json.schema(kind)
    definitions = schema.get("$defs", {})

    def flatten(node: dict[str, Any]) -> dict[str, Any]:
        if "$ref" in node:
            return flatten(definitions[node["$ref"].rsplit("/", 1)[1]])
        if "anyOf" in node:
            return flatten(next(option for option in node["anyOf"] if option.get("type") != "null"))
        flat: dict[str, Any] = {key: node[key] for key in ("title", "description", "enum") if key in node}
        flat["type"] = node.get("type") or (
            "integer" if all(isinstance(v, int) for v in node.get("enum", [""])) else "string"
        )
        if flat["type"] == "object":
            fields = {name: flatten(child) for name, child in node.get("properties", {}).items()}
            flat["properties"] = {name: field for name, field in fields.items() if not _nested(field)}
        elif flat["type"] == "array":
            item = (node.get("prefixItems") or [node.get("items")])[0]
            flat["items"] = flatten(item) if isinstance(item, dict) else {"type": "string"}
        elif flat["type"] == "integer" and "enum" in flat:
            named = {enum.__name__: enum for enum in _integer_enums(msgspec.inspect.type_info(kind))}
            if (enum := named.get(flat.get("title", ""))) is not None:
                flat["oneOf"] = [{"title": value.name, "const": value.value} for value in enum]
                del flat["enum"]
        return flat

    return flatten(schema)


def _nested(field: dict[str, Any]) -> bool:
    return bool(field["type"] == "array" and field["items"]["type"] == "array")


def _integer_enums(node: Any) -> Iterator[type[IntEnum]]:
    """Every enumeration of integers in what msgspec tells of a type."""
    if isinstance(node, msgspec.inspect.EnumType):
        if issubclass(node.cls, IntEnum):
            yield node.cls
    elif isinstance(node, msgspec.Struct):
        for name in node.__struct_fields__:
            yield from _integer_enums(getattr(node, name))
    elif isinstance(node, tuple):
        for part in node:
            yield from _integer_enums(part)


class Channel:
    """One topic of a file being written."""

    def __init__(self, number: int, topic: str) -> None:
        self.number = number
        self.topic = topic
        self.count = 0
        """Messages so far: the sequence number of the next."""
        self.index = bytearray()


class McapWriter:
    """Writes an MCAP file chunk by chunk; whatever chunk has been flushed can be read after a crash."""

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._offset = 0
        self._buffer = bytearray()
        self._start_ns = self._end_ns = 0
        self._message_start = 0
        self._encoder = msgspec.json.Encoder()
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._channels: list[Channel] = []
        self._repeated: dict[int, list[bytes]] = {Opcode.SCHEMA: [], Opcode.CHANNEL: []}
        self._indexes: dict[int, list[bytes]] = {
            Opcode.CHUNK_INDEX: [],
            Opcode.ATTACHMENT_INDEX: [],
            Opcode.METADATA_INDEX: [],
        }
        self._first_ns: int | None = None
        self._last_ns = 0
        self._write(MAGIC + _record(records.Header(profile="", library=library)))

    @property
    def pending(self) -> int:
        """Bytes of the chunk not yet flushed."""
        return len(self._buffer)

    @property
    def pending_since_ns(self) -> int:
        """Time of the first message of the chunk not yet flushed."""
        return self._start_ns

    def channel(self, topic: str, kind: Any) -> Channel:
        """Open a topic whose messages are of the msgspec type ``kind``."""
        channel = Channel(len(self._channels) + 1, topic)
        name = getattr(kind, "__name__", topic.strip("/").capitalize())
        data = json.dumps(flat_schema(kind), separators=(",", ":")).encode()
        schema = _record(records.Schema(id=channel.number, name=name, encoding="jsonschema", data=data))
        entry = _record(
            records.Channel(
                id=channel.number, schema_id=channel.number, topic=topic, message_encoding="json", metadata={}
            )
        )
        self._channels.append(channel)
        self._repeated[Opcode.SCHEMA].append(schema)
        self._repeated[Opcode.CHANNEL].append(entry)
        self._write(schema + entry)
        return channel

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        data = _record(records.Metadata(name=name, metadata=values))
        index = records.MetadataIndex(offset=self._offset, length=len(data), name=name)
        self._indexes[Opcode.METADATA_INDEX].append(_record(index))
        self._write(data)

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """Write an attachment without a time."""
        data = _record(records.Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=content))
        index = records.AttachmentIndex(
            offset=self._offset,
            length=len(data),
            log_time=0,
            create_time=0,
            data_size=len(content),
            name=name,
            media_type=media_type,
        )
        self._indexes[Opcode.ATTACHMENT_INDEX].append(_record(index))
        self._write(data)

    def add(self, channel: Channel, t_ns: int, message: object) -> int:
        """Append one message to the chunk; tells how often "null" stands in its encoding."""
        buffer = self._buffer
        self._message_start = start = len(buffer)
        body = start + _MESSAGE.size
        buffer.extend(bytes(_MESSAGE.size))
        self._encoder.encode_into(message, buffer, body)
        length = len(buffer) - body + _MESSAGE_FIELDS
        _MESSAGE.pack_into(buffer, start, Opcode.MESSAGE, length, channel.number, channel.count, t_ns, t_ns)
        if start == 0:
            self._start_ns = self._end_ns = t_ns
        else:
            self._start_ns = min(self._start_ns, t_ns)
            self._end_ns = max(self._end_ns, t_ns)
        channel.index += _INDEX.pack(t_ns, start)
        channel.count += 1
        return buffer.count(b"null", body)

    def take_back(self, channel: Channel) -> None:
        """Remove the message just added to this channel."""
        del self._buffer[self._message_start :]
        del channel.index[-_INDEX.size :]
        channel.count -= 1

    def flush(self) -> None:
        """Write the chunk in progress, with its index, and hand everything to the operating system."""
        if self._buffer:
            data = self._compressor.compress(self._buffer)
            chunk = _record(
                records.Chunk(
                    compression="zstd",
                    data=data,
                    message_start_time=self._start_ns,
                    message_end_time=self._end_ns,
                    uncompressed_crc=zlib.crc32(self._buffer),
                    uncompressed_size=len(self._buffer),
                )
            )
            offsets = {}
            index = bytearray()
            for channel in self._channels:
                if channel.index:
                    offsets[channel.number] = self._offset + len(chunk) + len(index)
                    size = len(channel.index)
                    index += _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, size + 6, channel.number, size)
                    index += channel.index
                    channel.index.clear()
            entry = records.ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=self._offset,
                compression="zstd",
                compressed_size=len(data),
                message_end_time=self._end_ns,
                message_index_length=len(index),
                message_index_offsets=offsets,
                message_start_time=self._start_ns,
                uncompressed_size=len(self._buffer),
            )
            self._indexes[Opcode.CHUNK_INDEX].append(_record(entry))
            self._first_ns = self._start_ns if self._first_ns is None else min(self._first_ns, self._start_ns)
            self._last_ns = max(self._last_ns, self._end_ns)
            self._buffer = bytearray()
            self._write(chunk + index)
        self._stream.flush()

    def finish(self) -> None:
        """Flush, and write the summary that lets readers seek."""
        self.flush()
        self._write(_record(records.DataEnd(data_section_crc=0)))
        statistics = records.Statistics(
            attachment_count=len(self._indexes[Opcode.ATTACHMENT_INDEX]),
            channel_count=len(self._channels),
            channel_message_counts={channel.number: channel.count for channel in self._channels},
            chunk_count=len(self._indexes[Opcode.CHUNK_INDEX]),
            message_count=sum(channel.count for channel in self._channels),
            metadata_count=len(self._indexes[Opcode.METADATA_INDEX]),
            message_start_time=self._first_ns or 0,
            message_end_time=self._last_ns,
            schema_count=len(self._channels),
        )
        summary_start = self._offset
        summary = bytearray()
        offsets = bytearray()
        for opcode, entries in {**self._repeated, Opcode.STATISTICS: [_record(statistics)], **self._indexes}.items():
            if entries:
                group = b"".join(entries)
                start = summary_start + len(summary)
                offsets += _record(
                    records.SummaryOffset(group_opcode=opcode, group_start=start, group_length=len(group))
                )
                summary += group
        offset_start = summary_start + len(summary)
        summary += offsets
        footer = _FOOTER.pack(Opcode.FOOTER, 20, summary_start, offset_start)
        self._write(summary + footer + struct.pack("<I", zlib.crc32(summary + footer)) + MAGIC)
        self._stream.flush()

    def _write(self, data: bytes | bytearray) -> None:
        self._stream.write(data)
        self._offset += len(data)


class Message:
    """One message as it stands in the file."""

    __slots__ = ("data", "sequence", "t_ns", "topic")

    def __init__(self, topic: str, sequence: int, t_ns: int, data: memoryview) -> None:
        self.topic = topic
        self.sequence = sequence
        self.t_ns = t_ns
        self.data = data


class McapScan:
    """Where everything lies in an MCAP file, found by walking its records without decompressing.

    Works on a file that was cut off anywhere: ``complete`` tells whether it was finished.

    Raises:
        ValueError: not an MCAP file, or one that is damaged.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.complete = False
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.start_ns: int | None = None
        self.end_ns = 0
        self._topics: dict[int, str] = {}
        self._chunks: list[tuple[int, int]] = []
        size = stream.seek(0, 2)
        stream.seek(0)
        if stream.read(len(MAGIC)) != MAGIC:
            raise ValueError("no MCAP magic at the start")
        position = len(MAGIC)
        while position + _RECORD.size <= size:
            stream.seek(position)
            opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
            body = position + _RECORD.size
            position = body + length
            if position > size:
                return
            if opcode == Opcode.FOOTER:
                stream.seek(position)
                self.complete = stream.read(len(MAGIC)) == MAGIC
                return
            with _whole(f"the record at byte {body - _RECORD.size}"):
                self._note(opcode, body, length)

    def _note(self, opcode: int, body: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            start, end, _, _ = _CHUNK_HEAD.unpack(self._stream.read(_CHUNK_HEAD.size))
            self._chunks.append((body, length))
            self.start_ns = start if self.start_ns is None else min(self.start_ns, start)
            self.end_ns = max(self.end_ns, end)
        elif opcode in (Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT):
            data = ReadDataStream(BytesIO(self._stream.read(length)))
            if opcode == Opcode.CHANNEL:
                channel = records.Channel.read(data)
                self._topics[channel.id] = channel.topic
            elif opcode == Opcode.METADATA:
                entry = records.Metadata.read(data)
                self.metadata[entry.name] = entry.metadata
            else:
                attachment = records.Attachment.read(data)
                self.attachments[attachment.name] = attachment.data

    def messages(self) -> Iterator[Message]:
        """All messages in order of writing.

        Raises:
            ValueError: a chunk is damaged or compressed in a way that is not read here.
        """
        for body, length in self._chunks:
            with _whole(f"the chunk at byte {body}"):
                yield from self._walk(self._unpacked(body, length))

    def _unpacked(self, body: int, length: int) -> bytes:
        self._stream.seek(body)
        chunk = records.Chunk.read(ReadDataStream(BytesIO(self._stream.read(length))))
        data: bytes = chunk.data
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().decompress(data, chunk.uncompressed_size)
        elif chunk.compression:
            raise ValueError(f"compression {chunk.compression!r} is not supported, only zstd")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError(f"the chunk at byte {body} is damaged (checksum)")
        return data

    def _walk(self, data: bytes) -> Iterator[Message]:
        topics = self._topics
        unpack = _MESSAGE.unpack_from
        view = memoryview(data)
        position = 0
        end = len(data)
        while position < end:
            if data[position] == Opcode.MESSAGE:
                _, size, channel, sequence, t_ns, _ = unpack(data, position)
                stop = position + _RECORD.size + size
                yield Message(topics[channel], sequence, t_ns, view[position + _MESSAGE.size : stop])
                position = stop
            else:
                position += _RECORD.size + _RECORD.unpack_from(data, position)[1]
