"""Words that pages and commands share."""

import sys
from collections.abc import Iterable, Sequence

from smal.features import FeatureSettings


def counted(count: int, what: str) -> str:
    """Return "1 drive" or "2 drives"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def listed(names: Sequence[str], most: int = 10) -> str:
    """Name some of them, and say how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def described_by(features: FeatureSettings) -> str:
    """Name the modalities."""
    return " ".join(features.modalities)


def remark(lines: Iterable[object]) -> None:
    """Say something on standard error, a line each."""
    sys.stderr.writelines(f"smal: {line}\n" for line in lines)
