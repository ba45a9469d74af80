"""The parser of the command line: what is mistyped is answered in a sentence, with what is nearest to it."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from difflib import SequenceMatcher
from typing import Any, Final

#: As alike as a name must be to be what was meant.
_ALIKE: Final = 0.55
_MOST: Final = 3


class Parser(argparse.ArgumentParser):
    """As argparse's, but for its words on wrong input. Its subparsers are of this class too."""

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        kind = "command" if isinstance(action, argparse._SubParsersAction) else action.dest
        known = [str(choice) for choice in action.choices]
        best = nearest(str(value), known)
        hint = f"nearest: {', '.join(best)}" if best else f"there are: {', '.join(known)}"
        self.exit(2, f"{self.prog}: no {kind} {str(value)!r}; {hint}\n")


def nearest(wrong: str, known: Sequence[str]) -> list[str]:
    """Up to three names that a wrong one may have meant, the likeliest first."""
    wrong = wrong.lower()

    def likeness(name: str) -> float:
        begins = name.startswith(wrong) and len(wrong) > 1
        return max(SequenceMatcher(None, wrong, name, autojunk=False).ratio(), 0.9 * begins)

    likely = sorted(known, key=likeness, reverse=True)[:_MOST]
    return [name for name in likely if likeness(name) >= _ALIKE]


def leaves(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """The parsers of the commands that do something, in their order."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield parser
    for group in groups:
        for command in group.choices.values():
            yield from leaves(command)
