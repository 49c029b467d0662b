"""Named variations of the conditions: daylight, haze, façades, moved objects, camera."""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

from services.simulator.tables import table

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Daylight:
    """Sun and sky."""

    elevation_deg: float = 40.98
    # Position of the sun: above the horizon, and clockwise from north.
    azimuth_deg: float = 221.58
    # Linear colour and intensity of the direct light; black under full cloud.
    sun: Colour = (2.6, 2.45, 2.2)
    sky: Colour = (0.42, 0.45, 0.5)  # Linear colour of the ambient light.
    fill: Colour = (0.35, 0.38, 0.45)  # Linear colour of the bright sky opposite the sun.
    zenith: Colour = (84.0, 132.0, 200.0)
    horizon: Colour = (206.0, 218.0, 228.0)  # Colours of the sky image, 0 to 255.
    clouds: float = 1.0  # Cloud cover relative to a fair day.
    clouds_seed: int = 0  # Seed of the cloud pattern.
    # Linear colour and intensity of indoor light: lamps and windows.
    lamps: Colour = (1.0, 1.0, 1.0)

    @property
    def direction(self) -> tuple[float, float, float]:
        """Direction of sunlight, a unit vector: x east, y north, z up."""
        up = math.radians(self.elevation_deg)
        around = math.radians(self.azimuth_deg)
        return (-math.cos(up) * math.sin(around), -math.cos(up) * math.cos(around), -math.sin(up))


@dataclass(frozen=True)
class Variation:
    """A named set of conditions for ``--variation``, with a description for users."""

    name: str
    meaning: str
    light: Daylight = Daylight()
    visibility_m: float | None = None
    """Meteorological visibility: 5 % of an object's contrast is left at this distance. None: clear
    air."""
    exposure_ev: float = 0.0  # Overexposure of the camera, stops.
    noise: float = 0.0  # Standard deviation of the camera's noise, levels of 0 to 255.
    defocus: float = 0.0  # Standard deviation of the lens blur, thousandths of the image width.
    facade_seed: int = 0  # Seed of the façades; 0 keeps them.
    # Seed of the positions of furniture and trees; 0 keeps them.
    clutter_seed: int = 0


@dataclass(frozen=True)
class _Table:
    lights: dict[str, Daylight]
    variations: dict[str, dict[str, Any]]


_TABLE: Final = table("variations", _Table)
VARIATIONS: Final[dict[str, Variation]] = {
    name: Variation(name, light=_TABLE.lights.get(fields.pop("light", ""), Daylight()), **fields)
    for name, fields in _TABLE.variations.items()
}
DAY: Final = VARIATIONS["day"]


def clouded(name: str, seed: int) -> Variation:
    """Return a variation with another cloud pattern."""
    usual = variation_named(name)
    return replace(usual, light=replace(usual.light, clouds_seed=seed))


def variation_named(name: str) -> Variation:
    """Return the variation of a name; raise ValueError for an unknown name."""
    if name not in VARIATIONS:
        raise ValueError(f"variation {name!r} not found; choose from {', '.join(VARIATIONS)}")
    return VARIATIONS[name]
