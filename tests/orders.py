"""The order of the G1's joints in Isaac Lab's projects, breadth first, from their own deploy.yaml (`joint_ids_map`)."""

from forgetmimic_jax.robot.model import Robot

ISAAC = [
    *(0, 6, 12, 1, 7, 13, 2, 8, 14, 3, 9, 15, 22, 4, 10, 16, 23, 5, 11, 17, 24),
    *(18, 25, 19, 26, 20, 27, 21, 28),
]


def isaac_order(robot: Robot) -> tuple[str, ...]:
    """Names of the G1's joints in Isaac Lab's order."""
    return tuple(robot.joint_names[joint] for joint in ISAAC)
