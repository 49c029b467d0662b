"""What can be saved to a model file, and read again."""

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

Content = tuple[dict[str, Any], dict[str, AnyArray]]  # What a file says of itself, and its arrays.


class Stored(ABC):
    """A model of either scheme, "filter" or "paper", which is kept in one file; `Stored.load` reads both."""

    scheme: ClassVar[Literal["filter", "paper"]]

    @property
    @abstractmethod
    def longest(self) -> int:
        """Frames of the longest drive that it was learned from."""

    @abstractmethod
    def content(self) -> Content:
        """Return what the file says of it, and the arrays in it."""

    @classmethod
    @abstractmethod
    def of_content(cls, meta: dict[str, Any], arrays: dict[str, AnyArray]) -> Self:
        """Make it of what a file says; LookupError, TypeError, ValueError or ArithmeticError where that is wrong."""

    def _header(self) -> Content:
        meta, arrays = self.content()
        return {"scheme": self.scheme, "longest": self.longest} | meta, arrays

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of all that it holds, in hex: the one with which its file ends."""
        return container.checksum(FORMAT_VERSION, *self._header())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file; an existing one is replaced only when the new one is complete."""
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
        """Read an open file, which errors call `name`. Nothing but this file is opened, whatever it says.

        NoModelError where it cannot be read, is too large, or does not begin as a model does; ModelError where it is of
        another version or scheme, truncated, altered or inconsistent, or was learned on features that this program
        computes differently.
        """
        meta, arrays, checksum = container.read(file, name, FORMAT_VERSION)
        try:
            if not isinstance(meta, dict):
                raise TypeError("it does not say what it is")
            scheme = meta.pop("scheme")
            if not isinstance(scheme, str) or scheme not in _KINDS:
                raise ValueError(f"it is for no scheme that this program knows: {scheme!r}")
            file_of_kind, class_name = _KINDS[scheme]
            kind = getattr(
                import_module(file_of_kind), class_name
            )  # The paper's is imported only for its files.
            if not issubclass(kind, cls):
                raise ValueError(f"it was learned for the scheme '{scheme}', not '{cls.scheme}'")  # noqa: TRY004
            found: Self = kind.of_content(meta, arrays)
        except (LookupError, TypeError, ValueError, ArithmeticError, MemoryError) as error:
            raise ModelError(f"{name}: {container.one_line(error)}") from error
        # Known from the file: hashing all of it again would delay the start of a service.
        vars(found)["checksum"] = checksum
        return found
