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

    Without success nothing is left behind, and with `replace` what was there before stays as it was.

    Raises FileExistsError when there is one already that is not to be replaced, and any other OSError of the disk.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not replace:
        raise _exists(path)
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
        else:
            _move(part, target)
    finally:
        part.unlink(missing_ok=True)


def _move(part: Path, target: Path) -> None:
    """Give a file its name, unless another process was faster."""
    try:
        target.hardlink_to(part)
    except FileExistsError:
        raise _exists(target) from None
    except OSError:  # a file system without links, as of SD cards
        part.rename(target)


def _exists(path: Path) -> FileExistsError:
    return FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
