"""``pipewright completion``: the Tab key completes commands, options, phases, parameters and configurations."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable
from typing import Any, Final

from groundstation import codes
from groundstation.parsing import leaves

SHELLS: Final = ("bash", "zsh", "fish")
_EPILOG = """\
examples:
  eval "$(pipewright completion bash)"                                   for this terminal
  pipewright completion bash >> ~/.bashrc                                for good
  pipewright completion zsh >> ~/.zshrc                                  after compinit
  pipewright completion fish > ~/.config/fish/completions/pipewright.fish
"""
#: Set by the shell, when it wants to know what could stand at the cursor.
_ASKED: Final = "_ARGCOMPLETE"

Completer = Callable[..., Iterable[str]]


def add_parser(commands: Any) -> None:
    """Add ``completion`` to the commands of an argparse parser."""
    words = "print what lets a shell complete commands, phases, parameters and configurations"
    completion = commands.add_parser(
        "completion",
        help=words,
        description=words.capitalize() + ".",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    completion.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))
    completion.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run ``completion``; gives the exit code."""
    from argcomplete.shell_integration import shellcode

    print(shellcode(["pipewright"], shell=options.shell))
    return codes.DONE


def complete(parser: argparse.ArgumentParser) -> None:
    """Answer the shell and end, if it is the shell that asks; to be called before anything is parsed."""
    if _ASKED not in os.environ:
        return
    import argcomplete

    attach(parser)
    argcomplete.autocomplete(parser, always_complete_options=False)


def attach(parser: argparse.ArgumentParser) -> None:
    """Say of every argument that takes a name which names there are."""
    from argcomplete.completers import FilesCompleter

    files = FilesCompleter()

    def configurations(prefix: str, **_: Any) -> Iterable[str]:
        from onboard.param_file import scenario_names

        return [*scenario_names(), *files(prefix)]

    completers: dict[str, Completer] = {
        "scenario": configurations,
        "config": configurations,
        "other": configurations,
        "names": _parameters,
        "sets": _settings,
        "law": _laws,
    }
    for command in leaves(parser):
        for action in command._actions:
            if action.dest in completers and action.choices is None:
                action.completer = completers[action.dest]  # type: ignore[attr-defined]


def _parameters(prefix: str, **_: Any) -> Iterable[str]:
    """Groups first: nobody wants to see all parameters at once."""
    from onboard.param_file import parameter_names

    depth = prefix.count(".") + 1
    paths = (path.split(".") for path in parameter_names() if path.startswith(prefix))
    return dict.fromkeys(".".join(path[:depth]) + ("." if len(path) > depth else "") for path in paths)


def _settings(prefix: str, **_: Any) -> Iterable[str]:
    return (name if name.endswith(".") else f"{name}=" for name in _parameters(prefix))


def _laws(prefix: str, **_: Any) -> Iterable[str]:
    from onboard.param_file import law_names

    return law_names()
