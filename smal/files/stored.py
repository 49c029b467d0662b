"""Base class of models that are stored in a file."""

import os
from abc import ABC, abstractmethod
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import IO, Any, ClassVar, Literal, Self

from smal.arrays import AnyArray
from smal.files import container
from smal.files.container import ModelError, NoModelError, open_regular

FORMAT_VERSION = 1
_KINDS = {"filter": ("smal.model", "Model"), "paper": ("smal.paper.model", "PaperModel")}

#: Metadata and arrays of a file.
Content = tuple[dict[str, Any], dict[str, AnyArray]]


class Stored(ABC):
    """A model of either scheme, "filter" or "paper", in one file; `Stored.load` reads both."""

    scheme: ClassVar[Literal["filter", "paper"]]

    @property
    @abstractmethod
    def longest(self) -> int:
        """Number of frames of the longest drive."""

    @abstractmethod
    def content(self) -> Content:
        """Return the metadata and the arrays of the file."""

    @classmethod
    @abstractmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Build the model; LookupError, TypeError, ValueError or ArithmeticError if the content is invalid."""

    def _header(self) -> Content:
        meta, arrays = self.content()
        return {"scheme": self.scheme, "longest": self.longest} | meta, arrays

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the content, in hex, as at the end of its file."""
        return container.checksum(FORMAT_VERSION, *self._header())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model to a file atomically."""
        container.write(Path(path), FORMAT_VERSION, *self._header())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read the file at a path; see `read`."""
        try:
            descriptor = open_regular(Path(path))
        except OSError as error:
            raise NoModelError(f"{path}: cannot be read: {error.strerror}") from error
        with os.fdopen(descriptor, "rb") as file:
            return cls.read(file, str(path))

    @classmethod
    def read(cls, file: IO[bytes], name: str) -> Self:
        """Read an open file, called `name` in errors, and no other file.

        Raises
        ------
        NoModelError
            If it cannot be read, is too large, or does not begin like a model.
        ModelError
            If it has another version or scheme, is truncated, altered or inconsistent, or was learned on features that
            this program computes differently.
        """
        meta, arrays, checksum = container.read(file, name, FORMAT_VERSION)
        try:
            if not isinstance(meta, dict):
                raise TypeError("the metadata are missing")
            scheme = meta.pop("scheme")
            if not isinstance(scheme, str) or scheme not in _KINDS:
                raise ValueError(f"unsupported scheme: {scheme!r}")
            module, class_name = _KINDS[scheme]
            # The paper's classes are imported only for their files.
            kind = getattr(import_module(module), class_name)
            if not issubclass(kind, cls):
                raise ValueError(f"it was learned for the scheme '{scheme}', not '{cls.scheme}'")  # noqa: TRY004
            found: Self = kind.of_content(meta, arrays)
        except (LookupError, TypeError, ValueError, ArithmeticError, MemoryError) as error:
            raise ModelError(f"{name}: {container.one_line(error)}") from error
        # From the file: hashing the content again delays the start of a service.
        vars(found)["checksum"] = checksum
        return found
