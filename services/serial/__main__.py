"""Run a robot with a base without ROS: ``python -m services.serial --robot-config mine.yaml``."""

from contextlib import ExitStack, closing

from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.robot.pace import Paces
from services.robot.real import BaseSettings, RealView
from services.robot.service import ROBOT, serve_robot
from services.robot.task import OperatorsTask, Task
from services.serial.body import SerialBody
from services.serial.camera import VideoSource
from services.serial.config import read_config
from services.serial.link import LineLink
from services.serial.odometry import LineOdometry


def serve() -> None:
    """Drive until stopped."""
    settings = read_settings(BaseSettings, "serial")
    configure_logging(settings.log_level)
    config = read_config(settings.robot_config)
    with ExitStack() as stacked:

        def open_body(node: Node) -> tuple[SerialBody, Paces[RealView]]:
            node.log.info("%s at %s", config.name, config.base.address)
            odometer = LineOdometry(config)
            link = stacked.enter_context(closing(LineLink(config, odometer.take)))
            camera = stacked.enter_context(closing(VideoSource(config.camera)))
            return SerialBody(config, camera, odometer, link), {}

        task: Task[RealView] = OperatorsTask()
        serve_robot(settings, open_body, task)


if __name__ == "__main__":
    run_service(ROBOT, serve)
