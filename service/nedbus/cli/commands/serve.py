"""Commands that run a service or a router: serve, router."""

import logging
import threading
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from nedbus import __version__
from nedbus.cli.options import (
    ConfigOption,
    PrefixOption,
    TlsCaOption,
    TlsCertificateOption,
    TlsKeyOption,
    command,
)
from nedbus.cli.output.progress import log_progress
from nedbus.cli.run import run_until_stopped
from nedbus.cli.systemd import Notifier
from nedbus.daemon import SOURCE_FORMS, Daemon, run_router
from nedbus.endpoints import DEFAULT_ENDPOINT
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.settings import load_settings

_log = logging.getLogger("nedbus")
_SOURCES = f"Source to publish: {', '.join(SOURCE_FORMS)}, with ?OPTION=VALUE&...; repeatable"
_HTTP = "Serve metrics, health and status on this address"
_ZENOHD = "Router configuration in the format of zenohd"
_LISTEN = f"Endpoint to listen on; repeatable (default: {DEFAULT_ENDPOINT})"
ListenOption = Annotated[
    list[str] | None, typer.Option("--listen", "-l", metavar="ENDPOINT", help=_LISTEN)
]
_JOIN = "Router to join; repeatable"
JoinOption = Annotated[
    list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help=_JOIN)
]


@command
def serve(
    *,
    source: Annotated[
        list[str] | None, typer.Option("--source", "-s", metavar="SOURCE", help=_SOURCES)
    ] = None,
    connect: JoinOption = None,
    listen: ListenOption = None,
    router_config: Annotated[
        Path | None, typer.Option(help="Configuration file of the embedded router, JSON5")
    ] = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    prefix: PrefixOption = None,
    vehicle: Annotated[
        str | None, typer.Option("--vehicle", "-v", help="Vehicle id for sources without one")
    ] = None,
    http: Annotated[str | None, typer.Option(metavar="HOST:PORT", help=_HTTP)] = None,
    until_done: Annotated[
        bool | None, typer.Option("--until-done", help="Exit when finite sources have ended")
    ] = None,
    config: ConfigOption = None,
    check: Annotated[bool, typer.Option("--check", help="Check the settings and exit")] = False,
) -> None:
    """Run a service: publish validated messages from sources.

    The service runs its own router unless it joins one (--connect). SIGHUP reloads the settings: it starts new sources,
    stops removed ones and leaves all others running. Closing the terminal stops the service.
    """
    given = {name: value for name, value in locals().items() if name not in {"config", "check"}}
    if check:
        from nedbus.doctor import check_service

        from .checks import report_mistakes

        report_mistakes(check_service(config, given))
        return
    settings = load_settings(config, **given)
    daemon = Daemon(settings, version=__version__)
    pages: AbstractContextManager[object] = nullcontext()
    if settings.http is not None:
        from nedbus.monitoring import service_pages

        from .bridges import serve_pages

        pages = serve_pages(settings.http, service_pages(daemon))
    progress = log_progress(daemon)
    with pages, Notifier(daemon) as notifier:

        def tick() -> None:
            next(progress)
            notifier.tick()

        def stop() -> None:
            notifier.stopping()
            daemon.stop()

        def reload() -> None:
            try:
                with notifier.reloading():
                    done = daemon.reload(load_settings(config, **given))
            except NedbusError as exc:
                _log.error(
                    "settings not reloaded, the old ones stay active: %s",
                    exc,
                    extra=about("reload"),
                )
            else:
                _log.info("settings reloaded: %s", done, extra=about("reload"))

        run_until_stopped(
            lambda _: daemon.run(),
            on_stop=stop,
            on_tick=tick,
            on_hangup=reload,
            closing=daemon.closing,
        )


@command
def router(
    config_file: Annotated[
        Path | None, typer.Argument(metavar="CONFIG.json5", help=_ZENOHD, show_default=False)
    ] = None,
    *,
    listen: ListenOption = None,
    connect: JoinOption = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    config: ConfigOption = None,
) -> None:
    """Run a Zenoh router without sources, for services and scripts.

    --listen and --connect replace the endpoints of the file, like the flags of zenohd.
    """
    settings = load_settings(
        config, listen=listen, tls_ca=tls_ca, tls_certificate=tls_certificate, tls_key=tls_key
    )
    routers = tuple(connect or ())
    closing = threading.Event()
    tls = None
    if routers:
        tls = settings.tls

    def run(stop: threading.Event) -> None:
        run_router(
            stop,
            listen=settings.listen,
            connect=routers,
            config_file=config_file,
            tls=tls,
            closing=closing,
        )

    run_until_stopped(run, closing=closing)
