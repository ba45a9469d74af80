"""Putting values into a YAML file that a person has written: comments, order, quoting and layout stay as they are."""

from __future__ import annotations

import codecs
import os
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from io import StringIO
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import RoundTripConstructor
from ruamel.yaml.error import CommentMark
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter
from ruamel.yaml.scalarstring import DoubleQuotedScalarString
from ruamel.yaml.tokens import CommentToken
from ruamel.yaml.util import load_yaml_guess_indent

from onboard.layers import ConfigError, Key, dump_text

_TAG: Final = "tag:yaml.org,2002:"
_KINDS: Final = {int: "int", float: "float", bool: "bool", type(None): "null"}
#: Longer than any line: what stands on one line stays on one.
_ENDLESS: Final = 1_000_000


class _Written:
    """A number, truth value or null as its text: the library would write many a float with other digits."""

    def __init__(self, tag: str, text: str) -> None:
        self.tag, self.text = tag, text

    def __str__(self) -> str:
        return self.text


class _Constructor(RoundTripConstructor):
    """Leaves the text of such values as it stands."""

    def keep(self, node: ScalarNode) -> _Written:
        return _Written(str(node.tag), node.value)


class _Representer(RoundTripRepresenter):
    """Writes that text."""

    def written(self, value: _Written) -> ScalarNode:
        node: ScalarNode = self.represent_scalar(value.tag, value.text)
        return node


for _name in ("int", "float", "bool", "null", "timestamp"):
    _Constructor.add_constructor(f"{_TAG}{_name}", _Constructor.keep)
_Representer.add_representer(_Written, _Representer.written)


def edited(text: str, values: Iterable[tuple[Key, Any]]) -> str:
    """The text with these values at these paths.

    text: a YAML mapping that ``onboard.layers.parse_yaml`` reads, or nothing but comments. values: plain values, each
    at the path of its keys; an element of a list by its index. What is not there yet is added at the end of its group;
    a path into a list that is not there is an error (KeyError), since the rest of the list is not known here.
    """
    yaml = YAML()
    yaml.Constructor, yaml.Representer = _Constructor, _Representer
    yaml.preserve_quotes = True
    yaml.width = _ENDLESS
    yaml.allow_duplicate_keys = False
    _, indent, offset = load_yaml_guess_indent(text)
    yaml.indent(mapping=2 if offset is not None else indent or 2, sequence=indent or 2, offset=offset or 0)
    root = yaml.load(text)
    before = ""
    if root is None:
        root, before = CommentedMap(), f"{text.rstrip()}\n" if text.strip() else ""
    for path, value in values:
        _put(root, path, value)
    out = StringIO()
    yaml.dump(root, out)
    return before + out.getvalue()


def _put(root: Any, path: Key, value: Any) -> None:
    at = root
    for depth, part in enumerate(path):
        key = _key(at, part)
        rest = path[depth + 1 :]
        if not rest or (isinstance(at, CommentedMap) and not isinstance(at.get(key), CommentedMap | CommentedSeq)):
            for inner in reversed(rest):
                value = {_new_key(inner): value}
            _set(at, key, value)
            return
        at = at[key]
    raise KeyError(path)  # an element that is no group


def _key(at: Any, part: str) -> Any:
    """The key as it stands there: an index of a list; in a mapping, maybe a number that is meant as a name."""
    if isinstance(at, CommentedSeq):
        if not part.isdecimal() or int(part) >= len(at):
            raise KeyError(part)
        return int(part)
    if not isinstance(at, CommentedMap):
        raise KeyError(part)
    return next((known for known in at if str(known) == part), _new_key(part))


def _new_key(part: str) -> str | int:
    """An index of a list that stands in another file is written without quotes."""
    return int(part) if part.isdecimal() else part


def _set(at: Any, key: Any, value: Any) -> None:
    """Set an element or a key. What stands behind the group (a blank line, a heading) stays behind it.

    To the library, whatever stands between two keys belongs to the value before it.
    """
    behind = ""
    if isinstance(at, CommentedSeq) or key in at:
        old = at[key]
        if _is_block(old):
            behind = _take_behind(at, key)
    else:
        old = None
        if at and _is_block(at):
            behind = _take_behind(at, list(at)[-1])
    at[key] = _laid_out(value, old, isinstance(at, CommentedMap))
    if behind:
        holder, last = _innermost(at, key)
        slot: list[CommentToken | None] = [None] * 4
        slot[_slot(holder)] = CommentToken(f"\n{behind}", CommentMark(0), None)
        holder.ca.items[last] = slot


def _is_block(value: Any) -> bool:
    return isinstance(value, CommentedMap | CommentedSeq) and bool(value) and not value.fa.flow_style()


def _innermost(at: Any, key: Any) -> tuple[Any, Any]:
    """Where the last line of a value is: the group or list that holds it, and its key there."""
    while _is_block(at[key]):
        at = at[key]
        key = list(at)[-1] if isinstance(at, CommentedMap) else len(at) - 1
    return at, key


def _slot(holder: Any) -> int:
    return 2 if isinstance(holder, CommentedMap) else 0


def _take_behind(at: Any, key: Any) -> str:
    """Take away, and give, what stands behind a value: from the first line on that is blank or not of its group."""
    holder, last = _innermost(at, key)
    slot = holder.ca.items.get(last)
    token = slot[_slot(holder)] if slot else None
    if token is None:
        return ""
    own, _, rest = token.value.partition("\n")
    lines = rest.splitlines(keepends=True)
    column = holder.lc.col or 0
    n = next((i for i, line in enumerate(lines) if not column or _indent(line) < column), len(lines))
    kept = f"{own}\n{''.join(lines[:n])}"
    if kept.strip():
        token.value = kept
    else:
        slot[_slot(holder)] = None
    return "".join(lines[n:])


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip()) if line.strip() else 0


def _laid_out(value: Any, old: Any, in_mapping: bool) -> Any:
    """The value in the form in which the old one stood."""
    if isinstance(value, Mapping):
        group = CommentedMap((key, _laid_out(item, None, True)) for key, item in value.items())
        if isinstance(old, CommentedMap | CommentedSeq) and old.fa.flow_style():
            group.fa.set_flow_style()
        return group
    if isinstance(value, list | tuple):
        items = CommentedSeq(_laid_out(item, None, False) for item in value)
        if not any(isinstance(item, CommentedMap | CommentedSeq) for item in items) or not in_mapping:
            items.fa.set_flow_style()
        return items
    text = dump_text({"value": value}).removeprefix("value: ").removesuffix("\n")
    if not isinstance(value, str):
        return _Written(f"{_TAG}{_KINDS[type(value)]}", text)
    if isinstance(old, str) and type(old) is not str:  # in its own quotes
        return type(old)(value)
    return value if text == value else DoubleQuotedScalarString(value)


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
