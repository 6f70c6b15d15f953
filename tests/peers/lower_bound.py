"""What no retargeter can do on a recording, however clever it is and even if it knows the future: linear programs.

A hand cannot both copy a fast, noisy human and move smoothly. This asks how much of each is possible at all, over *all*
joint paths x of a recording's frames, and prints Markdown tables.

1. Smoothness. The least mean |x[t+1] - 2 x[t] + x[t-1]| of a path that stays within eps of the given one, joint by
   joint and frame by frame; of one that may be anywhere with the joints of thumb and pinching finger in the frames in
   which the human pinches, which allows any posture of contact and any gap; and of one that is exactly on the given
   path there.
2. Causal smoothness. The same if x[t] is a weighted mean of the last 15 frames (half a second) of the given path, the
   weights, of either sign, of each joint the best ones for this very recording: what a causal linear filter could do at
   best. "Exact in the pinches": there it steps aside.
3. Limits. The least eps with which a path exists that obeys the hand's speed and acceleration, stays within eps of the
   combined mapping's in every frame, and in the frames in which the human pinches is exactly on it with the joints of
   thumb and pinching finger.
4. Contact within the limits. The least gap in the frames in which the human pinches, in any posture, from within eps of
   the combined mapping in the last frame before: contact_bound.py.

Lag is allowed as stated: with a lag of up to one frame, x[t] need only be within eps of the interval between the path's
x[t-1] and x[t], which every constant or changing delay of up to a frame fulfils. Speed and acceleration bound the path
between frames too; only what they imply for the frames themselves is asked for, |x[t+1] - x[t]| <= v dt and
|x[t+1] - 2 x[t] + x[t-1]| <= a dt^2. Both make the bounds lower, so that they hold for every retargeter.

Proved is: no path that is that faithful in joint space is smoother (1), no causal linear filter of the last 15 frames
is (2), none keeps to the limits and to the mapping's own postures of contact (3), none brings the tips nearer (4). Not
proved is anything about paths that are faithful in another sense, nor, by 2, about filters that are not linear: our own
is not. The joint limits are left out of 1 to 3, which makes the bounds lower again.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csr_array, eye_array, hstack, vstack

import contact_bound

URDF = Path(__file__).resolve().parents[2] / "urdf"
TOLERANCES = (0.05, 0.1, 0.2)  # rad
FILTER_TOLERANCES = (0.1, 0.2, 0.4, 0.8)  # rad
TAPS = 15  # frames
REACH_TOLERANCES = (0.0, 0.05, 0.1)  # rad
SPEED, ACCELERATION = 7.0, 300.0  # of the Allegro's joints, rad/s and rad/s^2
TIPS = {"thumb": 4, "index": 8, "middle": 12, "ring": 16}  # of the 21 keypoints


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--recording", type=Path, required=True)
    parser.add_argument("--hand", choices=("right", "left"), required=True)
    parser.add_argument("--robot", type=Path, required=True)
    parser.add_argument("--pinch", type=float, required=True, help="mm")
    parser.add_argument("robot_options", nargs="*")
    arguments = parser.parse_args()
    table = np.loadtxt(arguments.recording, delimiter=",", skiprows=1)
    dt = float(np.median(np.diff(table[:, 1])))
    pinched = pinches(table[:, 2:].reshape(-1, 21, 3), 1e-3 * arguments.pinch, arguments.hand)
    measured, _ = retarget(arguments, "--mode", "joint", "--filter", "off")
    combined, tips = retarget(arguments)
    if not len(measured) == len(combined) == len(table):
        sys.exit(f"error: {arguments.robot} gives {len(combined)} frames for {len(table)}")

    print(f"`{arguments.recording.name}`, {len(table)} frames at {1 / dt:.3g} Hz. Least mean second difference, mrad:\n")
    row("within eps of", "lag, frames", "eps 0 (the path)", *(f"eps {eps} rad" for eps in TOLERANCES))
    row(*["---"] * (3 + len(TOLERANCES)))
    nowhere = np.zeros_like(pinched)
    for name, path, exact, loose in (
        ("joint mapping, unfiltered", measured, nowhere, nowhere),
        ("combined mapping", combined, nowhere, nowhere),
        ("combined mapping, anything in the pinches", combined, nowhere, pinched),
        ("combined mapping, exact in the pinches", combined, pinched, nowhere),
    ):
        for lag in (0, 1):
            own = [f"{1e3 * np.abs(np.diff(path, n=2, axis=0)).mean():.1f}"] if lag == 0 else [""]
            bounds = (smoothest(path, exact, eps, lag, loose=loose) for eps in TOLERANCES)
            row(name, lag, *own, *(f"{1e3 * bound:.1f}" for bound in bounds))

    print(f"\nThe same of the best causal filter of the last {TAPS} frames, mrad:\n")
    row("filter of, and within eps of", "lag, frames", *(f"eps {eps} rad" for eps in FILTER_TOLERANCES))
    row(*["---"] * (2 + len(FILTER_TOLERANCES)))
    for name, path, exact in (
        ("joint mapping, unfiltered", measured, nowhere),
        ("combined mapping", combined, nowhere),
        ("combined mapping, exact in the pinches", combined, pinched),
    ):
        for lag in (0, 1):
            bounds = (smoothest(path, exact, eps, lag, taps=TAPS) for eps in FILTER_TOLERANCES)
            row(name, lag, *(f"{1e3 * bound:.1f}" for bound in bounds))

    frames = int(pinched.any(axis=1).sum())
    print(f"\nLeast eps within {SPEED:g} rad/s and {ACCELERATION:g} rad/s^2, rad; the human pinches in {frames} frames:\n")
    row("within eps of the combined mapping, lag, frames", "in no frame exact", "exact in the pinches")
    row(*["---"] * 3)
    for lag in (0, 1):
        found = [nearest(combined, exact, dt, lag) for exact in (nowhere, pinched)]
        row(lag, *("impossible" if error is None else f"{error:.2f}" for error in found))

    print(f"\nMean gap in the pinches within {SPEED:g} rad/s, any posture, a frame of lag, mm:\n")
    row("within eps of the combined mapping before, rad", "finger", "frames", "proved at least", "found")
    row(*["---"] * 5)
    chains = contact_bound.chains(URDF, arguments.hand)
    for finger, chain in chains.items():
        off = np.abs(chain.tip(combined[:, chain.joints])[0] - tips[finger]).max()
        if not off < 1e-9:
            sys.exit(f"error: the {finger}'s tips are {off:.3g} m from those that {arguments.robot} gives")
    for finger in ("index", "middle", "ring"):
        here = pinched[:, chains[finger].joints].all(axis=1)
        for eps in REACH_TOLERANCES if here.any() else ():
            gaps = np.array([contact(chains, combined, here, frame, finger, eps, dt) for frame in np.flatnonzero(here)])
            row(eps, finger, len(gaps), *(f"{1e3 * gap:.1f}" for gap in gaps.mean(axis=0)))


def contact(chains: dict, path: np.ndarray, here: np.ndarray, frame: int, finger: str, eps: float, dt: float):
    """The least gap in a frame of a pinch, proved and found, m; a pinch at the very start is not bounded."""
    before = frame
    while before >= 0 and here[before]:
        before -= 1
    if before < 0:
        return 0.0, 0.0
    low, high = contact_bound.box(path, before, eps, SPEED * dt * (frame - before))
    return contact_bound.least_gap(chains["thumb"], chains[finger], low, high)


def row(*cells) -> None:
    print(f"| {' | '.join(map(str, cells))} |")


def retarget(arguments: argparse.Namespace, *more: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Joint angles (frames, joints), rad, and each finger's pole (frames, 3), m, by `robot retarget`."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "frames.jsonl"
        command = [arguments.robot, "retarget", "--hand", arguments.hand, "--input", arguments.recording]
        command += ["--output", output, *more, *arguments.robot_options]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f"error: {' '.join(map(str, command))}\n{done.stderr.strip()}")
        rows = [json.loads(line) for line in output.read_text().splitlines()]
        tips = {finger: np.array([row["p"][finger] for row in rows]) for finger in rows[0]["p"]}
        return np.array([row["q"] for row in rows]), tips


def pinches(human: np.ndarray, threshold: float, side: str) -> np.ndarray:
    """Whether a joint takes part in a pinch, (frames, joints), of keypoints (frames, 21, 3), m."""
    description = tomllib.loads((URDF / f"allegro_v4_{side}.toml").read_text())
    order = description["joints"]["order"]
    of = {finger["name"]: [order.index(joint) for joint in finger["joints"]] for finger in description["finger"]}
    out = np.zeros((len(human), len(order)), dtype=bool)
    for finger in ("index", "middle", "ring"):
        close = np.linalg.norm(human[:, TIPS[finger]] - human[:, TIPS["thumb"]], axis=1) < threshold
        out[np.ix_(close, of["thumb"] + of[finger])] = True
    return out


def band(path: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest value of one joint's path (frames,) from each frame back to `lag` frames before."""
    before = shifted(path, lag + 1)
    return before.min(axis=1), before.max(axis=1)


