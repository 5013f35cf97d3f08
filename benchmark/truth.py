"""Do a recording's images agree with its true depth and poses? What SLAM cannot get below.

    .venv/bin/python benchmark/truth.py --out FOLDER --data DATA

Points of an image with true depth are put into a later one by the true poses and found there by
optical flow; then the later camera is moved to where it explains them best. The medians of what is
left over all pairs of images, and the median of how far the camera moved. In a rendered scene both
agree; in a recording what is left at the true pose is calibration, time stamps and the truth's own
error. One figure a line; adds to benchmark.json.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from figures import Figures, add, parser, said
from torch import Tensor

from aim_slam_ros.config import Config
from aim_slam_ros.datasets import load_sequence
from aim_slam_ros.datasets.base import Sequence
from aim_slam_ros.frontend.admission import Admission
from aim_slam_ros.frontend.landmarks import LandmarkCache, matched_grid
from aim_slam_ros.frontend.matching import predict_matches
from aim_slam_ros.geometry import camera, sim3
from aim_slam_ros.models.simulated.levels import PRESETS
from aim_slam_ros.models.simulated.model import SimulatedModel
from aim_slam_ros.recorded_truth import RecordedTruth, pose_at
from aim_slam_ros.registration.rigid import solve_rigid
from aim_slam_ros.types import Frame, FrameEncoding, Keyframe

SEQUENCES = ('tum_fr1_xyz', 'redkitchen_600')
APART = 3           # images with depth between the two of a pair: half a second on the recordings
FEWEST = 60         # matches of a pair that counts
RENDERED_STEP = 5   # every so many images of the rendered room


def main() -> int:
    arguments = parser(__doc__)
    arguments.add_argument('--data', type=Path, help='folder with ' + ', '.join(SEQUENCES))
    arguments.add_argument('--undistort', action='store_true', help='take lens distortion out')
    args = arguments.parse_args()
    figures = said(_agreement('rendered_room', load_sequence('rendered:room'), RENDERED_STEP))
    for name in SEQUENCES if args.data else ():
        if (args.data / name).exists():
            sequence = load_sequence(args.data / name, undistort=args.undistort)
            figures |= said(_agreement(name, sequence, 1))
    args.out.mkdir(parents=True, exist_ok=True)
    add(args.out, figures)
    return 0


def _agreement(name: str, sequence: Sequence, step: int) -> Figures:
    truth, config = RecordedTruth(sequence), Config()
    model = SimulatedModel(truth, PRESETS['none'])
    landmarks, admission = matched_grid(config.tracking.stride), Admission(config.camera)
    views: list[Keyframe] = []
    for i in truth.with_depth(range(0, len(sequence), step)):
        frame = admission.admit(int(sequence.stamps_ns[i]), sequence.image(i), None)
        if isinstance(frame, Frame):
            views.append(_view(len(views), model, model.encode(frame), sequence))
    pairs = [pair for a, b in zip(views, views[APART:])
             if (pair := _pair(a, b, landmarks, config)) is not None]
    at_truth, at_best, moved = np.array(pairs).T
    return {f'{name}_px_at_true_poses': float(np.median(at_truth)),
            f'{name}_px_at_best_poses': float(np.median(at_best)),
            f'{name}_best_from_true_m': float(np.median(moved)),
            f'{name}_pairs': float(len(pairs))}


def _view(keyframe_id: int, model: SimulatedModel, encoding: FrameEncoding,
          sequence: Sequence) -> Keyframe:
    """The image with its true depth at its true pose, in metres."""
    seen = model.infer([encoding])
    assert sequence.groundtruth is not None
    T_world_cam = pose_at(sequence.groundtruth, encoding.frame.stamp_ns)
    assert T_world_cam is not None
    points = camera.unproject(seen.depth[0], seen.K[0])
    return Keyframe(keyframe_id, 0, encoding, seen.K[0], points, seen.confidence[0],
                    T_world_cam)


def _pair(old: Keyframe, new: Keyframe, landmarks: LandmarkCache,
          config: Config) -> tuple[float, float, float] | None:
    """Median distance [px] at the true pose and at the best, and the way between [m]."""
    matches = predict_matches([old], landmarks, new.frame.grey, new.K, new.T_world_kf,
                              config.following.sigma_depth)
    if len(matches.uv) < FEWEST:
        return None
    T_cam_world = sim3.inverse(new.T_world_kf)
    best = solve_rigid(matches.points_world, matches.uv, new.K, T_cam_world, matches.spread_world,
                       config.tracking.sigma_px)
    moved = float((sim3.inverse(best.T_cam_ref) - new.T_world_kf)[:3, 3].norm())
    return (_median_px(matches.points_world, matches.uv, new, T_cam_world),
            _median_px(matches.points_world, matches.uv, new, best.T_cam_ref), moved)


def _median_px(points_world: np.ndarray, uv: np.ndarray, view: Keyframe,
               T_cam_world: Tensor) -> float:
    points_cam = sim3.transform(T_cam_world, torch.from_numpy(points_world))
    projected = camera.project(points_cam, view.K).numpy()
    return float(np.nanmedian(np.linalg.norm(projected - uv, axis=1)))


if __name__ == '__main__':
    raise SystemExit(main())
