"""Every setting, its default, its range and its meaning: the only place they are written.

Sections are frozen dataclasses and are handed, one by one, to the code that needs them. A wrong
name or value raises ConfigError with the allowed range, before any work starts.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from typing import Any, Mapping

import yaml

from .settings import ConfigError, Section, checked, parsed, setting


@dataclass(frozen=True)
class CameraConfig(Section):
    width: int = setting(
        518, 'width of the image the model sees [px]', 84, 1036, multiple_of=14)
    use_calibration: bool = setting(
        False, "take the dataset's or camera_info's intrinsics instead of estimating them")
    fov_deg: float = setting(
        60.0, 'horizontal field of view assumed where nothing better is known [deg]', 20, 140)
    min_side: int = setting(
        32, 'a smaller image than this is skipped [px]', 8, 1000)
    min_contrast: float = setting(
        2.0, 'an image whose grey values have a smaller standard deviation is skipped', 0, 100)


@dataclass(frozen=True)
class ModelConfig(Section):
    name: str = setting(
        'classical', 'the geometry model; simulated answers from recorded depth and poses, with '
        'the errors of simulated.preset, and only in evaluate',
        choices=('classical', 'vggt', 'simulated'))
    weights: str = setting('', 'the file with the weights of vggt, or its folder')
    device: str = setting(
        'auto', 'where vggt runs: auto (the GPU where there is one), cpu, cuda or cuda:N')
    infer: str = setting(
        'on_demand', 'when the model is asked: where it pays, or for every image as in the paper',
        choices=('on_demand', 'every_image'))
    min_inference_s: float = setting(
        0.0, 'an inference is made to last at least so long: to spare a shared GPU, or to try '
        'what a slower model would do [s]', 0, 60)


@dataclass(frozen=True)
class ClassicalConfig(Section):
    features: int = setting(800, 'SIFT features per frame, at half resolution', 50, 10000)
    ratio: float = setting(0.9, 'ratio test between best and second-best match', 0.1, 1)
    min_matches: int = setting(24, 'fewer matches than this leave a view unconnected', 8, 1000)
    rotation_gate_px: float = setting(
        6.0, 'median residual of a pure rotation below which there is no parallax '
        '[px at a width of 518]', 0, 100)
    planes: int = setting(48, 'inverse-depth planes of the sweep', 8, 256)


@dataclass(frozen=True)
class VggtConfig(Section):
    precision: str = setting(
        'auto', 'what its transformer multiplies in; auto is bfloat16 on a GPU that has it and '
        'float32 elsewhere. The heads are always float32',
        choices=('auto', 'float32', 'bfloat16'))
    compile: bool = setting(
        False, 'torch.compile: the first inferences take minutes, later ones less time')
    cached_frames: int = setting(
        64, 'images whose tokens are kept, 8.5 to 12.8 MB each at a width of 518', 1, 100000)


@dataclass(frozen=True)
class SimulatedConfig(Section):
    preset: str = setting(
        'vggt', 'errors of the simulated model: those of a foundation model, half, twice as '
        'large, or with the same depth warp in all inferences of an image; none leaves those of '
        'the recording itself',
        choices=('vggt', 'mild', 'harsh', 'correlated', 'none'))


@dataclass(frozen=True)
class SigmaConfig(Section):
    """Choice of the window's keyframes (SIGMA)."""

    prioritiser: str = setting(
        'information', 'which keyframes join first: those that see the same, by how much they '
        'inform about it (SIGMA), or the newest (for comparison)',
        choices=('information', 'recency'))
    voxel_fraction: float = setting(
        0.06, "voxel size as a fraction of the first keyframe's median depth", 0.005, 1)
    voxel_quantile: float = setting(
        0.1, 'this share of a keyframe, its least confident points, is not indexed', 0, 0.95)
    stride: int = setting(
        4, 'every so many pixels of a keyframe are indexed and ranked', 1, 64)
    candidates: int = setting(10, 'keyframes kept by voxel overlap for the ranking', 1, 100)
    points: int = setting(
        1000, 'least confident points of the last keyframe that the gain is computed on', 10,
        100000)
    sigma_px: float = setting(1.0, 'noise of a pixel [px]', 0.01, 100)
    sigma_depth: float = setting(
        0.05, 'relative noise of the depth at the median confidence', 1e-4, 1)
    sigma_ray: float = setting(
        1e-3, 'isotropic noise added to a measured ray [rad]', 1e-6, 0.1)
    depth_tolerance: float = setting(
        0.15, 'relative depth difference above which a candidate does not see a point', 0.001, 1)
    kappa: float = setting(
        1.0, 'reduced chi-square above which another keyframe joins the window', 0)
    min_window: int = setting(
        3, 'views that a window starts from, the current frame included', 2, 20)
    max_window: int = setting(
        5, 'views that a window has at most, however many it starts from', 2, 20)