def shifted(path: np.ndarray, count: int) -> np.ndarray:
    """One joint's path (frames,) and what it was 1 to `count` - 1 frames before, (frames, count)."""
    before = [np.concatenate([np.full(shift, path[0]), path[: len(path) - shift]]) for shift in range(count)]
    return np.stack(before, axis=1)


def difference(frames: int, order: int) -> csr_array:
    """The matrix of the first or second difference."""
    rows = frames - order
    weights = {1: (-1.0, 1.0), 2: (1.0, -2.0, 1.0)}[order]
    return csr_array(sum(weight * eye_array(rows, frames, k=shift) for shift, weight in enumerate(weights)))


def smoothest(
    path: np.ndarray, exact: np.ndarray, eps: float, lag: int, loose: np.ndarray | None = None, taps: int = 0
) -> float:
    """The least mean second difference, rad, within `eps` of `path`, on it where `exact`, anywhere where `loose` (all of
    them (frames, joints)); with `taps`, of what a weighted sum of so many last frames makes of it."""
    frames, joints = path.shape
    second = difference(frames, 2)
    count = second.shape[0]
    total = 0.0
    for joint in range(joints):
        low, high = band(path[:, joint], lag)
        low, high = low - eps, high + eps
        if loose is not None:
            low, high = np.where(loose[:, joint], -np.inf, low), np.where(loose[:, joint], np.inf, high)
        own = exact[:, joint]
        # x = base variables + fixed, and sum(s) is minimised with -s <= D x <= s.
        if taps:
            base, fixed = shifted(path[:, joint], taps), np.where(own, path[:, joint], 0.0)
            base[own] = 0.0
            base = csr_array(base)
            low, high = np.where(own, -np.inf, low), np.where(own, np.inf, high)
            ranges, sides = np.tile([-np.inf, np.inf], (taps, 1)), [(base, high), (-base, -low)]
        else:
            base, fixed = eye_array(frames), np.zeros(frames)
            low, high = np.where(own, path[:, joint], low), np.where(own, path[:, joint], high)
            ranges, sides = np.column_stack([low, high]), []
        bend, offset = second @ base, second @ fixed
        rows = [hstack([bend, -eye_array(count)]), hstack([-bend, -eye_array(count)])]
        right = [-offset, offset]
        for side, limit in sides:
            kept = np.isfinite(limit)
            rows.append(hstack([csr_array(side)[kept], csr_array((int(kept.sum()), count))]))
            right.append(limit[kept])
        if taps:
            # A hand at rest is copied: the weights add up to 1.
            rows += [csr_array(np.append(np.full(taps, sign), np.zeros(count))[None]) for sign in (1.0, -1.0)]
            right += [[1.0], [-1.0]]
        ranges = np.concatenate([ranges, np.tile([0.0, np.inf], (count, 1))])
        cost = np.concatenate([np.zeros(base.shape[1]), np.ones(count)])
        found = solve(cost, vstack(rows), np.concatenate(right), ranges)
        if found is None:
            return np.nan
        total += found.fun
    return total / (count * joints)


