"""The service with which people let a policy drive, or take the drive from it."""

from typing import Any

from rclpy.node import Node
from rclpy.service import Service
from std_srvs.srv import SetBool

from tractor_ems.decide import Decider
from tractor_ems.handover import Mode
from tractor_ems.nodes.policy_topics import CommandOutlet
from tractor_msgs_py import topics
from tractor_msgs_py.errors import PolicyError


def serve_enable(node: Node, decider: Decider, outlet: CommandOutlet) -> Service:
    """``~/enable``: true engages, false disengages; the response says what happens, or why not."""

    def enable(request: Any, response: Any) -> Any:
        try:
            response.message = _engage(decider, outlet) if request.data else _end(decider, outlet)
            response.success = True
        except PolicyError as error:
            response.success, response.message = False, f"refused: {error}"
        node.get_logger().info(f"enable {request.data}: {response.message}")
        return response

    return node.create_service(SetBool, "~/enable", enable)


def _engage(decider: Decider, outlet: CommandOutlet) -> str:
    others = outlet.others()
    if others and decider.mode is Mode.SHADOW:
        raise PolicyError(
            f"{others} other publishers on {topics.COMMAND.name}: {outlet.names_of_others()}; "
            "stop them first (a killed one counts for about 20 s)"
        )
    text = decider.engage()
    outlet.open()
    return text


def _end(decider: Decider, outlet: CommandOutlet) -> str:
    command, text = decider.disengage()
    outlet.say(command)
    return text
