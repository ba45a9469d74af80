"""Words that are read from across the room: five rows of blocks."""

from __future__ import annotations

from typing import Final

#: Each letter in five rows of five, from the top; the bits of a row from the left.
_LETTERS: Final = {
    " ": (0, 0, 0, 0, 0),
    "?": (14, 17, 6, 0, 4),
    "A": (14, 17, 31, 17, 17),
    "D": (30, 17, 17, 17, 30),
    "E": (31, 16, 30, 16, 31),
    "H": (17, 17, 31, 17, 17),
    "I": (14, 4, 4, 4, 14),
    "K": (17, 18, 28, 18, 17),
    "L": (16, 16, 16, 16, 31),
    "O": (14, 17, 17, 17, 14),
    "P": (30, 17, 30, 16, 16),
    "R": (30, 17, 30, 18, 17),
    "S": (15, 16, 14, 1, 30),
    "T": (31, 4, 4, 4, 4),
    "Y": (17, 10, 4, 4, 4),
}


def big(word: str) -> str:
    """Five lines; each letter is ten columns wide. KeyError for a letter that is not here."""
    rows = []
    for row in range(5):
        bits = (f"{_LETTERS[letter][row]:05b}" for letter in word)
        rows.append("  ".join("".join("██" if bit == "1" else "  " for bit in letter) for letter in bits))
    return "\n".join(rows)
