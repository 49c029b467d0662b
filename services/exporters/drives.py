"""Recorded episodes as drives for export: images, poses by odometry, velocities."""

import importlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from schemas.base import TICK_S, Atom
from schemas.command import CommandApplied
from schemas.motion import Imu, Odometry
from schemas.topics import IMU
from services.importers.drive import Tally
from services.importers.job import Format
from services.kit.cameras import camera_of
from services.kit.errors import JobError
from services.kit.jpeg import is_jpeg
from services.recordings.encoding import stamped_jpeg
from services.recordings.reader import USUAL, read_recording
from services.recordings.recorded import RecordedEpisode
from services.recordings.records import Allowance
from services.recordings.stream import RecordingError
from smal.movement import Movement

_DIGITS: Final = 6  # Decimals of velocities: a micrometre and a microradian per second.
#: Modules of this package that write a format, by ``write(drives, folder, tally, advance)``.
_WRITERS: Final[dict[Format, str]] = {
    "rosbag2": "rosbag2",
    "lerobot": "lerobot",
    "folder": "csv_folder",
}
FORMATS: Final = tuple(_WRITERS)


class Rate(NamedTuple):
    """Full speed of an atom, metres or radians a second, and the origin of the figure."""

    value: float
    origin: str


class NominalSpeeds(NamedTuple):
    """Full speed of a robot: forward and backward, and in turns."""

    speed: Rate
    turn_rate: Rate


class Moment(NamedTuple):
    """One tick of a drive; None stands for missing, damaged or unknown values.

    The image is as recorded. The velocity (linear, angular) holds from this tick on. The inertial
    readings are those since the tick before.
    """

    tick: int
    stamp_ns: int
    jpeg: bytes | None
    velocity: tuple[float, float] | None
    odometry: Odometry | None
    imu: Imu | None


@dataclass(eq=False, kw_only=True)
class ExportedDrive(RecordedEpisode):
    """A recorded episode to export, with a unique name for files."""

    name: str
    nominal: NominalSpeeds

    @property
    def success(self) -> bool:
        """Whether its last frame is the goal."""
        return self.outcome == "found"

    @property
    def ticks(self) -> list[int]:
        """All ticks with an image, a pose or a command."""
        return sorted(self.images.keys() | self.odometry.keys() | self.applied.keys())

    def moments(self, tally: Tally, advance: Callable[[], None]) -> Iterator[Moment]:
        """Yield each tick, count unusable data, and call ``advance`` for each."""
        last_ns = -1
        for tick in self.ticks:
            advance()
            stamp_ns, jpeg = self._image(tick, tally)
            # Messages about a frame have its stamp.
            stamp_ns = next(
                (one[tick].stamp_ns for one in (self.odometry, self.applied) if tick in one),
                stamp_ns,
            )
            if stamp_ns <= last_ns:
                tally.count("ticks are not later than the tick before (left out)")
                continue
            last_ns = stamp_ns
            yield Moment(
                tick,
                stamp_ns,
                jpeg,
                self._velocity(tick),
                self.odometry.get(tick),
                self.imu.get(tick),
            )

    def usable(
        self, tally: Tally, advance: Callable[[], None]
    ) -> Iterator[tuple[Moment, bytes, tuple[float, float]]]:
        """Yield the moments with an image and a velocity; count the others."""
        for moment in self.moments(tally, advance):
            if moment.jpeg is not None and moment.velocity is not None:
                yield moment, moment.jpeg, moment.velocity
            elif moment.jpeg is not None:
                tally.count("frames lack an action (left out)")

    def _image(self, tick: int, tally: Tally) -> tuple[int, bytes | None]:
        if tick not in self.images:
            tally.count("ticks have no image")
            return -1, None
        with suppress(ValueError):
            stamp_ns, jpeg = stamped_jpeg(bytes(self.images[tick]))
            if is_jpeg(jpeg):
                return stamp_ns, jpeg
        tally.count("images are damaged")
        return -1, None

    def _velocity(self, tick: int) -> tuple[float, float] | None:
        # At its end the robot stands.
        if self.end_tick is not None and tick >= self.end_tick:
            return 0.0, 0.0
        applied = self.applied.get(tick)
        if applied is None:
            return None
        speed_m_s = self.nominal.speed.value * applied.linear
        turn_rad_s = self.nominal.turn_rate.value * applied.angular
        return round(speed_m_s, _DIGITS), round(turn_rad_s, _DIGITS)


