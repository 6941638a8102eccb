"""Atomic writes: a file is written completely or not at all."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield the path of a temporary file in the same folder, and rename it to `path` on success.

    On failure nothing is left behind, and with `replace` the previous file is unchanged.

    Raises FileExistsError if the file exists and `replace` is false, and any other OSError of the disk.
    """
    target = Path(os.path.realpath(path))
    exists = FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    if target.exists() and not replace:
        raise exists
    if target.exists() and not target.is_file():
        yield target  # a device or a pipe
        return
    part = target.with_name(f".{os.getpid()}-part-{target.name}")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        if replace:
            part.replace(target)
            return
        try:
            target.hardlink_to(part)
        except FileExistsError:  # another process was faster
            raise exists from None
        except OSError:  # a file system without links, as of SD cards
            part.rename(target)
    finally:
        part.unlink(missing_ok=True)
