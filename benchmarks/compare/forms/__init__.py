"""One file for each way of sending the message; each has `publish` and `receive`, and imports only what it needs.

`publish(case)` is a context manager that gives a function for each vehicle: it sends one message with this timestamp,
or several with these.
`receive(case, ready, seen)` says when it is ready, and calls `seen` with the timestamp of each message, or with the
timestamps of several, until `seen` returns False; it reads at least one more field, as any reader does.
"""
