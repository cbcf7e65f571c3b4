"""Faulty and foreign motion files, made from one clean clip: what users have, under the names of ../shared/cases."""

import pickle

import numpy as np
from orders import isaac_order
from scipy.spatial.transform import Rotation

ROOT = ["x", "y", "z", "qx", "qy", "qz", "qw"]
LESS = [
    "waist_roll",
    "waist_pitch",
    *(f"{side}_wrist_{axis}" for side in ("left", "right") for axis in ("pitch", "yaw")),
]


def clean_rows(clip):
    """CSV rows [frame, 36] of a clip: root position, quaternion xyzw, joints."""
    return np.concatenate([clip.root_pos, np.roll(clip.root_quat, -1, axis=-1), clip.joint_pos], axis=-1)


def write_all(folder, robot, clip):
    """Write every kind of file."""
    clean, half, names = clean_rows(clip), clip.num_frames // 2, list(robot.joint_names)
    column = {name: 7 + place for place, name in enumerate(names)}
    elbow, shoulder, hip = (column[f"left_{joint}_joint"] for joint in ("elbow", "shoulder_pitch", "hip_yaw"))
    order = [column[name] for name in isaac_order(robot)]

    def csv(name, rows, delimiter=",", header=()):
        path = folder / f"{name}.csv"
        np.savetxt(path, rows, delimiter=delimiter, fmt="%.6f", header=delimiter.join(header), comments="")

    def changed(name, rows, columns, change):
        copy = clean.copy()
        copy[rows, columns] = change(copy[rows, columns])
        csv(name, copy)

    every = slice(None)
    rise = np.linspace(0.0, 0.3, len(clean))
    csv("ok", clean)
    changed("floats_0.10", every, 2, lambda z: z + 0.10)
    changed("sinks_0.05", every, 2, lambda z: z - 0.05)
    changed("height_drifts_0.3", every, 2, lambda z: z + rise)
    changed("millimetres", every, slice(0, 3), lambda pos: 1000 * pos)
    changed("centimetres", every, slice(0, 3), lambda pos: 100 * pos)
    changed("degrees", every, slice(7, None), np.degrees)
    changed("quat_signs_flip", slice(None, None, 2), slice(3, 7), lambda quat: -quat)
    changed("quat_norm_1.03", every, slice(3, 7), lambda quat: 1.03 * quat)
    changed("teleports_1.5m", slice(half, None), 0, lambda x: x + 1.5)
    changed("elbow_spike_3_frames", slice(half, half + 3), elbow, lambda angle: angle + 1.0)
    changed("shoulder_wraps_2pi", slice(half, None), shoulder, lambda angle: angle + 2 * np.pi)
    changed("hip_yaw_plus_2pi", every, hip, lambda angle: angle + 2 * np.pi)
    changed("nan", half, 20, lambda angle: np.nan)
    changed("wxyz", every, slice(3, 7), lambda quat: np.roll(quat, 1, axis=1))
    glitch = clean.copy()
    glitch[0, 2] += 0.2
    glitch[0, 3:7] = 0.5
    glitch[0, 7:] = 0.3 * np.cos(np.arange(len(names)))
    csv("glitch_first_frame", glitch)
    y_up = clean.copy()
    y_up[:, :3] = clean[:, [0, 2, 1]] * [1, 1, -1]
    y_up[:, 3:7] = (Rotation.from_euler("x", -90, degrees=True) * Rotation.from_quat(clean[:, 3:7])).as_quat()
    csv("y_up", y_up)
    other = [column[name.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")] for name in names]
    csv("sides_swapped_without_signs", clean[:, [*range(7), *other]])
    csv("isaac_joint_order_no_names", clean[:, [*range(7), *order]])
    csv("isaac_joint_order_header", clean[:, [*range(7), *order]], header=[*ROOT, *isaac_order(robot)])
    csv("header", clean, header=[*ROOT, *names])
    counted = np.concatenate([np.arange(len(clean))[:, None], clean], axis=1)
    csv("frame_column", counted, header=["Frame", *ROOT, *names])
    csv("frame_column_without_names", counted)
    csv("23_joints", np.delete(clean, [column[f"{joint}_joint"] for joint in LESS], axis=1))
    csv("one_frame", clean[:1])
    csv("two_frames", clean[:2])
    csv("half_second", clean[: round(clip.fps / 2)])
    csv("semicolons", clean, delimiter=";")
    csv("tabs", clean, delimiter="\t")
    csv("spaces", clean, delimiter=" ")
    text = (folder / "ok.csv").read_text()
    (folder / "empty.csv").write_bytes(b"")
    (folder / "bom_crlf.csv").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    (folder / "trailing_comma.csv").write_text(text.replace("\n", ",\n"))
    (folder / "decimal_comma.csv").write_text(text.replace(",", ";").replace(".", ","))
    (folder / "utf16.csv").write_bytes(text.encode("utf-16"))
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:" + "0" * 64 + "\nsize 4194304\n"
    (folder / "git_lfs_pointer.npz").write_text(pointer)
    np.savez(
        folder / "names_as_objects.npz",
        fps=np.array([clip.fps]),
        joint_names=np.array(names, dtype=object),
        robot=np.array("g1", dtype=object),
        joint_pos=clean[:, 7:],
        joint_vel=np.gradient(clean[:, 7:], 1 / clip.fps, axis=0),
        body_pos_w=clean[:, None, :3],
        body_quat_w=np.roll(clean[:, None, 3:7], 1, axis=-1),
    )


def write_pickle(path, content):
    """A pickle, as careless projects write them."""
    path.write_bytes(pickle.dumps(content))
    return path
