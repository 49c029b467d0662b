"""Conditions other than those of teaching: light by time of day, haze, façades, moved things, exposure.

A table of names, so that a model taught under one condition can be run under another (``--variation NAME``), and so
that everybody means the same by a name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """Sun and sky."""

    elevation_deg: float = 40.98
    azimuth_deg: float = 221.58
    """Where the sun stands: above the horizon, and clockwise from north."""
    sun: Colour = (2.6, 2.45, 2.2)
    """Colour and strength of the direct light, linear; black where clouds hide the sun."""
    sky: Colour = (0.42, 0.45, 0.5)
    """Of the light that comes from everywhere."""
    fill: Colour = (0.35, 0.38, 0.45)
    """Of the brighter part of the sky opposite the sun."""
    zenith: Colour = (84.0, 132.0, 200.0)
    horizon: Colour = (206.0, 218.0, 228.0)
    """Colours of the sky's picture, 0 to 255."""
    clouds: float = 1.0
    """How much of the sky clouds cover, relative to a fair day."""
    lamps: Colour = (1.0, 1.0, 1.0)
    """Strength and colour of what lights a room: lamps, and daylight through windows."""

    @property
    def direction(self) -> tuple[float, float, float]:
        """Where sunlight goes, a unit vector: x east, y north, z up."""
        up, around = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        return (-math.cos(up) * math.sin(around), -math.cos(up) * math.cos(around), -math.sin(up))

    @property
    def casts_shadows(self) -> bool:
        """Whether the sun is strong enough for shadows to be seen."""
        return max(self.sun) > 0.5


@dataclass(frozen=True)
class Variation:
    """One set of conditions: its name, as given to ``--variation``, and what it means, for people."""

    name: str
    meaning: str
    light: Daylight = Daylight()
    visibility_m: float | None = None
    """Distance at which 5 % of an object's contrast is left (meteorologists' visibility); None for clear air."""
    exposure_ev: float = 0.0
    """By how many stops the camera exposes too much."""
    facade_seed: int = 0
    """Façades are painted anew for every number but 0."""
    clutter_seed: int = 0
    """Movable things (furniture, trees) stand elsewhere for every number but 0."""


DAY: Final = Variation("day", "A fair afternoon, as in teaching unless said otherwise.")
_MORNING: Final = Daylight(
    elevation_deg=18.0, azimuth_deg=95.0, sun=(2.5, 2.0, 1.45), sky=(0.34, 0.38, 0.46), fill=(0.25, 0.3, 0.4),
    zenith=(96.0, 140.0, 198.0), horizon=(236.0, 222.0, 200.0), lamps=(0.92, 0.95, 1.02),
)  # fmt: skip
_EVENING: Final = Daylight(
    elevation_deg=9.0, azimuth_deg=282.0, sun=(2.1, 1.25, 0.62), sky=(0.3, 0.3, 0.38), fill=(0.2, 0.2, 0.3),
    zenith=(74.0, 92.0, 146.0), horizon=(238.0, 176.0, 124.0), lamps=(0.82, 0.7, 0.54),
)  # fmt: skip
_OVERCAST: Final = Daylight(
    elevation_deg=60.0, azimuth_deg=180.0, sun=(0.0, 0.0, 0.0), sky=(0.92, 0.95, 1.0), fill=(0.32, 0.33, 0.35),
    zenith=(172.0, 178.0, 186.0), horizon=(204.0, 208.0, 212.0), clouds=2.5, lamps=(0.88, 0.9, 0.95),
)  # fmt: skip

VARIATIONS: Final[dict[str, Variation]] = {
    one.name: one
    for one in (
        DAY,
        Variation("morning", "Low sun in the east: long shadows that fall the other way.", light=_MORNING),
        Variation("evening", "Low red sun in the west.", light=_EVENING),
        Variation("overcast", "No sun and no shadows.", light=_OVERCAST),
        Variation("haze", "Mist: 60 m of visibility.", light=_OVERCAST, visibility_m=60.0),
        Variation("dark", "Exposed two stops too little.", exposure_ev=-2.0),
        Variation("bright", "Exposed one and a half stops too much: skies and white walls burn out.", exposure_ev=1.5),
        Variation("repainted", "All façades are painted anew.", facade_seed=1),
        Variation("moved", "Furniture and trees stand a little elsewhere.", clutter_seed=1),
        Variation(
            "other-day",
            "Everything at once: morning, light mist, half a stop too dark, moved things.",
            light=_MORNING,
            visibility_m=250.0,
            exposure_ev=-0.5,
            clutter_seed=2,
        ),
    )
}


def variation_named(name: str) -> Variation:
    """Return a variation; a `ValueError` names those that there are."""
    if name not in VARIATIONS:
        raise ValueError(f"unknown variation {name!r}; known are {', '.join(VARIATIONS)}")
    return VARIATIONS[name]
