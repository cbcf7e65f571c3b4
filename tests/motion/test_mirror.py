import numpy as np
import pytest

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import body_motion, configuration
from forgetmimic_jax.motion.mirror import mirrored


@pytest.fixture
def clip(robot) -> Clip:
    """Ten frames of a robot in any pose."""
    rng = np.random.default_rng(0)
    quat = rng.standard_normal((10, 4))
    return Clip(
        name="any",
        fps=50.0,
        joint_names=robot.joint_names,
        root_pos=rng.standard_normal((10, 3)),
        root_quat=quat / np.linalg.norm(quat, axis=-1, keepdims=True),
        joint_pos=rng.uniform(-0.5, 0.5, (10, robot.num_joints)),
    )


def test_every_body_is_where_its_other_side_was_reflected(robot, clip):
    model = robot.model
    names = [model.body(body).name for body in range(1, model.nbody)]
    ids = np.array([model.body(name).id for name in names])
    before, after = (body_motion(model, configuration(c, robot), 50.0, ids).pos for c in (clip, mirrored(robot, clip)))
    swap = {"left": "right", "right": "left"}
    for place, name in enumerate(names):
        side, _, rest = name.partition("_")
        other = names.index(f"{swap[side]}_{rest}") if side in swap else place
        # Unitree's torso sits a fraction of a millimetre off the plane of symmetry.
        np.testing.assert_allclose(after[:, place], before[:, other] * [1.0, -1.0, 1.0], atol=2e-3, err_msg=name)


def test_the_image_of_the_image_is_the_clip(robot, clip):
    twice = mirrored(robot, mirrored(robot, clip))
    assert twice.name == "any_mirrored_mirrored"
    for field in ("root_pos", "root_quat", "joint_pos"):
        np.testing.assert_array_equal(getattr(twice, field), getattr(clip, field))
