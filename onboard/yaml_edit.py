"""Putting values into a YAML file that a person has written: every character that need not change stays."""

from __future__ import annotations

import codecs
import json
import os
import re
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import yaml

from onboard.layers import ConfigError, Key, compose_yaml, dump_text, inline_text


def edited(text: str, values: Iterable[tuple[Key, Any]]) -> str:
    """The text with these values at these paths.

    text: a YAML mapping that ``onboard.layers.parse_yaml`` reads, or nothing but comments, with line ends of Unix.
    values: plain values, each at the path of its keys; an element of a list by its index. What is not there yet is
    added at the end of its group. Raises KeyError for an element of a list that is not there.
    """
    for path, value in values:
        text = _put(text, path, value)
    return text


class _Found(NamedTuple):
    """How far a path leads: the node there, the key before it (of a mapping), and what of the path is left."""

    node: yaml.Node
    key: yaml.Node | None
    rest: Key


def _put(text: str, path: Key, value: Any) -> str:
    root = compose_yaml(text)
    if root is None:
        return (f"{text.rstrip()}\n" if text.strip() else "") + dump_text(_nested(path, value))
    node, key, rest = _follow(root, path)
    if not rest:
        return _replaced(text, node, key, value)
    if isinstance(node, yaml.MappingNode):
        return _added(text, root, node, _nested(rest, value))
    if isinstance(node, yaml.SequenceNode):
        raise KeyError(path)
    if key is None:
        raise KeyError(path)
    return _replaced(text, node, key, _nested(rest, value))


def _follow(root: yaml.Node, path: Key) -> _Found:
    node, key = root, None
    for depth, part in enumerate(path):
        if isinstance(node, yaml.MappingNode):
            pair = next((pair for pair in node.value if pair[0].value == part), None)
            if pair is None:
                return _Found(node, key, path[depth:])
            key, node = pair
        elif isinstance(node, yaml.SequenceNode) and part.isdecimal() and int(part) < len(node.value):
            key, node = None, node.value[int(part)]
        else:
            return _Found(node, key, path[depth:])
    return _Found(node, key, ())


def _nested(path: Key, value: Any) -> Any:
    """The value under these keys. An index of a list that stands in another file is written without quotes."""
    for part in reversed(path):
        value = {int(part) if part.isdecimal() else part: value}
    return value


def _replaced(text: str, node: yaml.Node, key: yaml.Node | None, value: Any) -> str:
    """Another value in the place of a node. A comment behind it keeps its column, where there is room."""
    begin, end = node.start_mark.index, _end(text, node)
    if key is not None and (_is_block(node) or begin == end):
        begin = text.index(":", key.end_mark.index) + 1
        after = " "
    else:
        after = ""
    if anchor := re.match(r"&\S+\s+", text[begin:end]):
        begin += anchor.end()
    new = after + _in_the_form_of(node, value)
    behind = text[end:]
    if (spaces := re.match(r" +(?=#)", behind)) and "\n" not in text[begin:end]:
        room = len(spaces[0]) + (end - begin) - len(new)
        behind = " " * max(room, 2) + behind[len(spaces[0]) :]
    return text[:begin] + new + behind


def _in_the_form_of(node: yaml.Node, value: Any) -> str:
    style = node.style if isinstance(node, yaml.ScalarNode) else None
    if isinstance(value, str) and style == '"':
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, str) and style == "'" and "\n" not in value:
        return "'" + value.replace("'", "''") + "'"
    return inline_text(value)


def _added(text: str, root: yaml.Node, group: yaml.MappingNode, new: dict[Any, Any]) -> str:
    """New keys as the last of a group."""
    if not _is_block(group):
        at = _end(text, group.value[-1][1]) if group.value else group.end_mark.index - 1
        return text[:at] + (", " if group.value else "") + inline_text(new)[1:-1] + text[at:]
    column = group.start_mark.column
    at = _end(text, group)
    for line in text[at:].splitlines(keepends=True):  # the rest of its line, then comments that stand in the group
        if at != _end(text, group) and not (line.lstrip().startswith("#") and 0 < column <= _indent(line)):
            break
        at += len(line)
    lines = dump_text(new, indent=_step(root)).splitlines(keepends=True)
    before = text[:at] + ("" if text[:at].endswith("\n") else "\n")
    return before + "".join(" " * column + line for line in lines) + text[at:]


def _is_block(node: yaml.Node) -> bool:
    return isinstance(node, yaml.CollectionNode) and not node.flow_style


def _end(text: str, node: yaml.Node) -> int:
    """Where the text of a node ends. The parser has that of a block only where the next thing begins."""
    while _is_block(node) and node.value:
        last = node.value[-1]
        node = last[1] if isinstance(last, tuple) else last
    begin, end = node.start_mark.index, node.end_mark.index
    return begin + len(text[begin:end].rstrip()) if isinstance(node, yaml.ScalarNode) else int(end)


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip())


def _step(root: yaml.Node) -> int:
    """By how much the groups of a file are indented."""
    if isinstance(root, yaml.MappingNode):
        for _, value in root.value:
            if isinstance(value, yaml.MappingNode) and _is_block(value):
                return int(value.start_mark.column) - int(root.start_mark.column)
    return 2


class Candidate:
    """A new text for a file, on its way: readable as ``path``, and put in the file's place by ``commit``, or never.

    Use as a context manager; what was not committed is gone at its end. The file keeps its permissions, its line ends
    and its byte order mark; a link keeps its target. Raises ConfigError for a file that cannot be read or written.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._target = file.resolve()
        try:
            self._before = self._target.read_bytes()
            handle, name = tempfile.mkstemp(dir=self._target.parent, prefix=f".{self._target.stem}-", suffix=".yaml")
        except OSError as error:
            raise self._refused(error) from error
        os.close(handle)
        self.path = Path(name)
        self.text = self._before.decode("utf-8-sig").replace("\r\n", "\n")
        """As it is to be; to begin with, as it is. Line ends are those of Unix."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.path.unlink(missing_ok=True)

    def write(self, text: str) -> None:
        """Change the text."""
        self.text = text
        if b"\r\n" in self._before:
            text = text.replace("\n", "\r\n")
        encoding = "utf-8-sig" if self._before.startswith(codecs.BOM_UTF8) else "utf-8"
        try:
            with self.path.open("wb") as file:
                file.write(text.encode(encoding))
                was = self._target.stat()
                with suppress(PermissionError):  # only root may give a file away
                    os.fchown(file.fileno(), was.st_uid, was.st_gid)
                os.fchmod(file.fileno(), was.st_mode & 0o7777)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise self._refused(error) from error

    def commit(self) -> None:
        """Put it in the place of the file, unless somebody has changed that since it was read."""
        try:
            if self._target.read_bytes() != self._before:
                raise ConfigError([f"{self._file}: has been changed meanwhile; nothing was written, try again"])
            self.path.replace(self._target)
            folder = os.open(self._target.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            raise self._refused(error) from error

    def _refused(self, error: OSError) -> ConfigError:
        return ConfigError([f"{self._file}: cannot be written: {error.strerror}"])
