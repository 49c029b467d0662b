"""Cache of computed features by content: one SQLite file in the user's cache folder."""

import hashlib
import os
import sqlite3
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from smal.features import FeatureSettings

Features = NDArray[np.float16]
# Maximum number of images (2 GB with the usual features); the oldest are deleted.
MOST_IMAGES: Final = 90_000
_AT_ONCE: Final = 500  # Number of features per write.
_DECODING: Final = b"upright"  # Part of the keys; change it with `services.kit.pixels.decode_file`.


def cache_file() -> Path:
    """Return the path of the cache file, below `$XDG_CACHE_HOME` or `~/.cache`."""
    return (
        Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        / "smal"
        / "features.sqlite"
    )


class FeatureCache:
    """Thread-safe cache of features for some settings; reports an unusable file and continues."""

    # Reports about the file, once: references and queries each have a cache.
    _said: ClassVar[set[str]] = set()

    def __init__(self, settings: FeatureSettings) -> None:
        self._settings = settings
        self._lock = Lock()
        self._new = dict[bytes, Features]()
        self._file: sqlite3.Connection | None = None
        with self._going_on():
            self._open()

    def key(self, *data: bytes) -> bytes:
        """Return the cache key of the features of some image files."""
        parts = [hashlib.sha256(one).digest() for one in data]
        settings = self._settings.fingerprint.encode()
        return hashlib.sha256(b"".join([*parts, _DECODING, settings])).digest()

    def find(self, key: bytes) -> Features | None:
        """Return cached features, float16 (m,), if any."""
        with self._lock, self._going_on():
            if self._file is None:
                return None
            query = "SELECT vector, checksum FROM features WHERE key = ?"
            for vector, checksum in self._file.execute(query, (key,)):
                if zlib.crc32(vector) != checksum or len(vector) != 2 * self._settings.size:
                    raise sqlite3.DatabaseError("checksum of features is wrong")
                return np.frombuffer(vector, np.float16)
        return None

    def keep(self, key: bytes, features: Features) -> Features:
        """Add features to the cache and return them."""
        with self._lock:
            self._new[key] = features
            if len(self._new) >= _AT_ONCE:
                self._write()
        return features

    def close(self) -> None:
        """Write pending features."""
        with self._lock:
            self._write()
            if self._file is not None:
                self._file.close()

    def _open(self) -> None:
        cache_file().parent.mkdir(parents=True, exist_ok=True)
        self._file = sqlite3.connect(cache_file(), check_same_thread=False)
        self._file.execute(
            "CREATE TABLE IF NOT EXISTS features (key BLOB UNIQUE, vector BLOB, checksum INTEGER)"
        )

    def _write(self) -> None:
        rows = [(key, one.tobytes(), zlib.crc32(one.tobytes())) for key, one in self._new.items()]
        self._new.clear()
        with self._going_on():
            if self._file is not None:
                with self._file:
                    self._file.executemany("REPLACE INTO features VALUES (?, ?, ?)", rows)
                    old = (
                        "DELETE FROM features WHERE rowid <= (SELECT max(rowid) FROM features) - ?"
                    )
                    self._file.execute(old, (MOST_IMAGES,))

    @contextmanager
    def _going_on(self) -> Iterator[None]:
        """Report an unusable file once and continue without it; replace a damaged file."""
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            self._file = None
            why = str(error)
            went_on = "features are not cached; $XDG_CACHE_HOME chooses another folder"
            if isinstance(error, OSError):
                why = error.strerror or why
            elif isinstance(error, sqlite3.DatabaseError) and not isinstance(
                error, sqlite3.OperationalError
            ):
                with suppress(sqlite3.Error, OSError):
                    cache_file().unlink()
                    self._open()
                    went_on = "replaced"
            line = f"smal: cache {cache_file()}: {why}; {went_on}\n"
            if line not in self._said:
                self._said.add(line)
                sys.stderr.write(line)
