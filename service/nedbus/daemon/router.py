"""A router without sources, as `nedbus router` runs it."""

import logging
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from nedbus.log_event import about
from nedbus.transport import Tls, Uplinks, open_router, router_endpoints

_log = logging.getLogger(__name__)

_CHECK_INTERVAL: Final = 1.0  # s between checks of the links to other routers


def run_router(
    stop: threading.Event,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    config_file: Path | None = None,
    tls: Tls | None = None,
    closing: threading.Event | None = None,
) -> None:
    """Run a Zenoh router until `stop` is set; log its links to other routers.

    `listen`: endpoints, by default those of the file, else tcp/127.0.0.1:7447. `connect`: routers to join.
    `config_file`: a configuration of `zenohd`, whose endpoints `listen` and `connect` override.
    `tls`: files for `tls/` routers to join. `closing`: set once only the session is still open.

    Raises ListenError if it cannot listen, ConfigError for an invalid endpoint or file.
    """
    where = router_endpoints(listen, config_file)
    session = open_router(listen=listen, connect=connect, config_file=config_file, tls=tls)
    joining = f", joining {', '.join(connect)}" if connect else ""
    _log.info("router on %s%s", ", ".join(where), joining, extra=about("router"))
    uplinks = Uplinks(session, connect, tls=tls)
    interval = _CHECK_INTERVAL if connect else None
    while not stop.wait(interval):
        uplinks.check()
    if closing is not None:
        closing.set()
    session.close()
