"""Commands that run until they are told to end: serve, router."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

import typer

from nedbus import __version__
from nedbus.daemon import Daemon
from nedbus.session import DEFAULT_ENDPOINT, open_router
from nedbus.settings import load_settings

from .options import ConfigOption, PrefixOption, TlsCaOption, TlsCertificateOption, TlsKeyOption, command
from .progress import Display

_log = logging.getLogger("nedbus")

_LIMIT: Final = 1.6  # s after a signal by which the process is gone
ListenOption = Annotated[
    list[str] | None,
    typer.Option("--listen", "-l", metavar="ENDPOINT", help=f"Where the router listens (default: {DEFAULT_ENDPOINT})"),
]


@command
def serve(
    *,
    source: Annotated[
        list[str] | None,
        typer.Option(
            "--source",
            "-s",
            metavar="SOURCE",
            help="sim:, ulog:FILE, px4-zenoh: or mavlink:LINK, with ?OPTION=VALUE&...; repeatable",
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option("--connect", "-c", metavar="ENDPOINT", help="Join this router instead of being one"),
    ] = None,
    listen: ListenOption = None,
    router_config: Annotated[Path | None, typer.Option(help="JSON5 configuration of the embedded router")] = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    prefix: PrefixOption = None,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="Vehicle of sources that name none")] = None,
    until_done: Annotated[bool | None, typer.Option("--until-done", help="End when every finite source ended")] = None,
    config: ConfigOption = None,
) -> None:
    """Publish sources, validated; the service is a router itself unless --connect names one."""
    settings = load_settings(
        config,
        source=source and tuple(source),
        connect=connect and tuple(connect),
        listen=listen and tuple(listen),
        router_config=router_config,
        tls_ca=tls_ca,
        tls_certificate=tls_certificate,
        tls_key=tls_key,
        prefix=prefix,
        vehicle=vehicle,
        until_done=until_done,
    )
    daemon = Daemon(settings, version=__version__)
    with Display(daemon) as display:
        ends = run_until_signal(daemon.run, daemon.stop, beside=display.update)
    if ends is not None:
        raise typer.Exit(ends)


@command
def router(
    config_file: Annotated[
        Path | None, typer.Argument(metavar="CONFIG.json5", help="A file that zenohd reads too", show_default=False)
    ] = None,
    *,
    listen: ListenOption = None,
    connect: Annotated[
        list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help="Another router to join")
    ] = None,
    config: ConfigOption = None,
) -> None:
    """Run a Zenoh router, without sources, for services and scripts to meet at.

    Endpoints that are given replace those of the file, as the flags of zenohd do.
    """
    endpoints = load_settings(config, listen=listen).listen
    stop = threading.Event()

    def run() -> bool:
        session = open_router(listen=endpoints, connect=tuple(connect or ()), config_file=config_file)
        joined = f", joined to {', '.join(connect)}" if connect else ""
        _log.info("router on %s%s", ", ".join(endpoints) or config_file or DEFAULT_ENDPOINT, joined)
        stop.wait()
        session.close()
        return True

    ends = run_until_signal(run, stop.set, beside=lambda: None)
    if ends is not None:
        raise typer.Exit(ends)


def run_until_signal(
    run: Callable[[], bool], stop: Callable[[], object], *, beside: Callable[[], object]
) -> int | None:
    """Run something in a thread until it ends or a signal comes; return the exit code, None for success.

    The main thread only waits: a signal is then handled at once, whatever Zenoh is busy with.
    """
    outcome: list[bool | BaseException] = []
    signals: list[int] = []

    def body() -> None:
        try:
            outcome.append(run())
        except BaseException as exc:  # noqa: BLE001 - raised again below, in the main thread
            outcome.append(exc)

    def on_signal(number: int, _: FrameType | None) -> None:
        if signals:
            os._exit(130 if number == signal.SIGINT else 1)  # the second time there is no patience
        signals.append(number)
        stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    thread = threading.Thread(target=body, name="nedbus-run", daemon=True)
    thread.start()
    while thread.is_alive() and not signals:
        beside()
        thread.join(0.1)
    deadline = time.monotonic() + _LIMIT
    while thread.is_alive() and time.monotonic() < deadline:
        thread.join(0.05)
    if thread.is_alive():
        _log.error("not everything ended in time, perhaps because a reader does not read: what it holds is given up")
        sys.stderr.flush()
        os._exit(1)
    if isinstance(outcome[0], BaseException):
        raise outcome[0]
    if signals and signals[0] == signal.SIGINT:
        return 130
    return None if outcome[0] else 1
