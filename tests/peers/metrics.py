"""What is measured of a trajectory. README.md has the definitions."""

import numpy as np

from hand import FINGERS, WRIST, Hand

RADIUS = 0.012  # m, of the robot's spherical fingertips
OVERLAP = 0.001  # m, of two fingertips
AT_LIMIT = 1e-2  # rad from a limit
LAGS = range(-5, 16)  # frames
KEYPOINTS = {"wrist": 0, "thumb": 4, "index": 8, "middle": 12, "ring": 16}


def human_distance(human: np.ndarray, finger: str) -> np.ndarray:
    """From thumb tip to fingertip, (frames,), m, of keypoints (frames, 21, 3)."""
    return np.linalg.norm(human[:, KEYPOINTS[finger]] - human[:, KEYPOINTS["thumb"]], axis=1)


def gaps(distance: np.ndarray, pinched: np.ndarray) -> dict:
    """mm, while the human pinches."""
    chosen = 1e3 * distance[pinched]
    if len(chosen) == 0:
        return {"frames": 0, "mean_mm": None, "p95_mm": None}
    return {"frames": len(chosen), "mean_mm": chosen.mean(), "p95_mm": np.percentile(chosen, 95)}


def human_pinches(human: np.ndarray, pinch: float) -> dict:
    distances = {finger: human_distance(human, finger) for finger in FINGERS[1:]}
    return {finger: gaps(distance, distance < pinch) for finger, distance in distances.items()}


def measure(hand: Hand, human: np.ndarray, times: np.ndarray, q: np.ndarray, pinch: float) -> dict:
    """All figures of the trajectory q (frames, 16) for the keypoints (frames, 21, 3) at times (frames,), s; the human
    pinches where keypoints of fingertips are closer than `pinch`, m."""
    poles, centers = hand.tips(q)
    human_by_finger = {finger: human_distance(human, finger) for finger in FINGERS[1:]}
    robot_by_finger = {
        finger: np.linalg.norm(poles[:, i] - poles[:, 0], axis=1) for i, finger in enumerate(FINGERS) if i > 0
    }
    step = np.abs(np.diff(q, axis=0))
    outside = np.maximum(np.maximum(hand.lower - q, q - hand.upper), 0.0)
    near = (q <= hand.lower + AT_LIMIT) | (q >= hand.upper - AT_LIMIT)
    between = [np.linalg.norm(centers[:, i] - centers[:, j], axis=1) for i in range(4) for j in range(i)]
    overlap = 2 * RADIUS - np.array(between)
    pinch_gap, correlation, lag = {}, {}, {}
    for finger, theirs in human_by_finger.items():
        pinch_gap[finger] = gaps(robot_by_finger[finger], theirs < pinch)
        by_lag = {shift: correlate(theirs, robot_by_finger[finger], shift) for shift in LAGS}
        correlation[finger] = by_lag[0]
        lag[finger] = max(by_lag, key=by_lag.get)
    return {
        "pinch_gap": pinch_gap,
        "correlation": correlation,
        "lag_frames": lag,
        "mean_second_difference_mrad": 1e3 * np.abs(np.diff(q, n=2, axis=0)).mean(),
        "max_step_rad": step.max(),
        "max_speed_rad_s": (step / np.diff(times)[:, None]).max(),
        "worst_limit_violation_rad": outside.max(),
        "joint_frames_at_limit_percent": 100 * near.mean(),
        "tip_direction_error_deg": {
            finger: direction_error(human[:, KEYPOINTS[finger]] - human[:, 0], poles[:, i] - WRIST)
            for i, finger in enumerate(FINGERS)
        },
        "tips_overlap_frames": int((overlap.max(axis=0) > OVERLAP).sum()),
        "worst_tip_overlap_mm": max(0.0, 1e3 * overlap.max()),
    }


def correlate(human: np.ndarray, robot: np.ndarray, shift: int) -> float:
    """Pearson's coefficient of the human with the robot `shift` frames later."""
    n = len(human) - abs(shift)
    a, b = human[max(0, -shift) :][:n], robot[max(0, shift) :][:n]
    if n < 2 or a.std() == 0 or b.std() == 0:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def direction_error(a: np.ndarray, b: np.ndarray) -> float:
    """Mean angle, deg, between vectors (frames, 3)."""
    cosine = (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
