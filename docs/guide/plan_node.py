"""ROS 2 node: plan motions of an arm to goal poses, and publish them as trajectories."""

from functools import partial
from typing import Any

import rclpy
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from models import FixedBase, Robot
from ocp import Cost, Goal, Limits, Plan, ProblemError, SolveError, plan

LIMITS = Limits(acceleration=3.0, jerk=40.0)  # rad/s^2, rad/s^3: those of your robot
PERIOD, TIME_LIMIT = 0.02, 20.0  # s: between two points, and of the planning


def trajectory_message(result: Plan) -> Any:
    fields, points = result.to_ros(PERIOD), []
    for point in fields["points"]:
        time = Duration(**point.pop("time_from_start"))
        points.append(JointTrajectoryPoint(**point, time_from_start=time))
    return JointTrajectory(joint_names=fields["joint_names"], points=points)


def serve(node: Any, machine: FixedBase) -> None:
    received: dict[str, Any] = {}  # the last message of each topic
    publisher = node.create_publisher(JointTrajectory, "joint_trajectory", 1)

    def plan_to_goal(request: Any, response: Any) -> Any:
        try:
            state, goal = received["joint_states"], received["goal_pose"]
            if goal.header.frame_id != machine.robot.root:
                raise ProblemError(f"the goal is not in frame {machine.robot.root}")
            measured = dict(zip(state.name, state.position, strict=True))
            start = [measured[name] for name in machine.robot.joint_names]
            p, o = goal.pose.position, goal.pose.orientation
            target = Goal(position=(p.x, p.y, p.z), orientation=(o.w, o.x, o.y, o.z))
            cost = Cost(velocity=0, time=1)  # least time, rest to rest
            options: Any = {"limits": LIMITS, "cost": cost, "time_limit": TIME_LIMIT}
            result = plan(machine, target, start=start, **options)
            publisher.publish(trajectory_message(result))
            response.success, response.message = True, result.audit().sentence
        except KeyError as missing:
            response.success, response.message = False, f"not received: {missing}"
        except (ProblemError, SolveError) as error:
            response.success, response.message = False, str(error)
        return response

    for kind, topic in ((JointState, "joint_states"), (PoseStamped, "goal_pose")):
        node.create_subscription(kind, topic, partial(received.__setitem__, topic), 1)
    node.create_service(Trigger, "plan", plan_to_goal)


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("selfmotion")
    urdf = node.declare_parameter("urdf", "arm.urdf").value
    tip = node.declare_parameter("tip", "tool0").value
    serve(node, FixedBase(Robot.from_urdf(urdf, tip=tip)))
    rclpy.spin(node)


if __name__ == "__main__":
    main()
