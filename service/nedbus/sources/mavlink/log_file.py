"""Saves a ULog stream as a .ulg file that is valid at any moment: it grows by whole records."""

import struct
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Final

from nedbus import clock
from nedbus.errors import OutputError

_FILE_HEADER: Final = 16  # bytes
_RECORD_HEADER: Final = 3  # bytes: the size of the rest, and the type
_DROPOUT: Final = struct.Struct("<HBH")  # a record of type O: duration [ms]
_MAX_DROPOUT: Final = 2**16 - 1  # ms
_MAX_SAME_NAME: Final = 100


class LogFile:
    """One stream of one boot in a new file of a folder: `<vehicle>_<UTC>.ulg`.

    `path`: of the file.

    Raises OutputError if the file cannot be created or written, for example on a full disk.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        self.path, self._file = _create(folder, vehicle)
        self._partial = bytearray()  # the last record, until it is complete
        self._begins = True

    def write(self, data: bytes) -> None:
        """Append bytes of the stream; only whole records reach the file."""
        self._partial += data
        end = position = 0
        if self._begins and len(self._partial) >= _FILE_HEADER:
            end = position = _FILE_HEADER
            self._begins = False
        while not self._begins and position + _RECORD_HEADER <= len(self._partial):
            position += _RECORD_HEADER + int.from_bytes(self._partial[position : position + 2], "little")
            if position <= len(self._partial):
                end = position
        self._append(bytes(self._partial[:end]))
        del self._partial[:end]

    def mark_gap(self, seconds: float) -> None:
        """Discard the record that the gap cut, and record a dropout of this duration."""
        self._partial.clear()
        if not self._begins:
            self._append(_DROPOUT.pack(2, ord("O"), max(1, min(_MAX_DROPOUT, round(seconds * 1000)))))

    def close(self) -> None:
        """Close the file. Idempotent."""
        with suppress(OSError):
            self._file.close()

    def _append(self, data: bytes) -> None:
        try:
            self._file.write(data)
        except OSError as exc:
            raise OutputError(self.path, exc) from exc


def _create(folder: Path, vehicle: str) -> tuple[Path, BinaryIO]:
    """Create a file that does not exist yet, and its folder."""
    name = f"{vehicle}_{clock.now():%Y-%m-%d_%H-%M-%S}"
    path = folder / f"{name}.ulg"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(2, _MAX_SAME_NAME):
            with suppress(FileExistsError):
                return path, path.open("xb", buffering=0)
            path = folder / f"{name}_{number}.ulg"
        return path, path.open("xb", buffering=0)
    except OSError as exc:
        raise OutputError(path, exc) from exc
