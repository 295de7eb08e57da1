"""Bytes by key: in a folder, or in an object store through fsspec. A key appears whole or not at all, and can be made to appear only once.

Nothing here lists keys: that would be slow with a million of them, and some stores show new keys late in lists.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, TypeVar

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.io.atomic import disk_error, temporary_path, write_bytes

T = TypeVar("T")

DOING = "using a store"
PATIENCE_S = 300.0  # for a store that does not answer
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 10.0  # between tries


class Objects(Protocol):
    """Bytes by key; keys are relative paths."""

    def read(self, key: str) -> bytes | None:
        """Return a key's bytes; None where it is not there."""
        ...

    def write(self, key: str, data: bytes) -> None:
        """Write a key, whole or not at all; what was there is replaced."""
        ...

    def create(self, key: str, data: bytes) -> bool:
        """Write a key, whole or not at all, unless it is there; return whether this call made it.

        A store may say False to the one that made it, if its first answer was lost: read the key to know what is there.
        """
        ...


def open_objects(url: str) -> Objects:
    """Open the store of a URL: a path, ``file://``, or what fsspec knows (``s3://BUCKET/PREFIX``).

    Raises:
        InputError: The URL has a scheme that no installed library knows.
    """
    if "://" not in url or url.startswith("file://"):
        return FolderObjects(Path(url.removeprefix("file://")))
    fsspec = require_library("fsspec", DOING, f"--store {url}", "pip install 'alpasim-onefixer[s3]'")
    try:
        system, root = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except (ValueError, ImportError) as error:
        raise InputError(DOING, f"--store {url}", str(error), "write a path or s3://BUCKET/PREFIX; s3 needs the extra [s3]") from error
    return RemoteObjects(system, root, url)


class FolderObjects:
    """Keys as files of a folder, also on NFS: a new name is linked, which only one process can do."""

    def __init__(self, root: Path) -> None:
        self._root = root.absolute()

    def read(self, key: str) -> bytes | None:
        """See `Objects`."""
        try:
            return (self._root / key).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise disk_error(self._root / key, error, DOING) from error

    def write(self, key: str, data: bytes) -> None:
        """See `Objects`."""
        write_bytes(self._root / key, data, DOING)

    def create(self, key: str, data: bytes) -> bool:
        """See `Objects`."""
        path = self._root / key
        partial = temporary_path(path)
        write_bytes(partial, data, DOING)
        try:
            os.link(partial, path)
        except FileExistsError:
            return False
        except OSError as error:
            raise disk_error(path, error, DOING) from error
        finally:
            partial.unlink(missing_ok=True)
        return True


class RemoteObjects:
    """Keys of an object store. A store that does not answer is asked again for five minutes.

    Args:
        system: A file system of fsspec whose ``pipe_file`` knows ``mode="create"``.
        root: Its path for the empty key.
        url: For messages.
    """

    def __init__(self, system: Any, root: str, url: str, patience_s: float = PATIENCE_S) -> None:
        self._system, self._root, self._url, self._patience_s = system, root.rstrip("/"), url, patience_s

    def read(self, key: str) -> bytes | None:
        """See `Objects`."""

        def ask() -> bytes | None:
            try:
                return bytes(self._system.cat_file(f"{self._root}/{key}"))
            except FileNotFoundError:
                return None

        return self._patiently(key, ask)

    def write(self, key: str, data: bytes) -> None:
        """See `Objects`."""
        self._patiently(key, lambda: self._system.pipe_file(f"{self._root}/{key}", data))

    def create(self, key: str, data: bytes) -> bool:
        """See `Objects`."""

        def ask() -> bool:
            try:
                self._system.pipe_file(f"{self._root}/{key}", data, mode="create")
            except FileExistsError:
                return False
            return True

        return self._patiently(key, ask)

    def _patiently(self, key: str, ask: Callable[[], T]) -> T:
        """Ask until there is an answer.

        Raises:
            InfrastructureError: The store refuses, or there was no answer for `PATIENCE_S`.
        """
        until_s, wait_s = time.monotonic() + self._patience_s, FIRST_WAIT_S
        while True:
            try:
                return ask()
            except (PermissionError, FileNotFoundError) as error:  # no right, no bucket: asking again would not help
                do_this = "check the address, the bucket and the credentials, on the nodes too"
                raise InfrastructureError(DOING, f"{self._url}/{key}", f"{type(error).__name__}: {error}", do_this) from error
            except Exception as error:  # libraries of object stores have families of errors for a network that is down
                if time.monotonic() + wait_s > until_s:
                    found = f"no answer for {self._patience_s:g} s: {type(error).__name__}: {error}"
                    do_this = "give the same command again when the store is back; finished rollouts are kept"
                    raise InfrastructureError(DOING, f"{self._url}/{key}", found, do_this) from error
            time.sleep(wait_s)
            wait_s = min(2 * wait_s, LONGEST_WAIT_S)
