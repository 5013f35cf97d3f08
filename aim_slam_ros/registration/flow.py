"""Predicted matches refined in the images by pyramidal Lucas-Kanade optical flow.

Matches taken from an inference's own geometry carry no information that its poses do not already
have (they agree by construction); what the images say about them does.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

WINDOW_PX = 21    # of a search
SMALL_PX = 15     # enough where the prediction is nearly right, in two thirds of the time
LEVELS = 3        # a search over the whole pyramid: reaches some 90 px
TIGHT_LEVELS = 1  # enough from a prediction that is right within some 12 px
TIGHT_ROUND_TRIP_PX = 0.5   # refuses as many covered points there as .7 after a wide search
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.02)
_ROUGHLY = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 8, 0.05)   # the way back


@dataclass(frozen=True)
class FlowMatches:
    """uv_b: [N,2] float32, where each point was found. valid: [N] bool.

    searched: how many were predicted inside the image.
    """

    uv_b: np.ndarray
    valid: np.ndarray
    searched: int


def _flow(a: np.ndarray, b: np.ndarray, uv_a: np.ndarray, uv_b: np.ndarray, levels: int,
          window_px: int, criteria: tuple[int, int, float]) -> tuple[np.ndarray, np.ndarray]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        a, b, uv_a, uv_b.copy(), winSize=(window_px, window_px), maxLevel=levels,
        criteria=criteria, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=1e-4)
    return found, status[:, 0].astype(bool)


def refine(a: np.ndarray, b: np.ndarray, uv_a: np.ndarray, uv_b_predicted: np.ndarray,
           max_move_px: float = 14.0, max_round_trip_px: float | None = 0.7,
           levels: int = LEVELS, window_px: int = WINDOW_PX) -> FlowMatches:
    """Find the points uv_a [N,2] of image a in image b ([H,W] uint8 both).

    The search starts where they are predicted. A match is valid when it stays within max_move_px
    of its prediction, inside the image, and flowing back from it returns to within
    max_round_trip_px of where it started (None: do not look). Predictions that are not finite or
    lie outside b give no match. levels: 0 searches only at full resolution. window_px: side of the
    patch.
    """
    uv_b = np.array(uv_b_predicted, np.float32)
    valid = _inside(uv_b, b)
    rows = np.flatnonzero(valid)
    if rows.size == 0:
        return FlowMatches(uv_b, valid, 0)
    start = np.ascontiguousarray(uv_a[rows], np.float32)
    found, ok = _flow(a, b, start, uv_b[rows], levels, window_px, _CRITERIA)
    ok &= np.linalg.norm(found - uv_b[rows], axis=1) <= max_move_px
    ok &= _inside(found, b)
    if max_round_trip_px is not None and ok.any():
        # After a tight search the full resolution alone, begun where it should end, tells nearly
        # the same in half the time; after a wide one it would believe too much.
        back, back_ok = _flow(b, a, found[ok], start[ok], levels if levels > TIGHT_LEVELS else 0,
                              window_px, _ROUGHLY)
        ok[ok] = back_ok & (np.linalg.norm(back - start[ok], axis=1) <= max_round_trip_px)
    valid[rows] = ok
    uv_b[rows] = found
    return FlowMatches(uv_b, valid, len(rows))


def _inside(uv: np.ndarray, image: np.ndarray) -> np.ndarray:
    with np.errstate(invalid='ignore'):
        ok: np.ndarray = (uv >= 0) & (uv <= (image.shape[1] - 1, image.shape[0] - 1))
    return np.logical_and(ok[:, 0], ok[:, 1])
