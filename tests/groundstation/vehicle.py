"""A vehicle's end of the link that shows what a test gives it, for commands of a station to talk to."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from onboard.link import Asked, Link
from onboard.link_settings import LinkSettings
from onboard.orders import NotShownError
from onboard.wire import Ack
from tests.zenoh_sessions import free_port

Show = Callable[[Any], bytes]


@contextmanager
def showing(shows: Mapping[type, Show], port: int | None = None) -> Iterator[int]:
    """A vehicle on loopback; gives its port."""

    def answer(asked: Asked) -> Ack:
        try:
            return asked.done(data=shows[type(asked.ask)](asked.ask))
        except NotShownError as error:
            return asked.refused(str(error))

    port = port or free_port()
    link = Link(LinkSettings(listen=(f"tcp/127.0.0.1:{port}",), plain=True), answer)
    link.start()
    try:
        yield port
    finally:
        link.stop()


def run(add_parser: Callable[[Any], None], port: int, *arguments: str) -> int:
    """Run a command as the command line does; gives its exit code."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    given = [*arguments, "--connect", f"tcp/127.0.0.1:{port}", "--plain", "--station", "tester"]
    options = parser.parse_args(given)
    code: int = options.run(options)
    return code
