"""State file of a running ULog stream: its definitions and progress, from which a restarted process continues it."""

import logging
import os
import struct
import zlib
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple
from uuid import UUID

from nedbus import limits
from nedbus.atomic_write import atomic_write
from nedbus.errors import OutputError, system_reason
from nedbus.log_event import about
from nedbus.settings import state_folder
from nedbus.sources.options import MavlinkOptions

_log = logging.getLogger(__name__)

_MAGIC: Final = b"nedbusS1"  # the last character is the version
# magic, boot of the host, system id, size and CRC of the definitions
_HEAD: Final = struct.Struct("<8s16sBII")
# host time [s], vehicle time [us], sequence of the last LOGGING_DATA
_PROGRESS: Final = struct.Struct("<dQH")
_NO_PROGRESS: Final = bytes(_PROGRESS.size)
_START: Final = _HEAD.size + _PROGRESS.size  # of the definitions
_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
_JITTER: Final = 2.0  # s that a message may be late
_DRIFT: Final = 0.02  # of the vehicle's clock, as a share of the time since the last message


class SavedStream(NamedTuple):
    """A running stream as an earlier process left it."""

    definitions: bytes
    host_time: float
    vehicle_time: int
    sequence: int

    def check_boot(self, vehicle_time: int, now: float) -> None:
        """Raise ValueError unless the vehicle's time [us] shows that it has not rebooted since."""
        elapsed = now - self.host_time
        difference = (vehicle_time - self.vehicle_time) / 1e6 - elapsed
        if abs(difference) > _JITTER + _DRIFT * elapsed:
            raise ValueError("the vehicle has rebooted since its definitions were saved")


def state_path(options: MavlinkOptions, link: str, system: int) -> Path | None:
    """Return the path of the state file of a vehicle on a link; None if `state=0`."""
    if options.state == "0":
        return None
    folder = state_folder() / "ulog-streams"
    if options.state:
        folder = Path(options.state).expanduser()
    name = sha256(link.encode()).hexdigest()[:16]
    return folder / f"{name}-{system}"


def read_stream(path: Path | None, system: int) -> SavedStream:
    """Return the stream in a state file; raise ValueError with the reason if it cannot be used."""
    if path is None:
        raise ValueError("state=0 is set")
    try:
        with path.open("rb") as file:
            content = file.read(_START + limits.LOG_STREAM_PENDING)
    except FileNotFoundError:
        raise ValueError(f"its definitions are not in {path.parent}") from None
    except OSError as exc:
        reason = system_reason(exc)
        raise ValueError(f"{path} cannot be read ({reason})") from exc
    definitions = content[_START:]
    if len(content) < _START or not content.startswith(_MAGIC):
        raise ValueError(f"{path} was not written by this release")
    _, boot, owner, size, checksum = _HEAD.unpack_from(content)
    if size != len(definitions) or checksum != zlib.crc32(definitions):
        raise ValueError(f"{path} is damaged")
    if owner != system:
        raise ValueError(f"{path} is of system {owner}")
    if boot != _host_boot():
        raise ValueError("this host has rebooted since its definitions were saved")
    return SavedStream(definitions, *_PROGRESS.unpack_from(content, _HEAD.size))


class StreamFile:
    """The state file of one vehicle's stream, written by its receiver; after an error it is not written any more."""

    def __init__(self, path: Path | None, system: int) -> None:
        self._path = path
        self._system = system
        self._definitions = b""
        self._progress = _NO_PROGRESS
        self._file: BinaryIO | None = None

    @property
    def is_current(self) -> bool:
        """Whether the file has the definitions of the current stream."""
        return self._file is not None

    def write(self, definitions: bytes, progress: bytes = _NO_PROGRESS) -> None:
        """Replace the definitions, by default without progress until the next `update`."""
        self.close()
        self._definitions = definitions
        self._progress = progress
        size = len(definitions)
        if self._path is None or size > limits.LOG_STREAM_PENDING:
            return
        head = _HEAD.pack(_MAGIC, _host_boot(), self._system, size, zlib.crc32(definitions))
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with atomic_write(self._path, replace=True) as temporary:
                temporary.write_bytes(head + progress + definitions)
            self._file = self._path.open("r+b", buffering=0)
        except OSError as exc:
            self._give_up(self._path, exc)

    def append(self, record: bytes) -> None:
        """Add a definition."""
        if self.is_current:
            self.write(self._definitions + record, self._progress)

    def update(self, sequence: int, vehicle_time: int, now: float) -> None:
        """Save the progress; it survives the end of the process at any time."""
        if self._file is None or self._path is None:
            return
        self._progress = _PROGRESS.pack(now, vehicle_time, sequence)
        try:
            os.pwrite(self._file.fileno(), self._progress, _HEAD.size)
        except OSError as exc:
            self._give_up(self._path, exc)

    def close(self, *, remove: bool = False) -> None:
        """Close the file; with `remove`, delete it, because the stream has ended. Idempotent."""
        if self._file is not None and self._path is not None:
            self._file.close()
            self._file = None
            if remove:
                self._path.unlink(missing_ok=True)

    def _give_up(self, path: Path, exc: OSError) -> None:
        self.close()
        self._path = None
        error = OutputError(path, exc)
        text = "%s; after a restart in flight, the ULog stream of system %d cannot be continued: set state="
        _log.warning(text, error, self._system, extra=about("log_stream", reason=str(error)))


def _host_boot() -> bytes:
    """Return an id of the host's boot, because monotonic times are comparable within it only; zeros if unknown."""
    try:
        return UUID(_BOOT.read_text().strip()).bytes
    except (OSError, ValueError):
        return bytes(16)
