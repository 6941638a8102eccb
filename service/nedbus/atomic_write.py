"""Atomic file writes."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_write(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, and rename the file to `path` on success.

    On failure the temporary file is removed, and an existing file is unchanged.

    Raises FileExistsError if the file exists and `replace` is false, OSError if it cannot be written.
    """
    target = Path(os.path.realpath(path))
    exists = FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    if target.exists() and not replace:
        raise exists
    if target.exists() and not target.is_file():
        yield target  # a device or a pipe
        return
    temporary = target.with_name(f".{os.getpid()}-part-{target.name}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        if replace:
            temporary.replace(target)
            sync_folder(target)
            return
        try:
            target.hardlink_to(temporary)
        except FileExistsError:  # another process created it first
            raise exists from None
        except OSError:  # a file system without hard links, such as FAT on SD cards
            temporary.rename(target)
        sync_folder(target)
    finally:
        temporary.unlink(missing_ok=True)


def sync_folder(path: Path) -> None:
    """Sync the folder of a new or renamed file to disk: until then a power cut may undo the creation or renaming."""
    with suppress(PermissionError):  # a folder that can be written but not read
        folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
