"""Conditions other than those of teaching, by name: light by time of day, haze, façades, moved things, exposure."""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

from services.simulator.tables import table

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """Sun and sky."""

    elevation_deg: float = 40.98
    azimuth_deg: float = (
        221.58  # Where the sun stands: above the horizon, and clockwise from north.
    )
    sun: Colour = (
        2.6,
        2.45,
        2.2,
    )  # Colour and strength of the direct light, linear; black where clouds hide the sun.
    sky: Colour = (0.42, 0.45, 0.5)  # Of the light that comes from everywhere.
    fill: Colour = (0.35, 0.38, 0.45)  # Of the brighter part of the sky opposite the sun.
    zenith: Colour = (84.0, 132.0, 200.0)
    horizon: Colour = (206.0, 218.0, 228.0)  # Colours of the sky's picture, 0 to 255.
    clouds: float = 1.0  # How much of the sky clouds cover, relative to a fair day.
    clouds_seed: int = 0  # Every number has clouds of its own.
    lamps: Colour = (
        1.0,
        1.0,
        1.0,
    )  # Strength and colour of what lights a room: lamps, and daylight through windows.

    @property
    def direction(self) -> tuple[float, float, float]:
        """Where sunlight goes, a unit vector: x east, y north, z up."""
        up = math.radians(self.elevation_deg)
        around = math.radians(self.azimuth_deg)
        return (-math.cos(up) * math.sin(around), -math.cos(up) * math.cos(around), -math.sin(up))


@dataclass(frozen=True)
class Variation:
    """One set of conditions: its name, as given to ``--variation``, and what it means, for people."""

    name: str
    meaning: str
    light: Daylight = Daylight()
    visibility_m: float | None = None
    """Distance at which 5 % of an object's contrast is left (meteorologists' visibility); None for clear air."""
    exposure_ev: float = 0.0  # By how many stops the camera exposes too much.
    facade_seed: int = 0  # Façades are painted anew for every number but 0.
    clutter_seed: int = (
        0  # Movable things (furniture, trees) stand elsewhere for every number but 0.
    )


@dataclass(frozen=True)
class _Table:
    lights: dict[str, Daylight]
    variations: dict[str, dict[str, Any]]


_TABLE: Final = table("variations", _Table)
VARIATIONS: Final[dict[str, Variation]] = {
    name: Variation(name, light=_TABLE.lights.get(said.pop("light", ""), Daylight()), **said)
    for name, said in _TABLE.variations.items()
}
DAY: Final = VARIATIONS["day"]


def clouded(name: str, seed: int) -> Variation:
    """Return a variation with other clouds."""
    usual = variation_named(name)
    return replace(usual, light=replace(usual.light, clouds_seed=seed))


def variation_named(name: str) -> Variation:
    """Return a variation; a `ValueError` names those that there are."""
    if name not in VARIATIONS:
        raise ValueError(f"unknown variation {name!r}; known are {', '.join(VARIATIONS)}")
    return VARIATIONS[name]
