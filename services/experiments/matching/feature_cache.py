"""Features that were computed before, by what they are of: one file of SQLite in the user's cache folder."""

import hashlib
import os
import sqlite3
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from smal.features import FeatureSettings

#: Most bytes of the file: 90,000 images with the usual features. The oldest features go first.
MOST_BYTES: Final = 2 * 10**9
#: Features that are written at a time, and that go at a time.
_AT_ONCE: Final = 500
_TABLE: Final = "CREATE TABLE IF NOT EXISTS features (key BLOB UNIQUE, vector BLOB, checksum INTEGER)"


def cache_file() -> Path:
    """Return the file, below `$XDG_CACHE_HOME` or `~/.cache`."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "smal" / "features.sqlite"


def digest(*data: bytes | NDArray[np.uint8]) -> bytes:
    """Return the SHA-256 of the bytes of images, files or pixels."""
    parts = [one if isinstance(one, bytes) else one.data for one in data]
    return hashlib.sha256(b"".join(hashlib.sha256(one).digest() for one in parts)).digest()


class FeatureCache:
    """Finds and keeps features of some settings, in threads; where the file cannot be used it says so and goes on."""

    def __init__(self, settings: FeatureSettings) -> None:
        self._prefix, self._size = settings.fingerprint.encode(), settings.size
        self._lock, self._new = Lock(), dict[bytes, NDArray[np.float16]]()
        self._file: sqlite3.Connection | None = None
        with self._going_on():
            self._open()

    def find(self, key: bytes) -> NDArray[np.float16] | None:
        """Return the features of the images with this digest, float16 (m,), if they are known."""
        with self._lock, self._going_on():
            if self._file is None:
                return None
            query = "SELECT vector, checksum FROM features WHERE key = ?"
            for vector, checksum in self._file.execute(query, (self._prefix + key,)):
                if zlib.crc32(vector) != checksum or len(vector) != 2 * self._size:
                    raise sqlite3.DatabaseError("features are not what was written")
                return np.frombuffer(vector, np.float16)
        return None

    def keep(self, key: bytes, features: NDArray[np.float16]) -> NDArray[np.float16]:
        """Keep the features of the images with this digest, and return them."""
        with self._lock:
            self._new[key] = features
            if len(self._new) >= _AT_ONCE:
                self._write()
        return features

    def close(self) -> None:
        """Write what is not yet written."""
        with self._lock:
            self._write()
            if self._file is not None:
                self._file.close()

    def _open(self) -> None:
        cache_file().parent.mkdir(parents=True, exist_ok=True)
        self._file = sqlite3.connect(cache_file(), check_same_thread=False)
        self._file.execute(_TABLE)

    def _write(self) -> None:
        rows = [(self._prefix + key, one.tobytes(), zlib.crc32(one.tobytes())) for key, one in self._new.items()]
        self._new.clear()
        with self._going_on():
            if self._file is None:
                return
            with self._file:
                self._file.executemany("INSERT OR REPLACE INTO features VALUES (?, ?, ?)", rows)
                oldest = "DELETE FROM features WHERE rowid IN (SELECT rowid FROM features ORDER BY rowid LIMIT ?)"
                while self._bytes() > MOST_BYTES and self._file.execute(oldest, (_AT_ONCE,)).rowcount:
                    pass

    def _bytes(self) -> int:
        assert self._file is not None  # noqa: S101 - asked above
        pages, free, size = (
            self._file.execute(f"PRAGMA {one}").fetchone()[0] for one in ("page_count", "freelist_count", "page_size")
        )
        return int((pages - free) * size)

    @contextmanager
    def _going_on(self) -> Iterator[None]:
        """Where the file cannot be used, say so once and go on without it; make one that is damaged anew."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            damaged = isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError)
            went_on = "begun anew" if damaged else "features are computed, and not kept"
            sys.stderr.write(f"smal: cache {cache_file()}: {error}; {went_on}\n")
            self._file = None
            if damaged:
                cache_file().unlink()
                self._open()
