"""All timeouts, intervals and backoffs in one object, which tests can shorten or lengthen."""

from dataclasses import dataclass
from typing import Final


@dataclass(slots=True)
class Timings:
    """Durations in seconds, read at the time of use; ordered by the layer that uses them, the lowest first."""

    # without data until a link is closed, as with a frozen host or a cut cable
    lease: float = 5.0
    # longer: a router must drop a client before that client joins the next router
    router_lease: float = 8.0
    # before tokens beyond the limit are listed again
    tokens_retry: float = 10.0
    # for a router to list all tokens, before a query counts those of each vehicle
    slow_list: float = 1.0
    # before a vehicle with too many tokens is listed again
    excluded: float = 600.0
    # until a sequence gap counts as lost; publishers cache messages for as long
    retransmit_timeout: float = 20.0
    # from a liveliness token to the warning that no downsampled message arrives
    downsampled_timeout: float = 10.0
    # for a busy publisher to send the definition of a message
    definition_timeout: float = 3.0
    # for the return of a reader that disconnected without closing, if a router is connected
    return_wait: float = 5.0
    # for the return of a reader whose lease expired: its process may be suspended
    frozen_wait: float = 90.0
    # between polls for credit: first and longest pause
    credit_polls: tuple[float, float] = (0.0005, 0.005)
    # without a message until a stream is stale: it has no rate, and sources stop publishing it
    stale: float = 3.0
    # until a vehicle that is gone or silent counts as switched off, and its state is deleted
    forgotten: float = 3600.0
    # the longest wait of a live source for its next message
    source_tick: float = 0.25
    # for a received MAVLink message to be published; one that waited longer is dropped
    link_wait: float = 2.0
    # before a failed source is restarted
    backoff: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0, 16.0, 30.0)
    # for the first data, and for a COMMAND_ACK, where it doubles with each retry of START
    log_answer: float = 1.0
    # until PX4 gives up on an unacknowledged message; also between STOP and START
    log_timeout: float = 2.5
    # without data until START is sent again; at least three times the interval of the stream
    log_silence: float = 1.0
    # longest silence of a live stream: sync alone fills a LOGGING_DATA in 11.3 s
    log_longest_silence: float = 15.0
    # without any message until the link is lost
    log_link: float = 3.0
    # between two measurements of the round trip, before a stream is refused
    log_measure: float = 0.8
    # until the round trip is measured again, while a stream is refused because of it
    log_measure_again: float = 5.0
    # after a temporary refusal
    log_retry: float = 30.0
    # after a refusal caused by the configuration or the link
    log_slow_retry: float = 300.0
    # for the header, which blocks PX4's logger and so leaves a gap in its own log
    log_header: float = 10.0
    # random: a fleet reconnects all at once after a router restart
    probe_first: tuple[float, float] = (1.0, 5.0)
    # before a denial is checked again
    probe_confirm: float = 1.0
    # before the next check while a vehicle is refused or unknown
    probe_unsure: float = 60.0
    # before the next check if all vehicles are allowed
    probe_pause: float = 600.0
    # between polls of the link
    probe_poll: float = 1.0
    # to open a session
    probe_open: float = 5.0
    # for an allowed message to arrive
    probe: float = 3.0
    # between queries for addresses and for publishers of other nodes
    bridge_poll: float = 1.0
    # for a liveliness token to become visible to other sessions, or it counts as denied
    token_visible: float = 5.0
    # minimum latency of a sample that counts as late: recovered, or queued behind recovered ones
    lateness: float = 1.0
    # after another node's publisher has gone, before its topic is published
    take_over: float = 5.0
    # to send a request, to read the response, and to wait for a free thread
    http_client: float = 5.0
    # for a browser to send a request, and between two requests
    page_request: float = 10.0
    # between router queries of the exporter; a reply has 183 bytes per session
    routers_interval: float = 30.0
    # for all replies, perhaps over a slow link
    routers_timeout: float = 5.0
    # to open the session for router queries
    routers_session: float = 1.0
    # for messages and packets, in the doctor
    listen: float = 3.0
    # after all queries, to measure message latency
    min_listen: float = 1.0
    # to open a session
    doctor_open: float = 1.5
    # TLS handshake
    handshake: float = 1.5
    # TLS handshake that tells why a connection without TLS failed
    tls_hint: float = 0.5
    # for the TLS alert of a router that rejects our certificate
    tls_alert: float = 0.5
    # for a router to list all streams
    list_timeout: float = 10.0
    # without a sample until a notice is printed to stderr
    first_sample: float = 2.0
    # minimum age to display, for retained or recovered messages
    old: float = 1.0
    # between progress reports of `serve`; the last interval repeats
    reports: tuple[float, ...] = (*(10.0,) * 6, 60.0)
    # until a client without a router reports READY, to let the boot continue
    systemd_patience: float = 30.0
    # between status updates
    systemd_status: float = 1.0


TIMINGS: Final = Timings()