@dataclass(frozen=True)
class JointTrackingConfig(Section):
    """The paper's joint solve (``tracker: paper``)."""

    residual: str = setting(
        'hybrid', 'what is compared besides log-distances',
        choices=('ray', 'projection', 'hybrid'))
    pairs: str = setting(
        'composed', 'neighbouring views only, or also those with one view between them',
        choices=('adjacent', 'composed'))
    stride: int = setting(4, 'every so many pixels of a view are matched', 1, 64)
    sigma_ray: float = setting(0.003, 'noise of a ray [rad]', 1e-6, 1)
    sigma_pixel: float = setting(1.0, 'noise of a projection [px]', 0.01, 100)
    sigma_log_distance: float = setting(0.05, 'noise of a log-distance', 1e-4, 10)
    huber: float = setting(1.345, 'whitened residual where Huber turns linear', 0.1, 100)
    max_iterations: int = setting(15, 'Levenberg-Marquardt steps per stage', 1, 200)
    relative_decrease: float = setting(
        1e-3, 'a step that lowers the cost by a smaller share ends a stage', 1e-12, 0.1)
    depth_tolerance: float = setting(
        0.15, 'relative distance difference above which a match is an occlusion', 0.001, 1)
    confidence_quantile: float = setting(
        0.1, 'this share of a view, its least confident points, is not matched', 0, 0.95)
    min_match_fraction: float = setting(
        0.05, 'a pair of views that shares less is not used', 0, 1)
    memory: float = setting(
        1.0, 'weight of the earlier observations of a keyframe pair: 0 overwrites its relative '
        'pose, 1 moves it by 1/(n+1) after n of them', 0, 100)


@dataclass(frozen=True)
class LoopClosureConfig(Section):
    """Retrieval, verification, pose graph and the fused map."""

    enabled: bool = setting(True, 'look for loops; otherwise only collect and fuse keyframes')
    candidates: int = setting(2, 'most similar keyframes that are verified', 1, 10)
    min_gap: int = setting(
        8, 'keyframes nearer in time than this many are no candidates; a longer edge of the '
        'frontend is trusted no more than a loop', 1, 1000)
    covisible_hops: int = setting(
        2, 'keyframes within this many edges are no candidates', 0, 10)
    similarity: float = setting(
        0.5, 'least similarity of a candidate: 0 is the median over all keyframes, 1 the best of '
        "the keyframe's neighbours", 0, 1)
    min_matched: float = setting(
        0.15, "fraction of a keyframe's textured points around which the other must look the "
        'same, in both directions', 0, 1)
    max_kappa: float = setting(2.0, 'largest reduced chi-square of a verified loop', 0.1, 1000)
    max_disagreement: float = setting(
        0.08, 'largest difference between the two directions of a loop, relative to the median '
        'depth for translations and natural (rad, log-scale) for the rest', 0.001, 1)
    max_depth_spread: float = setting(
        0.25, 'largest robust deviation of the log depth ratios between matched points', 0.01, 2)
    cauchy_width: float = setting(
        3.0, 'whitened residual at which a loop edge has lost half its weight', 0.1, 100)
    map_voxel: float = setting(
        0.01, "voxel of the fused map, as a fraction of the keyframes' median depth", 0.001, 0.2)
    map_percentile: float = setting(
        40.0, 'the least confident part of each keyframe that the map leaves out [%]', 0, 99)


@dataclass(frozen=True)
class FollowingConfig(Section):
    points: int = setting(250, 'corners of a keyframe that are followed', 50, 5000)
    spacing_px: int = setting(9, 'smallest distance between two of them [px]', 2, 50)
    references: int = setting(3, 'keyframes an image is followed against', 1, 10)
    sigma_px: float = setting(0.6, 'standard deviation of a followed point [px]', 0.05, 10)
    sigma_depth: float = setting(
        0.03, "relative standard deviation of a keyframe's depth at its mean confidence",
        0.001, 0.5)
    min_inliers: int = setting(30, 'fewer explained points than this are no pose', 6, 1000)
    min_inlier_ratio: float = setting(
        0.4, 'smallest share of the found points that the pose must explain', 0.05, 1)


@dataclass(frozen=True)
class TrackingConfig(Section):
    tracker: str = setting(
        'image', "refine matches in the images, or the paper's joint Sim(3) solve",
        choices=('image', 'paper'))
    stride: int = setting(
        24, 'side of the squares of a keyframe of each of which a point is matched [px at a width '
        'of 518]', 1, 64)
    sigma_px: float = setting(
        1.0, 'standard deviation of a refined match [px]', 0.05, 10)
    sigma_model_px: float = setting(
        4.5, "standard deviation of a match at the pose that the model's window gives the image; "
        'kappa is in its unit (calibrate finds it) [px]', 0.05, 100)
    min_matches: int = setting(40, 'fewer refined matches than this: keep the pose mean',
                               10, 100000)
    max_stray: float = setting(
        0.15, 'how far the solve may move the camera from its start, relative to the median '
        'depth, before the start is kept instead', 0.01, 10)