def nearest(path: np.ndarray, exact: np.ndarray, dt: float, lag: int) -> float | None:
    """The least error, rad, of a path within the hand's limits that is exactly on `path` where `exact` (both (frames,
    joints)); None if there is no such path at all."""
    frames, joints = path.shape
    first, second = difference(frames, 1), difference(frames, 2)
    limits = [(first, SPEED * dt), (-first, SPEED * dt), (second, ACCELERATION * dt**2), (-second, ACCELERATION * dt**2)]
    worst = 0.0
    for joint in range(joints):
        low, high = band(path[:, joint], lag)
        own = exact[:, joint]
        # Minimise e with low - e <= x <= high + e, and x on the path where it is to be exact, whatever the lag.
        loose = csr_array(np.ones((frames, 1)))
        sides = [hstack([eye_array(frames), -loose]), hstack([-eye_array(frames), -loose])]
        matrix = vstack([hstack([part, csr_array((part.shape[0], 1))]) for part, _ in limits] + sides)
        right = np.concatenate([np.full(part.shape[0], limit) for part, limit in limits] + [high, -low])
        bounds = [np.append(np.where(own, path[:, joint], free), end) for free, end in ((-np.inf, 0.0), (np.inf, np.inf))]
        found = solve(np.append(np.zeros(frames), 1.0), matrix, right, np.column_stack(bounds))
        if found is None:
            return None
        worst = max(worst, found.fun)
    return worst


def solve(cost: np.ndarray, matrix: csr_array, right: np.ndarray, bounds: np.ndarray):
    """The solution of min cost x, matrix x <= right; None if nothing fulfils that."""
    found = linprog(cost, A_ub=csr_array(matrix), b_ub=right, bounds=bounds, method="highs")
    if found.status == 2:
        return None
    if found.status != 0:
        sys.exit(f"error: HiGHS: {found.message}")
    return found


if __name__ == "__main__":
    main()
