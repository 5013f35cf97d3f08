"""Keyframes that must exist but have not come: ids are given out without gaps."""

from __future__ import annotations

_LONGEST_S = 60.0


class KeyframeGaps:
    """Says when it is time to ask the frontend for all keyframes again."""

    def __init__(self, patience_s: float) -> None:
        """patience_s: how long a gap may stay open; after asking in vain, ever longer."""
        self._patience_s = patience_s
        self._first_patience_s = patience_s
        self._received: set[int] = set()
        self._count = 0
        self._open_since_s: float | None = None
        self._resending = False

    @property
    def missing(self) -> int:
        """How many are known to exist but have not come."""
        return self._count - len(self._received)

    def received(self, keyframe_id: int, better: bool = False) -> None:
        """One that is not the newest, nor better than before, comes because all are sent again."""
        self._resending |= keyframe_id < self._count - 1 and not better
        self._received.add(keyframe_id)
        self.exists(keyframe_id)

    def exists(self, keyframe_id: int) -> None:
        """It was mentioned, by another keyframe or by a frame that was tracked against it."""
        self._count = max(self._count, keyframe_id + 1)

    def overdue(self, now_s: float) -> bool:
        """Whether a gap has been open for too long; once True, it waits anew and twice as long."""
        if not self.missing:
            self._open_since_s, self._patience_s = None, self._first_patience_s
            return False
        if self._open_since_s is None or self._resending:
            self._open_since_s, self._resending = now_s, False
        if now_s - self._open_since_s < self._patience_s:
            return False
        self._open_since_s = now_s
        self._patience_s = min(2 * self._patience_s, max(_LONGEST_S, self._first_patience_s))
        return True
