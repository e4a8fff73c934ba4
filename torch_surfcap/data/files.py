"""Files that are complete or absent, never half written."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch_surfcap.errors import InputError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it replaces `path` when the block ends well and is removed when it fails.

    The temporary path keeps the suffix, since many writers choose the format by it. Folders are created as needed.
    Raises InputError where the folder cannot be made or written to.

    >>> with atomic_write("out/history.csv") as partial:            # doctest: +SKIP
    ...     partial.write_text("loss\\n")
    """
    target = Path(path)
    partial = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target.parent}: cannot make this folder: {error.strerror}") from error
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"{target.parent}: not writable, expected a folder that results can be written to")
    try:
        yield partial
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)