@dataclass(frozen=True)
class KeyframesConfig(Section):
    promote_below: float = setting(
        0.5, 'an image that still sees a smaller share of its reference keyframe is promoted',
        0.05, 0.95)
    reuse_above: float = setting(
        0.6, 'an older keyframe of which the image sees at least this share is taken as reference '
        'instead of making a new one; 1 never reuses', 0.1, 1)
    min_confident: float = setting(
        0.15, 'smallest share of pixels with a measured depth for a prediction to be used', 0, 1)
    long_edge: int = setting(
        8, 'a pose-graph edge over more keyframes than this is measured between its two ends '
        "alone: the map's poses would repeat the drift between them", 1, 100000)
    max_fuse_spread: float = setting(
        0.15, 'a prediction whose log depth ratios to the keyframe scatter more is not fused',
        0.01, 2)
    shared_focal: bool = setting(
        True, 'all images of a camera share one focal length, the mean of what the model says of '
        'each; otherwise every keyframe averages its own, as in the paper')
    device: str = setting(
        'cpu', 'where pointmaps are kept, ranked, matched and fused: cpu, auto (the GPU where '
        'there is one), cuda or cuda:N. On a GPU a keyframe takes 3.2 MB of its memory')
    fuse: bool = setting(
        True, "average a keyframe's pointmap and focal length with what later inferences say")


@dataclass(frozen=True)
class InitialisationConfig(Section):
    min_parallax_px: float = setting(
        6.0, 'parallax awaited by a model that needs two views [px at a width of 518]', 0.5, 200)
    max_frames: int = setting(
        60, 'after so many images the map is begun without parallax', 2, 10000)


@dataclass(frozen=True)
class RelocalisationConfig(Section):
    candidates: int = setting(3, 'keyframes retrieved for a lost image', 1, 20)
    min_matched_fraction: float = setting(
        0.3, 'smallest matched fraction that ends a loss', 0.05, 1)
    give_up_after: int = setting(
        45, 'after so many lost images a new map piece is begun', 1, 100000)


@dataclass(frozen=True)
class Config:
    """All sections. ``seed`` fixes every random choice."""

    seed: int = setting(0, 'seed of every random choice', 0, 2**31 - 1)
    camera: CameraConfig = CameraConfig()
    model: ModelConfig = ModelConfig()
    classical: ClassicalConfig = ClassicalConfig()
    vggt: VggtConfig = VggtConfig()
    simulated: SimulatedConfig = SimulatedConfig()
    following: FollowingConfig = FollowingConfig()
    tracking: TrackingConfig = TrackingConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    initialisation: InitialisationConfig = InitialisationConfig()
    relocalisation: RelocalisationConfig = RelocalisationConfig()
    sigma: SigmaConfig = SigmaConfig()
    joint_tracking: JointTrackingConfig = JointTrackingConfig()
    loop_closure: LoopClosureConfig = LoopClosureConfig()

    def with_values(self, values: Mapping[str, str]) -> Config:
        """A copy with settings replaced, ``{'section.name': 'text'}``; raises ConfigError."""
        config = self
        for name, text in values.items():
            config = config._with(name, parsed(name, text))
        return config

    def _with(self, name: str, value: Any) -> Config:
        section_name, _, field_name = name.rpartition('.')
        section: Any = getattr(self, section_name, None) if section_name else self
        specs = {f.name: f for f in dataclasses.fields(section)} if section is not None and \
            dataclasses.is_dataclass(section) else {}
        spec = specs.get(field_name)
        if spec is None or not spec.metadata:
            raise ConfigError(f'{name}: there is no such setting{self._nearest(name)}')
        new = dataclasses.replace(section, **{field_name: checked(name, spec, value)})
        changed: dict[str, Any] = {section_name: new}
        return dataclasses.replace(self, **changed) if section_name else new

    def settings(self) -> dict[str, dataclasses.Field[Any]]:
        """Every setting by its full name."""
        out: dict[str, dataclasses.Field[Any]] = {}
        for spec in dataclasses.fields(self):
            value = getattr(self, spec.name)
            if dataclasses.is_dataclass(value):
                out |= {f'{spec.name}.{f.name}': f for f in dataclasses.fields(value)}
            else:
                out[spec.name] = spec
        return out

    def _nearest(self, name: str) -> str:
        near = difflib.get_close_matches(name, list(self.settings()), n=3, cutoff=0.4)
        return f'; did you mean {" or ".join(near)}?' if near else ''

    def to_yaml(self) -> str:
        """The resolved configuration, written beside every result."""
        return yaml.safe_dump(dataclasses.asdict(self), sort_keys=False)
