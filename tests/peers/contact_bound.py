"""How near thumb and fingertip can come to each other within the hand's speed, whatever the posture in which they meet.

In the last frame before the human pinches, a retargeter that is faithful has each joint within eps of the combined
mapping (of the interval between its last two frames, which allows a frame of lag). m frames later each joint is at most
m v dt from there and inside its limits: a box of postures. The least gap of the poles over that box bounds what any
retargeter can reach, whatever it knows and does. It is found from both sides: a local search from many starts gives a
posture of the box, and branch and bound proves that none is nearer by more than the tolerance. The tip over a box of
half widths h around c is within F(c) + J (q - c) up to 1/2 sum_ij h_i h_j L_max(i,j), with L_j the length of the finger
beyond joint j, as d2F/dq_i dq_j is a turn about i of a turn about j.

Acceleration, the other pinches and what comes after are left out, which makes the bound lower.
"""

import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

STARTS = 30
TOLERANCE = 0.1  # share of the gap found, and
RESOLUTION = 5e-4  # m, what is left between the gap found and the gap proved
MOST_BOXES = 3_000_000


class Chain:
    """A finger of the hand: joints, limits and the pole, from URDF and description."""

    def __init__(self, urdf: ElementTree.Element, description: dict, finger: str):
        own = next(own for own in description["finger"] if own["name"] == finger)
        by_child = {joint.find("child").get("link"): joint for joint in urdf.iter("joint")}
        order = description["joints"]["order"]
        self.joints = [order.index(name) for name in own["joints"]]
        self.steps, limits, link = [], [], own["pole"]
        while link in by_child:
            joint = by_child[link]
            turn = None
            if joint.get("type") != "fixed":
                turn = numbers(joint, "axis", "xyz")
                limits.append([float(joint.find("limit").get(end)) for end in ("lower", "upper")])
            self.steps.append((numbers(joint, "origin", "xyz"), rpy(*numbers(joint, "origin", "rpy")), turn))
            link = joint.find("parent").get("link")
        self.steps.reverse()
        self.lower, self.upper = np.array(limits[::-1]).T
        # Length beyond each joint, m.
        turning = [index for index, (_, _, turn) in enumerate(self.steps) if turn is not None]
        self.lengths = np.array([sum(np.linalg.norm(offset) for offset, _, _ in self.steps[i + 1 :]) for i in turning])

    def tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poles (n, 3), m, and their derivatives (n, 3, joints) at joint angles (n, joints), rad."""
        rotation, position = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        origins, axes = [], []
        for offset, fixed, turn in self.steps:
            position = position + rotation @ offset
            rotation = rotation @ fixed
            if turn is not None:
                axes.append(rotation @ turn)
                rotation = rotation @ about(turn, q[:, len(origins)])
                origins.append(position)
        columns = [np.cross(axis, position - origin) for axis, origin in zip(axes, origins)]
        return position, np.stack(columns, axis=2)

    def curvature(self, half: np.ndarray) -> np.ndarray:
        """How far the tip may be from its linear prediction within half widths (n, joints), (n,), m."""
        least = np.minimum(self.lengths[:, None], self.lengths[None, :])
        return 0.5 * np.einsum("ni,ij,nj->n", half, least, half)


def numbers(joint: ElementTree.Element, child: str, name: str) -> np.ndarray:
    return np.array([float(value) for value in joint.find(child).get(name, "0 0 0").split()])


def rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    x, y, z = (about(axis, np.array([angle]))[0] for axis, angle in zip(np.eye(3), (roll, pitch, yaw)))
    return z @ y @ x


def about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) about a unit axis by angles (n,)."""
    cross = np.cross(axis, np.eye(3)).T
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def chains(folder: Path, side: str) -> dict[str, Chain]:
    description = tomllib.loads((folder / f"allegro_v4_{side}.toml").read_text())
    urdf = ElementTree.parse(folder / f"allegro_v4_{side}.urdf").getroot()
    return {finger["name"]: Chain(urdf, description, finger["name"]) for finger in description["finger"]}


def box(path: np.ndarray, before: int, eps: float, travel: float) -> tuple[np.ndarray, np.ndarray]:
    """Where each joint can be after so much travel (rad), if in frame `before` it was within eps of `path`."""
    last = path[max(before - 1, 0) : before + 1]
    way = eps + travel
    return last.min(axis=0) - way, last.max(axis=0) + way


def least_gap(thumb: Chain, finger: Chain, low: np.ndarray, high: np.ndarray) -> tuple[float, float]:
    """The least distance of the poles over the box `low..high` of all joints of the hand: proved, and found, m."""
    low = np.concatenate([np.maximum(low[chain.joints], chain.lower) for chain in (thumb, finger)])
    high = np.concatenate([np.minimum(high[chain.joints], chain.upper) for chain in (thumb, finger)])
    found = search(thumb, finger, low, high)
    proved = (1 - TOLERANCE) * found - RESOLUTION
    while proved > 0 and not farther(thumb, finger, low, high, proved):
        proved -= TOLERANCE * found
    return max(proved, 0.0), found


def search(thumb: Chain, finger: Chain, low: np.ndarray, high: np.ndarray) -> float:
    count = len(thumb.joints)

    def squared(x: np.ndarray) -> tuple[float, np.ndarray]:
        (a, slope_a), (b, slope_b) = thumb.tip(x[None, :count]), finger.tip(x[None, count:])
        between = (a - b)[0]
        return between @ between, 2 * np.concatenate([between @ slope_a[0], -between @ slope_b[0]])

    random = np.random.default_rng(0)
    starts = low + random.random((STARTS, len(low))) * (high - low)
    options = {"ftol": 1e-15, "gtol": 1e-12}
    ends = (minimize(squared, x, jac=True, bounds=list(zip(low, high)), options=options).fun for x in starts)
    return float(np.sqrt(min(ends)))


def farther(thumb: Chain, finger: Chain, low: np.ndarray, high: np.ndarray, gap: float) -> bool:
    """Whether it is proved that no posture of the box has the poles within `gap`."""
    count, lengths = len(thumb.joints), np.concatenate([thumb.lengths, finger.lengths])
    center, half, seen = (0.5 * (low + high))[None], (0.5 * (high - low))[None], 0
    while len(center):
        seen += len(center)
        if seen > MOST_BOXES:
            return False
        (a, slope_a), (b, slope_b) = thumb.tip(center[:, :count]), finger.tip(center[:, count:])
        between = a - b
        distance = np.linalg.norm(between, axis=1)
        normal = between / np.maximum(distance, 1e-12)[:, None]
        slopes = np.concatenate([np.einsum("ni,nij->nj", normal, slope) for slope in (slope_a, slope_b)], axis=1)
        rest = thumb.curvature(half[:, :count]) + finger.curvature(half[:, count:])
        # In the direction between the centres' tips nothing of the box is nearer than this.
        open_ = distance - (np.abs(slopes) * half).sum(axis=1) - rest <= gap
        center, half = center[open_], half[open_]
        widest = np.argmax(half * lengths, axis=1)
        rows = np.arange(len(center))
        half = half.copy()
        half[rows, widest] *= 0.5
        lower, upper = center.copy(), center.copy()
        lower[rows, widest] -= half[rows, widest]
        upper[rows, widest] += half[rows, widest]
        center, half = np.concatenate([lower, upper]), np.concatenate([half, half])
    return True
