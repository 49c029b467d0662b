"""The configuration of a base: every mistake is one clear line."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.kit.errors import UsageError
from services.robot.loop import STAND_WITHIN_S
from services.robot.real import known_presets
from services.ros2.config import PRESETS, read_config
from services.ros2.messages import Messages
from services.ros2.senses import Senses
from tests.command import run_smal
from tests.services.real_base import check_refusal


@pytest.mark.parametrize("preset", known_presets(PRESETS))
def test_preset_needs_only_the_watchdog(preset: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(f"preset: {preset}\n")
    with pytest.raises(
        UsageError, match=r"mine\.yaml: watchdog_s: required; give the seconds .* stops by itself"
    ):
        read_config(path)
    path.write_text(
        f"preset: {preset}\nwatchdog_s: 0.2\nnamespace: /robot1\ncamera: {{latency_s: 0.12}}\n"
    )
    config = read_config(path)
    assert config.watchdog_s + config.braking_s <= STAND_WITHIN_S
    assert config.camera.latency_s == 0.12
    listened = Senses(config).inputs
    assert listened
    for topic, heard in listened.items():
        assert topic.startswith("/robot1/")
        assert Messages(config.distribution).type_hash(heard.type_name).startswith("RIHS01_")


BASE = "preset: generic\nwatchdog_s: 0.2\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("preset: turtlebot5\n", "preset not found; available: donkeycar, generic, turtlebot3"),
        (BASE + "spede_m_s: 1\n", "spede_m_s: Extra inputs are not permitted"),
        ("watchdog_s: 0.2\n", "missing name, speed_m_s, turn_rate_rad_s, braking_s, camera; pre"),
        ("preset: generic\nwatchdog_s: 0.5\n", "the silence of this process is too large (0.70 s"),
        (BASE + "speed_m_s: fast\n", "speed_m_s: 'fast' must be a valid number"),
        (BASE + "speed_m_s: .nan\n", "speed_m_s: nan must be"),
        ("preset: generic\nwatchdog_s: .inf\n", "watchdog_s: inf must be a finite number"),
        (BASE + "camera: {topic: 'a b'}\n", "camera.topic: 'a b' must match pattern"),
        (BASE + "dialect: dds\n", "dialect: 'dds' must be 'rmw_zenoh' or 'zenoh-bridge-ros2dds'"),
        (BASE + "namespace: robot1\n", "namespace: 'robot1' must match pattern"),
        (BASE + "router: robot.local\n", "mine.yaml: invalid router address 'robot.local': exp"),
        (BASE + "scan: {topic: scan}\n", "scan.stop_m: Field required"),
        (BASE + "scan: {topic: a, stop_m: 0.2, blind_m: 0.3}\n", "scan: blind_m (0.3 m) must be"),
        (BASE + "stops: [{topic: bump, type: x}]\n", "stops.0.type: 'x' must be"),
        (BASE + "velocity: {wheelbase_m: 0.3}\n", "radius_m: required for AckermannDrive"),
        (
            BASE + "velocity: {type: ackermann_msgs/msg/AckermannDrive}\n",
            "velocity: wheelbase_m is required for AckermannDrive",
        ),
        ("- a\n", "expected settings such as `preset: turtlebot4`"),
        ("", "expected settings such as"),
        ("a: [\n", "invalid YAML in line"),
        ("!!python/object/apply:os.system ['true']\n", "invalid YAML"),
        ("[" * 1500, "invalid YAML"),
        ("a: " + "x" * 70000, "too large for a configuration (maximum 65536 bytes)"),
    ],
)
def test_config_is_refused_in_one_line_when_it_is_wrong(
    text: str, line: str, tmp_path: Path
) -> None:
    check_refusal(read_config, text, line, tmp_path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=60))
def test_config_is_refused_in_one_line_when_it_is_any_bytes(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(data)
    with pytest.raises(UsageError) as caught:
        read_config(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (("--robot-body", "x.yaml"), "x.yaml: no such file or directory"),
        (("--robot-body", "none", "--model", "x.smal"), "x.smal"),
    ],
)
def test_up_reports_a_bad_config_before_it_starts(flags: tuple[str, ...], line: str) -> None:
    done = run_smal("up", *flags)
    assert done.returncode == 2
    assert line in done.stderr
    assert done.stderr.strip().count("\n") == 0
