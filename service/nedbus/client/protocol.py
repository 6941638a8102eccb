"""The acknowledgement protocol between publishers and readers.

A lossless publisher requests acknowledgements from readers in mode `every` with the query
`<key>/@ack?publisher=<id>;number=<sequence number>;read=<0 or 1>`.
"""

from typing import Final

# attachment of a publisher's reply with its last message; a storage's reply has none
LIVE: Final = b"live"
# payload of an acknowledgement from a closed reader; other acknowledgements are empty
CLOSED: Final = b"closed"
