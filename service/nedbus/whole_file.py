"""Files that are written whole, or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield the name of a file to write, in the same folder; at the end it gets the name that it is to have.

    Without success nothing is left behind, and with `replace` the file that was there stays as it was.

    Raises FileExistsError when there is one already that is not to be replaced, and any other OSError of the disk.
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
