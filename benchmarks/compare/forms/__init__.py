"""One module per way of sending the message, with `publish` and `receive`; each imports only what it needs.

`publish(case)` is a context manager that yields one function per vehicle, which sends a message with this timestamp, or
several messages with these timestamps.
`receive(case, ready, seen)` calls `ready` once subscribed, and then `seen` with the timestamp of each message, or the
timestamps of several, until `seen` returns False; it reads at least one other field, as any application does.
"""
