"""Limits of definitions and values: each number once, with its reason and what happens at it; see `nedbus.limits`."""

from __future__ import annotations

from typing import Final

# --- Messages ---

SHOWN_VALUE: Final = 200
"""Characters of a value in an error: the key of a peer may be 64 kB long. A longer value is cut."""

FIELD_READERS: Final = 64
"""Types of messages for which a `FieldReader` keeps a function. Beyond it the functions are made again."""

FIELDS: Final = 256
"""Fields of a message that is defined at run time, three times as many as PX4's largest has. More are an error."""

ARRAY_ELEMENTS: Final = 1024
"""Elements of an array field; PX4's longest array has 512. A longer one is not a valid type."""

NAME: Final = 64
"""Characters of a vehicle or of a topic, because keys and labels hold them. A longer name is not valid."""

# --- Definitions ---

MSG_FILE: Final = 2**18
"""Characters of a .msg file with its nested messages; PX4's longest has 20,000. A longer one is not parsed."""

MSG_NESTING: Final = 3
"""Levels of nested messages in a .msg file; PX4 has one. A deeper message is an error, because it may nest itself."""

MSG_COMMENT: Final = 2000
"""Characters of the comment of a field in a .msg file. The rest is cut."""

MSG_FIELDS: Final = 1000
"""Fields of a .msg file, including those of nested messages, before a message is defined. More are an error."""