def read(
    files: Iterable[Path], speed: float | None, turn_rate: float | None, tally: Tally
) -> list[ExportedDrive]:
    """Read recordings, with action speeds as given (m/s, rad/s) or by odometry."""
    episodes = list(_episodes(files, tally))
    if not episodes:
        raise JobError(
            tally.remarks.pop()
            if len(tally.remarks) == 1
            else "nothing to export, for these reasons"
        )
    names = [episode.episode for episode in episodes]
    nominal = {}
    for robot in dict.fromkeys(episode.robot for episode in episodes):
        own = [episode for episode in episodes if episode.robot == robot]
        nominal[robot] = NominalSpeeds(
            _rate(own, speed, "--speed", ("forward", "backward")),
            _rate(own, turn_rate, "--turn-rate", ("left", "right")),
        )
    return [
        ExportedDrive(
            **vars(episode),
            name=name if names.count(name) == 1 else f"{episode.robot}-{name}",
            nominal=nominal[episode.robot],
        )
        for name, episode in zip(names, episodes, strict=True)
    ]


def write(
    form: Format,
    drives: Sequence[ExportedDrive],
    folder: Path,
    tally: Tally,
    advance: Callable[[], None] = lambda: None,
) -> None:
    """Write drives into an empty folder; raise JobError if they do not fit the format.

    ``advance`` is called for each tick.
    """
    importlib.import_module(f"services.exporters.{_WRITERS[form]}").write(
        drives, folder, tally, advance
    )


def say_view(drives: Iterable[ExportedDrive], tally: Tally) -> None:
    """Report the fields of view, which the format cannot store."""
    for camera in (drive.camera for drive in drives):
        if camera is not None:
            angle = camera_of(camera).field_deg
            tally.say(
                "the format cannot store the camera's field of view; import it with "
                f"--field-of-view {angle:.4g}"
            )


def _episodes(files: Iterable[Path], tally: Tally) -> Iterator[RecordedEpisode]:
    allowance = Allowance()
    seen: dict[tuple[str, str], Path] = {}
    for path in files:
        try:
            recording = read_recording(path, allowance, (*USUAL, IMU))
        except RecordingError as error:
            tally.say(str(error))
            continue
        for remark in recording.remarks():
            tally.say(remark)
        for episode in recording.episodes:
            other = seen.setdefault((episode.robot, episode.episode), path)
            if other != path:
                tally.say(f"{path}: episode {episode.episode} left out: already in {other}")
            elif not episode.images:
                tally.say(f"{path}: episode {episode.episode} left out: no images")
            else:
                yield episode


def _rate(
    episodes: Collection[RecordedEpisode],
    given: float | None,
    option: str,
    atoms: tuple[Atom, Atom],
) -> Rate:
    """Return the given speed, or the median over all ticks of these actions, as in learning."""
    if given is not None:
        return Rate(given, f"given by {option}")
    made = [
        (episode, tick, applied)
        for episode in episodes
        for tick, applied in episode.applied.items()
        if applied.atom in atoms
    ]
    if not made:
        return Rate(0.0, "action absent")
    steps = [step for each in made if (step := _step(*each)) is not None]
    rate = round(float(np.median(steps)) / TICK_S, _DIGITS) if steps else 0.0
    if rate > 0.0:
        return Rate(rate, "by odometry")
    episode, _, applied = made[0]
    raise JobError(
        f"episode {episode.episode}: no odometry for the speed of {applied.atom}; give it with "
        f"{option}"
    )


def _step(episode: RecordedEpisode, tick: int, applied: CommandApplied) -> float | None:
    """Return the distance or turn of a tick at full speed; None if unknown."""
    ahead = applied.atom in ("forward", "backward")
    share = abs(applied.linear if ahead else applied.angular)
    if share == 0.0 or not {tick, tick + 1} <= episode.odometry.keys():
        return None
    moved = Movement.between(episode.odometry[tick].pose, episode.odometry[tick + 1].pose)
    return abs(moved.ahead if ahead else moved.turn_rad) / share
