"""Run a robot with a ROS 2 base: ``python -m services.ros2 --robot-config turtlebot4.yaml``."""

from services.kit.node import Node
from services.kit.process import configure_logging, read_settings, run_service
from services.robot.pace import Paces
from services.robot.real import BaseSettings, RealView
from services.robot.service import ROBOT, serve_robot
from services.robot.task import OperatorsTask, Task
from services.ros2.body import Ros2Body
from services.ros2.config import read_config
from services.ros2.senses import Senses
from services.ros2.session import Ros2Session


def serve() -> None:
    """Drive until stopped."""
    settings = read_settings(BaseSettings, "ros2")
    configure_logging(settings.log_level)
    config = read_config(settings.robot_config)

    def open_body(node: Node) -> tuple[Ros2Body, Paces[RealView]]:
        senses = Senses(config)
        session = Ros2Session(config, senses)
        node.log.info("%s at %s, in the dialect %s", config.name, config.router, config.dialect)
        return Ros2Body(config, senses, session), {}

    task: Task[RealView] = OperatorsTask()
    serve_robot(settings, open_body, task)


if __name__ == "__main__":
    run_service(ROBOT, serve)
