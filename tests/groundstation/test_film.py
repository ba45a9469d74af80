"""What ``pipewright film`` says to wrong input; tests/acceptance/test_two_worlds.py films a flight."""

from __future__ import annotations

from pathlib import Path

import pytest

from groundstation import cli


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["nowhere.mcap"], "nowhere.mcap"), (["x", "--width", "10"], "160 to 1920"), (["x", "--speed", "0"], "above 0")],
)
def test_wrong_input_is_told(
    arguments: list[str],
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = cli.main(["film", *arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert words in capsys.readouterr().err
