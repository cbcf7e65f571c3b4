import mujoco
import numpy as np
import pytest

from forgetmimic_jax.robot.model import VISUAL_GROUP
from forgetmimic_jax.viewing.offscreen import drawing_model
from forgetmimic_jax.viewing.shapes import UNIT_MESHES, shapes

# A shape at (1, 2, 3) of its body whose z axis is turned to the world's -y, and half its extent along x, y and z.
EXTENTS = {
    ("capsule", "0.1 0.2"): (0.1, 0.3, 0.1),
    ("cylinder", "0.1 0.2"): (0.1, 0.2, 0.1),
    ("box", "0.1 0.2 0.3"): (0.1, 0.3, 0.2),
    ("ellipsoid", "0.1 0.2 0.3"): (0.1, 0.3, 0.2),
    ("sphere", "0.1"): (0.1, 0.1, 0.1),
}


def vertices(model: mujoco.MjModel) -> np.ndarray:
    """The vertices [vertex, 3] of everything, in the world, at the model's first configuration."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points, rotation = [], np.empty(9)
    for kind, found in shapes(model).items():
        for position, quat, half in zip(*found.placed(data.xpos, data.xquat), found.half_size, strict=True):
            mujoco.mju_quat2Mat(rotation, quat)
            points.append(UNIT_MESHES[kind].vertices * half @ rotation.reshape(3, 3).T + position)
    return np.concatenate(points)


@pytest.mark.parametrize(("kind", "size"), EXTENTS)
def test_a_shape_has_its_size_place_and_colour(kind, size):
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="degree"/><worldbody><body pos="5 5 5">
        <geom type="{kind}" size="{size}" pos="1 2 3" euler="90 0 0" group="{VISUAL_GROUP}" rgba="1 0.5 0 1"/>
        <geom type="sphere" size="9" group="3"/></body></worldbody></mujoco>"""
    )
    for found in shapes(model).values():
        assert set(found.body) == {1}
        assert {tuple(colour) for colour in found.colour} == {(255, 128, 0)}
    low, high = vertices(model).min(0), vertices(model).max(0)
    # A round shape's facets stay a little inside it.
    np.testing.assert_allclose((low + high) / 2.0, [6.0, 7.0, 8.0], atol=5e-3)
    np.testing.assert_allclose((high - low) / 2.0, EXTENTS[kind, size], rtol=0.06)


def test_the_g1_is_as_tall_as_unitrees_and_stands_on_its_soles():
    model = drawing_model("g1", 16, 16)
    points = vertices(model)
    low, high = points.min(0), points.max(0)
    assert high[2] - low[2] == pytest.approx(1.32, abs=0.02)  # m, Unitree's data sheet
    assert low[2] == pytest.approx(0.0, abs=0.005)
    assert high[1] == pytest.approx(-low[1], abs=2e-3)
