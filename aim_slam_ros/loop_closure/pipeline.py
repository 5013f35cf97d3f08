"""Loop closure as in the paper: retrieve, verify, add edges, optimise."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Mapping

from torch import Tensor

from ..config import Config
from ..geometry import sim3
from ..models.base import GeometryModel
from ..types import Cloud, CorrectedKeyframes, KeyframeEvent, KeyframePose, PoseEdge
from .fused_map import FusedMap
from .pose_graph import PoseGraph
from .retrieval import Retrieval
from .verification import LoopVerifier


@dataclass(frozen=True)
class AcceptedLoop:
    """A verified loop.

    T_older_newer: [4,4] float64 Sim(3) between the keyframes' pointmaps. sigma: [7], as PoseEdge
    has it. matched_fraction, kappa: as Verification has them.
    """

    newer: int
    older: int
    T_older_newer: Tensor
    sigma: Tensor
    matched_fraction: float
    kappa: float


class LoopClosurePipeline:
    """Takes keyframe events, gives corrected keyframes and the fused map."""

    def __init__(self, config: Config, model: GeometryModel) -> None:
        self._config = config.loop_closure
        self._retrieval = Retrieval(self._config)
        self._verifier = LoopVerifier(self._config, model)
        self._graph = PoseGraph(self._config.cauchy_width)
        self._map = FusedMap(self._config)
        self._events: dict[int, KeyframeEvent] = {}
        self._piece_ids: dict[int, int] = {}
        self._observations: dict[int, int] = {}
        self._waiting: list[PoseEdge] = []
        self._loops: list[AcceptedLoop] = []
        self._rejected: Counter[str] = Counter()
        self._version = 0

    def add(self, event: KeyframeEvent) -> CorrectedKeyframes | None:
        """Take a keyframe in; all corrected poses if it saw an old place again, else None.

        A keyframe that is known already changes nothing where the frontend was asked to resend it;
        with more observations than before, its cloud in the map becomes the better one.
        Raises PoseGraphError or RetrievalError for an event with unusable numbers.
        """
        if not self.wants(event):
            return None
        if event.keyframe_id in self._graph:
            self._show(event)
            return None
        self._insert(event)
        self._show(event)
        if self._config.enabled:
            self._events[event.keyframe_id] = event
        again = self._add_edges(event)
        if not self._config.enabled:
            return None
        candidates = self._retrieve(event)
        loops = [loop for older in candidates if (loop := self._verify(event, older)) is not None]
        self._close(loops)
        return self._optimise() if loops or again else None

    def wants(self, event: KeyframeEvent) -> bool:
        """Whether the keyframe is new, or known better than when it came."""
        return event.observations > self._observations.get(event.keyframe_id, 0)

    @property
    def loops(self) -> tuple[AcceptedLoop, ...]:
        """In the order they were accepted."""
        return tuple(self._loops)

    @property
    def rejected(self) -> Mapping[str, int]:
        """How many candidates failed their verification, by reason."""
        return dict(self._rejected)

    @property
    def poses(self) -> tuple[KeyframePose, ...]:
        """Every keyframe in the corrected world."""
        return tuple(KeyframePose(k, T) for k, T in self._graph.poses().items())

    @property
    def pieces(self) -> Mapping[int, int]:
        """The map piece of every keyframe; joined ones carry the id of the oldest keyframe's."""
        return {k: self._piece_ids[root] for k, root in self._graph.components.items()}

    @property
    def largest_piece(self) -> int | None:
        """The piece with most keyframes; None before the first."""
        most = Counter(self.pieces.values()).most_common(1)
        return most[0][0] if most else None

    @property
    def version(self) -> int:
        """How many corrections there have been."""
        return self._version

    @property
    def edges(self) -> tuple[tuple[int, int], ...]:
        """The pairs of keyframes that the frontend measured, loops left out."""
        loops = {(loop.older, loop.newer) for loop in self._loops}
        return tuple(edge for edge in self._graph.edges if edge not in loops)

    def fused_map(self, piece_id: int | None = None) -> Cloud:
        """A map piece's cloud, in its world's unit; by default that with most keyframes.

        Unconnected pieces have no common world.
        """
        pieces = self.pieces
        if piece_id is None:
            piece_id = self.largest_piece
        return self._map.fuse({k: T for k, T in self._graph.poses().items()
                               if pieces[k] == piece_id})

    def _show(self, event: KeyframeEvent) -> None:
        self._observations[event.keyframe_id] = event.observations
        self._map.add(event)

    def _insert(self, event: KeyframeEvent) -> None:
        # Once the graph has been corrected, its world is not the one the frontend was in when it
        # made this event; the measured edges hold in both.
        chained = self._graph.chained(event.keyframe_id, event.edges) if self._version else None
        T_world_kf = event.T_world_kf if chained is None else chained
        self._graph.add_keyframe(event.keyframe_id, T_world_kf)
        self._piece_ids[event.keyframe_id] = event.piece_id
        T_graph_frontend = T_world_kf @ sim3.inverse(event.T_world_kf)
        for moved in event.moved:
            if moved.keyframe_id in self._graph:
                self._graph.move(moved.keyframe_id, T_graph_frontend @ moved.T_world_kf)

    def _add_edges(self, event: KeyframeEvent) -> bool:
        """The frontend's own measurements; whether one of them spans a long time.

        Such an edge closes a loop, and like one it may be false. Edges to keyframes that have not
        arrived (lost or late messages) wait for them.
        """
        edges, self._waiting = [*self._waiting, *event.edges], []
        again = False
        for edge in edges:
            if edge.a not in self._graph or edge.b not in self._graph:
                self._waiting.append(edge)
            else:
                long = self._graph.is_long(edge, self._config.min_gap)
                again |= long
                self._graph.add_edge(edge, robust=long)
        return again

    def _retrieve(self, event: KeyframeEvent) -> list[int]:
        """Keyframes that look similar but are not already linked."""
        self._retrieval.add(event.keyframe_id, event.descriptor)
        similar = self._retrieval.candidates(event.keyframe_id, self._graph.neighbourhood(
            event.keyframe_id, self._config.covisible_hops, self._config.min_gap))
        return [candidate.keyframe_id for candidate in similar]

    def _verify(self, newer: KeyframeEvent, older_id: int) -> AcceptedLoop | None:
        older = self._events[older_id]
        found = self._verifier.verify(newer, older, self._companions(newer, older))
        if not found.accepted:
            self._rejected[found.reason] += 1
            return None
        return AcceptedLoop(newer.keyframe_id, older.keyframe_id, found.T_older_newer,
                            found.sigma, found.matched_fraction, found.kappa)

    def _companions(self, newer: KeyframeEvent, older: KeyframeEvent) -> list[KeyframeEvent]:
        """The nearest linked keyframe of each, for parallax in the model's window."""
        pair = (newer.keyframe_id, older.keyframe_id)
        nearest = [min((k for k in self._graph.neighbours(own) if k not in pair), default=None,
                       key=lambda k: abs(k - own)) for own in reversed(pair)]
        return [self._events[k] for k in dict.fromkeys(nearest) if k is not None]

    def _close(self, loops: list[AcceptedLoop]) -> None:
        for loop in loops:
            edge = PoseEdge(loop.older, loop.newer, loop.T_older_newer, loop.sigma)
            self._graph.add_edge(edge, robust=True)
        self._loops += loops

    def _optimise(self) -> CorrectedKeyframes:
        self._graph.optimise()
        self._version += 1
        return CorrectedKeyframes(self._version, self.poses, self.pieces)
