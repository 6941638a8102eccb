"""The durations that tests shorten or lengthen, all in one object."""

from dataclasses import dataclass
from typing import Final


@dataclass(slots=True)
class Timings:
    """Durations in seconds, read at the time of use; in order of the floors that read them, the lowest first."""

    lease: float = 5.0  # silence until a link is closed, as with a frozen host or a cut cable
    router_lease: float = 8.0  # longer, so that a router has given up a client before the next router has it
    tokens_retry: float = 10.0  # until tokens beyond the limit are listed again, once there is room
    retransmit_timeout: float = 20.0  # until a gap counts as lost; publishers cache as long
    downsampled_timeout: float = 10.0  # from a stream's token to the warning that no downsampled message has arrived
    definition_timeout: float = 3.0  # for the definition of a message: readers wait for a busy publisher as long
    return_wait: float = 5.0  # to wait for a reader that left without closing, while there is a router
    frozen_wait: float = 90.0  # to wait for a reader whose lease expired: its process may be suspended
    credit_polls: tuple[float, float] = (0.0005, 0.005)  # between polls while waiting: the first and the longest pause
    stale: float = 3.0  # without a message until a stream is stale, has no rate, and is no longer published by a source
    forgotten: float = 3600.0  # until a vehicle that is gone or silent counts as switched off, and is forgotten
    source_tick: float = 0.25  # the longest wait of a live source for its next message
    backoff: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)  # before a failed source is restarted
    log_answer: float = 1.0  # for a COMMAND_ACK, doubled with each repetition of START, and for the first data
    log_timeout: float = 2.5  # PX4 gives up a message without acknowledgement; also between STOP and START
    log_silence: float = 1.0  # without data until PX4 is asked; at least three times the interval of the stream
    log_longest_silence: float = 15.0  # of any stream; its synchronisation alone (22 B/s) fills a message in 11.3 s
    log_link: float = 3.0  # without any message until the link is lost
    log_retry: float = 30.0  # after a refusal that may pass
    log_slow_retry: float = 300.0  # after a refusal that lies in the configuration or the link
    log_header: float = 10.0  # of the header, for which PX4's logger is blocked: a hole in the vehicle's own log
    probe_first: tuple[float, float] = (1.0, 5.0)  # random: a fleet reconnects at once after its router restarted
    probe_confirm: float = 1.0  # until a denial is checked again
    probe_unsure: float = 60.0  # until the next check while a vehicle is refused or unknown
    probe_pause: float = 600.0  # until the next check if all vehicles are allowed
    probe_poll: float = 1.0  # between two polls of the link
    probe_open: float = 5.0  # to open a session
    probe: float = 3.0  # for an allowed message to arrive
    bridge_poll: float = 1.0  # between queries for addresses and for publishers of other nodes
    token_visible: float = 5.0  # for a token to become visible to other sessions; later counts as denied
    lateness: float = 1.0  # beyond which a sample is late: recovered after an outage, or queued behind one that was
    take_over: float = 5.0  # after another node's publisher is gone until its topic is taken over
    http_client: float = 5.0  # to send a request, to read the response, and to wait for a free thread
    page_request: float = 10.0  # for a browser to send a request, and between two requests
    routers_interval: float = 30.0  # between router queries of the exporter; a reply has 183 bytes per session
    routers_timeout: float = 5.0  # for all replies; the link may be slow
    routers_session: float = 1.0  # to open the session for router queries
    listen: float = 3.0  # for messages and packets
    min_listen: float = 1.0  # after all queries, to measure the delay of messages
    doctor_open: float = 1.5  # to open a session
    handshake: float = 1.5  # of TLS
    tls_alert: float = 0.5  # for the alert of a router that rejects our certificate; else it is silent
    list_timeout: float = 10.0  # for the router to list all streams
    first_sample: float = 2.0  # without a sample until a notice is written to stderr
    old: float = 1.0  # latency from which it is shown: the last value of an ended stream, or a recovered message
    reports: tuple[float, ...] = (*(10.0,) * 6, 60.0)  # between reports of `serve`; the last one repeats
    systemd_patience: float = 30.0  # until a client without its router reports READY, to let the boot continue
    systemd_status: float = 1.0  # between two status texts


TIMINGS: Final = Timings()
"""Those of this process."""
