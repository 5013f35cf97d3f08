"""Poses as messages, and the axes of map and odom.

``map`` and ``odom`` are z-up (REP-103: x forward, y left, z up) with the first camera taken as
level. Inside Python every world has the axes of its first camera (OpenCV: x right, y down, z
forward), and T_ZUP_OPTICAL leads from these to those: ``T_map_cam = T_ZUP_OPTICAL @ T_world_cam``.
The camera's own frame stays optical. Functions of this file convert transforms as they are given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np
import torch
from geometry_msgs.msg import (Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped,
                               Vector3)
from nav_msgs.msg import Odometry, Path
from scipy.spatial.transform import Rotation
from torch import Tensor

from .errors import MessageError
from .stamps import header

T_ZUP_OPTICAL = torch.tensor([[0.0, 0.0, 1.0, 0.0],
                              [-1.0, 0.0, 0.0, 0.0],
                              [0.0, -1.0, 0.0, 0.0],
                              [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
_MIN_LENGTH = 1e-6   # a shorter quaternion has no direction left, least of all in float32


@dataclass(frozen=True)
class PoseParts:
    """N Sim(3) transforms taken apart, float64.

    translation: [N,3]. quaternion: [N,4], x y z w of length 1 with w >= 0. scale: [N].
    """

    translation: np.ndarray
    quaternion: np.ndarray
    scale: np.ndarray


def split(Ts: Any) -> PoseParts:
    """Transforms [N,4,4] (array or tensor) to their parts; raises MessageError."""
    matrices = np.asarray(Ts, np.float64).reshape(-1, 4, 4)
    linear = matrices[:, :3, :3]
    if not np.isfinite(matrices).all() or not (np.linalg.det(linear) > 0).all():
        raise MessageError('a pose to be sent is not finite or not a rotation with a positive '
                           'scale: this is an error of the sender')
    scale = np.sqrt(np.square(linear).sum((1, 2)) / 3.0)
    rotation = Rotation.from_matrix(linear / scale[:, None, None])
    return PoseParts(matrices[:, :3, 3], rotation.as_quat(canonical=True), scale)


def join(parts: PoseParts, what: str = 'a pose') -> Tensor:
    """The inverse of split: [N,4,4] float64. Quaternions may have any length but 0.

    Raises MessageError, which begins with ``what``, for numbers that are no transform.
    """
    values = (parts.translation, parts.quaternion, parts.scale)
    if not all(np.isfinite(v).all() for v in values):
        raise MessageError(f'{what} holds values that are not finite')
    if (np.linalg.norm(parts.quaternion, axis=1) < _MIN_LENGTH).any():
        raise MessageError(f'{what} has a quaternion of length 0, which is no rotation')
    if (parts.scale <= 0).any():
        raise MessageError(f'{what} has a scale of {parts.scale.min():g}, but it must be positive')
    matrices = np.tile(np.eye(4), (len(parts.scale), 1, 1))
    if len(matrices):
        rotation = Rotation.from_quat(parts.quaternion).as_matrix()
        matrices[:, :3, :3] = parts.scale[:, None, None] * rotation
        matrices[:, :3, 3] = parts.translation
    return torch.from_numpy(matrices)


def _pose(translation: np.ndarray, quaternion: np.ndarray) -> Pose:
    x, y, z = translation.tolist()
    qx, qy, qz, qw = quaternion.tolist()
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_msg(T: Tensor) -> Pose:
    """T: [4,4]. A message's pose is rigid: a scale is dropped."""
    parts = split(T)
    return _pose(parts.translation[0], parts.quaternion[0])


def matrix(pose: Any) -> Tensor:
    """Rigid [4,4] float64 of a Pose; raises MessageError for NaN or a quaternion of length 0."""
    p, q = pose.position, pose.orientation
    return join(PoseParts(np.array([[p.x, p.y, p.z]]), np.array([[q.x, q.y, q.z, q.w]]),
                          np.ones(1)))[0]


def pose_stamped(T: Tensor, stamp_ns: int, frame_id: str) -> PoseStamped:
    return PoseStamped(header=header(stamp_ns, frame_id), pose=pose_msg(T))


def odometry(T: Tensor, stamp_ns: int, frame_id: str, child_frame_id: str) -> Odometry:
    """Covariances and the twist stay 0: they are not estimated."""
    msg = Odometry(header=header(stamp_ns, frame_id), child_frame_id=child_frame_id)
    msg.pose.pose = pose_msg(T)
    return msg


def transform(T: Tensor, stamp_ns: int, parent: str, child: str) -> TransformStamped:
    """T_parent_child for TF, which is rigid: a scale is dropped."""
    pose = pose_msg(T)
    p = pose.position
    return TransformStamped(
        header=header(stamp_ns, parent), child_frame_id=child,
        transform=Transform(translation=Vector3(x=p.x, y=p.y, z=p.z), rotation=pose.orientation))


def path(stamps_ns: Sequence[int] | np.ndarray, Ts: Any, frame_id: str) -> Path:
    """A trajectory: stamps [N] and transforms [N,4,4] (or a sequence of [4,4]).

    The stamp of the whole is its last one.
    """
    matrices = [np.asarray(T, np.float64) for T in Ts]
    parts = split(np.stack(matrices) if matrices else np.empty((0, 4, 4)))
    headers = [header(int(ns), frame_id) for ns in stamps_ns]
    poses = [PoseStamped(header=h, pose=_pose(t, q))
             for h, t, q in zip(headers, parts.translation, parts.quaternion, strict=True)]
    return Path(header=headers[-1] if headers else header(0, frame_id), poses=poses)
