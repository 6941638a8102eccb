"""Batch: a NumPy array of messages with the address, time and sequence number of each."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nedbus_msgs import Address, Message, Provenance
from nedbus_msgs.arrays import MessageArray


@dataclass(eq=False)
class Batch(ABC):
    """Valid messages of one type, in order of arrival; `subscription.batches()` yields them.

    `messages`: structured array of shape (n,), one column per field: `messages["x"]`.
    `message`: type of the messages.
    `addresses`: distinct addresses. `address_index`: index into `addresses` for each message.
    `lost`: messages lost in transit before this batch, over all addresses.
    """

    messages: MessageArray
    message: type[Message]
    addresses: tuple[Address, ...]
    address_index: npt.NDArray[np.intp]
    lost: int

    def __len__(self) -> int:
        return len(self.messages)

    def of(self, address: Address) -> MessageArray:
        """Return the messages of one address."""
        index = self.addresses.index(address) if address in self.addresses else -1
        chosen: MessageArray = self.messages[self.address_index == index]
        return chosen

    @property
    @abstractmethod
    def received(self) -> npt.NDArray[np.int64]:
        """Time at which each message left Zenoh's ring, ns since the epoch by the clock of this host."""

    @property
    @abstractmethod
    def sent(self) -> npt.NDArray[np.int64]:
        """Time of sending of each message, ns since the epoch by the publisher's clock; 0 without a timestamp."""

    @property
    @abstractmethod
    def sequence(self) -> npt.NDArray[np.int64]:
        """Publisher's sequence number of each message; -1 without one."""

    @property
    @abstractmethod
    def provenances(self) -> list[Provenance]:
        """Provenance of each message: its source and the fields that the source did not provide."""
