"""One file for each way of sending the message; each has `publish` and `receive`, and imports only what it needs.

`publish(endpoint)` is a context manager that gives a function: it sends one message, or several, with these timestamps.
`receive(endpoint, ready, seen)` says when it is ready, and calls `seen` with the timestamp of each message, or with the
timestamps of several, until `seen` returns False; it reads at least one more field, as any reader does.
"""
