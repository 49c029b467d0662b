"""The configuration of a base without ROS: templates, presets, and one clear line for every mistake."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.base import STANDING, Velocity
from services.kit.errors import UsageError
from services.robot.loop import STAND_WITHIN_S
from services.robot.real import known_presets
from services.serial.config import PRESETS, read_config
from services.serial.template import Template
from tests.command import run_smal
from tests.services.real_base import check_refusal

AHEAD = Velocity(1.0, 0.0)
LEFT = Velocity(0.0, 1.0)
BASE = """
name: mine
watchdog_s: 0.2
speed_m_s: 0.4
turn_rate_rad_s: 1.0
braking_s: 0.2
camera: {source: 0}
"""
LINE = "base: {address: /dev/ttyUSB0, velocity: 'v {linear_m_s:.2f} {angular_rad_s:.2f}'}\n"


@pytest.mark.parametrize("preset", known_presets(PRESETS))
def test_preset_needs_only_the_watchdog(preset: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"preset: {preset}\n")
    with pytest.raises(UsageError, match=r"mine\.yaml: watchdog_s: required; give the seconds"):
        read_config(path)
    path.write_text(f"preset: {preset}\nwatchdog_s: 0.2\ncamera: {{source: /dev/video2}}\n")
    config = read_config(path)
    assert config.camera.source == "/dev/video2"
    assert config.watchdog_s + config.braking_s <= STAND_WITHIN_S
    assert "https://" in (PRESETS / f"{preset}.yaml").read_text()


@pytest.mark.parametrize(
    ("preset", "velocity", "line"),
    [
        ("waveshare_ugv", AHEAD, '{"T":136,"cmd":200}\n{"T":1,"L":0.300,"R":0.300}\n'),
        ("waveshare_ugv", LEFT, '{"T":136,"cmd":200}\n{"T":1,"L":-0.069,"R":0.069}\n'),
        ("openbot", AHEAD, "h200\nc255,255\n"),
        ("openbot", STANDING, "h200\nc0,0\n"),
        ("ros_arduino_bridge", AHEAD, "m 27 27\re\r"),
        ("roboteq", LEFT, "^RWD 200\r!G 1 -200\r!G 2 200\r?C\r"),
    ],
)
def test_preset_sends_the_lines_of_its_base(
    preset: str, velocity: Velocity, line: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"preset: {preset}\nwatchdog_s: 0.2\n")
    assert read_config(path).command(velocity) == line


@pytest.mark.parametrize(
    ("preset", "line", "values"),
    [
        ("waveshare_ugv", '{"T":1001,"L":0,"R":0.25,"r":7.0,"p":-4.9,"v":11.1}', {"left_m_s": 0.0, "right_m_s": 0.25}),
        ("ros_arduino_bridge", "-400 2000", {"left_m": -0.1, "right_m": 0.5}),
        ("roboteq", "C=10000:-5000", {"left_m": 1.0, "right_m": -0.5}),
    ],
)  # fmt: skip
def test_preset_reads_the_odometry_of_its_base(
    preset: str, line: str, values: dict[str, float], tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"preset: {preset}\nwatchdog_s: 0.2\n")
    odometry = read_config(path).odometry
    assert odometry is not None
    assert odometry.template().read(line) == values


def test_shares_of_the_wheels_keep_the_curve_at_their_limit(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    base = "base: {address: 'udp://robot:8', velocity: '{left:.2f} {right:.2f}', track_m: 0.4}\n"
    path.write_text(BASE + base)
    config = read_config(path)
    assert config.command(Velocity(1.0, 1.0)) == "0.33 1.00\n"  # 0.2 and 0.6 m/s, of 0.4.
    assert config.command(Velocity(-0.5, 0.0)) == "-0.50 -0.50\n"


def test_steering_of_a_car_is_a_share_of_its_narrowest_bend(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    base = "base: {address: /dev/ttyACM0, velocity: '{linear:.1f},{steering:.2f}'}\n"
    path.write_text(BASE + "radius_m: 0.8\n" + base)
    config = read_config(path)
    assert config.command(Velocity(0.5, 0.25)) == "0.5,1.00\n"
    assert config.command(Velocity(1.0, -0.25)) == "1.0,-0.50\n"
    assert config.command(STANDING) == "0.0,0.00\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("preset: ugv\n", "preset not found; available: openbot, roboteq, ros_arduino_bridge, wav"),
        (BASE, "base: Field required"),
        (BASE + LINE + "speed: 1\n", "speed: Extra inputs are not permitted"),
        (BASE.replace("0.2", "0.4") + LINE, "silence of the driver is too large (0.67 s"),
        (BASE + LINE.replace("linear_m_s", "speed"), "base.velocity: unknown {speed}; known: ang"),
        (BASE + LINE.replace("s:.2f}'", "s:.2f'"), "base.velocity: '{angular_rad_s:.2f' lacks its"),
        (BASE + LINE.replace(".2f", "d"), "base.velocity: invalid format 'd'; use for example .3f"),
        (BASE + LINE.replace("linear_m_s", "linear*0"), "base.velocity: factor '0': must be a f"),
        (BASE + LINE.replace("{linear_m_s:.2f}", ""), "must differ for standing, driving ahead"),
        (BASE + LINE.replace("linear_m_s:.2f", "left:.2f"), "base.track_m: required for wheels"),
        (BASE + LINE.replace("angular_rad_s", "steering"), "radius_m: required for {steering}"),
        (BASE + LINE.replace("/dev/ttyUSB0", "ttyUSB0"), "base.address: 'ttyUSB0' must be a ser"),
        (BASE + LINE.replace("/dev/ttyUSB0", "'tcp://robot'"), "tcp://HOST:PORT or udp://HOST:P"),
        (BASE + LINE.replace("/dev/ttyUSB0", "'udp://a:99999'"), "tcp://HOST:PORT or udp://HOST:P"),
        (BASE + LINE + "odometry: {line: '{x_m} {y_m}'}\n", "odometry.line: must have the numbers"),
        (BASE + LINE + "odometry: {line: '{left_m} {right_m}'}\n", "base.track_m: required for w"),
        (BASE.replace("source: 0", "source: [0]") + LINE, "camera.source"),
        (BASE.replace("source: 0", "source: 0, rotate: 45") + LINE, "camera.rotate: 45 must be 0"),
    ],
)  # fmt: skip
def test_config_is_refused_in_one_line_when_it_is_wrong(
    text: str, line: str, tmp_path: Path
) -> None:
    check_refusal(read_config, text, line, tmp_path)


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_template_reads_what_it_writes(x_m: float, y_m: float) -> None:
    template = Template('{"T":7,"x":{x_m*100:.3f},"y":{y_m:.5e}} *', ("x_m", "y_m"))
    values = template.read(template.write({"x_m": x_m, "y_m": y_m}).replace("*", "more {text}"))
    assert values is not None
    assert values["x_m"] == pytest.approx(x_m, abs=1e-4)
    assert values["y_m"] == pytest.approx(y_m, abs=1e-3)


def test_template_writes_no_exponent_by_default() -> None:
    assert Template("v {x_m}", ("x_m",)).write({"x_m": 5.55e-17}) == "v 0.000000"


@given(st.text(max_size=60))
def test_template_ignores_lines_of_another_form(line: str) -> None:
    values = Template("o {x_m} {y_m}", ("x_m", "y_m")).read(line)
    assert values is None or line.startswith("o ")


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (("--robot-body", "serial"), "--robot-body serial: requires --robot-config FILE"),
        (("--robot-config", "x.yaml"), "--robot-config: unsupported by --robot-body simulator"),
        (("--robot-body", "serial", "--robot-config", "x.yaml"), "x.yaml: no such file or direct"),
        (
            ("--robot-body", "seriel", "--robot-config", "x.yaml"),
            "unsupported by --robot-body seriel",
        ),
    ],
)
def test_up_reports_a_bad_config_before_it_starts(flags: tuple[str, ...], line: str) -> None:
    done = run_smal("up", *flags)
    assert done.returncode == 2
    assert line in done.stderr
    assert done.stderr.strip().count("\n") == 0
